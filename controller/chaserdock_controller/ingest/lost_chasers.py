# SPDX-License-Identifier: Apache-2.0
"""Chasers whose odometry is missing. No I/O.

A lost chaser is assumed to coast, as one does whose process has stopped. The margin that others
keep grows with the time since its last odometry; it also covers a chaser that brakes for a while by
its fallback. After ``FORGOTTEN_S`` its position counts as unknown, and it is no obstacle any more.
"""

from __future__ import annotations

from dataclasses import dataclass

from chaserdock_protocol.messages import Level, Odometry

ABSENT_S = 0.3
"""A chaser without odometry for this long is lost."""
FORGOTTEN_S = 60.0
"""Time, s, after which a lost chaser is no obstacle any more. Larger: others avoid places that it
has long left; smaller: they may meet it while its coast is still a good prediction.
"""
FIRST_M, GROWTH_M_S, MOST_M = 0.02, 0.01, 0.3
"""Margin around a lost chaser: initial (m), growth by the error of its last velocity and by
disturbances (m/s), and largest (m).
"""


def margin_m(lost_s: float) -> float:
    """Return the margin (m) added to the distance from a chaser without odometry for ``lost_s``."""
    return min(MOST_M, FIRST_M + GROWTH_M_S * max(0.0, lost_s))


@dataclass
class LossWatch:
    """Tracks whether one chaser is lost. ``last``: its last odometry. ``reported``: it was reported
    as lost.
    """

    chaser: int
    last: Odometry | None = None
    reported: bool = False

    def is_absent(self, now_ns: int) -> bool:
        """Return whether the last odometry is at least ``ABSENT_S`` old."""
        return self.last is not None and (now_ns - self.last.sim_time_ns) / 1e9 >= ABSENT_S

    def obstacle(self, now_ns: int) -> Odometry | None:
        """Return the last odometry of a lost chaser while it is an obstacle, else None."""
        if self.last is None or not self.is_absent(now_ns):
            return None
        return self.last if (now_ns - self.last.sim_time_ns) / 1e9 <= FORGOTTEN_S else None

    def update(self, odometry: Odometry | None, now_ns: int) -> tuple[Level, str] | None:
        """Process a tick's odometry, if any. Returns an event when the chaser is lost, found or
        forgotten.
        """
        self.last = odometry or self.last
        before, self.reported = self.reported, self.obstacle(now_ns) is not None
        if self.reported == before:
            return None
        who = f"chaser {self.chaser}"
        if self.reported:
            return "warning", f"{who}: lost; the others avoid its extrapolated position"
        if odometry is not None:
            return "info", f"{who}: odometry received again"
        return "warning", f"{who}: no odometry for {FORGOTTEN_S:g} s; it is no obstacle any more"
