# SPDX-License-Identifier: Apache-2.0
"""Docking by capture: wait for a free corridor, align, fly in, touch, latch, test the latch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from chaserdock_protocol.messages import OperatorCommand

from chaserdock_controller.interfaces import DirectCommand

from ..chaser_machine import Activity, ChaserMachine, pull
from ..chaser_state import Cause, ChaserGuidance, ChaserTick, TrackingErrors
from ..docking import Dock, DockingObservation
from ..fleet import ChaserFleet
from ..latch_test import motion_between, why_untold
from ..parameters import GUIDANCE
from ..phases import CORRIDOR, Phase, Trigger
from ..trajectories import Glide, glide, stay, stop
from .hold import rest


class DockingActivity(Activity):
    phases = (
        Phase.WAIT,
        Phase.ALIGN,
        Phase.APPROACH,
        Phase.FINAL,
        Phase.CONTACT,
        Phase.LATCHED,
        Phase.VERIFIED,
    )
    commands = ("approach",)
    by_capture = True

    def __init__(self, fleet: ChaserFleet) -> None:
        self._fleet = fleet

    def refuse(self, chaser: ChaserMachine, command: OperatorCommand, now_s: float) -> str:
        if reason := super().refuse(chaser, command, now_s):
            return reason
        gap, lateral = _dock(chaser).gap_and_lateral(
            chaser.motion(now_s).at(np.array([now_s]))[0][0]
        )
        if gap >= 0.0 and lateral <= GUIDANCE.in_line_m:
            return ""
        return (
            f"the reference is {lateral:.2f} m beside the port's axis, {gap:.2f} m before the "
            "port; allowed are "
            f"at most {GUIDANCE.in_line_m:g} m beside and at least 0 m before: retreat or goto "
            "first"
        )

    def start(self, chaser: ChaserMachine, command: OperatorCommand, now_s: float) -> None:
        if occupied := self._fleet.why_corridor_occupied(chaser):
            chaser.fire(Trigger.COMMAND_APPROACH_BLOCKED, now_s, occupied)
        else:
            chaser.fire(Trigger.COMMAND_APPROACH, now_s)

    def enter(self, chaser: ChaserMachine, begun: ChaserGuidance, cause: Cause) -> ChaserGuidance:
        now_s, moves = cause.now_s, self._fleet.moves
        match begun.phase, cause.trigger:
            case Phase.WAIT, _:
                return replace(begun, move=stop(chaser.motion(now_s), now_s))
            case Phase.ALIGN, trigger:
                again = trigger is Trigger.NEXT_ATTEMPT
                move = moves.move(chaser, _dock(chaser).entry(), now_s, moves.goto_m_s)
                return replace(begun, move=move, attempt=begun.attempt + 1 if again else 1)
            case Phase.APPROACH, _:
                return replace(begun, move=_way_in(_dock(chaser), now_s))
            case Phase.LATCHED, _:
                return replace(begun, move=stay(_seen(chaser).offset_m, now_s))
            case _, Trigger.COMMAND_HOLD:
                return replace(begun, move=rest(chaser, now_s))
            case _:
                return begun

    def step(self, chaser: ChaserMachine, known: ChaserTick, errors: TrackingErrors) -> None:
        state, seen, now_s = chaser.state, _seen(chaser), known.now_s
        docking = chaser.scenario.docking
        match state.phase:
            case Phase.WAIT:
                if not self._fleet.why_corridor_occupied(chaser):
                    chaser.fire(Trigger.CORRIDOR_FREE, now_s)
                return
            case Phase.ALIGN:
                inside = not seen.view.fault(docking.corridor, docking.corridor.closing_m_s)
                chaser.state = replace(state, inside_since_s=state.inside_since(inside, now_s))
            case Phase.LATCHED if state.held is None and now_s - state.since_s >= docking.settle_s:
                chaser.state = replace(state, held=seen.pose)
            case _:
                pass
        if seen.latched and state.phase in CORRIDOR:
            chaser.fire(Trigger.LATCH_CLOSED, now_s, "the latch closed")
        elif (outcome := _CHECKS[state.phase](chaser, seen, now_s)) is not None:
            chaser.fire(outcome[0], now_s, outcome[1])

    def command(self, chaser: ChaserMachine, known: ChaserTick) -> DirectCommand | None:
        if chaser.phase is Phase.LATCHED and chaser.is_attached(known):
            return pull(pull_N(chaser, known.now_s))
        return super().command(chaser, known)


def pull_N(chaser: ChaserMachine, now_s: float) -> float:
    """Return the force along -X (CRF), N, of the latch test: a pull, then a push of equal
    duration.
    """
    docking = chaser.scenario.docking
    into_s = now_s - chaser.state.since_s - docking.settle_s
    if into_s < 0.0 or into_s >= 2.0 * docking.pull_s:
        return 0.0
    return docking.pull_N if into_s < docking.pull_s else -docking.pull_N


def _dock(chaser: ChaserMachine) -> Dock:
    assert chaser.dock is not None
    return chaser.dock


def _seen(chaser: ChaserMachine) -> DockingObservation:
    assert chaser.seen is not None
    return chaser.seen


def _way_in(dock: Dock, now_s: float) -> Glide:
    """Return the motion from the corridor's entry into the port; slow from the final distance
    on.
    """
    docking = dock.docking
    fast = (docking.entry_m - docking.final_m, docking.approach_speed_m_s)
    slow = (docking.final_m + docking.overdrive_m, docking.contact_speed_m_s)
    return glide(dock.entry(), -np.asarray(dock.port.axis), now_s, fast, slow)


# -- conditions that end a phase -------------------------------------------------------------------

_Outcome = tuple[Trigger, str] | None
"""Trigger that ends a phase and the reason for the log; None to stay."""


def _failed(reason: str) -> _Outcome:
    return Trigger.ATTEMPT_FAILED, reason


def _check_align(chaser: ChaserMachine, seen: DockingObservation, now_s: float) -> _Outcome:
    state, docking = chaser.state, chaser.scenario.docking
    since = state.inside_since_s
    inside_s = 0.0 if since is None else now_s - since
    if state.move.over_at(now_s) and inside_s >= GUIDANCE.aligned_s:
        return Trigger.ALIGNED, "aligned"
    if now_s - state.since_s > docking.align_timeout_s:
        fault = seen.view.fault(docking.corridor, docking.corridor.closing_m_s)
        return _failed(f"not aligned within {docking.align_timeout_s:g} s: {fault}")
    return None


def _check_approach(chaser: ChaserMachine, seen: DockingObservation, now_s: float) -> _Outcome:
    state, docking = chaser.state, chaser.scenario.docking
    if fault := seen.view.fault(docking.corridor, docking.corridor.closing_m_s):
        return _failed(f"left the corridor: {fault}")
    reference_gap_m, _ = _dock(chaser).gap_and_lateral(state.move.at(np.array([now_s]))[0][0])
    if reference_gap_m <= docking.final_m:
        fault = seen.view.fault(docking.final, docking.corridor.closing_m_s)
        if fault:
            return _failed(f"not fit for the final approach: {fault}")
        return Trigger.FINAL_DISTANCE, ""
    if now_s - state.since_s > docking.approach_timeout_s:
        return _failed(f"approach took more than {docking.approach_timeout_s:g} s")
    return None


def _check_final(chaser: ChaserMachine, seen: DockingObservation, now_s: float) -> _Outcome:
    state, docking = chaser.state, chaser.scenario.docking
    if seen.contact:
        return Trigger.TIP_CONTACT, "the tip touches"
    if fault := seen.view.fault(docking.final, docking.corridor.closing_m_s):
        return _failed(f"left the corridor: {fault}")
    if state.move.over_at(now_s) or now_s - state.since_s > docking.final_timeout_s:
        return _failed("no contact at the estimated port")
    return None


def _check_contact(chaser: ChaserMachine, seen: DockingObservation, now_s: float) -> _Outcome:
    docking = chaser.scenario.docking
    if fault := seen.view.fault(docking.corridor, docking.corridor.closing_m_s):
        return _failed(f"left the corridor: {fault}")
    if now_s - chaser.state.since_s > docking.contact_timeout_s:
        return _failed(f"the latch did not close within {docking.contact_timeout_s:g} s")
    return None


def _check_latched(chaser: ChaserMachine, seen: DockingObservation, now_s: float) -> _Outcome:
    state, docking = chaser.state, chaser.scenario.docking
    if (outcome := check_latch(chaser, seen, now_s)) is not None or state.held is None:
        return outcome
    motion = motion_between(state.held, seen.pose, chaser.scenario)
    reason = f"{motion} under the pull"
    if motion.exceeded:
        return _failed(reason)
    if now_s - state.since_s < docking.settle_s + 2.0 * docking.pull_s:
        return None
    if untold := why_untold(state.held, seen.pose, chaser.scenario):
        return _failed(untold)
    return Trigger.PULL_WITHSTOOD, reason


def check_latch(chaser: ChaserMachine, seen: DockingObservation, now_s: float) -> _Outcome:
    """Return a latch failure if the latch is open although the chaser is at its port, else None."""
    return None if seen.latched else _failed("the latch opened")


_CHECKS: dict[Phase, Callable[[ChaserMachine, DockingObservation, float], _Outcome]] = {
    Phase.ALIGN: _check_align,
    Phase.APPROACH: _check_approach,
    Phase.FINAL: _check_final,
    Phase.CONTACT: _check_contact,
    Phase.LATCHED: _check_latched,
    Phase.VERIFIED: check_latch,
}
