# SPDX-License-Identifier: Apache-2.0
"""Docking by capture: geometry of a port's corridor and the conditions of phase changes. Pure
functions.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.docking_geometry import PortView, centre_offset, segments_apart
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.scenario.docking import Docking, Port

from .phases import CORRIDOR, Phase, Trigger

_ALIGNED_S = 1.0
_KEEP_OUT_MARGIN_M = 0.03
_IN_LINE_M = 0.3


@dataclass(frozen=True)
class Dock:
    """A chaser's port, the distance ``reach_m`` from its centre to the probe tip, and the docking
    limits.
    """

    port: Port
    reach_m: float
    docking: Docking

    def offset(self, gap_m: float) -> Array:
        """Return the chaser's centre (3,), TRF, when its tip is ``gap_m`` before the port."""
        return centre_offset(self.port, self.reach_m, gap_m)

    def gap_and_lateral(self, offset_m: Array) -> tuple[float, float]:
        """Return gap and lateral distance (m) of a centre at ``offset_m`` (3,), TRF, for the
        nominal attitude.
        """
        off, axis = offset_m - self.offset(0.0), np.asarray(self.port.axis)
        gap = float(off @ axis)
        return gap, float(np.linalg.norm(off - gap * axis))

    def inside(self, offset_m: Array) -> bool:
        """Return whether a centre at ``offset_m`` (3,), TRF, is in the corridor, nearer than its
        entry.
        """
        gap, lateral = self.gap_and_lateral(offset_m)
        return gap < self.docking.entry_m - 0.02 and lateral < 2.0 * self.docking.corridor.lateral_m

    def keep_out_m(self) -> float:
        """Return the least distance from the target's centre that a plan in this corridor must
        keep.
        """
        return max(
            0.0, float(np.linalg.norm(self.offset(-self.docking.overdrive_m))) - _KEEP_OUT_MARGIN_M
        )


def dock_of(scenario: FlightScenario, chaser: int) -> Dock | None:
    """Return the dock of a chaser, or None if it does not dock by capture."""
    port = scenario.docking.port_of(chaser)
    return None if port is None else Dock(port, scenario.chaser.probe_reach_m, scenario.docking)


def corridors_apart(a: Dock, b: Dock) -> float:
    """Return the least distance (m) between the centre lines of two corridors."""
    ends = [(d.offset(0.0), d.offset(d.docking.entry_m)) for d in (a, b)]
    return segments_apart(*ends[0], *ends[1])


def why_not_approach(dock: Dock, offset_m: Array) -> str:
    """Return why a chaser cannot fly from a reference at ``offset_m`` (3,), TRF, to its corridor,
    or an empty string.
    """
    gap, lateral = dock.gap_and_lateral(offset_m)
    if gap < 0.0 or lateral > _IN_LINE_M:
        return (
            f"the reference is {lateral:.2f} m beside the port's axis, {gap:.2f} m before the port; allowed are "
            f"at most {_IN_LINE_M:g} m beside and at least 0 m before: retreat or goto first"
        )
    return ""


@dataclass(frozen=True)
class DockingObservation:
    """Estimated geometry of a chaser at its port, and the state of its docking sensor.

    ``offset_m`` (3,) and ``q_wxyz`` (4,): estimated pose of its centre and body in TRF. ``sensed``:
    the sensor has reported in this tick; otherwise ``latched`` is its last report.
    """

    view: PortView
    contact: bool
    latched: bool
    offset_m: Array
    q_wxyz: Array
    sensed: bool = True


@dataclass(frozen=True)
class PhaseProgress:
    """Progress within a phase: duration, whether the reference move is complete, the reference's
    gap, the time within the alignment limits, and the pose in TRF (offset, attitude) at the start
    of the pull test."""

    phase: Phase
    in_phase_s: float
    move_complete: bool
    reference_gap_m: float
    inside_s: float
    held: tuple[Array, Array] | None


def pull_N(docking: Docking, in_phase_s: float) -> float:
    """Return the force along -X (CRF) of the latch test at ``in_phase_s``: a pull, then an equally
    long push.
    """
    into_s = in_phase_s - docking.settle_s
    if into_s < 0.0 or into_s >= 2.0 * docking.pull_s:
        return 0.0
    return docking.pull_N if into_s < docking.pull_s else -docking.pull_N


