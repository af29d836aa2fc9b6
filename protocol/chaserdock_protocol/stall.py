# SPDX-License-Identifier: Apache-2.0
"""Limits of waiting: how long a mission may make no progress, and the time waited so far."""

from __future__ import annotations

from collections.abc import Callable

DEFAULT_STALL_S = 60.0
"""Time (s) without progress after which a lock-step mission ends, and without the world after which
a process ends.
"""
_LONGEST_STEP_S = 0.5
"""Most that one step counts, s: callers update at least twice a second, so that a longer step is
one in which the process, or the machine, stood still."""


class StallTimer:
    """Time (s) that a loop has waited in vain. A time in which the process did not run counts as
    one short step.
    """

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s, self._last_s = now_s, now_s()
        self.waited_s = 0.0

    def reset(self) -> None:
        """Restart the count: what the loop waits for has come."""
        self.waited_s = 0.0

    def update(self) -> float:
        """Count the time since the last call, which is to be made at least twice a second; return
        the waited time.
        """
        now_s = self._now_s()
        self.waited_s += min(now_s - self._last_s, _LONGEST_STEP_S)
        self._last_s = now_s
        return self.waited_s
