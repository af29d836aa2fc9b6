"""A probe's latch: what it has been told, and what it makes of a touch. No physics in here."""

from __future__ import annotations

import heapq
from dataclasses import dataclass, field

from chaserdock_models.docking_geometry import PortView
from chaserdock_protocol.messages import Latch, ProbeTouch
from chaserdock_protocol.scenario.docking import Port, Tolerances

_APART_S = 0.02
"""So long without a touch, and the next one is a new one."""


@dataclass
class ProbeLatch:
    """The latch of one chaser's probe. Steps are physics steps; ``touches`` and ``touched`` collect until taken."""

    chaser: int
    port: Port
    tolerances: Tolerances
    physics_hz: int
    armed: bool = False
    latched: bool = False
    touched: bool = False
    touches: list[ProbeTouch] = field(default_factory=list)
    _last_touch_step: int | None = None
    _due: list[tuple[int, int, Latch]] = field(default_factory=list)
    _told: int = 0

    def command(self, told: Latch, effective_step: int) -> None:
        """Notes what the latch is to do from ``effective_step`` on."""
        if told != "keep":
            self._told += 1
            heapq.heappush(self._due, (effective_step, self._told, told))

    def obey(self, step: int) -> bool:
        """Takes up the commands that are due; True when the latch opens."""
        opens = False
        while self._due and self._due[0][0] <= step:
            self.armed = heapq.heappop(self._due)[2] == "arm"
            opens = self.latched and not self.armed
        if opens:
            self.latched = False
            self._last_touch_step = step  # it still touches
        return opens

    def touch(self, step: int, before: PortView) -> bool:
        """The tip touches in the step from ``step`` on; ``before`` is the state at its beginning. True: it closes.

        A touch is judged once, when it begins: in the middle of a bounce the tip stands still, too.
        """
        self.touched = True
        last, self._last_touch_step = self._last_touch_step, step
        if self.latched or (last is not None and step - last <= _APART_S * self.physics_hz):
            return False
        refused = "" if self.armed else "not armed"
        refused = refused or before.fault(self.tolerances, self.tolerances.closing_m_s)
        self.latched = not refused
        self.touches.append(
            ProbeTouch(
                chaser=self.chaser,
                sim_time_ns=step * 1_000_000_000 // self.physics_hz,
                lateral_m=before.lateral_m,
                angle_rad=before.angle_rad,
                closing_m_s=before.closing_m_s,
                lateral_speed_m_s=before.lateral_speed_m_s,
                latched=self.latched,
                refused=refused,
            )
        )
        return self.latched

    def take(self) -> tuple[ProbeTouch, ...]:
        """The touches that began since the last call; ``touched`` begins anew."""
        taken = tuple(self.touches)
        self.touches.clear()
        self.touched = False
        return taken
