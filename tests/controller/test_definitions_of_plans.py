# SPDX-License-Identifier: Apache-2.0
"""Problems, plans and commands are what their definitions say, in general position: tumbling
references, disturbances on all axes, plans of an earlier tick, chasers lost while they move.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from chaserdock_controller.estimation.joint.parameters import parameters_of
from chaserdock_controller.ingest.lost_chasers import margin_m
from chaserdock_controller.interfaces import (
    ChaserEstimate,
    ChaserObservation,
    ChaserPlan,
    ChaserPlanning,
    Directive,
    GuidanceResult,
    HorizonReference,
    Observation,
    OwnMotion,
    PlanResult,
    TargetEstimation,
    TickOutputs,
)
from chaserdock_controller.nmpc import NmpcInput, NmpcPlan, NmpcSolver, make_solver
from chaserdock_controller.nmpc import stage as planning
from chaserdock_controller.nmpc.terms.coast import COASTS, SPARE_SHARE, coast_rows
from chaserdock_controller.nmpc.types import CoastSafety
from chaserdock_controller.nmpc.warm_start import shift_inputs
from chaserdock_controller.output.stage import OutputStage
from chaserdock_controller.parameters import nmpc_parameters
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.passive_safety import CoastModel, CoastNoise, DisturbedMotion
from chaserdock_models.rigid_body import BodyState
from chaserdock_models.setpoint_tracking import Setpoint, track_setpoint
from chaserdock_protocol.scenario import Scenario
from coast_cases import coast_of, disturbed_in_general, margins_of
from flight_cases import scenario
from general_position import (
    BODY,
    INERTIA,
    attitude,
    flown,
    matrix,
    moving_odometry,
    target_state,
)

MASS_KG, STEP_S, STAGES = 17.8, 0.2, 5
TENSOR = ((0.31, 0.04, -0.03), (0.04, 0.42, 0.05), (-0.03, 0.05, 0.53))
TIME_NS, EFFECTIVE_NS, TICK = 3_200_000_000, 3_390_000_000, 48


def mission(**changes: Any) -> Scenario:
    keys = {
        "chaser": {"mass_kg": MASS_KG, "inertia_kg_m2": list(INERTIA)},
        "controller": {"dt_s": STEP_S, "horizon_s": STEP_S * STAGES, "falloff": 0.4},
        "limits": {
            "passive_safety": "monitor",
            "passive_safety_s": 300.0,
            "passive_safety_force_N": 0.0,
        },
        "chasers": [
            {"position_m": p, "q_wxyz": [1.0, 0.0, 0.0, 0.0]}
            for p in ([-1.0, 0.0, 0.0], [0.0, -1.2, 0.0], [0.0, 1.2, 0.3])
        ],
    }
    return scenario(**keys | changes)


def tumbling_references(rng: np.random.Generator, n: int) -> Array:
    """References (N, D+1, 7) that move and turn uniformly about axes of their own."""
    out = np.empty((n, STAGES + 1, 7))
    for row in out:
        p, v, q, w = (
            rng.uniform(-2, 2, 3),
            rng.uniform(-0.1, 0.1, 3),
            attitude(rng),
            (rng.uniform(0.1, 0.3, 3)),
        )
        for k, pose in enumerate(row):
            t, size = k * STEP_S, float(np.linalg.norm(w))
            half = size * t / 2
            turn = np.array([math.cos(half), *(math.sin(half) * w / size)])
            pose[:3], pose[3:] = p + t * v, rotations.multiply(q, turn)
    return out


class Tick:
    """What the stages before planning state in one tick: chasers 0 and 1 are planned for, 2 is
    lost.
    """

    def __init__(self, seed: int, **changes: Any) -> None:
        rng = np.random.default_rng(seed)
        self.mission = mission(**changes)
        self.limits = np.array([2.0, 1.5, 1.2, 0.06, 0.05, 0.04])
        self.lost = moving_odometry(rng, 2, TICK - 15, TIME_NS - 1_000_000_000)
        seen = [
            ChaserObservation(
                i, self.limits * (1 - 0.1 * i),
                odometry=moving_odometry(rng, i, TICK, TIME_NS) if i < 2 else None,
                lost=self.lost if i == 2 else None,
            )
            for i in range(3)
        ]  # fmt: skip
        self.observation = Observation(TICK, TIME_NS, EFFECTIVE_NS, tuple(seen))
        self.target = target_state(rng, EFFECTIVE_NS)
        # The second is more than may be cancelled on its first axis.
        self.disturbances = 0.2 * rng.uniform(-1, 1, (2, 6)) * self.limits
        self.disturbances[1, 0] = -1.7
        references = tumbling_references(rng, 2)
        estimates = []
        for i in range(2):
            at_effect = np.concatenate(
                [
                    references[i, 0, :3] + rng.uniform(-0.05, 0.05, 3),
                    rng.uniform(-0.1, 0.1, 3),
                    rotations.multiply(references[i, 0, 3:], rotations.exp([0.05, -0.03, 0.04])),
                    rng.uniform(-0.2, 0.2, 3),
                ]
            )
            odometry = seen[i].odometry
            assert odometry is not None
            own = OwnMotion(odometry, at_effect, self.disturbances[i])
            motion = disturbed_in_general(rng, 0.02 + 0.01 * i, 1e-4, 1e-6)
            estimates.append(ChaserEstimate(i, own, disturbed=motion))
        estimates.append(ChaserEstimate(2))
        self.estimation = TargetEstimation(self.target, self.target, tuple(estimates), BODY)
        self.horizon = HorizonReference(
            chasers=(0, 1),
            references=references,
            u_ref=0.2 * rng.uniform(-1, 1, (2, STAGES, 6)) * self.limits,
            target_positions=self.target.position_m
            + STEP_S * np.arange(STAGES + 1)[:, None] * self.target.velocity_m_s,
            min_distance_target_m=np.array([0.5, 0.6]),
            corridors=None,
            attached=frozenset(),
        )
        directives = tuple(
            Directive(i, "hold", 1.0, "keep", True, (), (), None, None) for i in range(3)
        )
        self.guidance = GuidanceResult(directives, self.horizon, (), ())

    def outputs(self, *plans: ChaserPlan | None) -> TickOutputs:
        planned = tuple(ChaserPlanning(i, flyable=p) for i, p in enumerate((*plans, None)))
        return OutputStage(self.mission).run(
            self.observation, self.estimation, self.guidance, PlanResult(planned)
        )


class Answering(NmpcSolver):
    """Answers each problem with the same plan and keeps the problems."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.inputs = rng.uniform(-0.5, 0.5, (3, STAGES, 6))
        self.states = rng.uniform(-0.2, 0.2, (3, STAGES + 1, 13))
        self.states[:, :, 0] += 9.0
        self.asked: list[tuple[NmpcInput, float, tuple[int, ...]]] = []

    def solve(
        self, problem: NmpcInput, shift_s: float, ids: Sequence[int] | None = None
    ) -> NmpcPlan:
        self.asked.append((problem, shift_s, tuple(ids or ())))
        return NmpcPlan(
            self.inputs, self.states, ("solved",) * 3, np.ones(3, dtype=np.int64), np.zeros(3),
            np.zeros(3),
        )  # fmt: skip

    def reset(self) -> None: ...


