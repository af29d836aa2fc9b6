"""Exit statuses, the same for every verb (docs/cli.md)."""

from __future__ import annotations

DONE = 0
"""What was asked was done, and what was judged is good."""
FAILED = 1
"""It was done, and the answer is no: a mission that failed, logs that differ, a protocol that is not kept."""
BAD_INPUT = 2
"""Nothing could be done: bad input, nobody there, a file that cannot be read or written."""
STOPPED = 130
"""Stopped before the end by Ctrl-C or SIGTERM (128 + SIGINT, as shells have it)."""
