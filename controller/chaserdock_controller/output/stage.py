# SPDX-License-Identifier: Apache-2.0
"""Last stage of a tick: select each chaser's command and build the messages."""

from __future__ import annotations

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.braking import brake_wrench
from chaserdock_models.rigid_body import BodyState
from chaserdock_models.setpoint_tracking import Setpoint, track_setpoint
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import ExpectedPose, GeometryEstimate, WrenchCommand
from chaserdock_protocol.scenario import FlightScenario

from chaserdock_controller.ingest.latency_compensation import CommandHistory
from chaserdock_controller.interfaces import (
    DirectCommand,
    GuidanceResult,
    HorizonReference,
    LogEntry,
    Observation,
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


class OutputStage:
    """Keeps the commands sent so far, and which chasers have no plan."""

    def __init__(self, scenario: FlightScenario) -> None:
        self._scenario = scenario
        self.history = CommandHistory()
        self._without_plan: set[int] = set()
        self._camera, self._period_s = scenario.camera_model(), 1.0 / scenario.time.rate_hz

    def run(
        self,
        observation: Observation,
        estimation: TargetEstimation,
        guidance: GuidanceResult,
        result: PlanResult,
    ) -> TickOutputs:
        """Return all messages of a tick."""
        out = TickOutputs(
            target=target_message(observation, estimation), replies=list(guidance.replies)
        )
        if estimation.stack is not None and observation.tick % self._scenario.time.rate_hz == 0:
            out.stack = stack_message(observation, estimation.stack)
        shape = estimation.shape
        renewed = shape is not None and (
            shape.changed or observation.tick % self._scenario.time.rate_hz == 0
        )
        geometry = geometry_estimate(shape) if shape is not None and renewed else None
        expected = self._expected(observation, estimation)
        events = [*observation.events, *estimation.events, *guidance.events, *result.events]
        for i in sorted(observation.odometry):
            directive = guidance.directives[i]
            if directive.reference is not None:
                out.references[i] = reference_message(i, observation, directive)
            command = directive.direct
            if command is None:
                command = self._planned_or_safe(
                    i, observation, estimation, guidance, result, events, out
                )
            out.wrenches[i] = self._send(
                i, observation, guidance, command, geometry, expected.get(i)
            )
        for i, reason in observation.invalid.items():
            if i not in self._without_plan:
                events.append(("error", f"chaser {i}: invalid odometry, coasting: {reason}"))
            self._without_plan.add(i)
            command = guidance.directives[i].direct
            assert command is not None
            out.wrenches[i] = self._send(i, observation, guidance, command, geometry, None)
        self.history.forget_before(observation.time_ns)
        out.safety = {
            i: safety_message(i, observation, guidance, c) for i, c in result.certificates.items()
        }
        out.solver = solver_message(observation, self._scenario.controller.solver, result)
        out.events = [event_message(observation, level, text) for level, text in events]
        return out

    def _expected(
        self, observation: Observation, estimation: TargetEstimation
    ) -> dict[int, ExpectedPose]:
        """Return where chasers that do not see a target without markers will have it in their next
        image.
        """
        if self._scenario.perception.name != "model" or not estimation.known:
            return {}
        unseen = [i for i in observation.odometry if i not in estimation.visible_to]
        return {
            i: expected_pose(i, estimation, self._camera, observation.time_ns, self._period_s)
            for i in unseen
        }

    def _planned_or_safe(
        self,
        i: int,
        observation: Observation,
        estimation: TargetEstimation,
        guidance: GuidanceResult,
        result: PlanResult,
        events: list[LogEntry],
        out: TickOutputs,
    ) -> DirectCommand:
        """Return the input of a chaser's plan; without one that may be flown, a safe wrench.

        That follows the reference, and so moves with the target. Without a target it brakes to rest
        in WRF.
        """
        step_s = self._scenario.controller.dt_s
        plan = result.flyable.get(i)
        wrench = None if plan is None else plan.input_at(observation.effective_ns, step_s)
        new = plan is not None and plan.time_ns == observation.effective_ns
        if new != (i not in self._without_plan) and estimation.known:
            if new:
                events.append(("info", f"chaser {i}: planned again"))
                self._without_plan.discard(i)
            else:
                action = "tracking its reference" if wrench is None else "flying its last plan"
                events.append(("error", f"chaser {i}: no plan, {action}"))
                self._without_plan.add(i)
        if plan is not None and wrench is not None:
            out.plans[i] = plan_message(i, observation.tick, step_s, plan)
            return DirectCommand("nmpc", wrench)
        body, horizon = self._scenario.chaser, guidance.horizon
        if horizon is None or i not in horizon.chasers:
            return DirectCommand("brake", brake_wrench(estimation.own[i], body))
        setpoint = _setpoint(horizon, horizon.chasers.index(i), step_s)
        return DirectCommand(
            "track", track_setpoint(_body_state(estimation.own_at_effect[i]), body, setpoint)
        )

    def _send(
        self,
        i: int,
        observation: Observation,
        guidance: GuidanceResult,
        command: DirectCommand,
        geometry: GeometryEstimate | None,
        expected: ExpectedPose | None,
    ) -> WrenchCommand:
        thrusts = command.thrusts_N
        # The limits hold on all axes at once; commanded thrusters need none but their own.
        limits = (
            observation.input_limits[i]
            if thrusts is None
            else np.abs(command.wrench) + COMMAND_STEP
        )
        wrench = in_steps(command.wrench, limits)
        self.history.add(i, observation.effective_ns, wrench)
        directive = guidance.directives[i]
        lifetime_ns = round(self._scenario.controller.command_lifetime_s * 1e9)
        return WrenchCommand(
            tick=observation.tick,
            sim_time_ns=observation.time_ns,
            chaser=i,
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
    """Return a state (13,) by its parts."""
    return BodyState(x[:3], x[3:6], x[6:10], x[10:])


def _setpoint(horizon: HorizonReference, row: int, step_s: float) -> Setpoint:
    """Return the reference at the beginning of the horizon; its rates are those over the first
    stage.
    """
    now, then = horizon.references[row, :2]
    turn = rotations.log(rotations.multiply(rotations.conjugate(now[3:]), then[3:]))
    return Setpoint(
        now[:3], (then[:3] - now[:3]) / step_s, now[3:], turn / step_s, horizon.u_ref[row, 0]
    )