Planned = tuple[Tick, Answering, PlanResult]


@pytest.fixture(params=range(2))
def planned(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Planned:
    tick, solver = Tick(request.param), Answering(np.random.default_rng(request.param + 50))
    monkeypatch.setattr(planning, "make_solver", lambda *_: solver)
    stage = planning.PlanningStage(
        tick.mission, nmpc_parameters(tick.mission), lambda: 0.0, realtime=False
    )
    return tick, solver, stage.run(tick.observation, tick.estimation, tick.guidance)


def cancelled(tick: Tick, i: int) -> Array:
    """The disturbance that may be cancelled: at most half of each limit."""
    half = 0.5 * tick.observation.chasers[i].input_limits
    return np.clip(tick.disturbances[i], -half, half)


def test_problem_starts_at_effect_and_leaves_room_for_the_disturbance(planned: Planned) -> None:
    tick, solver, _ = planned
    problem, _, ids = solver.asked[0]
    assert ids == (0, 1, 2)
    for i in range(2):
        own = tick.estimation.chasers[i].own
        assert own is not None
        np.testing.assert_array_equal(problem.states[i], own.at_effect)
        room = tick.observation.chasers[i].input_limits - np.abs(cancelled(tick, i))
        np.testing.assert_allclose(problem.input_max[i], room, atol=1e-15)
        # Any input of the plan can be flown.
        for sign in (-1.0, 1.0):
            flown_input = sign * problem.input_max[i] - cancelled(tick, i)
            assert (np.abs(flown_input) <= tick.observation.chasers[i].input_limits + 1e-12).all()


def test_lost_chaser_coasts_from_its_last_odometry_to_the_stages(planned: Planned) -> None:
    tick, solver, _ = planned
    problem, last = solver.asked[0][0], tick.lost
    for k in range(STAGES + 1):
        since_s = (EFFECTIVE_NS - last.sim_time_ns) / 1e9 + k * STEP_S
        place = np.array(last.position_m) + since_s * np.array(last.velocity_m_s)
        np.testing.assert_allclose(problem.references[2, k, :3], place, atol=1e-9)
    np.testing.assert_allclose(problem.states[2, :3], problem.references[2, 0, :3])
    end_s = (EFFECTIVE_NS - last.sim_time_ns) / 1e9 + STAGES * STEP_S
    kept = tick.mission.limits.min_distance_chasers_m + margin_m(end_s)
    np.testing.assert_allclose(np.asarray(problem.min_distance_chasers_m)[2, :2], kept)


def test_planned_inputs_are_flown_less_the_disturbance_from_their_own_time_on(
    planned: Planned,
) -> None:
    tick, solver, result = planned
    for i in range(2):
        plan = result.chasers[i].flyable
        assert plan is not None
        assert plan.time_ns == EFFECTIVE_NS
        np.testing.assert_allclose(plan.inputs, solver.inputs[i] - cancelled(tick, i), atol=1e-15)
        np.testing.assert_array_equal(plan.states, solver.states[i])


def test_certificate_is_of_the_coasts_from_all_stages_under_the_disturbance(
    planned: Planned,
) -> None:
    """The smallest margin of r + v t + a t^2 / 2 about the moving target, on a fine grid."""
    tick, solver, result = planned
    keep_out_m, times_s = tick.mission.limits.min_distance_target_m, np.arange(0.0, 300.0, 0.005)
    noise = parameters_of(tick.mission).coast_noise
    for i in range(2):
        found = result.chasers[i].certificate
        motion = tick.estimation.chasers[i].disturbed
        assert found is not None
        assert motion is not None
        approaches = []
        for k, x in enumerate(solver.states[i]):
            moved = tick.target.position_m + k * STEP_S * tick.target.velocity_m_s
            r, v = x[:3] - moved, x[3:6] - tick.target.velocity_m_s
            x = np.concatenate([r, v])
            margins, away = margins_of(x, motion, noise, keep_out_m, times_s)
            at = int(np.argmin(margins))
            approaches.append((margins[at], away[at], times_s[at], k * STEP_S))
        margin, distance_m, time_s, loss_s = min(approaches)
        # Within a step of 10 s the smallest distance counts, with the deviation at one of its ends.
        assert found.coast.margin_sigmas == pytest.approx(margin, rel=0.02, abs=0.01)
        assert found.coast.distance_m == pytest.approx(distance_m, rel=0.03)
        assert found.coast.time_s == pytest.approx(time_s, abs=10.0)
        assert found.loss_s == pytest.approx(loss_s)


@pytest.mark.parametrize("age_s", [0.0, 0.13, 0.33, 0.79])
def test_command_is_the_input_of_the_stage_in_which_it_takes_effect(age_s: float) -> None:
    tick, rng = Tick(3), np.random.default_rng(3)
    begun_ns = EFFECTIVE_NS - round(age_s * 1e9)
    states = rng.uniform(-1, 1, (STAGES + 1, 13))
    plan = ChaserPlan(begun_ns, states, 0.5 * rng.uniform(-1, 1, (STAGES, 6)) * tick.limits)
    out = tick.outputs(plan, None)
    expected = plan.inputs[math.floor(age_s / STEP_S)]
    command = out.wrenches[0]
    assert command.mode == "nmpc"
    assert command.effective_time_ns == EFFECTIVE_NS
    np.testing.assert_allclose(command.force_N, expected[:3], atol=2**-16)
    np.testing.assert_allclose(command.torque_N_m, expected[3:], atol=2**-22)
    message = out.plans[0]
    assert (message.sim_time_ns, message.step_s) == (begun_ns, STEP_S)
    np.testing.assert_array_equal(message.positions_m, states[:, :3].ravel())
    np.testing.assert_array_equal(message.quaternions_wxyz, states[:, 6:10].ravel())
    np.testing.assert_array_equal(message.inputs, plan.inputs.ravel())


@pytest.mark.parametrize("seed", range(3))
def test_chaser_without_a_plan_tracks_the_motion_of_its_reference(seed: int) -> None:
    """Velocity of the reference, and its rate in body axes, by differences of its poses."""
    tick = Tick(seed)
    out = tick.outputs(None, None)
    for i in range(2):
        own = tick.estimation.chasers[i].own
        assert own is not None
        now, then = tick.horizon.references[i, :2]
        r_0, r_1 = matrix(now[3:]), matrix(then[3:])
        turned = r_0.T @ r_1
        angle = math.acos((np.trace(turned) - 1.0) / 2.0)
        axis = np.array(
            [turned[2, 1] - turned[1, 2], turned[0, 2] - turned[2, 0], turned[1, 0] - turned[0, 1]]
        )
        rate = axis / np.linalg.norm(axis) * angle / STEP_S
        setpoint = Setpoint(
            now[:3], (then[:3] - now[:3]) / STEP_S, now[3:], rate, tick.horizon.u_ref[i, 0]
        )
        x = own.at_effect
        wrench = track_setpoint(
            BodyState(x[:3], x[3:6], x[6:10], x[10:]), tick.mission.chaser, setpoint
        )
        limits = tick.observation.chasers[i].input_limits
        wrench = np.clip(wrench, -limits, limits)
        assert out.wrenches[i].mode == "track"
        np.testing.assert_allclose(out.wrenches[i].force_N, wrench[:3], atol=2**-16)
        np.testing.assert_allclose(out.wrenches[i].torque_N_m, wrench[3:], atol=2**-21)


@pytest.mark.parametrize("seed", range(3))
def test_tracking_law_accelerates_by_its_errors_in_the_frames_of_force_and_torque(
    seed: int,
) -> None:
    """Errors of position and velocity in WRF act as a force in body axes; those of attitude and
    rate as a torque.
    """
    rng, body = np.random.default_rng(seed), mission().chaser
    q = attitude(rng)
    errors = 0.05 * rng.uniform(-1, 1, (4, 3))
    turn, own_rate, feed = errors[2], rng.uniform(-0.2, 0.2, 3), 0.01 * rng.uniform(-1, 1, 6)
    place, speed = rng.uniform(-2, 2, 3), rng.uniform(-0.1, 0.1, 3)
    setpoint = Setpoint(
        place + errors[0], speed + errors[1], rotations.multiply(q, rotations.exp(turn)),
        own_rate + errors[3], feed,
    )  # fmt: skip
    wrench = track_setpoint(BodyState(place, speed, q, own_rate), body, setpoint)
    acceleration = 0.3**2 * errors[0] + 2 * 0.9 * 0.3 * errors[1]
    force = feed[:3] + MASS_KG * matrix(q).T @ acceleration
    torque = feed[3:] + np.array(INERTIA) * (0.6**2 * turn + 2 * 0.9 * 0.6 * errors[3])
    top = body.wrench_max
    np.testing.assert_allclose(
        wrench, np.clip(np.concatenate([force, torque]), -top, top), atol=1e-12
    )


# -- the solver ------------------------------------------------------------------------------------


def solved(seed: int) -> tuple[NmpcInput, NmpcPlan, Any]:
    tick = Tick(seed)
    params = replace(nmpc_parameters(tick.mission), inertia_kg_m2=TENSOR)
    h = tick.horizon
    states = np.array([c.own.at_effect for c in tick.estimation.chasers[:2] if c.own is not None])
    problem = NmpcInput(
        states=states,
        references=h.references,
        u_ref=h.u_ref,
        target_positions=h.target_positions,
        min_distance_target_m=np.zeros(2),
        min_distance_chasers_m=0.0,
        input_max=np.tile(tick.limits, (2, 1)),
    )
    return problem, make_solver("rti", params, 2).solve(problem, 0.0), params


@pytest.mark.parametrize("seed", range(2))
def test_planned_states_are_those_of_the_inputs_on_the_true_body(seed: int) -> None:
    """A full inertia tensor, in small steps."""
    problem, plan, _ = solved(seed)
    for i in range(2):
        np.testing.assert_allclose(plan.states[i, 0], problem.states[i], atol=1e-12)
        for k in range(STAGES):
            here = plan.states[i, k]
            moved = flown(here, MASS_KG, np.array(TENSOR), plan.inputs[i, k], STEP_S)
            after = plan.states[i, k + 1]
            np.testing.assert_allclose(after[:6], moved[:6], atol=1e-7)
            np.testing.assert_allclose(matrix(after[6:10]).ravel(), moved[6:15], atol=1e-6)
            np.testing.assert_allclose(after[10:], moved[15:], atol=1e-6)


@pytest.mark.parametrize("seed", range(2))
def test_cost_is_equation_6_on_the_planned_states(seed: int) -> None:
    """Weights fall off along the horizon; the last stage has a weight of its own in addition."""
    problem, plan, _ = solved(seed)
    c = mission().controller
    for i in range(2):
        total = 0.0
        for k in range(STAGES + 1):
            falling = 1.0 - c.falloff * k / STAGES
            last = float(k == STAGES)
            position = c.weight_position * falling + last * c.weight_final_position
            turning = c.weight_orientation * falling + last * c.weight_final_orientation
            x, ref = plan.states[i, k], problem.references[i, k]
            off = rotations.multiply(x[6:10], rotations.conjugate(ref[3:]))[1:]
            total += position * float(np.sum((x[:3] - ref[:3]) ** 2))
            total += turning * float(off @ off)
            if k < STAGES:
                d = plan.inputs[i, k] - problem.u_ref[i, k]
                total += c.weight_force * float(d[:3] @ d[:3])
                total += c.weight_torque * float(d[3:] @ d[3:])
        assert plan.cost[i] == pytest.approx(total, rel=1e-9)


@pytest.mark.parametrize("shift_s", [0.2, 0.07, 0.33, 1.7])
def test_warm_start_keeps_the_impulse_of_the_old_plan(shift_s: float) -> None:
    """Each new input is the mean of the old plan over its own interval."""
    inputs, dt_s = np.random.default_rng(2).normal(size=(STAGES, 6)), STEP_S
    found = shift_inputs(inputs[None], shift_s, dt_s)[0]
    fine = 1000
    for k in range(STAGES):
        times = shift_s + dt_s * (k + (np.arange(fine) + 0.5) / fine)
        stages = np.minimum((times / dt_s).astype(int), STAGES - 1)
        np.testing.assert_allclose(found[k], inputs[stages].mean(axis=0), atol=5e-3)


@pytest.mark.parametrize("seed", range(3))
def test_coast_rows_bound_the_closest_approach_of_each_stage(seed: int) -> None:
    """A row's slack is the room that the coast's closest approach leaves to the target, which
    moves; a row bounds what states, at the same moment, keep under the same disturbance.
    """
    rng = np.random.default_rng(seed)
    target = target_state(rng)
    # Errors of the position alone count, so that the approach is also that of smallest margin.
    spread, noise = np.diag([4e-4] * 3 + [1e-14] * 3 + [1e-20] * 3), CoastNoise(1e-7)
    motion = DisturbedMotion(rng.normal(0.0, 1e-5, 3), spread)
    coast = CoastModel(0.0, 600.0, noise=noise)
    safety = CoastSafety(coast, 0.75, 3.0, target.velocity_m_s, {1: motion})
    times_s = STEP_S * np.arange(STAGES + 1)[:, None]
    targets = target.position_m + times_s * target.velocity_m_s
    states = rng.uniform(-1, 1, (2, STAGES + 1, 13))
    states[:, :, :3] = targets + rng.uniform(2.0, 4.0, 3)
    states[:, :, 3:6] = target.velocity_m_s - 0.02 * rng.uniform(0.6, 1.0, (STAGES + 1, 3))
    rows = coast_rows(safety, states, targets, STAGES * STEP_S)
    assert rows.shape == (2, STAGES + 1, COASTS, 7)
    assert not rows[0].any()
    sigmas, times_s = (1.0 + SPARE_SHARE) * 3.0, np.arange(0.0, 600.0, 0.01)
    for k in range(1, STAGES + 1):
        row, x = rows[1, k, 0], states[1, k]
        relative = np.concatenate([x[:3] - targets[k], x[3:6] - target.velocity_m_s])
        margins, away = margins_of(relative, motion, noise, 0.75, times_s)
        at = int(np.argmin(away))
        sigma_m = (away[at] - 0.75) / margins[at]
        scale = max(1.0, times_s[at] / (STAGES * STEP_S))
        slack = float(row[:3] @ x[:3] + row[3:6] @ x[3:6] - row[6]) * scale
        assert slack == pytest.approx(away[at] - 0.75 - sigmas * sigma_m, abs=2e-3)
        line = coast_of(relative, motion, times_s[at : at + 1])[0][0] / away[at]
        np.testing.assert_allclose(row[:3] * scale, line, atol=1e-2)
        np.testing.assert_allclose(
            row[3:6] * scale, times_s[at] * line, atol=0.01 * times_s[at] + 0.5
        )
