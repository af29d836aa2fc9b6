# SPDX-License-Identifier: Apache-2.0
"""Identify, detumble and stack_hold: move the target by the chasers latched to it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import replace

from chaserdock_protocol.messages import OperatorCommand

from chaserdock_controller.interfaces import DirectCommand, Observation, TargetEstimation

from .. import command_validation as validation
from ..chaser_machine import Activity, ChaserMachine
from ..chaser_state import ChaserTick, TrackingErrors
from ..detumble.control import DetumbleControl, StackState, StackTask
from ..fleet import ChaserFleet
from ..parameters import GUIDANCE
from ..phases import BACKING_OUT, DETUMBLING, Phase, Trigger, next_phase
from .docking import check_latch


class DetumbleActivity(Activity):
    """Moves the stack by all chasers in these phases together.

    ``control``: computes their thrusts. ``waits``: the stack coasts while a chaser backs out.
    """

    phases = (Phase.IDENTIFY, *DETUMBLING)
    commands = ("identify", "detumble")

    def __init__(self, fleet: ChaserFleet) -> None:
        self._fleet = fleet
        self.control = DetumbleControl(fleet.scenario)
        self.waits = False
        self._state: StackState | None = None
        self._refusal = ""
        self._thrusts: Mapping[int, DirectCommand] = {}

    # -- one chaser --------------------------------------------------------------------------------

    def refuse(self, chaser: ChaserMachine, command: OperatorCommand, now_s: float) -> str:
        if reason := super().refuse(chaser, command, now_s):
            return reason
        if command.command == "identify":
            return validation.why_not_identify(chaser.scenario)
        return self._refusal

    def step(self, chaser: ChaserMachine, known: ChaserTick, errors: TrackingErrors) -> None:
        """Back out when the latch opens. All else is decided for the whole stack."""
        if chaser.seen is not None and (failed := check_latch(chaser, chaser.seen, known.now_s)):
            chaser.fire(failed[0], known.now_s, failed[1])

    def command(self, chaser: ChaserMachine, known: ChaserTick) -> DirectCommand | None:
        return self._thrusts.get(chaser.number) or super().command(chaser, known)

    # -- the stack ---------------------------------------------------------------------------------

    def observe(
        self,
        commands: Sequence[OperatorCommand],
        observation: Observation,
        estimation: TargetEstimation,
    ) -> None:
        """Estimate the stack's motion if chasers move it, or ``commands`` ask them to."""
        self._state = None
        if self._in(*self.phases) or any(c.command in self.commands for c in commands):
            self._state = self.with_trusted(self.control.state(observation, estimation))
        named = {c.chaser for c in commands if c.command == "detumble"}
        able = {c.number for c in self._fleet.chasers if c.number in named and _may_stop_stack(c)}
        self._refusal = self._why_not(able | self._in(*DETUMBLING)) if able else ""

    def conclude(self, observation: Observation) -> None:
        """Advance the phases of the chasers that move the stack, and compute their thrusts."""
        now_s = observation.time_s
        for chaser in self._fleet.chasers:
            into_s = now_s - chaser.state.since_s
            if chaser.phase is Phase.IDENTIFY and into_s >= GUIDANCE.identify_s:
                chaser.fire(Trigger.IDENTIFIED, now_s)
        self._follow_motion(observation)
        self._thrusts = self._command_thrusters(observation)
        self._report_waiting()

    def with_trusted(self, state: StackState | None) -> StackState | None:
        """Return the stack's state without the failures of thrusters that an operator has
        restored.
        """
        if state is None or not state.failed:
            return state
        chasers = self._fleet.chasers
        failed = {(i, k) for i, k in state.failed if chasers[i].thrusters.untrusted((k,))}
        return replace(state, failed=frozenset(failed))

    def _in(self, *phases: Phase) -> frozenset[int]:
        """Return the numbers of the chasers that are in one of these phases."""
        return frozenset(c.number for c in self._fleet.chasers if c.phase in phases)

    def _why_not(self, chasers: Set[int]) -> str:
        return self.control.why_not(self._state, chasers)

    def _follow_motion(self, observation: Observation) -> None:
        """Advance the phases by the stack's mean motion, which may be neither stopped nor moving.

        Fails, and closes the thrusters, if the remaining ones cannot stop the stack.
        """
        state, now_s, active = self._state, observation.time_s, self._in(*DETUMBLING)
        if not active or state is None:
            return
        self.control.follow(state)
        present = active & state.chasers.keys()
        failure = self._why_not(present) if present else ""
        stopped, moving = self.control.is_stopped(state), self.control.moves_again(state)
        for chaser in (self._fleet.chasers[i] for i in sorted(active)):
            if failure:
                chaser.fire(Trigger.DETUMBLE_FAILED, now_s, failure)
            else:
                self._judge(chaser, now_s, stopped, moving)

    def _judge(self, chaser: ChaserMachine, now_s: float, stopped: bool, moving: bool) -> None:
        """Advance the phase of a chaser that stops the stack or keeps it at rest."""
        state, holds = chaser.state, chaser.phase is Phase.STACK_HOLD
        in_phase_s, timeout_s = now_s - state.since_s, self._fleet.scenario.detumble.timeout_s
        moves_again = moving and in_phase_s >= GUIDANCE.stack_settling_s
        since = state.inside_since(moves_again if holds else stopped, now_s)
        chaser.state = replace(state, inside_since_s=since)
        lasts_s = GUIDANCE.stack_moving_s if holds else GUIDANCE.stack_rest_s
        if since is not None and now_s - since >= lasts_s:
            chaser.fire(Trigger.STACK_MOVED if holds else Trigger.STACK_STOPPED, now_s)
        elif not holds and in_phase_s > timeout_s:
            chaser.fire(Trigger.DETUMBLE_FAILED, now_s, f"not stopped within {timeout_s:g} s")

    def _command_thrusters(self, observation: Observation) -> Mapping[int, DirectCommand]:
        """Return the commands of the chasers that move the stack, by chaser. Identifying pulses
        wait until the stack is stopped.
        """
        present = {c.chaser for c in observation.chasers if c.odometry is not None}
        detumbling = self._in(*DETUMBLING) & present
        active = detumbling or self._in(Phase.IDENTIFY) & present
        if self._state is None or not active:
            self.control.reset()
            return {}
        task = StackTask.STOP
        if self._leaving():
            task = StackTask.WAIT
        elif not detumbling:
            task = StackTask.IDENTIFY
        elif active <= self._in(Phase.STACK_HOLD):
            task = StackTask.HOLD
        return self.control.commands(self._state, active, task, observation)

    def _leaving(self) -> list[ChaserMachine]:
        """Return the chasers that back out. Meanwhile no thrust may turn the stack under them."""
        return [chaser for chaser in self._fleet.chasers if _backs_out(chaser)]

    def _report_waiting(self) -> None:
        """Log when the stack begins to coast for chasers that back out, and when that ends."""
        leaving = self._leaving() if self._in(*self.phases) else []
        if self.waits == bool(leaving):
            return
        self.waits = bool(leaving)
        text = "no chaser backs out any more: the stack is no longer coasting"
        if leaving:
            text = f"the stack coasts while chaser {leaving[0].number} backs out"
        self._fleet.notes.append(("info", text))


def _backs_out(chaser: ChaserMachine) -> bool:
    """Return whether a chaser is leaving its corridor."""
    leaves = chaser.phase in BACKING_OUT and not chaser.state.stuck
    return leaves and chaser.is_free() and chaser.in_corridor()


def _may_stop_stack(chaser: ChaserMachine) -> bool:
    """Return whether a chaser stops the stack, or may be commanded to."""
    begins = next_phase(chaser.phase, Trigger.COMMAND_DETUMBLE, chaser.by_capture)
    return chaser.phase in DETUMBLING or begins is not None


def detumbling_of(activities: Sequence[Activity]) -> DetumbleActivity:
    """Return the activity that moves the stack."""
    return next(a for a in activities if isinstance(a, DetumbleActivity))