TriggerReason = tuple[Trigger, str]
"""A trigger and its reason for the log."""


def docking_trigger(
    docking: Docking, now: PhaseProgress, observed: DockingObservation
) -> TriggerReason | None:
    """Return the condition that ends the phase, with its reason, or None to stay."""
    if observed.latched and now.phase in CORRIDOR:
        return Trigger.LATCH_CLOSED, "the latch closed"
    check = _CHECKS.get(now.phase)
    return None if check is None else check(docking, now, observed)


def _failed(reason: str) -> TriggerReason:
    return Trigger.ATTEMPT_FAILED, reason


def _check_align(
    docking: Docking, now: PhaseProgress, observed: DockingObservation
) -> TriggerReason | None:
    if now.move_complete and now.inside_s >= _ALIGNED_S:
        return Trigger.ALIGNED, "aligned"
    if now.in_phase_s > docking.align_timeout_s:
        fault = observed.view.fault(docking.corridor, docking.corridor.closing_m_s)
        return _failed(f"not aligned within {docking.align_timeout_s:g} s: {fault}")
    return None


def _check_approach(
    docking: Docking, now: PhaseProgress, observed: DockingObservation
) -> TriggerReason | None:
    if fault := observed.view.fault(docking.corridor, docking.corridor.closing_m_s):
        return _failed(f"left the corridor: {fault}")
    if now.reference_gap_m <= docking.final_m:
        fault = observed.view.fault(docking.final, docking.corridor.closing_m_s)
        return (
            _failed(f"not fit for the final approach: {fault}")
            if fault
            else (Trigger.FINAL_DISTANCE, "")
        )
    if now.in_phase_s > docking.approach_timeout_s:
        return _failed(f"approach took more than {docking.approach_timeout_s:g} s")
    return None


def _check_final(
    docking: Docking, now: PhaseProgress, observed: DockingObservation
) -> TriggerReason | None:
    if observed.contact:
        return Trigger.TIP_CONTACT, "the tip touches"
    if fault := observed.view.fault(docking.final, docking.corridor.closing_m_s):
        return _failed(f"left the corridor: {fault}")
    if now.move_complete or now.in_phase_s > docking.final_timeout_s:
        return _failed("no contact at the estimated port")
    return None


def _check_contact(
    docking: Docking, now: PhaseProgress, observed: DockingObservation
) -> TriggerReason | None:
    if fault := observed.view.fault(docking.corridor, docking.corridor.closing_m_s):
        return _failed(f"left the corridor: {fault}")
    if now.in_phase_s > docking.contact_timeout_s:
        return _failed(f"the latch did not close within {docking.contact_timeout_s:g} s")
    return None


def _check_latched(
    docking: Docking, now: PhaseProgress, observed: DockingObservation
) -> TriggerReason | None:
    if not observed.latched:
        return _failed("the latch opened")
    if now.phase is not Phase.LATCHED or now.held is None:
        return None
    offset, q = now.held
    moved_m = float(np.linalg.norm(observed.offset_m - offset))
    turned_deg = float(np.degrees(rotations.angle_between(q, observed.q_wxyz)))
    reason = f"moved {moved_m * 1e3:.2f} mm and {turned_deg:.2f} deg under the pull"
    if moved_m > docking.verify_position_m or turned_deg > docking.verify_angle_deg:
        return _failed(reason)
    if now.in_phase_s >= docking.settle_s + 2.0 * docking.pull_s:
        return Trigger.PULL_WITHSTOOD, reason
    return None


_CHECKS: dict[
    Phase, Callable[[Docking, PhaseProgress, DockingObservation], TriggerReason | None]
] = {
    Phase.ALIGN: _check_align,
    Phase.APPROACH: _check_approach,
    Phase.FINAL: _check_final,
    Phase.CONTACT: _check_contact,
    Phase.LATCHED: _check_latched,
    Phase.VERIFIED: _check_latched,
    Phase.IDENTIFY: _check_latched,
    Phase.DETUMBLE: _check_latched,
    Phase.STACK_HOLD: _check_latched,
}
