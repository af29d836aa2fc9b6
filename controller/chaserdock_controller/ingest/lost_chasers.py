# SPDX-License-Identifier: Apache-2.0
"""Chasers without odometry for a while. No I/O.

They are taken to coast, as a chaser does whose process has stopped. The margin that other chasers
keep grows with the time since the last odometry; it covers a chaser that brakes by its fallback for
a while. After ``FORGOTTEN_S`` the position is unknown, and the chaser is no obstacle any more.
"""

from __future__ import annotations

from dataclasses import dataclass

from chaserdock_protocol.messages import Level, Odometry

ABSENT_S = 0.3
"""A chaser without odometry for this long is lost."""
FORGOTTEN_S = 60.0
"""Time, s, after which the coast of a lost chaser says nothing about its place any more. Chosen."""
FIRST_M, GROWTH_M_S, MOST_M = 0.02, 0.01, 0.3
"""Margin around a lost chaser: at first (m), its growth (m/s) by the error of its last velocity and
by disturbances, and at most (m).
"""


def margin_m(lost_s: float) -> float:
    """Return the margin added to the distance from a chaser without odometry for ``lost_s``."""
    return min(MOST_M, FIRST_M + GROWTH_M_S * max(0.0, lost_s))


@dataclass
class LossWatch:
    """Follows whether one chaser is lost: its ``last`` odometry, and whether it was ``reported`` as
    lost.
    """

    chaser: int
    last: Odometry | None = None
    reported: bool = False

    def is_absent(self, now_ns: int) -> bool:
        """Return whether the last odometry is ``ABSENT_S`` old or older."""
        return self.last is not None and (now_ns - self.last.sim_time_ns) / 1e9 >= ABSENT_S

    def obstacle(self, now_ns: int) -> Odometry | None:
        """Return the last odometry of a lost chaser that is an obstacle."""
        if self.last is None or not self.is_absent(now_ns):
            return None
        return self.last if (now_ns - self.last.sim_time_ns) / 1e9 <= FORGOTTEN_S else None

    def update(self, odometry: Odometry | None, now_ns: int) -> tuple[Level, str] | None:
        """Take the odometry of a tick, if there is any; return an event if the chaser was lost,
        came back or is forgotten.
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
