"""One tick of the controller, without I/O: odometry and sightings in, commands and all that explains them out."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from chaserdock_protocol import rotations
from chaserdock_protocol.braking import brake_wrench
from chaserdock_protocol.codec import vector
from chaserdock_protocol.facing import facing_attitudes
from chaserdock_protocol.messages import (
    CommandReply,
    DockingStatus,
    Event,
    JetReport,
    Odometry,
    OperatorCommand,
    Plan,
    Reference,
    Sighting,
    SolverStatus,
    TargetEstimate,
    WrenchCommand,
)
from chaserdock_protocol.rotations import Array
from chaserdock_protocol.scenario import Scenario

from . import reference
from .captures import Captures
from .fusion import geometry
from .fusion.types import Estimator, Measurement
from .fusion.types import TargetEstimate as Fused
from .guidance import Guidance
from .jets import JET_COMMANDS, JetDesk
from .nmpc import NmpcInput, NmpcPlan, make_solver
from .prediction import CommandHistory, predict_state, predict_state_with_impulse
from .setup import estimator_of, nmpc_parameters

Mode = Literal["nmpc", "brake", "coast", "pull"]
_ODOMETRY_KEPT_NS = 2_000_000_000
_GREATEST_MARGIN_M = 0.1


COMMAND_STEP = np.array([2.0**-16] * 3 + [2.0**-22] * 3)
"""Resolution of commands: 15 uN and 0.24 uN m, 17 and 18 bits of the paper's actuators.

