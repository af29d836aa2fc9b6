"""One tick of the controller, without I/O: odometry and sightings in, commands and all that explains them out."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal, cast

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.attitude_reference import facing_attitudes
from chaserdock_models.braking import brake_wrench
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import (
    CommandReply,
    Event,
    Odometry,
    Reference,
    Sighting,
    SolverStatus,
    TargetEstimate,
    WrenchCommand,
)
from chaserdock_protocol.plugins import PluginError
from chaserdock_protocol.scenario import Scenario

from chaserdock_controller.estimation.types import CameraPose, Estimator, Measurement, TargetState
from chaserdock_controller.guidance.approach_cone import corridor_rows
from chaserdock_controller.guidance.composite_body import Captures, pose_in_target
from chaserdock_controller.guidance.phase_machine import PhaseMachine
from chaserdock_controller.guidance.phases import Phase
from chaserdock_controller.guidance.target_search import Searches, settled
from chaserdock_controller.ingest.lost_chasers import LostChasers, with_lost_chasers
from chaserdock_controller.nmpc.budget import Bounded, SolveBudget
from chaserdock_controller.output.latency_compensation import (
    CommandHistory,
    fault_of,
    predict_state,
    predict_state_with_impulse,
)
from chaserdock_controller.output.message_builders import in_words, plan_message, target_message
from chaserdock_controller.output.quantization import in_steps
from chaserdock_controller.output.thruster_state import THRUSTER_COMMANDS, ThrusterCommandHandler

from .estimation import geometry
from .guidance import reference
from .interfaces import TickInputs, TickOutputs
from .nmpc import NmpcInput, NmpcPlan, make_solver
from .parameters import estimator_of, nmpc_parameters

Mode = Literal["nmpc", "brake", "coast", "pull", "search"]
_ODOMETRY_KEPT_NS = 2_000_000_000
_GREATEST_MARGIN_M = 0.1


class ControllerCore:
    """The controller's memory from tick to tick. ``now_s`` is a wall clock that only measures the solver; in
    ``realtime`` the scenario's budget of seconds follows from what it measures.

    ``estimator`` takes the place of the one that the scenario names. Raises PluginError for an installed solver that
    cannot be held to a budget when there is one.
    """

    def __init__(
        self,
        scenario: Scenario,
        now_s: Callable[[], float],
        estimator: Estimator | None = None,
        realtime: bool = False,
    ) -> None:
        self.scenario = scenario
        self.guidance = PhaseMachine(scenario)
        self._thrusters = ThrusterCommandHandler(scenario)
        self._now_s = now_s
        self._camera = scenario.camera_model()
        self.estimator = estimator or estimator_of(scenario)
        self._captures = Captures(scenario, self.estimator)
        self._parameters = nmpc_parameters(scenario)
        c = scenario.controller
        self._solver = make_solver(c.solver, self._parameters, len(scenario.chasers), c.max_iterations)
        self._budget: SolveBudget | None = None
        if realtime and c.solve_budget_s is not None:
            self._budget = SolveBudget(c.solve_budget_s, c.max_iterations)
            if not hasattr(self._solver, "max_iterations"):
                raise PluginError(
                    f"controller.solve_budget_s: solver {c.solver!r} has no max_iterations to set"
                )
        self._odometry: dict[tuple[int, int], Odometry] = {}
        self._history = CommandHistory()
        self._last_solve_ns: int | None = None
        self._troubled: set[int] = set()
        self._searches = Searches(scenario.chaser, self._camera)
        self.absent = LostChasers()

    def step(self, inputs: TickInputs) -> TickOutputs:
        """Everything that one tick asks of the controller. Who tells of a state that is none is left out, and coasts."""
        now_s = inputs.time_ns / 1e9
        bad = {i: why for i, o in inputs.odometry.items() if (why := fault_of(o))}
        if bad:
            good = {i: o for i, o in inputs.odometry.items() if i not in bad}
            inputs = replace(inputs, odometry=good)
        fused, target = self.fuse(inputs)
        out = TickOutputs(target=target)
        self._events(out, inputs, [(e.level, e.text) for e in self.estimator.drain_events()])
        if fused.status in ("tracking", "predicting"):
            self.guidance.update_visibility(now_s, visible=fused.status == "tracking")
            self.guidance.target_acquired(now_s)
            if settled(fused):
                for i, odometry in inputs.odometry.items():
                    offset = rotations.rotate_inverse(fused.q_wxyz, odometry.position_m - fused.position_m)
                    self.guidance.target_settled(i, now_s, offset)
        else:
            if fused.status == "lost":
                self.guidance.target_lost(now_s)
            self.guidance.target_unknown(now_s)
        commands = (*self.guidance.due_commands(now_s), *inputs.commands)
        self.guidance.set_pending_goals(commands)
        for command in commands:
            if command.command in THRUSTER_COMMANDS:
                answer = self._thrusters.command(command, now_s)
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
        self._events(out, inputs, list(self.absent.take(inputs.odometry, inputs.time_ns)))
        self._command(inputs, fused, out)
        for i, why in bad.items():
            if i not in self._troubled:
                self._events(out, inputs, [("error", f"chaser {i}: odometry refused, coasting: {why}")])
            self._troubled.add(i)
            self._send(i, inputs, self.scenario.timing.effective_ns(inputs.tick), "coast", np.zeros(6), out)
        self._history.forget_before(inputs.time_ns)
        return out

    def fuse(self, inputs: TickInputs) -> tuple[TargetState, TargetEstimate]:
        """The estimation of ``step`` alone: the fused state and its message. Once a tick, by ``step`` or instead of it."""
        for odometry in inputs.odometry.values():
            self._odometry[odometry.chaser, odometry.sim_time_ns] = odometry
        self._thrusters.take(inputs.thrusters)
        given = self._thrusters.given(inputs.tick)
        self._captures.feel(inputs.docking, inputs.odometry, self._history, inputs.time_ns, given)
        fused = self.estimator.update(self._measurements(inputs.sightings), inputs.time_ns)
        if fused.status in ("tracking", "predicting"):
            self._captures.join(fused, inputs.odometry)
        for key in [k for k in self._odometry if k[1] < inputs.time_ns - _ODOMETRY_KEPT_NS]:
            del self._odometry[key]
        seen = {s.chaser for s in inputs.sightings if s.solutions}
        return fused, target_message(inputs.tick, inputs.time_ns, fused, seen, self.estimator, self._camera)

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
            eye = CameraPose(*self._camera.irf_pose_in_world(odometry.position_m, odometry.q_wxyz))
            measurements.append(Measurement(s.chaser, s.sim_time_ns, hypotheses, len(s.marker_ids), eye))
        return measurements

    def _command(self, inputs: TickInputs, fused: TargetState, out: TickOutputs) -> None:
        """References, plan and commands of all chasers whose odometry is there."""
        ids = tuple(sorted(inputs.odometry))
        effective_ns = self.scenario.timing.effective_ns(inputs.tick)
        known = fused.status in ("tracking", "predicting")
        self._describe(ids if known else (), inputs, fused, out)
        plan: NmpcPlan | None = None
        took_s = 0.0
        # Who holds on to the target is planned for only where others have to fly around it.
        held = {i for i in ids if self._is_held(i)}
        searching = {i for i in ids if self.guidance.chasers[i].phase is Phase.SEARCHING}
        planned = tuple(i for i in ids if i not in searching) if held != set(ids) else ()
        problem, away = None, {}
        if known and planned:
            problem = self._problem(planned, inputs, self.estimator.estimate_at(effective_ns), effective_ns)
            away = self.absent.away(inputs.time_ns)
            problem = with_lost_chasers(problem, away, effective_ns, self._parameters.dt_s)
        if problem is not None:
            begun_s = self._now_s()
            since_ns = 0 if self._last_solve_ns is None else inputs.time_ns - self._last_solve_ns
            if self._budget is not None:
                cast(Bounded, self._solver).max_iterations = self._budget.iterations()
            try:
                plan = self._solver.solve(problem, since_ns / 1e9, (*planned, *away))
                self._last_solve_ns = inputs.time_ns
            except (ValueError, ArithmeticError, RuntimeError) as error:
                self._events(out, inputs, [("error", f"the solver refused: {error}")])
            took_s = self._now_s() - begun_s
            if self._budget is not None and plan is not None:
                self._budget.note(took_s, int(plan.iterations.sum()))
        rows, n = {i: row for row, i in enumerate(planned)}, len(planned)
        for i in ids:
            if i in searching:
                since_s = self.guidance.chasers[i].since_s
                wrench = self._searches.wrench(inputs.odometry[i], since_s, fused)
                self._send(i, inputs, effective_ns, "search", wrench, out)
                continue
            row = rows.get(i, 0)
            if i in held:
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
                out.plans[i] = plan_message(i, inputs.tick, effective_ns, self._parameters.dt_s, plan, row)
            else:
                wrench, mode = brake_wrench(inputs.odometry[i], self.scenario.chaser), "brake"
            self._send(i, inputs, effective_ns, mode, wrench, out)
        out.solver = SolverStatus(
            tick=inputs.tick,
            sim_time_ns=inputs.time_ns,
            solver=self.scenario.controller.solver,
            chasers=planned if plan is not None else (),
            status=plan.status[:n] if plan is not None else (),
            iterations=tuple(int(k) for k in plan.iterations[:n]) if plan is not None else (),
            cost=vector(plan.cost[:n]) if plan is not None else (),
            max_violation_m=vector(plan.max_violation_m[:n]) if plan is not None else (),
            wall_solve_s=took_s,
        )

    def _is_held(self, i: int) -> bool:
        """Whether a chaser holds on to the target and is to stay: then its actuators are quiet unless told."""
        return i in self._captures.latched and self.guidance.chasers[i].phase not in (
            Phase.RETREAT,
            Phase.ABORT,
        )

    def _send(
        self, i: int, inputs: TickInputs, effective_ns: int, mode: Mode, wrench: Array, out: TickOutputs
    ) -> None:
        wrench = in_steps(wrench, self._thrusters.limits(i))
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
            isolated=self._thrusters.isolated(i),
            trusted=self._thrusters.trusted(i),
            free=self.guidance.is_free(i),
        )

    def _problem(
        self, ids: tuple[int, ...], inputs: TickInputs, ahead: TargetState, effective_ns: int
    ) -> NmpcInput:
        """The NMPC's problem at the time when the commands take effect."""
        p, s = self._parameters, self.scenario
        times_s = np.arange(p.stages + 1, dtype=float) * p.dt_s
        nodes, middles = self._captures.path(ahead, p.dt_s, p.stages)
        states = []
        for i in ids:
            coming = self._thrusters.coming(i, inputs.tick)
            if coming is None:
                state = predict_state(inputs.odometry[i], self._history, effective_ns, s.chaser)
            else:
                state = predict_state_with_impulse(inputs.odometry[i], coming, effective_ns, s.chaser)
            states.append(state)
        when_s = effective_ns / 1e9 + times_s
        (offsets, _, _), q_off = self._offsets(ids, when_s)
        references = reference.references_on(nodes.positions_m, nodes.q_wxyz, offsets, q_off)
        u_ref = np.zeros((len(ids), p.stages, 6))
        if s.controller.feed_forward:
            held, q_off = self._offsets(ids, when_s[:-1] + p.dt_s / 2)
            u_ref = reference.feed_forward(
                middles.omega_rad_s,
                *held,
                q_off,
                s.chaser.mass_kg,
                np.diag(s.chaser.inertia),
                middles.alpha_rad_s2,
                middles.acceleration_m_s2,
            )
        limits = np.array([self._thrusters.limits(i) for i in ids])
        for row, i in enumerate(ids):
            if self._is_held(i):  # it gives nobody room: no more than what follows the target's motion
                limits[row] = np.minimum(limits[row], 1.2 * np.abs(u_ref[row]).max(axis=0) + 1e-3)
        return NmpcInput(
            states=np.array(states),
            references=references,
            u_ref=u_ref,
            target_positions=nodes.positions_m,
            min_distance_target_m=np.array([self.guidance.min_distance_target_m(i) for i in ids])
            + self._margin_m(ahead),
            min_distance_chasers_m=s.limits.min_distance_chasers_m,
            input_max=limits,
            corridors=corridor_rows([self.guidance.corridor(i) for i in ids], nodes.q_wxyz),
        )

    def _offsets(self, ids: tuple[int, ...], times_s: Array) -> tuple[tuple[Array, Array, Array], Array]:
        """Where n chasers are to be in TRF at times (K,): offsets, their velocities and accelerations, each (n, K, 3),
        and attitudes, body to TRF, (n, K, 4)."""
        moves = [self.guidance.chasers[i].move.at(times_s) for i in ids]
        q_off = np.empty((len(ids), len(times_s), 4))
        for row, i in enumerate(ids):
            q_off[row] = rotations.normalize(self._attitudes(i, moves[row][0], times_s))
        positions, velocities, accelerations = (np.array(part) for part in zip(*moves, strict=True))
        return (positions, velocities, accelerations), q_off

    def _attitudes(self, i: int, offsets: Array, times_s: Array) -> Array:
        """Attitude of a chaser's reference, body to TRF, at offsets (K, 3) and times (K,): (K, 4), or (4,) where it
        never turns."""
        c, q = self.scenario.chasers[i], np.array(self.scenario.chasers[i].q_wxyz)
        if self.scenario.approach.face_target or self.guidance.chasers[i].faces:
            q = facing_attitudes(c.position_m, c.q_wxyz, offsets)
        turns = self.guidance.body_rotations(i, times_s)
        return q if turns is None else rotations.multiply(q, turns)

    def _margin_m(self, ahead: TargetState) -> float:
        """What the uncertainty of the target's position adds to the distance from it."""
        sigma_m = float(np.sqrt(np.linalg.eigvalsh(ahead.covariance[:3, :3])[-1]))
        return min(self.scenario.limits.estimate_margin_sigmas * sigma_m, _GREATEST_MARGIN_M)

    def _describe(
        self, ids: tuple[int, ...], inputs: TickInputs, fused: TargetState, out: TickOutputs
    ) -> None:
        """Where every chaser is to be now, and its phase by how near it is to that."""
        now_s = inputs.time_ns / 1e9
        for i in ids:
            offset = self.guidance.chasers[i].move.at(np.array([now_s]))[0][0]
            position = fused.position_m + rotations.rotate(fused.q_wxyz, offset)
            q_off = self._attitudes(i, offset[None], np.array([now_s])).reshape(4)
            attitude = rotations.multiply(fused.q_wxyz, q_off)
            odometry = inputs.odometry[i]
            error_m = float(np.linalg.norm(position - odometry.position_m))
            error_rad = float(rotations.angle_between(attitude, odometry.q_wxyz))
            self.guidance.set_position(i, pose_in_target(fused, odometry)[0])
            self.guidance.update_tracking(i, now_s, error_m, error_rad)
            senses = self._captures.senses(i, fused, odometry, inputs.docking.get(i))
            if senses is not None:
                self.guidance.update_docking(i, now_s, senses)
            phase = self.guidance.chasers[i]
            out.references[i] = Reference(
                tick=inputs.tick,
                sim_time_ns=inputs.time_ns,
                chaser=i,
                phase=phase.phase.value,
                phase_time_s=now_s - phase.since_s,
                position_m=vector(position),
                q_wxyz=vector(attitude),
                offset_m=vector(offset),
                min_distance_target_m=self.guidance.min_distance_target_m(i),
            )
        changes = self.guidance.drain_changes()
        self._events(out, inputs, [("info", f"chaser {c.chaser}: {c.phase} ({c.detail})") for c in changes])
        for change in changes:
            camera = next((c for c in out.target.cameras if c.chaser == change.chaser), None)
            if change.calibration_complete and camera is not None:
                self._events(out, inputs, [("info", f"chaser {change.chaser}: {in_words(camera)}")])

    def _events(self, out: TickOutputs, inputs: TickInputs, told: list[tuple[str, str]]) -> None:
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
