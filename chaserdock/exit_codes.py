# SPDX-License-Identifier: Apache-2.0
"""Exit statuses, the same for every command (docs/cli.md)."""

from __future__ import annotations

DONE = 0
"""The command did what it was asked to, and the verdict, if any, is good."""
FAILED = 1
"""The command ran, and the verdict is bad: a failed mission, logs that differ, a protocol
violation.
"""
BAD_INPUT = 2
"""The command could not run: invalid input, no reply, a file that cannot be read or written."""
STOPPED = 130
"""Stopped before the end by Ctrl-C or SIGTERM (128 + SIGINT, the convention of shells). `view` and
`router` have no other end.
"""