A command word is finite anyway. Here it also swallows what another SIMD level or BLAS changes in the last bits, which
pictures in whole grey levels would otherwise blow up to their own noise.
"""


def in_steps(wrench: Array, limits: Array) -> Array:
    """The nearest wrench (6,) that a command can carry, within ``limits`` (6,)."""
    return np.clip(np.rint(wrench / COMMAND_STEP) * COMMAND_STEP, -limits, limits)


@dataclass(frozen=True)
class Inputs:
    """What a tick brings. Sightings may belong to earlier ticks."""

    tick: int
    time_ns: int
    odometry: dict[int, Odometry]
    sightings: tuple[Sighting, ...]
    commands: tuple[OperatorCommand, ...] = ()
    jets: Mapping[int, JetReport] = field(default_factory=dict)
    docking: Mapping[int, DockingStatus] = field(default_factory=dict)


@dataclass
class Outputs:
    """What a tick yields; dictionaries by chaser."""

    target: TargetEstimate
    wrenches: dict[int, WrenchCommand] = field(default_factory=dict)
    references: dict[int, Reference] = field(default_factory=dict)
    plans: dict[int, Plan] = field(default_factory=dict)
    solver: SolverStatus | None = None
    replies: list[CommandReply] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)


class Flight:
    """The controller's memory from tick to tick. ``now_s`` is a wall clock that only measures the solver.

    ``estimator`` takes the place of the one that the scenario names.
    """

    def __init__(
        self, scenario: Scenario, now_s: Callable[[], float], estimator: Estimator | None = None
    ) -> None:
        self.scenario = scenario
        self.guidance = Guidance(scenario)
        self._jets = JetDesk(scenario)
        self._now_s = now_s
        self._camera = scenario.camera_model()
        self._estimator = estimator or estimator_of(scenario)
        self._captures = Captures(scenario, self._estimator)
        self._parameters = nmpc_parameters(scenario)
        c = scenario.controller
        self._solver = make_solver(c.solver, self._parameters, len(scenario.chasers), c.max_iterations)
        self._odometry: dict[tuple[int, int], Odometry] = {}
        self._history = CommandHistory()
        self._last_solve_ns: int | None = None
        self._troubled: set[int] = set()

    def step(self, inputs: Inputs) -> Outputs:
        """Everything that one tick asks of the controller."""
        now_s = inputs.time_ns / 1e9
        fused, target = self.fuse(inputs)
        out = Outputs(target=target)
        self._events(out, inputs, [("info", text) for _, text in self._estimator.drain_events()])
        if fused.status in ("tracking", "predicting"):
            self.guidance.found(now_s)
        elif fused.status == "lost":
            self.guidance.lost(now_s)
        commands = (*self.guidance.due_commands(now_s), *inputs.commands)
        self.guidance.expect(commands)
        for command in commands:
            if command.command in JET_COMMANDS:
                answer = self._jets.command(command)
            else:
                answer = self.guidance.command(command, now_s)
            out.replies.append(
                CommandReply(
                    tick=inputs.tick,
                    sim_time_ns=inputs.time_ns,
                    command=command.command,
                    chaser=command.chaser,
                    accepted=answer.accepted,
                    reason=answer.reason,
                    operator=command.operator,
                )
            )
        self._command(inputs, fused, out)
        self._history.forget_before(inputs.time_ns)
        return out

    def fuse(self, inputs: Inputs) -> tuple[Fused, TargetEstimate]:
        """The estimation of ``step`` alone: the fused state and its message. Once a tick, by ``step`` or instead of it."""
        for odometry in inputs.odometry.values():
            self._odometry[odometry.chaser, odometry.sim_time_ns] = odometry
        self._jets.take(inputs.jets)
        given = self._jets.given(inputs.tick)
        self._captures.feel(inputs.docking, inputs.odometry, self._history, inputs.time_ns, given)
        fused = self._estimator.update(self._measurements(inputs.sightings), inputs.time_ns)
        if fused.status in ("tracking", "predicting"):
            self._captures.join(fused, inputs.odometry)
        for key in [k for k in self._odometry if k[1] < inputs.time_ns - _ODOMETRY_KEPT_NS]:
            del self._odometry[key]
        return fused, self._target_message(inputs, fused)

    def _measurements(self, sightings: tuple[Sighting, ...]) -> list[Measurement]:
        measurements = []
        for s in sightings:
            odometry = self._odometry.get((s.chaser, s.sim_time_ns))
            if odometry is None:
                continue  # exposed before this controller knew where that chaser was
            hypotheses = tuple(
                geometry.to_world(
                    odometry.position_m,
                    odometry.q_wxyz,
                    self._camera.position_crf_m,
                    self._camera.q_crf_irf_wxyz,
                    solution.position_m,
                    solution.q_wxyz,
                    np.reshape(solution.covariance, (6, 6)),
                )
                for solution in s.solutions
            )
            measurements.append(Measurement(s.chaser, s.sim_time_ns, hypotheses, len(s.marker_ids)))
        return measurements

    def _command(self, inputs: Inputs, fused: Fused, out: Outputs) -> None:
        """References, plan and commands of all chasers whose odometry is there."""
        ids = tuple(sorted(inputs.odometry))
        effective_ns = self.scenario.timing.effective_ns(inputs.tick)
        known = fused.status in ("tracking", "predicting")
        plan: NmpcPlan | None = None
        took_s = 0.0
        # Who holds on to the target is planned for only where others have to fly around it.
        held = {i for i in ids if self._is_held(i)}
        planned = ids if held != set(ids) else ()
        problem = None
        if known and planned:
            problem = self._problem(planned, inputs, self._estimator.estimate_at(effective_ns), effective_ns)
        self._describe(ids if known else (), inputs, fused, out)
        if problem is not None:
            begun_s = self._now_s()
            since_ns = 0 if self._last_solve_ns is None else inputs.time_ns - self._last_solve_ns
            try:
                plan = self._solver.solve(problem, since_ns / 1e9, ids)
                self._last_solve_ns = inputs.time_ns
            except (ValueError, ArithmeticError, RuntimeError) as error:
                self._events(out, inputs, [("error", f"the solver refused: {error}")])
            took_s = self._now_s() - begun_s
        for row, i in enumerate(ids):
            if i in held or self._is_held(i):
                pull = (-self.guidance.pull_N(i, inputs.time_ns / 1e9), 0.0, 0.0, 0.0, 0.0, 0.0)
                self._send(i, inputs, effective_ns, "pull" if pull[0] else "coast", np.array(pull), out)
                continue
            usable = plan is not None and plan.status[row] != "failed"
            if usable != (i not in self._troubled) and known:
                text = f"chaser {i}: " + ("planned again" if usable else "no plan, braking")
                self._events(out, inputs, [("info" if usable else "error", text)])
                (self._troubled.discard if usable else self._troubled.add)(i)
            if plan is not None and usable:
                wrench: Array = plan.inputs[row, 0]
                mode: Mode = "nmpc"
                out.plans[i] = self._plan_message(i, inputs, effective_ns, plan, row)
            else:
                wrench, mode = brake_wrench(inputs.odometry[i], self.scenario.chaser), "brake"
            self._send(i, inputs, effective_ns, mode, wrench, out)
        out.solver = SolverStatus(
            tick=inputs.tick,
            sim_time_ns=inputs.time_ns,
            solver=self.scenario.controller.solver,
            chasers=planned if plan is not None else (),
            status=plan.status if plan is not None else (),
            iterations=tuple(int(n) for n in plan.iterations) if plan is not None else (),
            cost=vector(plan.cost) if plan is not None else (),
            max_violation_m=vector(plan.max_violation_m) if plan is not None else (),
            wall_solve_s=took_s,
        )

    def _is_held(self, i: int) -> bool:
        """Whether a chaser holds on to the target and is to stay: then its actuators are quiet unless told."""
        return i in self._captures.latched and self.guidance.chasers[i].phase not in ("retreat", "abort")

    def _send(
        self, i: int, inputs: Inputs, effective_ns: int, mode: Mode, wrench: Array, out: Outputs
    ) -> None:
        wrench = in_steps(wrench, self._jets.limits(i))
        self._history.add(i, effective_ns, wrench)
        out.wrenches[i] = WrenchCommand(
            tick=inputs.tick,
            sim_time_ns=inputs.time_ns,
            chaser=i,
            effective_time_ns=effective_ns,
            expires_ns=inputs.time_ns + round(self.scenario.controller.command_lifetime_s * 1e9),
            mode=mode,
            force_N=vector(wrench[:3]),
            torque_N_m=vector(wrench[3:]),
            latch=self.guidance.latch(i),
            isolated=self._jets.isolated(i),
            trusted=self._jets.trusted(i),
            free=self.guidance.is_free(i),
        )

    def _problem(self, ids: tuple[int, ...], inputs: Inputs, ahead: Fused, effective_ns: int) -> NmpcInput:
        """The NMPC's problem at the time when the commands take effect."""
        p, s = self._parameters, self.scenario
        times_s = np.arange(p.stages + 1) * p.dt_s
        nodes, middles = self._captures.path(ahead, p.dt_s, p.stages)
        states, references, u_ref = [], [], []
        for i in ids:
            offset = self.guidance.chasers[i].move.at(effective_ns / 1e9 + times_s)
            q_off = self._attitudes(i, offset[0])
            coming = self._jets.coming(i, inputs.tick)
            if coming is None:
                state = predict_state(inputs.odometry[i], self._history, effective_ns, s.chaser)
            else:
                state = predict_state_with_impulse(inputs.odometry[i], coming, effective_ns, s.chaser)
            states.append(state)
            references.append(reference.references_on(nodes.positions_m, nodes.q_wxyz, offset[0], q_off))
            if s.controller.feed_forward:
                held = self.guidance.chasers[i].move.at(effective_ns / 1e9 + times_s[:-1] + p.dt_s / 2)
                u_ref.append(
                    reference.feed_forward(
                        middles.omega_rad_s,
                        *held,
                        self._attitudes(i, held[0]),
                        s.chaser.mass_kg,
                        np.diag(s.chaser.inertia),
                        middles.alpha_rad_s2,
                        middles.acceleration_m_s2,
                    )
                )
            else:
                u_ref.append(np.zeros((p.stages, 6)))
        limits = np.array([self._jets.limits(i) for i in ids])
        for row, i in enumerate(ids):
            if self._is_held(i):  # it gives nobody room: no more than what follows the target's motion
                limits[row] = np.minimum(limits[row], 1.2 * np.abs(u_ref[row]).max(axis=0) + 1e-3)
        return NmpcInput(
            states=np.array(states),
            references=np.array(references),
            u_ref=np.array(u_ref),
            target_positions=nodes.positions_m,
            min_distance_target_m=np.array([self.guidance.min_distance_target_m(i) for i in ids])
            + self._margin_m(ahead),
            min_distance_chasers_m=s.limits.min_distance_chasers_m,
            input_max=limits,
        )

    def _attitudes(self, i: int, offsets: Array) -> Array:
        """Attitude of a chaser's reference, body to TRF, at offsets (K, 3): (K, 4), or (4,) where it never turns."""
        c = self.scenario.chasers[i]
        if not self.scenario.approach.face_target:
            return np.array(c.q_wxyz)
        return facing_attitudes(c.position_m, c.q_wxyz, offsets)

    def _margin_m(self, ahead: Fused) -> float:
        """What the uncertainty of the target's position adds to the distance from it."""
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(ahead.covariance[:3, :3])[-1]))
        return min(self.scenario.limits.estimate_margin_sigmas * sigma_m, _GREATEST_MARGIN_M)

    def _describe(self, ids: tuple[int, ...], inputs: Inputs, fused: Fused, out: Outputs) -> None:
        """Where every chaser is to be now, and its phase by how near it is to that."""
        now_s = inputs.time_ns / 1e9
        for i in ids:
            offset = self.guidance.chasers[i].move.at(np.array([now_s]))[0][0]
            position = fused.position_m + rotations.rotate(fused.q_wxyz, offset)
            attitude = rotations.multiply(fused.q_wxyz, self._attitudes(i, offset[None]).reshape(4))
            odometry = inputs.odometry[i]
            error_m = float(np.linalg.norm(position - odometry.position_m))
            error_rad = float(rotations.angle_between(attitude, odometry.q_wxyz))
            self.guidance.observe(i, now_s, error_m, error_rad)
            senses = self._captures.senses(i, fused, odometry, inputs.docking.get(i))
            if senses is not None:
                self.guidance.sense(i, now_s, senses)
            phase = self.guidance.chasers[i]
            out.references[i] = Reference(
                tick=inputs.tick,
                sim_time_ns=inputs.time_ns,
                chaser=i,
                phase=phase.phase,  # type: ignore[arg-type]
                phase_time_s=now_s - phase.since_s,
                position_m=vector(position),
                q_wxyz=vector(attitude),
                offset_m=vector(offset),
                min_distance_target_m=self.guidance.min_distance_target_m(i),
            )
        changes = self.guidance.drain_events()
        self._events(out, inputs, [("info", f"chaser {i}: {what} ({detail})") for i, what, detail in changes])

    def _plan_message(self, i: int, inputs: Inputs, effective_ns: int, plan: NmpcPlan, row: int) -> Plan:
        return Plan(
            tick=inputs.tick,
            sim_time_ns=effective_ns,
            chaser=i,
            step_s=self._parameters.dt_s,
            positions_m=vector(plan.states[row, :, :3]),
            quaternions_wxyz=vector(plan.states[row, :, 6:10]),
            inputs=vector(plan.inputs[row]),
        )

    def _target_message(self, inputs: Inputs, fused: Fused) -> TargetEstimate:
        seen = {s.chaser for s in inputs.sightings if s.solutions and s.sim_time_ns == inputs.time_ns}
        return TargetEstimate(
            tick=inputs.tick,
            sim_time_ns=inputs.time_ns,
            status=fused.status,  # type: ignore[arg-type]
            position_m=vector(fused.position_m),
            velocity_m_s=vector(fused.velocity_m_s),
            q_wxyz=vector(fused.q_wxyz),
            omega_rad_s=vector(fused.omega_rad_s),
            covariance=vector(fused.covariance),
            accepted=tuple(sorted(seen - set(fused.rejected))),
            rejected=tuple(sorted(fused.rejected)),
        )

    def _events(self, out: Outputs, inputs: Inputs, told: list[tuple[str, str]]) -> None:
        for level, text in told:
            out.events.append(
                Event(
                    tick=inputs.tick,
                    sim_time_ns=inputs.time_ns,
                    process="controller",
                    level=level,  # type: ignore[arg-type]
                    what=text,
                )
            )
