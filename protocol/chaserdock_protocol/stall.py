# SPDX-License-Identifier: Apache-2.0
"""Limit how long a mission waits without progress."""

from __future__ import annotations

from collections.abc import Callable

DEFAULT_STALL_S = 60.0
"""Time (s) without progress after which a lock-step mission ends, and without the world after which
a process ends.
"""
SHORTEST_STALL_S = 1.0
"""Least time (s) that may be set for it: a slow tick of a busy machine takes as long."""
_LONGEST_STEP_S = 0.5
"""Most that one step of waiting counts, s. Callers update at least twice a second; in a longer step
the process, or the machine, stood still.
"""


class StallTimer:
    """Measure the time (s) that a loop has waited in vain.

    A time in which the process did not run counts as one short step.
    """

    def __init__(self, now_s: Callable[[], float]) -> None:
        self._now_s, self._last_s = now_s, now_s()
        self.waited_s = 0.0

    def reset(self) -> None:
        """Restart the count, as what the loop waits for has come."""
        self.waited_s = 0.0

    def update(self) -> float:
        """Add the time since the last call and return the waited time, s. Call it at least twice a
        second.
        """
        now_s = self._now_s()
        self.waited_s += min(now_s - self._last_s, _LONGEST_STEP_S)
        self._last_s = now_s
        return self.waited_s
