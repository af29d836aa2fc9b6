"""Processes of a mission besides world and controller: chasers, recorder, router."""
