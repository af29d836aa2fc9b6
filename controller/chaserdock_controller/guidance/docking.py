"""Docking by capture: when a chaser goes from phase to phase, and why. Pure functions; time is given.

``wait`` (its corridor is taken), ``align`` (to the corridor's entry), ``approach`` and ``final`` (down the corridor,
slowly at last), ``contact`` (the tip touches), ``latched`` (holds on; a pull tests it), ``verified``. What breaks a
limit or takes too long leads to ``retreat``: back out along the axis, and another attempt while there are any left.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.docking_geometry import PortView, centre_offset, segments_apart
from chaserdock_models.rotations import Array
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.docking import Docking, Port

IN_CORRIDOR = ("align", "approach", "final", "contact")
HOLDING_ON = ("latched", "verified")
_ALIGNED_S = 1.0
_KEEP_OUT_MARGIN_M = 0.03
_IN_LINE_M = 0.3


@dataclass(frozen=True)
class Dock:
    """A chaser's way in: its port, ``reach_m`` from its centre to the tip, the mission's docking figures."""

    port: Port
    reach_m: float
    docking: Docking

    def offset(self, gap_m: float) -> Array:
        """Where in TRF the chaser's centre is with its tip ``gap_m`` before the port, (3,)."""
        return centre_offset(self.port, self.reach_m, gap_m)

    def place_of(self, offset_m: Array) -> tuple[float, float]:
        """Gap and lateral distance (m) of a centre at ``offset_m`` (3,), TRF, as if it were turned right."""
        off, axis = offset_m - self.offset(0.0), np.asarray(self.port.axis)
        gap = float(off @ axis)
        return gap, float(np.linalg.norm(off - gap * axis))

    def inside(self, offset_m: Array) -> bool:
        """Whether a chaser there is in the corridor, nearer than its entry."""
        gap, lateral = self.place_of(offset_m)
        return gap < self.docking.entry_m - 0.02 and lateral < 2.0 * self.docking.corridor.lateral_m

    def keep_out_m(self) -> float:
        """How near to the target's centre a chaser in this corridor may plan to come."""
        return max(0.0, float(np.linalg.norm(self.offset(-self.docking.overdrive_m))) - _KEEP_OUT_MARGIN_M)


def dock_of(scenario: Scenario, chaser: int) -> Dock | None:
    """The dock of a chaser, None where it is not captured."""
    port = scenario.docking.port_of(chaser)
    return None if port is None else Dock(port, scenario.chaser.probe_reach_m, scenario.docking)


def corridors_apart(a: Dock, b: Dock) -> float:
    """Least distance (m) between where the centres of two chasers in their corridors may be."""
    ends = [(d.offset(0.0), d.offset(d.docking.entry_m)) for d in (a, b)]
    return segments_apart(*ends[0], *ends[1])


def why_not_approach(dock: Dock, offset_m: Array) -> str:
    """Why a chaser whose reference is at ``offset_m`` (3,), TRF, cannot fly to its corridor, or nothing."""
    gap, lateral = dock.place_of(offset_m)
    if gap < 0.0 or lateral > _IN_LINE_M:
        return (
            f"its reference is {lateral:.2f} m beside its port's axis, {gap:.2f} m before the port; allowed are "
            f"{_IN_LINE_M:g} m beside and no less than 0 m before: retreat or goto first"
        )
    return ""


@dataclass(frozen=True)
class Senses:
    """What is known of a chaser at its port: the estimated view, and its docking sensor's word.

    ``offset_m`` (3,) and ``q_wxyz`` (4,): estimated pose of its centre and body in TRF.
    """

    view: PortView
    contact: bool
    latched: bool
    offset_m: Array
    q_wxyz: Array


@dataclass(frozen=True)
class Situation:
    """Where in its phase a chaser is: ``in_phase_s`` so long, the reference's motion over or not, the reference's gap,
    aligned for ``inside_s``; ``held`` its pose in TRF (offset, attitude) when the pull began."""

    phase: str
    in_phase_s: float
    move_over: bool
    reference_gap_m: float
    inside_s: float
    held: tuple[Array, Array] | None


def pull_N(docking: Docking, in_phase_s: float) -> float:
    """Force along -X (CRF) that tests a latch, ``in_phase_s`` into ``latched``: a pull, and as long a push."""
    into_s = in_phase_s - docking.settle_s
    if into_s < 0.0 or into_s >= 2.0 * docking.pull_s:
        return 0.0
    return docking.pull_N if into_s < docking.pull_s else -docking.pull_N


def next_phase(docking: Docking, now: Situation, senses: Senses) -> tuple[str, str] | None:
    """The phase that follows, and why; None to stay. ``retreat`` is the answer to everything that goes wrong."""
    if senses.latched and now.phase in IN_CORRIDOR:
        return "latched", "the latch has closed"
    match now.phase:
        case "align":
            return _after_align(docking, now, senses)
        case "approach":
            fault = senses.view.fault(docking.corridor, docking.corridor.closing_m_s)
            if fault:
                return "retreat", f"left the corridor: {fault}"
            if now.reference_gap_m <= docking.final_m:
                fault = senses.view.fault(docking.final, docking.corridor.closing_m_s)
                return ("retreat", f"not fit for the final approach: {fault}") if fault else ("final", "")
            if now.in_phase_s > docking.approach_timeout_s:
                return "retreat", f"approach took more than {docking.approach_timeout_s:g} s"
        case "final":
            if senses.contact:
                return "contact", "the tip touches"
            if fault := senses.view.fault(docking.final, docking.corridor.closing_m_s):
                return "retreat", f"left the corridor: {fault}"
            if now.move_over or now.in_phase_s > docking.final_timeout_s:
                return "retreat", "no contact where the port should be"
        case "contact":
            if fault := senses.view.fault(docking.corridor, docking.corridor.closing_m_s):
                return "retreat", f"left the corridor: {fault}"
            if now.in_phase_s > docking.contact_timeout_s:
                return "retreat", f"the latch has not closed within {docking.contact_timeout_s:g} s"
        case "latched" | "verified" if not senses.latched:
            return "retreat", "the latch has let go"
        case "latched" if now.held is not None:
            return _after_pull(docking, now, senses)
    return None


def _after_align(docking: Docking, now: Situation, senses: Senses) -> tuple[str, str] | None:
    if now.move_over and now.inside_s >= _ALIGNED_S:
        return "approach", "aligned"
    if now.in_phase_s > docking.align_timeout_s:
        fault = senses.view.fault(docking.corridor, docking.corridor.closing_m_s)
        return "retreat", f"not aligned within {docking.align_timeout_s:g} s: {fault}"
    return None


def _after_pull(docking: Docking, now: Situation, senses: Senses) -> tuple[str, str] | None:
    assert now.held is not None
    offset, q = now.held
    moved_m = float(np.linalg.norm(senses.offset_m - offset))
    turned_deg = float(np.degrees(rotations.angle_between(q, senses.q_wxyz)))
    what = f"moved {moved_m * 1e3:.2f} mm and {turned_deg:.2f} deg under the pull"
    if moved_m > docking.verify_position_m or turned_deg > docking.verify_angle_deg:
        return "retreat", what
    if now.in_phase_s >= docking.settle_s + 2.0 * docking.pull_s:
        return "verified", what
    return None
