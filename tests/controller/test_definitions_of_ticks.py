# SPDX-License-Identifier: Apache-2.0
"""What the stages of a tick hand on belongs to the right time: with a latency of two ticks, a
target that drifts and turns, disturbances, and commands under way.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.estimation.joint.parameters import parameters_of
from chaserdock_controller.estimation.types import (
    ChaserMotion,
    Estimate,
    Estimator,
    EstimatorInputs,
)
from chaserdock_controller.guidance.escape import EscapePlanner, RelativeState
from chaserdock_controller.guidance.stage import GuidanceStage
from chaserdock_controller.guidance.trajectories import move_to, stay
from chaserdock_controller.interfaces import (
    ChaserEstimate,
    OwnMotion,
    TargetState,
    TickOutputs,
)
from chaserdock_controller.nmpc import NmpcInput, NmpcPlan, NmpcSolver
from chaserdock_controller.nmpc import stage as planning
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.passive_safety import disturbed
from coast_cases import disturbed_in_general, margins_of
from flight_cases import odometry, scenario, tick_inputs
from general_position import (
    INERTIA,
    attitude,
    covariance,
    matrix,
    relative_pose,
    rigid_motion,
)

MASS_KG, HZ, LATENCY_S, STEP_S = 17.8, 10, 0.19, 0.2
NOTHING_VARIES = {"passive_safety": "enforce", "passive_safety_force_N": 0.0}
PLACES = ((-1.0, 0.4, 0.3), (0.5, -1.1, -0.4))


class Uniform(Estimator):
    """A target in uniform motion; chasers in general position with disturbances."""

    def __init__(self, rng: np.random.Generator) -> None:
        self.start = (rng.uniform(-2, 2, 3), attitude(rng))
        self.velocity, self.omega = rng.uniform(0.02, 0.05, 3), rng.uniform(0.05, 0.15, 3)
        self.spread = covariance(rng, np.full(12, 1e-4))
        self.pushed = rng.uniform(-0.02, 0.02, (2, 6))
        self.relative = [relative_pose(rng) for _ in PLACES]
        self.states = [
            (rng.uniform(-0.1, 0.1, 3), attitude(rng), rng.uniform(-0.2, 0.2, 3)) for _ in PLACES
        ]
        self.asked: list[EstimatorInputs] = []

    def pose(self, time_s: float) -> tuple[Array, Array]:
        """Position (3,) and attitude (3, 3)."""
        size = float(np.linalg.norm(self.omega))
        half, axis = size * time_s / 2, self.omega / size
        turned = matrix([math.cos(half), *(math.sin(half) * axis)])
        return self.start[0] + time_s * self.velocity, matrix(self.start[1]) @ turned

    def chaser(self, i: int, time_s: float) -> Array:
        """State (13,) near its reference at a time."""
        velocity, q, omega = self.states[i]
        position, r = self.pose(time_s)
        return np.concatenate([position + r @ np.array(PLACES[i]) + 0.02, velocity, q, omega])

    def estimate_at(self, time_ns: int) -> TargetState:
        position, r = self.pose(time_ns / 1e9)
        q = rotations.from_matrix(r)
        return TargetState(
            time_ns, position, self.velocity, q, self.omega, self.spread, "tracking", 2, ()
        )

    def update(self, inputs: EstimatorInputs) -> Estimate:
        self.asked.append(inputs)
        motions = []
        for i in range(2):
            x = self.chaser(i, inputs.time_ns / 1e9)
            parts = x[:3], x[3:6], x[6:10], x[10:]
            motions.append(ChaserMotion(i, *parts, self.pushed[i], self.relative[i], None))
        return Estimate(self.estimate_at(inputs.time_ns), tuple(motions))


class Random(NmpcSolver):
    """Answers with random plans and keeps the problems."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng
        self.asked: list[tuple[NmpcInput, float]] = []

    def solve(self, problem: NmpcInput, shift_s: float, ids: Any = None) -> NmpcPlan:
        self.asked.append((problem, shift_s))
        n, stages = problem.u_ref.shape[:2]
        inputs = 0.5 * self._rng.uniform(-1, 1, (n, stages, 6)) * problem.input_max[:, None, :]
        states, still = np.ones((n, stages + 1, 13)), np.zeros(n)
        return NmpcPlan(inputs, states, ("solved",) * n, np.ones(n, dtype=np.int64), still, still)

    def reset(self) -> None: ...


