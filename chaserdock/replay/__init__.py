"""Replay of recorded inputs through current code, and comparison of messages field by field."""
