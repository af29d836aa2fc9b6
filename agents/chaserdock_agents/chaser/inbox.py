# SPDX-License-Identifier: Apache-2.0
"""Keep what a chaser knows of the open tick and of its own state. No I/O."""

from __future__ import annotations

import msgspec
from chaserdock_protocol.extrapolation import extrapolate
from chaserdock_protocol.fault_injection import LostMessage
from chaserdock_protocol.messages import DockingStatus, Odometry, Tick


class ChaserInbox:
    """Keeps the newest tick, odometry and docking status, in whatever order they arrive.

    ``odometry`` and ``docking`` may be assumed where the message of a tick was lost; ``measured``
    is the newest odometry that has arrived, at ``arrived_s`` by the host's clock. Methods return
    False for a message that changes nothing, as a newer one is known.
    """

    def __init__(self) -> None:
        self.tick: Tick | None = None
        self.odometry: Odometry | None = None
        self.measured: Odometry | None = None
        self.arrived_s = 0.0
        self.docking: DockingStatus | None = None
        self._docking_tick = -1

    @property
    def latched(self) -> bool:
        """Return whether the docking sensor last reported a closed latch."""
        return self.docking is not None and self.docking.latched

    def is_outdated(self, tick: Tick) -> bool:
        """Return whether a newer tick, or a later revision of the same, has arrived before."""
        known = self.tick
        return known is not None and (tick.tick, tick.revision) < (known.tick, known.revision)

    def add_odometry(self, odometry: Odometry, arrived_s: float) -> bool:
        """Take measured odometry."""
        if self.measured is None or odometry.tick > self.measured.tick:
            self.measured, self.arrived_s = odometry, arrived_s
        return self._update_odometry(odometry)

    def extrapolate_odometry(self, lost: LostMessage) -> bool:
        """Assume that the chaser has moved on since the last odometry, which must be known."""
        assert self.odometry is not None
        return self._update_odometry(extrapolate(self.odometry, lost.tick, lost.sim_time_ns))

    def _update_odometry(self, odometry: Odometry) -> bool:
        if self.odometry is not None and odometry.tick < self.odometry.tick:
            return False
        self.odometry = odometry
        return True

    def odometry_age_ns(self, time_ns: int) -> int:
        """Return for how long no odometry has been measured; since the mission's begin if never."""
        return time_ns - (0 if self.measured is None else self.measured.sim_time_ns)

    def time_ns(self, now_s: float | None) -> int:
        """Return the simulated time, which in real time continues while nothing arrives.

        ``now_s``: the host's clock; None in lock-step.
        """
        if self.odometry is None:
            return 0
        silent_s = 0.0 if now_s is None else now_s - self.arrived_s
        return self.odometry.sim_time_ns + round(max(0.0, silent_s) * 1e9)

    def add_docking(self, docking: DockingStatus) -> bool:
        """Take a status of the docking sensor."""
        if docking.tick <= self._docking_tick:
            return False
        self._docking_tick = docking.tick
        if self.docking is not None and self.docking.tick > docking.tick:
            # It belongs to a tick for which an older status was assumed: apply it to the newest
            # tick.
            docking = _assumed(docking, self.docking.tick, self.docking.sim_time_ns)
        self.docking = docking
        return True

    def assume_docking(self, lost: LostMessage, chaser: int) -> bool:
        """Assume that the docking sensor reports what it last did, without contact."""
        if self.docking is not None and lost.tick <= self.docking.tick:
            return False
        last = self.docking or DockingStatus(
            chaser=chaser, contact=False, armed=False, latched=False
        )
        self.docking = _assumed(last, lost.tick, lost.sim_time_ns)
        return True


def _assumed(last: DockingStatus, tick: int, time_ns: int) -> DockingStatus:
    return msgspec.structs.replace(last, tick=tick, sim_time_ns=time_ns, contact=False)
