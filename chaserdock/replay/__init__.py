"""Recorded inputs through today's code, and two sets of messages compared field by field."""
