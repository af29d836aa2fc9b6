# SPDX-License-Identifier: Apache-2.0
"""Last stage of a tick: select each chaser's command, build the messages."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.braking import brake_wrench
from chaserdock_models.rigid_body import BodyState
from chaserdock_models.setpoint_tracking import Setpoint, track_setpoint
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import (
    CommandedWrench,
    ExpectedPose,
    GeometryEstimate,
    WrenchCommand,
)
from chaserdock_protocol.scenario import FlightScenario

from chaserdock_controller.ingest.latency_compensation import CommandHistory
from chaserdock_controller.interfaces import (
    ChaserEstimate,
    ChaserObservation,
    ChaserPlanning,
    DirectCommand,
    Directive,
    GuidanceResult,
    HorizonReference,
    LogEntry,
    Observation,
    OwnMotion,
    PlanResult,
    TargetEstimation,
    TickOutputs,
)

from .message_builders import (
    event_message,
    expected_pose,
    geometry_estimate,
    plan_message,
    reference_message,
    safety_message,
    solver_message,
    stack_message,
    target_message,
)
from .quantization import COMMAND_STEP, in_steps


class ChaserResult(NamedTuple):
    """Results of all stages for one chaser."""

    seen: ChaserObservation
    estimate: ChaserEstimate
    directive: Directive
    planning: ChaserPlanning


class OutputStage:
    """Builds the outputs of a tick. Keeps the commands sent to each chaser so far (``sent``), and
    which chasers have no plan.
    """

    def __init__(self, scenario: FlightScenario) -> None:
        self._scenario = scenario
        self.sent = tuple(CommandHistory() for _ in scenario.chasers)
        self._without_plan: set[int] = set()
        self._camera, self._period_s = scenario.camera_model(), 1.0 / scenario.time.rate_hz
        self._step_s = scenario.controller.dt_s

    def run(
        self,
        observation: Observation,
        estimation: TargetEstimation,
        guidance: GuidanceResult,
        planning: PlanResult,
    ) -> TickOutputs:
        """Return all messages of a tick."""
        o, out = observation, TickOutputs(target=target_message(observation, estimation))
        out.replies = list(guidance.replies)

        periodic = o.tick % self._scenario.time.rate_hz == 0
        if estimation.stack is not None and periodic:
            out.stack = stack_message(o, estimation.stack)
        shape, geometry = estimation.shape, None
        if shape is not None and (shape.changed or periodic):
            geometry = geometry_estimate(shape)

        events = [*o.events, *estimation.events, *guidance.events, *planning.events]
        chasers = [
            ChaserResult(*parts)
            for parts in zip(
                o.chasers, estimation.chasers, guidance.directives, planning.chasers, strict=True
            )
        ]

        for c in chasers:
            if c.estimate.own is not None:
                command = self._command(o, estimation, guidance, c, c.estimate.own, out, events)
                expected = self._expected(o, estimation, c.estimate)
                out.wrenches[c.seen.chaser] = self._send(o, c, command, geometry, expected)

        for c in chasers:
            if c.seen.invalid:
                command = self._coast(c, events)
                out.wrenches[c.seen.chaser] = self._send(o, c, command, geometry, None)

        for sent in self.sent:
            sent.forget_before(o.time_ns)
        out.safety = {
            c.seen.chaser: safety_message(o, c.directive, c.planning.certificate)
            for c in chasers
            if c.planning.certificate is not None
        }

        out.solver = solver_message(o, self._scenario.controller.solver, planning)
        out.events = [event_message(o, level, text) for level, text in events]
        return out

    def _command(
        self,
        o: Observation,
        estimation: TargetEstimation,
        guidance: GuidanceResult,
        c: ChaserResult,
        own: OwnMotion,
        out: TickOutputs,
        events: list[LogEntry],
    ) -> DirectCommand:
        """Return the command of a chaser with the state ``own``. Adds its reference and plan to
        ``out``.
        """
        i, directive = c.seen.chaser, c.directive
        if directive.reference is not None:
            out.references[i] = reference_message(o, directive, directive.reference)
        if directive.direct is not None:
            return directive.direct
        plan = c.planning.flyable
        wrench = None if plan is None else plan.input_at(o.effective_ns, self._step_s)
        new = plan is not None and plan.time_ns == o.effective_ns
        if estimation.known:
            self._report_plan(i, new, wrench is not None, events)
        if plan is None or wrench is None:
            return self._safe(i, own, guidance.horizon)
        out.plans[i] = plan_message(i, o.tick, self._step_s, plan)
        return DirectCommand("nmpc", wrench)

    def _report_plan(self, i: int, new: bool, flies: bool, events: list[LogEntry]) -> None:
        """Log a change: the chaser has no ``new`` plan any more, ``flies`` an older one or none, or
        has a new one again.
        """
        if new == (i not in self._without_plan):
            return
        if new:
            events.append(("info", f"chaser {i}: planned again"))
            self._without_plan.discard(i)
        else:
            action = "flying its last plan" if flies else "tracking its reference"
            events.append(("error", f"chaser {i}: no plan, {action}"))
            self._without_plan.add(i)

    def _safe(self, i: int, own: OwnMotion, horizon: HorizonReference | None) -> DirectCommand:
        """Return the command of a chaser without a plan: follow the reference and so move with the
        target. Without a target: brake to rest in WRF.
        """
        body = self._scenario.chaser
        if horizon is None or i not in horizon.chasers:
            return DirectCommand("brake", brake_wrench(own.state, body))
        setpoint = _setpoint(horizon, horizon.chasers.index(i), self._step_s)
        return DirectCommand("track", track_setpoint(_body_state(own.at_effect), body, setpoint))

    def _coast(self, c: ChaserResult, events: list[LogEntry]) -> DirectCommand:
        """Return the command of a chaser with invalid odometry; log it once."""
        i = c.seen.chaser
        if i not in self._without_plan:
            events.append(("error", f"chaser {i}: invalid odometry, coasting: {c.seen.invalid}"))
        self._without_plan.add(i)
        assert c.directive.direct is not None
        return c.directive.direct

    def _expected(
        self, o: Observation, estimation: TargetEstimation, estimate: ChaserEstimate
    ) -> ExpectedPose | None:
        """Return where a target without markers, which the chaser does not see, will appear in its
        next image.
        """
        unseen = self._scenario.perception.name == "model" and not estimate.visible
        if not unseen or not estimation.known or estimate.own is None:
            return None
        own = estimate.own.state
        return expected_pose(estimation.target, own, self._camera, o.time_ns, self._period_s)

    def take_commanded(self, tick: int, wrenches: Iterable[CommandedWrench]) -> None:
        """Replace the commands of a tick by those that another controller has sent."""
        effective_ns = self._scenario.timing.effective_ns(tick)
        for w in wrenches:
            if w.chaser < len(self.sent):
                wrench = np.array([*w.force_N, *w.torque_N_m])
                self.sent[w.chaser].replace(effective_ns, wrench)

    def _send(
        self,
        observation: Observation,
        c: ChaserResult,
        command: DirectCommand,
        geometry: GeometryEstimate | None,
        expected: ExpectedPose | None,
    ) -> WrenchCommand:
        seen, directive, thrusts = c.seen, c.directive, command.thrusts_N
        # The limits hold for all axes together; for commanded thrusters only their own limits
        # apply.
        limits = seen.input_limits if thrusts is None else np.abs(command.wrench) + COMMAND_STEP
        wrench = in_steps(command.wrench, limits)
        self.sent[seen.chaser].add(observation.effective_ns, wrench)
        lifetime_ns = round(self._scenario.controller.command_lifetime_s * 1e9)
        return WrenchCommand(
            tick=observation.tick,
            sim_time_ns=observation.time_ns,
            chaser=seen.chaser,
            effective_time_ns=observation.effective_ns,
            expires_ns=observation.time_ns + lifetime_ns,
            mode=command.mode,
            force_N=vector(wrench[:3]),
            torque_N_m=vector(wrench[3:]),
            thrusts_N=()
            if thrusts is None
            else vector(np.rint(thrusts / COMMAND_STEP[0]) * COMMAND_STEP[0]),
            latch=directive.latch,
            isolated=directive.isolated,
            trusted=directive.trusted,
            free=directive.free,
            geometry=geometry,
            expected=expected,
        )


def _body_state(x: Array) -> BodyState:
    """Split a state (13,) into its parts."""
    return BodyState(x[:3], x[3:6], x[6:10], x[10:])


def _setpoint(horizon: HorizonReference, row: int, step_s: float) -> Setpoint:
    """Return the reference at the beginning of the horizon, with its mean rates over the first
    stage.
    """
    now, then = horizon.references[row, :2]
    turn = rotations.log(rotations.multiply(rotations.conjugate(now[3:]), then[3:]))
    return Setpoint(
        now[:3], (then[:3] - now[:3]) / step_s, now[3:], turn / step_s, horizon.u_ref[row, 0]
    )