class Flown:
    """Five ticks: the last one's inputs and outputs, and the wrenches that act over time."""

    def __init__(self, seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
        rng = np.random.default_rng(seed)
        mission = scenario(
            time={"rate_hz": HZ, "image_hz": HZ, "latency_s": LATENCY_S, "physics_hz": 1000},
            target={"motion": "constant_rates"},
            chaser={"mass_kg": MASS_KG, "inertia_kg_m2": list(INERTIA)},
            controller={"dt_s": STEP_S, "horizon_s": 5 * STEP_S},
            chasers=[{"position_m": list(p), "q_wxyz": attitude(rng).tolist()} for p in PLACES],
        )
        self.mission, self.estimator, self.solver = mission, Uniform(rng), Random(rng)
        monkeypatch.setattr(planning, "make_solver", lambda *_: self.solver)
        core = ControllerCore(mission, lambda: 0.0, self.estimator)
        self.acting: list[tuple[float, Array]] = []  # of chaser 0, with its time of effect
        self.out: TickOutputs
        for tick in range(5):
            self.time_s = tick / HZ
            now_ns = mission.timing.tick_time_ns(tick)
            # Odometry is off from the estimate, which must be used.
            measured = {i: odometry(i, tick, now_ns) for i in range(2)}
            self.out = core.step(tick_inputs(tick, now_ns, measured))
            command = self.out.wrenches[0]
            assert command.effective_time_ns == now_ns + round(LATENCY_S * 1e9)
            wrench = np.array([*command.force_N, *command.torque_N_m])
            self.acting.append((self.time_s + LATENCY_S, wrench))

    def between(self, begin_s: float, end_s: float) -> list[tuple[float, Array]]:
        """Durations (s) and wrenches on chaser 0 between two times."""
        edges = sorted({begin_s, end_s, *(t for t, _ in self.acting if begin_s < t < end_s)})
        parts = []
        for a, b in itertools.pairwise(edges):
            flown = [w for t, w in self.acting if t <= a + 1e-9]
            parts.append((b - a, flown[-1] if flown else np.zeros(6)))
        return parts


@pytest.fixture(params=range(2))
def flown(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Flown:
    return Flown(request.param, monkeypatch)


def test_plan_begins_when_its_first_command_takes_effect(flown: Flown) -> None:
    """References, target, and the chaser's own state, which flies on under commands and
    disturbance.
    """
    problem, shift_s = flown.solver.asked[-1]
    effect_s = flown.time_s + LATENCY_S
    assert shift_s == pytest.approx(1 / HZ)
    for k in range(6):
        position, r = flown.estimator.pose(effect_s + k * STEP_S)
        np.testing.assert_allclose(problem.target_positions[k], position, atol=1e-9)
        for i, chaser in enumerate(flown.mission.chasers):
            pose = problem.references[i, k]
            np.testing.assert_allclose(pose[:3], position + r @ np.array(PLACES[i]), atol=1e-9)
            np.testing.assert_allclose(matrix(pose[3:]), r @ matrix(chaser.q_wxyz), atol=1e-9)
    x = flown.estimator.chaser(0, flown.time_s)
    x = np.concatenate([x[:6], matrix(x[6:10]).ravel(), x[10:]])
    for duration_s, wrench in flown.between(flown.time_s, effect_s):
        total = wrench + flown.estimator.pushed[0]
        x = rigid_motion(
            x, MASS_KG, np.diag(INERTIA), duration_s,
            lambda s, w=total: s[6:15].reshape(3, 3) @ w[:3], lambda _, w=total: w[3:],
        )  # fmt: skip
    own = problem.states[0]
    np.testing.assert_allclose(own[:6], x[:6], atol=1e-8)
    np.testing.assert_allclose(matrix(own[6:10]).ravel(), x[6:15], atol=1e-8)
    np.testing.assert_allclose(own[10:], x[15:], atol=1e-7)


def test_estimator_receives_the_impulse_of_the_tick_that_has_passed(flown: Flown) -> None:
    parts = flown.between(flown.time_s - 1 / HZ, flown.time_s)
    assert len(parts) == 2  # a command took effect in it
    given = flown.estimator.asked[-1].chasers[0].impulse
    impulse = sum((duration_s * wrench for duration_s, wrench in parts), np.zeros(6))
    np.testing.assert_allclose(given.impulse, impulse, atol=1e-9)
    np.testing.assert_allclose(given.magnitude, sum(d * np.abs(w) for d, w in parts), atol=1e-9)
    # About the middle of the tick: the first part acts early, the second late.
    (first_s, first), (second_s, second) = parts
    early = first_s * first * second_s / 2 - second_s * second * first_s / 2
    np.testing.assert_allclose(given.moment, early, atol=1e-9)


def test_messages_of_a_tick_are_of_its_own_time(flown: Flown) -> None:
    position, r = flown.estimator.pose(flown.time_s)
    out = flown.out
    np.testing.assert_allclose(out.target.position_m, position, atol=1e-12)
    for i, chaser in enumerate(flown.mission.chasers):
        reference, relative = out.references[i], out.target.relative[i]
        np.testing.assert_allclose(
            reference.position_m, position + r @ np.array(PLACES[i]), atol=1e-9
        )
        np.testing.assert_allclose(matrix(reference.q_wxyz), r @ matrix(chaser.q_wxyz), atol=1e-9)
        np.testing.assert_allclose(reference.offset_m, PLACES[i], atol=1e-9)
        known = flown.estimator.relative[i]
        np.testing.assert_array_equal(relative.position_m, known.position_m)
        np.testing.assert_array_equal(relative.covariance, known.covariance.ravel())
        pushed = np.array([*relative.force_N, *relative.torque_N_m])
        np.testing.assert_array_equal(pushed, flown.estimator.pushed[i])
        plan = out.plans[i]
        assert plan.sim_time_ns == out.wrenches[i].effective_time_ns
        np.testing.assert_allclose(out.wrenches[i].force_N, plan.inputs[:3], atol=2**-16)


INWARD, OUTWARD = (1.1, -1.9, 1.2), (2.9, 2.2, -0.7)


@pytest.mark.parametrize(
    ("seed", "goal"), [(0, INWARD), (1, INWARD), (2, INWARD), (2, OUTWARD), (3, OUTWARD)]
)
def test_margin_of_a_move_is_that_of_its_coasts_from_a_turning_target(
    seed: int, goal: tuple[float, ...]
) -> None:
    """Coasts begin with the velocity of the place, by differences of its path in WRF. The move is
    under way, since 1 s.
    """
    rng, h, now_s = np.random.default_rng(seed), 1e-4, 3.4
    mission = scenario(limits=NOTHING_VARIES | {"passive_safety_s": 200.0})
    planner, estimator = EscapePlanner(mission, 0.05), Uniform(rng)
    estimator.velocity = np.zeros(3)
    estimator.start = (np.zeros(3), estimator.start[1])
    move = move_to(stay((1.6, 1.3, -0.9), 0.0), goal, 1.0, 0.3)
    state = np.concatenate([rng.uniform(1, 2, 3), rng.uniform(-0.1, 0.1, 3)])
    motion = disturbed_in_general(rng, 0.03, 1e-4, 1e-5)
    known = RelativeState(state, motion, estimator.estimate_at(round(now_s * 1e9)))
    turn_s = 2 * math.pi / float(np.linalg.norm(estimator.omega))
    end_s = move.start_s + move.duration_s
    moments = [*np.linspace(now_s, end_s, 33), *(end_s + np.linspace(0.0, turn_s, 12))]

    def place(time_s: float) -> Array:
        return estimator.pose(time_s)[1] @ move.at([time_s])[0][0]

    noise, kept_m = parameters_of(mission).coast_noise, mission.limits.min_distance_target_m
    least, times_s = [], np.arange(0.0, 200.0, 0.02)
    for time_s in moments:
        v = (place(time_s + h) - place(time_s - h)) / (2 * h)
        x = np.concatenate([place(time_s), v])
        least.append(float(margins_of(x, motion, noise, kept_m, times_s)[0].min()))
    found = planner.move_margin(known, move, now_s)
    # Within a step of 10 s the deviation counts as that at one of its ends.
    assert found == pytest.approx(min(least), rel=0.05, abs=0.05)
    assert found <= min(least) + 0.005 * abs(min(least))


@pytest.mark.parametrize("seed", range(3))
def test_abort_has_the_margin_of_its_coast_with_the_error_of_its_burn(seed: int) -> None:
    """The disturbance acts from the burn's end; a burn's error is 3 % of it along each axis."""
    rng, duration_s = np.random.default_rng(seed), 200.0
    mission = scenario(limits=NOTHING_VARIES | {"passive_safety_s": duration_s})
    state = np.concatenate([rng.uniform(1, 2, 3), rng.uniform(-0.03, 0.03, 3)])
    motion = disturbed_in_general(rng, 0.03, 1e-4, 1e-5)
    known = RelativeState(state, motion, Uniform(rng).estimate_at(0))
    move, margin = EscapePlanner(mission, 0.05).escape(known, 1.0)
    burn_s, burn = move.burn_s, move.acceleration_m_s2
    r = state[:3] + burn_s * state[3:] + 0.5 * burn_s**2 * burn
    v = state[3:] + burn_s * burn
    spread = motion.covariance.copy()
    spread[3:6, 3:6] += (0.03 * burn_s * float(np.linalg.norm(burn))) ** 2 * np.eye(3)
    margins, _ = margins_of(
        np.concatenate([r, v]), replace(motion, covariance=spread),
        parameters_of(mission).coast_noise, mission.limits.min_distance_target_m,
        np.arange(0.0, duration_s + 0.02, 0.02),
    )  # fmt: skip
    assert margins.min() > 0.0
    assert margin == pytest.approx(float(margins.min()), rel=0.05)
    assert margin <= 1.005 * float(margins.min())


def test_guidance_knows_position_and_velocity_relative_to_the_target() -> None:
    rng = np.random.default_rng(8)
    mission, estimator = scenario(limits={"passive_safety": "enforce"}), Uniform(rng)
    target, own = estimator.estimate_at(10**9), odometry(0, 10, 10**9)
    motion = OwnMotion(own, np.zeros(13), np.zeros(6))
    pushed = disturbed(np.eye(6), 0.02)
    estimate = ChaserEstimate(0, motion, disturbed=pushed)
    known = GuidanceStage(mission)._relative(estimate, target)
    assert known is not None
    apart = np.array(own.position_m) - target.position_m
    np.testing.assert_allclose(known.state[:3], apart, atol=1e-15)
    assert known.disturbed is pushed
    np.testing.assert_allclose(known.state[3:], own.velocity_m_s - estimator.velocity, atol=1e-15)
