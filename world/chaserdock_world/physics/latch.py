# SPDX-License-Identifier: Apache-2.0
"""Decide when a probe's latch closes and opens: commands, faults, touches. Contains no physics."""

from __future__ import annotations

import heapq
import math
from dataclasses import dataclass, field

from chaserdock_models.docking_geometry import PortView
from chaserdock_protocol.messages import Latch, ProbeTouch
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.docking import Port, Tolerances
from chaserdock_protocol.scenario.faults import LATCH_FAULTS

from .compliant_latch import Grip

_NEW_TOUCH_AFTER_S = 0.02
"""Time, s, without contact after which a contact is a new touch."""


@dataclass(frozen=True)
class LatchFault:
    """A fault of a latch from physics step ``begin`` to before ``end``.

    ``grip``: of a latch that slips.
    """

    kind: str
    begin: int
    end: int
    grip: Grip = field(default_factory=Grip)


def capture_ports(scenario: Scenario) -> tuple[Port, ...]:
    """Return the ports at which chasers latch; none for docking at a distance."""
    return scenario.docking.ports if scenario.docking.kind == "capture" else ()


def latch_faults(scenario: Scenario, chaser: int) -> tuple[LatchFault, ...]:
    """Return the faults of a chaser's latch."""
    timing, faults = scenario.timing, []
    for fault in scenario.fault:
        if fault.kind in LATCH_FAULTS and fault.process == f"chaser/{chaser}":
            begin, end = (timing.step_of_tick(tick) for tick in fault.ticks(timing.rate_hz))
            limits = (x if x is not None else math.inf for x in (fault.force_N, fault.torque_N_m))
            faults.append(LatchFault(fault.kind, begin, end, Grip(*limits)))
    return tuple(faults)


@dataclass
class ProbeLatch:
    """The latch of one chaser's probe. Steps are physics steps.

    ``touches`` and ``touched`` accumulate until ``take_touches``.
    """

    chaser: int
    port: Port
    tolerances: Tolerances
    physics_hz: int
    faults: tuple[LatchFault, ...] = ()
    armed: bool = False
    latched: bool = False
    touched: bool = False
    touches: list[ProbeTouch] = field(default_factory=list)
    _last_touch_step: int | None = None
    _queue: list[tuple[int, int, Latch]] = field(default_factory=list)
    _received: int = 0

    def command(self, latch: Latch, effective_step: int) -> None:
        """Queue a command that acts from ``effective_step`` on."""
        if latch != "keep":
            self._received += 1
            heapq.heappush(self._queue, (effective_step, self._received, latch))

    def fault_at(self, kind: str, step: int) -> LatchFault | None:
        """Return the fault of this kind that acts at ``step``, or None."""
        return next((f for f in self.faults if f.kind == kind and f.begin <= step < f.end), None)

    def apply_due_commands(self, step: int) -> bool:
        """Apply the commands due at ``step``; return whether the latch opens.

        A stuck latch opens when it is free again.
        """
        while self._queue and self._queue[0][0] <= step:
            self.armed = heapq.heappop(self._queue)[2] == "arm"
        opens = self.latched and not self.armed and self.fault_at("latch_stuck", step) is None
        if opens:
            self.open(step)
        return opens

    def open(self, step: int) -> None:
        """Open the latch, which must be armed again before it can close."""
        self.latched = self.armed = False
        self._last_touch_step = step  # the probe is still in contact

    def touch(self, step: int, before: PortView) -> bool:
        """Handle contact of the tip during ``step``; return whether the latch closes.

        ``before``: relative state at the beginning of the step. Only the first contact of a touch
        is evaluated, as in the middle of a bounce the tip is at rest, too.
        """
        self.touched = True
        last, self._last_touch_step = self._last_touch_step, step
        if self.latched or (
            last is not None and step - last <= _NEW_TOUCH_AFTER_S * self.physics_hz
        ):
            return False
        refused = "" if self.armed else "not armed"
        refused = refused or before.fault(self.tolerances, self.tolerances.closing_m_s)
        refused = refused or ("latch stuck" if self.fault_at("latch_stuck", step) else "")
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

    def take_touches(self) -> tuple[ProbeTouch, ...]:
        """Return the touches that began since the last call, and reset ``touched``."""
        touches = tuple(self.touches)
        self.touches.clear()
        self.touched = False
        return touches
