# SPDX-License-Identifier: Apache-2.0
"""Third stage of a tick: apply commands, advance the phases, and compute the references."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import length
from chaserdock_models.docking_geometry import view_of
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.messages import CameraCalibration, CommandReply, Odometry, OperatorCommand
from chaserdock_protocol.scenario import FlightScenario

from chaserdock_controller.estimation.composite_body import centre_in_target, pose_in_target
from chaserdock_controller.interfaces import (
    DirectCommand,
    Directive,
    GuidanceResult,
    LogEntry,
    Observation,
    PlanningHistory,
    ReferencePose,
    TargetEstimation,
)

from .chaser_state import ChaserGuidance
from .detumble.control import DetumbleControl, StackState, StackTask
from .docking import DockingObservation
from .escape import RelativeState
from .horizon import ReferenceBuilder
from .phase_machine import PhaseMachine
from .phases import Phase
from .target_search import TargetSearch, is_settled
from .thruster_commands import THRUSTER_COMMANDS, ThrusterCommandHandler


class GuidanceStage:
    """Phases, thruster commands and searches of all chasers."""

    def __init__(self, scenario: FlightScenario) -> None:
        self._scenario = scenario
        self.machine = PhaseMachine(scenario)
        self.thrusters = ThrusterCommandHandler(scenario)
        self.search = TargetSearch(scenario.chaser, scenario.camera_model())
        self.detumble = DetumbleControl(scenario)
        self._waits = False
        self.references = ReferenceBuilder(scenario, self.machine)
        self._abort_margins: dict[int, float] = {}

    @property
    def chasers(self) -> list[ChaserGuidance]:
        """Return the guidance state of every chaser."""
        return self.machine.chasers

    def run(
        self,
        observation: Observation,
        estimation: TargetEstimation,
        history: PlanningHistory,
    ) -> GuidanceResult:
        """Return what every chaser is to do in this tick; ``history``: how planning went in the
        ticks before.
        """
        self._follow_estimate(observation, estimation)
        self._follow_relative_states(estimation)
        self.machine.update_planning(observation.time_s, history.failures(observation.time_ns))
        commands = (*self.machine.due_commands(observation.time_s), *observation.commands)
        stack = None
        if self.machine.thrusting() or any(c.command in ("detumble", "identify") for c in commands):
            stack = self.with_trusted(self.detumble.state(observation, estimation))
        replies = self._apply_commands(commands, observation, stack)
        references: dict[int, ReferencePose] = {}
        if estimation.known:
            for i in sorted(observation.odometry):
                references[i] = self._update_chaser(i, observation, estimation)
        self.machine.update_safety(observation.time_s, history.unsafe(observation.time_ns))
        abort_margins = self._update_abort_margins(observation)
        self._update_stack(observation, stack)
        thrusts = self._detumble_commands(observation, stack)
        ids, attached = sorted(observation.odometry), self._attached(observation, estimation)
        planned = tuple(i for i in ids if self.chasers[i].phase is not Phase.SEARCHING)
        horizon = None
        # Latched chasers are planned for only where others have to fly around them.
        if estimation.at_effect is not None and planned and attached != set(ids):
            horizon = self.references.horizon(
                planned, estimation.at_effect, estimation.body, attached, estimation.relative
            )
        directives = {}
        for i, c in enumerate(self.chasers):
            directives[i] = Directive(
                phase=c.phase,
                phase_time_s=observation.time_s - c.since_s,
                latch=self.machine.latch(i),
                free=self.machine.is_free(i),
                isolated=self._isolated(i, estimation),
                trusted=self.thrusters.trusted(i),
                reference=references.get(i),
                direct=thrusts.get(i)
                or self._direct_command(i, observation, estimation, i in attached),
            )
        return GuidanceResult(
            directives,
            horizon,
            tuple(replies),
            (*self._events(estimation), *self._report_waiting()),
            abort_margins,
        )

    def _follow_estimate(self, observation: Observation, estimation: TargetEstimation) -> None:
        target, now_s = estimation.target, observation.time_s
        if not estimation.known:
            if target.status == "lost":
                self.machine.target_lost(now_s)
            self.machine.target_unknown(now_s)
            return
        self.machine.update_visibility(now_s, target.status == "tracking", estimation.doubtful)
        self.machine.target_acquired(now_s)
        if is_settled(target):
            for i, odometry in estimation.own.items():
                self.machine.target_settled(i, now_s, centre_in_target(target, odometry))

    def _follow_relative_states(self, estimation: TargetEstimation) -> None:
        escapes, target = self.machine.escapes, estimation.target
        if escapes is None:
            return
        escapes.relative = {}
        for i, covariance in estimation.motion_covariances.items():
            own = estimation.own[i]
            state = np.concatenate(
                [own.position_m - target.position_m, own.velocity_m_s - target.velocity_m_s]
            )
            escapes.relative[i] = RelativeState(state, covariance, target)

    def _update_abort_margins(self, observation: Observation) -> dict[int, float]:
        """Return the margin of the best abort of each chaser whose passive safety is enforced,
        renewed once a second.
        """
        escapes, machine = self.machine.escapes, self.machine
        if escapes is None:
            return {}
        enforced = [i for i in sorted(observation.odometry) if machine.enforces_safety(i)]
        renew = observation.tick % self._scenario.time.rate_hz == 0
        for i in enforced:
            if (renew or i not in self._abort_margins) and (
                found := escapes.escape(i, observation.time_s)
            ):
                self._abort_margins[i] = found[1]
        self._abort_margins = {
            i: self._abort_margins[i] for i in enforced if i in self._abort_margins
        }
        return dict(self._abort_margins)

    def _apply_commands(
        self,
        commands: Sequence[OperatorCommand],
        observation: Observation,
        stack: StackState | None,
    ) -> list[CommandReply]:
        now_s = observation.time_s
        self.machine.set_pending_goals(commands)
        self.machine.set_detumble_refusal(self._why_not_detumble(commands, observation, stack))
        replies = []
        for command in commands:
            handler = self.thrusters if command.command in THRUSTER_COMMANDS else self.machine
            result = handler.command(command, now_s)
            replies.append(
                CommandReply(
                    tick=observation.tick,
                    sim_time_ns=observation.time_ns,
                    command=command.command,
                    chaser=command.chaser,
                    accepted=result.accepted,
                    reason=result.reason,
                    operator=command.operator,
                )
            )
        return replies

    def _why_not_detumble(
        self,
        commands: Sequence[OperatorCommand],
        observation: Observation,
        stack: StackState | None,
    ) -> str:
        """Return why the chasers that one tick's commands name cannot stop the stack together with
        those that do already.
        """
        named = {
            c.chaser for c in commands if c.command == "detumble" and c.chaser < len(self.chasers)
        }
        able = {i for i in named if self.machine.may_detumble(i)}
        if not able:
            return ""
        return self.detumble.why_not(stack, able | self.machine.detumbling(), observation.isolated)

    def _detumble_commands(
        self, observation: Observation, stack: StackState | None
    ) -> Mapping[int, DirectCommand]:
        """Return the commands of chasers that move the stack, by chaser. Pulses that identify it
        wait while it is stopped.
        """
        detumbling = self.machine.detumbling() & observation.odometry.keys()
        active = detumbling or self.machine.identifying() & observation.odometry.keys()
        if stack is None or not active:
            self.detumble.reset()
            return {}
        task = StackTask.STOP
        if self._leaving():
            task = StackTask.WAIT
        elif not detumbling:
            task = StackTask.IDENTIFY
        elif all(self.chasers[i].phase is Phase.STACK_HOLD for i in active):
            task = StackTask.HOLD
        return self.detumble.commands(stack, active, observation.isolated, task, observation)

    def _leaving(self) -> list[int]:
        """Return the chasers that back out of their corridor: the stack must not turn under them by
        thrust.
        """
        out = (Phase.RETREAT, Phase.ABORT)
        return [
            i
            for i, c in enumerate(self.chasers)
            if c.phase in out
            and not c.stuck
            and self.machine.is_free(i)
            and self.machine.in_corridor(i)
        ]

    def _report_waiting(self) -> list[LogEntry]:
        """Return an event when the stack begins to wait for chasers that back out, or goes on."""
        leaving = self._leaving() if self.machine.thrusting() else []
        waits = bool(leaving)
        if waits == self._waits:
            return []
        self._waits = waits
        if not waits:
            return [("info", "no chaser backs out any more: the stack is no longer coasting")]
        return [("info", f"the stack coasts while chaser {leaving[0]} backs out")]

    def _update_stack(self, observation: Observation, stack: StackState | None) -> None:
        """Advance the phases of detumbling chasers; close their thrusters if those that are left
        cannot stop the stack.
        """
        self.machine.update_identification(observation.time_s)
        active = self.machine.detumbling()
        if not active or stack is None:
            return
        self.detumble.follow(stack)
        present = active & stack.chasers.keys()
        if present and (reason := self.detumble.why_not(stack, present, observation.isolated)):
            self.machine.detumble_failed(observation.time_s, reason)
            return
        self.machine.update_stack(
            observation.time_s, self.detumble.is_stopped(stack), self.detumble.moves_again(stack)
        )

    def _update_chaser(
        self, i: int, observation: Observation, estimation: TargetEstimation
    ) -> ReferencePose:
        """Advance a chaser's phase by its errors and its docking sensor; return its reference at
        the start of the tick.
        """
        target, odometry, now_s = estimation.target, estimation.own[i], observation.time_s
        pose = self.references.pose(i, target, now_s)
        error_m = length(pose[0] - odometry.position_m)
        error_rad = float(rotations.angle_between(pose[1], odometry.q_wxyz))
        self.machine.set_position(i, centre_in_target(target, odometry))
        self.machine.update_tracking(i, now_s, error_m, error_rad)
        observed = self._observe_docking(i, odometry, observation, estimation)
        if observed is not None:
            self.machine.update_docking(i, now_s, observed)
        return self.references.reference(i, pose)

    def with_trusted(self, stack: StackState | None) -> StackState | None:
        """Return the stack's state without failures of thrusters that an operator has restored."""
        if stack is None or not stack.failed:
            return stack
        failed = {
            i: tuple(k for k in thrusters if k not in self.thrusters.trusted(i))
            for i, thrusters in stack.failed.items()
        }
        return replace(stack, failed=failed)

    def _isolated(self, i: int, estimation: TargetEstimation) -> tuple[int, ...]:
        """Return the thrusters that an operator or the motion of the stack has isolated."""
        failed = () if estimation.stack is None else estimation.stack.failed.get(i, ())
        trusted = self.thrusters.trusted(i)
        return tuple(
            sorted({*self.thrusters.isolated(i), *(k for k in failed if k not in trusted)})
        )

    def _observe_docking(
        self, i: int, odometry: Odometry, observation: Observation, estimation: TargetEstimation
    ) -> DockingObservation | None:
        """Return what is known of a chaser at its port; None where it has none."""
        s, target = self._scenario, estimation.target
        port = s.docking.port_of(i)
        if port is None:
            return None
        chaser = BodyState(
            np.array(odometry.position_m),
            np.array(odometry.velocity_m_s),
            np.array(odometry.q_wxyz),
            np.array(odometry.omega_rad_s),
        )
        moving = BodyState(
            target.position_m, target.velocity_m_s, target.q_wxyz, target.omega_rad_s
        )
        view = view_of(
            port, s.chaser.probe_reach_m, np.asarray(s.chasers[i].q_wxyz), chaser, moving
        )
        status = observation.docking.get(i)
        contact = status is not None and status.contact
        pose = pose_in_target(target, odometry)
        return DockingObservation(
            view, contact, i in estimation.latched, *pose, sensed=status is not None
        )

    def _attached(self, observation: Observation, estimation: TargetEstimation) -> frozenset[int]:
        """Return the latched chasers that are to stay, or cannot leave; their actuators are off but
        for the latch test.
        """
        backing_out = (Phase.RETREAT, Phase.ABORT)
        latched = estimation.latched & observation.odometry.keys()
        return frozenset(
            i for i in latched if self.chasers[i].phase not in backing_out or self.chasers[i].stuck
        )

    def _direct_command(
        self, i: int, observation: Observation, estimation: TargetEstimation, attached: bool
    ) -> DirectCommand | None:
        c = self.chasers[i]
        if i in observation.invalid:
            return DirectCommand("coast", np.zeros(6))
        if i not in observation.odometry:
            return None
        if c.phase is Phase.SEARCHING:
            acquiring = next((s.acquiring for s in observation.sightings if s.chaser == i), None)
            wrench = self.search.wrench(estimation.own[i], c.since_s, estimation.target, acquiring)
            return DirectCommand("search", wrench)
        if attached:
            pull_N = self.machine.pull_N(i, observation.time_s)
            wrench = np.array([-pull_N, 0.0, 0.0, 0.0, 0.0, 0.0])
            return DirectCommand("pull" if pull_N else "coast", wrench)
        return None

    def _events(self, estimation: TargetEstimation) -> list[LogEntry]:
        changes = self.machine.drain_changes()
        events: list[LogEntry] = [
            (c.level, f"chaser {c.chaser}: {c.phase} ({c.detail})") for c in changes
        ]
        for change in changes:
            camera = next((c for c in estimation.cameras if c.chaser == change.chaser), None)
            if change.calibration_complete and camera is not None:
                events.append(("info", f"chaser {change.chaser}: {_describe(camera)}"))
        return events


def _describe(c: CameraCalibration) -> str:
    turn, sigma = (
        ", ".join(f"{np.degrees(v):.3f}" for v in x) for x in (c.turn_rad, c.turn_sigma_rad)
    )
    return f"camera calibrated: turned by ({turn}) deg in CRF, sigma ({sigma}) deg"
