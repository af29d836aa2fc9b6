# SPDX-License-Identifier: Apache-2.0
"""Last stage of a tick: select each chaser's command and build the messages."""

from __future__ import annotations

from chaserdock_models.braking import brake_wrench
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import WrenchCommand
from chaserdock_protocol.scenario import FlightScenario

from chaserdock_controller.ingest.latency_compensation import CommandHistory
from chaserdock_controller.interfaces import (
    DirectCommand,
    GuidanceResult,
    LogEntry,
    Observation,
    PlanResult,
    TargetEstimation,
    TickOutputs,
)

from .message_builders import (
    event_message,
    plan_message,
    reference_message,
    solver_message,
    target_message,
)
from .quantization import in_steps


class OutputStage:
    """Keeps the commands sent so far, and which chasers have no plan."""

    def __init__(self, scenario: FlightScenario) -> None:
        self._scenario = scenario
        self.history = CommandHistory()
        self._without_plan: set[int] = set()

    def run(
        self,
        observation: Observation,
        estimation: TargetEstimation,
        guidance: GuidanceResult,
        result: PlanResult,
    ) -> TickOutputs:
        """Return all messages of a tick."""
        out = TickOutputs(target=target_message(observation, estimation), replies=list(guidance.replies))
        events = [*observation.events, *estimation.events, *guidance.events, *result.events]
        for i in sorted(observation.odometry):
            directive = guidance.directives[i]
            if directive.reference is not None:
                out.references[i] = reference_message(i, observation, directive)
            command = directive.direct
            if command is None:
                command = self._plan_or_brake(i, observation, estimation, result, events, out)
            out.wrenches[i] = self._send(i, observation, guidance, command)
        for i, reason in observation.invalid.items():
            if i not in self._without_plan:
                events.append(("error", f"chaser {i}: invalid odometry, coasting: {reason}"))
            self._without_plan.add(i)
            command = guidance.directives[i].direct
            assert command is not None
            out.wrenches[i] = self._send(i, observation, guidance, command)
        self.history.forget_before(observation.time_ns)
        out.solver = solver_message(observation, self._scenario.controller.solver, result)
        out.events = [event_message(observation, level, text) for level, text in events]
        return out

    def _plan_or_brake(
        self,
        i: int,
        observation: Observation,
        estimation: TargetEstimation,
        result: PlanResult,
        events: list[LogEntry],
        out: TickOutputs,
    ) -> DirectCommand:
        """Return the first input of a chaser's plan, or a braking wrench without a usable plan."""
        plan = result.plan
        row = result.chasers.index(i) if i in result.chasers else 0
        usable = plan is not None and plan.status[row] != "failed"
        if usable != (i not in self._without_plan) and estimation.known:
            if usable:
                events.append(("info", f"chaser {i}: planned again"))
                self._without_plan.discard(i)
            else:
                events.append(("error", f"chaser {i}: no plan, braking"))
                self._without_plan.add(i)
        if plan is None or not usable:
            return DirectCommand("brake", brake_wrench(estimation.own[i], self._scenario.chaser))
        step_s = self._scenario.controller.dt_s
        out.plans[i] = plan_message(i, observation, step_s, plan, row)
        return DirectCommand("nmpc", plan.inputs[row, 0])

    def _send(
        self, i: int, observation: Observation, guidance: GuidanceResult, command: DirectCommand
    ) -> WrenchCommand:
        wrench = in_steps(command.wrench, observation.input_limits[i])
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
            latch=directive.latch,
            isolated=directive.isolated,
            trusted=directive.trusted,
            free=directive.free,
        )
