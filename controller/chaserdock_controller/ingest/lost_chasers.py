# SPDX-License-Identifier: Apache-2.0
"""Chasers without odometry for a while. No I/O.

They are taken to coast, as a chaser does whose process has stopped. The margin that other chasers
keep grows with the time since the last odometry; it covers a chaser that brakes by its fallback for
a while. After ``FORGOTTEN_S`` the position is unknown, and the chaser is no obstacle any more.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from chaserdock_protocol.messages import Level, Odometry

ABSENT_S = 0.3
"""A chaser without odometry for this long is lost."""
FORGOTTEN_S = 60.0
FIRST_M, GROWTH_M_S, MOST_M = 0.02, 0.01, 0.3


def margin_m(lost_s: float) -> float:
    """Return the margin added to the distance from a chaser without odometry for ``lost_s``."""
    return min(MOST_M, FIRST_M + GROWTH_M_S * max(0.0, lost_s))


@dataclass
class LostChasers:
    """The last odometry of every chaser; ``reported``: chasers that were reported as lost."""

    last: dict[int, Odometry] = field(default_factory=dict)
    reported: set[int] = field(default_factory=set)

    def update(self, odometry: Mapping[int, Odometry], now_ns: int) -> list[tuple[Level, str]]:
        """Add a tick's odometry; return the events of chasers that were lost or came back."""
        self.last.update(odometry)
        lost = self.obstacles(now_ns)
        events: list[tuple[Level, str]] = []
        for i in sorted(self.reported - lost.keys()):
            if i in odometry:
                events.append(("info", f"chaser {i}: odometry received again"))
            else:
                text = f"chaser {i}: no odometry for {FORGOTTEN_S:g} s; it is no obstacle any more"
                events.append(("warning", text))
        for i in sorted(lost.keys() - self.reported):
            events.append(
                ("warning", f"chaser {i}: lost; the others avoid its extrapolated position")
            )
        self.reported = set(lost)
        return events

    def absent(self, now_ns: int) -> frozenset[int]:
        """Return the chasers whose last odometry is ``ABSENT_S`` old or older."""
        return frozenset(
            i for i, o in self.last.items() if (now_ns - o.sim_time_ns) / 1e9 >= ABSENT_S
        )

    def obstacles(self, now_ns: int) -> dict[int, Odometry]:
        """Return the last odometry of the lost chasers that are obstacles."""
        absent = {i: self.last[i] for i in sorted(self.absent(now_ns))}
        return {i: o for i, o in absent.items() if (now_ns - o.sim_time_ns) / 1e9 <= FORGOTTEN_S}
