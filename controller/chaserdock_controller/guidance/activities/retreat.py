# SPDX-License-Identifier: Apache-2.0
"""Retreat and abort: back out to the nominal offset, or move onto a passively safe coast."""

from __future__ import annotations

from dataclasses import replace

from chaserdock_controller.interfaces import Observation

from ..chaser_machine import Activity, ChaserMachine
from ..chaser_state import Cause, ChaserGuidance, ChaserTick, NextMove, TrackingErrors
from ..fleet import ChaserFleet
from ..parameters import GUIDANCE
from ..phases import ATTACHED, BACKING_OUT, Phase, Trigger
from ..trajectories import Escape, Move, move_to, stay


class RetreatActivity(Activity):
    phases = BACKING_OUT
    commands = ("retreat", "abort")

    def __init__(self, fleet: ChaserFleet) -> None:
        self._fleet, self._moves = fleet, fleet.moves

    def enter(self, chaser: ChaserMachine, begun: ChaserGuidance, cause: Cause) -> ChaserGuidance:
        """Begin the move to the nominal offset; from inside a corridor first along its axis to the
        entry.
        """
        now_s, aborts = cause.now_s, begun.phase is Phase.ABORT
        if chaser.in_corridor():
            then = NextMove.NOMINAL
            if aborts and self._moves.escapes is not None:
                then = NextMove.ESCAPE
            elif cause.trigger is Trigger.ATTEMPT_FAILED and _may_try_again(chaser):
                then = NextMove.ATTEMPT
            return replace(begun, move=self._way_out(chaser, begun.phase, now_s), then=then)
        move = self._escape(chaser, now_s) if aborts else None
        speed = self._moves.speed_m_s(begun.phase)
        if move is None:
            move = self._moves.move(chaser, chaser.nominal_m, now_s, speed)
        return replace(begun, move=move)

    def step(self, chaser: ChaserMachine, known: ChaserTick, errors: TrackingErrors) -> None:
        if chaser.state.move.over_at(known.now_s):
            self._continue(chaser, known.now_s)
        if chaser.phase in self.phases:
            self._watch_latch(chaser, known.now_s)
        elif chaser.phase is Phase.ALIGN:
            chaser.step(known, errors)  # the next attempt begins with this tick

    def conclude(self, observation: Observation) -> None:
        """Update the margins of the best aborts once a second, where passive safety is enforced."""
        escapes = self._moves.escapes
        renew = observation.tick % self._fleet.scenario.time.rate_hz == 0
        for chaser in self._fleet.chasers:
            if escapes is None or chaser.relative is None or not chaser.enforces_safety():
                chaser.abort_margin = None
            elif renew or chaser.abort_margin is None:
                chaser.abort_margin = escapes.escape(chaser.relative, observation.time_s)[1]

    def _continue(self, chaser: ChaserMachine, now_s: float) -> None:
        """Begin what follows a completed move."""
        state = chaser.state
        match state.then:
            case NextMove.ATTEMPT if chaser.failure is None:
                chaser.fire(Trigger.NEXT_ATTEMPT, now_s)
            case NextMove.ATTEMPT | NextMove.NOMINAL:
                here, speed = chaser.motion(now_s), self._moves.speed_m_s(state.phase)
                move = move_to(here, chaser.nominal_m, now_s, speed)
                chaser.state = replace(state, move=move, then=NextMove.NONE)
            case NextMove.ESCAPE if (escape := self._escape(chaser, now_s)) is not None:
                chaser.state = replace(state, move=escape, then=NextMove.NONE)
            case NextMove.NONE | NextMove.ESCAPE:
                chaser.fire(Trigger.MOVE_COMPLETE, now_s)

    def _way_out(self, chaser: ChaserMachine, phase: Phase, now_s: float) -> Move:
        """Return the move along the port's axis from the present place to the entry."""
        assert chaser.dock is not None
        assert chaser.seen is not None
        here, entry = stay(chaser.seen.offset_m, now_s), chaser.dock.entry()
        return move_to(here, entry, now_s, self._moves.speed_m_s(phase))

    def _escape(self, chaser: ChaserMachine, now_s: float) -> Escape | None:
        """Return the abort onto a safe coast, and log its margin; None unless passive safety is
        enforced.
        """
        escapes, known = self._moves.escapes, chaser.relative
        if escapes is None or known is None:
            return None
        move, margin = escapes.escape(known, now_s)
        text = (
            f"abort by {move.impulse_m_s:.3f} m/s onto a coast with a margin of {margin:.1f} sigmas"
        )
        chaser.log(text, warns=margin < escapes.sigmas, phase=Phase.ABORT)
        return move

    def _watch_latch(self, chaser: ChaserMachine, now_s: float) -> None:
        """Restart the way out in every tick while the latch does not open."""
        state, seen = chaser.state, chaser.seen
        if seen is None:
            return
        sensed = seen.sensed or state.stuck
        stuck = seen.latched and sensed and now_s - state.since_s >= GUIDANCE.release_s
        if stuck:
            state = replace(state, move=self._way_out(chaser, state.phase, now_s))
        if stuck and not state.stuck:
            chaser.log("the latch does not open", warns=True)
        elif state.stuck and not stuck:
            chaser.log("the latch opened")
        chaser.state = replace(state, stuck=stuck)


def _may_try_again(chaser: ChaserMachine) -> bool:
    """Return whether a failed docking attempt is repeated: only one that has not latched."""
    attempts = chaser.scenario.docking.attempts
    return chaser.state.attempt < attempts and chaser.phase not in ATTACHED
