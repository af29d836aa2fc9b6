# SPDX-License-Identifier: Apache-2.0
"""Published estimates are what their definitions say, in general position: no identity attitudes,
no zero rates, all axes different. The right sides are finite differences and small steps.
"""

from __future__ import annotations

import math
from dataclasses import replace as changed
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from chaserdock_controller.bodies.body_shape import SHAPE, BodyShape
from chaserdock_controller.bodies.target_body import TargetBody
from chaserdock_controller.estimation.composite_body import CompositeBody
from chaserdock_controller.estimation.joint import JointEstimator
from chaserdock_controller.estimation.joint.hypotheses import FilterState, mixture_covariance
from chaserdock_controller.estimation.joint.measurements import (
    mounting_of,
    odometry_noise,
    sighting_covariance,
)
from chaserdock_controller.estimation.joint.motion_models import process_noise, steady_motion
from chaserdock_controller.estimation.joint.prediction import disturbance, predict, predict_target
from chaserdock_controller.estimation.joint.replay import FilterTick
from chaserdock_controller.estimation.joint.state import (
    CENTRE,
    CHASER,
    FORCE,
    POSITION_DRIFT,
    TARGET,
    JointState,
    inject,
)
from chaserdock_controller.estimation.joint.tick import process_tick
from chaserdock_controller.estimation.stage import EstimationStage, camera_calibrations
from chaserdock_controller.estimation.target_shape import seen_place
from chaserdock_controller.estimation.types import (
    CameraError,
    ChaserMotion,
    Estimate,
    Estimator,
    EstimatorInputs,
    MeasuredChaser,
    Shock,
)
from chaserdock_controller.ingest.latency_compensation import CommandHistory, predict_state
from chaserdock_controller.interfaces import (
    AppliedImpulse,
    ChaserObservation,
    Observation,
    TargetState,
)
from chaserdock_controller.output.message_builders import expected_pose, target_message
from chaserdock_models import scalar_rotations as so3
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import DockingStatus, GeometryMeasurement, PoseSolution
from flight_cases import scenario
from general_position import (
    BODY,
    INERTIA,
    attitude,
    covariance,
    flown,
    matrix,
    moving_odometry,
    rigid_motion,
    skew,
    target_state,
    turn_between,
)
from joint_cases import joint_state, navigation, parameters
from msgspec.structs import replace
from runge_kutta import rk4

MASS_KG = 17.8
CHASER_BODY = {"mass_kg": MASS_KG, "inertia_kg_m2": list(INERTIA)}
SEEDS = pytest.mark.parametrize("seed", range(3))


def estimator_of(*states: JointState, **changes: Any) -> JointEstimator:
    """An estimator with these hypotheses after its newest tick."""
    p = parameters(scenario(chaser=CHASER_BODY), navigation("lab"))
    estimator = JointEstimator(changed(p, target=changed(p.target, **changes)), states[0].chasers)
    estimator._buffer.base = FilterState(states[0].time_ns, states)
    return estimator


def pose_in_target(s: JointState, i: int) -> tuple[Array, Array]:
    r = matrix(s.q_wxyz)
    return r.T @ (s.positions_m[i] - s.position_m), r.T @ matrix(s.attitudes_wxyz[i])


@SEEDS
def test_relative_poses_and_their_covariance(seed: int) -> None:
    """The covariance is that of central differences by all errors of the filter."""
    s, e = joint_state(np.random.default_rng(seed)), 1e-5
    for i, pose in estimator_of(s).relative_poses().items():
        place, turned = pose_in_target(s, i)
        np.testing.assert_allclose(pose.position_m, place, atol=1e-12)
        np.testing.assert_allclose(matrix(pose.q_wxyz), turned, atol=1e-12)
        columns = []
        for d in np.eye(len(s.covariance)):
            (p1, r1), (p0, r0) = (pose_in_target(inject(s, sign * e * d), i) for sign in (1, -1))
            turn = turn_between(turned, r1) - turn_between(turned, r0)
            columns.append(np.concatenate([p1 - p0, turn]) / (2 * e))
        j = np.column_stack(columns)
        np.testing.assert_allclose(pose.covariance, j @ s.covariance @ j.T, rtol=1e-5, atol=1e-10)


def acceleration_of(s: JointState, i: int) -> Array:
    """Acceleration by the disturbance, WRF."""
    return matrix(s.attitudes_wxyz[i]) @ s.of(i, FORCE) / MASS_KG


@SEEDS
def test_what_disturbs_a_coast_is_the_estimated_force_with_the_errors_of_the_motion(
    seed: int,
) -> None:
    """Without a limit of its own the force lasts; derivatives are central differences."""
    s, e = joint_state(np.random.default_rng(seed)), 1e-5
    for i in range(2):
        columns = []
        for d in np.eye(len(s.covariance)):
            values = []
            for sign in (1, -1):
                t = inject(s, sign * e * d)
                relative = [t.positions_m[i] - t.position_m, t.velocities_m_s[i] - t.velocity_m_s]
                values.append(np.concatenate([*relative, acceleration_of(t, i)]))
            columns.append((values[0] - values[1]) / (2 * e))
        j = np.column_stack(columns)
        found = estimator_of(s).disturbed_motion(i)
        assert found is not None
        np.testing.assert_allclose(found.acceleration_m_s2, acceleration_of(s, i), atol=1e-12)
        np.testing.assert_allclose(found.covariance, j @ s.covariance @ j.T, rtol=1e-6, atol=1e-12)


@SEEDS
def test_force_that_lasts_has_its_own_prior_in_place_of_the_filters(seed: int) -> None:
    """Bayes' rule in information form: the filter's prior is taken out of its result, and another
    one is put in.
    """
    rng, lasting_N = np.random.default_rng(seed), 0.004
    s, estimator = joint_state(rng), estimator_of(joint_state(np.random.default_rng(seed)))
    p = estimator.parameters = changed(estimator.parameters, lasting_force_N=lasting_N)
    found, free = estimator.disturbed_motion(1), estimator_of(s).disturbed_motion(1)
    assert found is not None
    assert free is not None
    own, r = TARGET + CHASER, matrix(s.attitudes_wxyz[1])
    force, turn = (slice(own + k, own + k + 3) for k in (12, 6))
    information = np.linalg.inv(s.covariance[force, force])
    total = information + np.eye(3) * (1.0 / lasting_N**2 - 1.0 / p.disturbance_force_N**2)
    mean = np.linalg.solve(total, information @ s.of(1, FORCE))
    np.testing.assert_allclose(found.acceleration_m_s2, r @ mean / MASS_KG, atol=1e-12)
    # Errors of the force are those of a regression on the filter's, those of the attitude its own.
    gain, lever = np.linalg.solve(total, information), -skew(mean)
    cross = gain @ s.covariance[force, turn] @ lever.T
    spread = np.linalg.inv(total) + lever @ s.covariance[turn, turn] @ lever.T + cross + cross.T
    np.testing.assert_allclose(
        found.covariance[6:, 6:], r @ spread @ r.T / MASS_KG**2, rtol=1e-6, atol=1e-14
    )
    np.testing.assert_allclose(found.covariance[:6, :6], free.covariance[:6, :6], atol=1e-15)
    assert np.linalg.eigvalsh(found.covariance).min() > -1e-12


def test_stated_force_bounds_what_is_assumed_of_a_coast_whatever_is_estimated() -> None:
    s = joint_state(np.random.default_rng(4))
    estimator = estimator_of(s)
    estimator.parameters = changed(estimator.parameters, lasting_force_N=1e-6)
    found = estimator.disturbed_motion(0)
    assert found is not None
    sigmas = np.sqrt(np.diag(found.covariance)[6:])
    np.testing.assert_allclose(sigmas, 1e-6 / MASS_KG, rtol=1e-3)
    assert np.abs(found.acceleration_m_s2).max() < 1e-8 / MASS_KG


@SEEDS
def test_camera_errors_are_given_in_the_chasers_axes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    q = attitude(rng)
    camera = changed(scenario().camera_model(), q_crf_irf_wxyz=tuple(q.tolist()))
    sigmas = [1e-3, 4e-3, 9e-3, 2e-3, 5e-3, 8e-3, 1e-3]
    error = CameraError(
        rng.normal(size=3), rng.normal(size=3), float(rng.normal()), covariance(rng, sigmas)
    )
    still = np.zeros(3)
    motion = ChaserMotion(1, still, still, q, still, np.zeros(6), None, error)
    found, r = camera_calibrations([motion], camera)[1], matrix(q)
    np.testing.assert_allclose(found.turn_rad, r @ error.turn_rad, atol=1e-12)
    np.testing.assert_allclose(found.shift_m, r @ error.shift_m, atol=1e-12)
    for at, stated in ((0, found.turn_sigma_rad), (3, found.shift_sigma_m)):
        variances = [row @ error.covariance[at : at + 3, at : at + 3] @ row for row in r]
        np.testing.assert_allclose(np.square(stated), variances, rtol=1e-9)
    assert found.focal_sigma_share == pytest.approx(math.sqrt(error.covariance[6, 6]))


@SEEDS
def test_disturbance_moves_a_centred_body_as_the_filters_model_moves_the_true_one(
    seed: int,
) -> None:
    """Equations of prediction.py with the centre of mass aside, written with vectors."""
    rng = np.random.default_rng(seed)
    s = joint_state(rng)
    p = estimator_of(s).parameters
    wrench, inertia = rng.uniform(-0.4, 0.4, 6), np.diag(INERTIA)
    for i in range(2):
        total, c, w = wrench + s.extra[i, :6], s.of(i, CENTRE), s.omegas_rad_s[i]
        force, torque = total[:3], total[3:]
        alpha = np.linalg.solve(inertia, torque - np.cross(c, force) - np.cross(w, inertia @ w))
        acceleration = force / MASS_KG - np.cross(alpha, c) - np.cross(w, np.cross(w, c))
        needed = np.concatenate(
            [MASS_KG * acceleration, inertia @ alpha + np.cross(w, inertia @ w)]
        )
        np.testing.assert_allclose(disturbance(s, i, wrench, p), needed - wrench, atol=1e-12)


class Fixed(Estimator):
    """States these motions of the chasers, whatever is measured."""

    def __init__(self, target: TargetState, chasers: tuple[ChaserMotion, ...]) -> None:
        self.found, self.shocks = Estimate(target, chasers), list[Shock]()

    def update(self, inputs: EstimatorInputs) -> Estimate:
        return self.found

    def estimate_at(self, time_ns: int) -> TargetState:
        return self.found.target

    def disturb(self, shock: Shock) -> None:
        self.shocks.append(shock)

    def change_body(self, body: TargetBody, covariance: Array) -> None:
        self.body = body


def observed(rng: np.random.Generator, time_ns: int, **more: Any) -> Observation:
    seen = ChaserObservation(0, np.ones(6), odometry=moving_odometry(rng, 0, 32, time_ns), **more)
    return Observation(32, time_ns, time_ns + 190_000_000, (seen,))


@SEEDS
def test_state_at_effect_is_flown_under_commands_disturbance_and_orbit(seed: int) -> None:
    """Clohessy-Wiltshire and the two commands under way, in small steps from the estimate."""
    rng = np.random.default_rng(seed)
    mission = scenario(
        chaser=CHASER_BODY,
        orbit={"altitude_m": 500e3, "inclination_deg": 51.0},
        target={"motion": "torque_free", "velocity_m_s": [0.0, 0.0, 0.0]},
        chasers=[{"position_m": [-1.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}],
    )
    assert mission.orbit is not None
    n, target = mission.orbit.elements.mean_motion_rad_s, target_state(rng)
    state, pushed = np.zeros(13), rng.uniform(-0.02, 0.02, 6)
    state[:3], state[3:6] = rng.uniform(-90.0, 90.0, 3), rng.uniform(-0.3, 0.3, 3)
    state[6:10], state[10:] = attitude(rng), rng.uniform(-0.2, 0.2, 3)
    motion = ChaserMotion(0, state[:3], state[3:6], state[6:10], state[10:], pushed, None, None)
    commands = rng.uniform(-0.5, 0.5, (2, 6))
    ahead = ((0.07, commands[0]), (0.12, commands[1]))
    found = EstimationStage(mission, Fixed(target, (motion,))).run(
        observed(rng, target.time_ns, ahead=ahead)
    )
    own = found.chasers[0].own
    assert own is not None

    def force(s: Array, command: Array) -> Array:
        x, _, z = s[:3]
        u, v, _ = s[3:6]
        tide = MASS_KG * np.array([3 * n * n * x + 2 * n * v, -2 * n * u, -n * n * z])
        return tide + s[6:15].reshape(3, 3) @ (command + pushed)[:3]

    x = np.concatenate([state[:6], matrix(state[6:10]).ravel(), state[10:]])
    np.testing.assert_allclose(
        own.disturbance[:3], pushed[:3] + matrix(state[6:10]).T @ force(x, -pushed), atol=1e-9
    )
    for duration_s, command in ahead:
        x = rigid_motion(
            x, MASS_KG, np.diag(INERTIA), duration_s,
            lambda s, c=command: force(s, c), lambda _, c=command: (c + pushed)[3:],
        )  # fmt: skip
    np.testing.assert_allclose(own.at_effect[:3], x[:3], atol=2e-7)
    np.testing.assert_allclose(own.at_effect[3:6], x[3:6], atol=5e-6)
    np.testing.assert_allclose(matrix(own.at_effect[6:10]).ravel(), x[6:15], atol=2e-5)
    np.testing.assert_allclose(own.at_effect[10:], x[15:], atol=2e-4)


@SEEDS
def test_prediction_includes_the_disturbance(seed: int) -> None:
    rng = np.random.default_rng(seed)
    o = moving_odometry(rng, 0, 5, 500_000_000)
    history, commands = CommandHistory(), rng.uniform(-0.5, 0.5, (3, 6))
    for k, command in enumerate(commands):
        history.add(430_000_000 + 100_000_000 * k, command)
    pushed = rng.uniform(-0.05, 0.05, 6)
    ahead = history.ahead(o.sim_time_ns, 680_000_000)
    found = predict_state(o, ahead, pushed, scenario(chaser=CHASER_BODY).chaser)
    x = np.array([*o.position_m, *o.velocity_m_s, *o.q_wxyz, *o.omega_rad_s])
    inertia = np.diag(INERTIA)
    moved = flown(x, MASS_KG, inertia, commands[0] + pushed, 0.03)
    for command, duration_s in ((commands[1], 0.1), (commands[2], 0.05)):
        wrench = command + pushed
        moved = rigid_motion(
            moved, MASS_KG, inertia, duration_s,
            lambda s, w=wrench: s[6:15].reshape(3, 3) @ w[:3], lambda _, w=wrench: w[3:],
        )  # fmt: skip
    np.testing.assert_allclose(found[:6], moved[:6], atol=1e-9)
    np.testing.assert_allclose(matrix(found[6:10]).ravel(), moved[6:15], atol=1e-8)
    np.testing.assert_allclose(found[10:], moved[15:], atol=1e-8)


@SEEDS
def test_push_of_a_latched_chaser_moves_the_whole_stack(seed: int) -> None:
    """Momentum and angular momentum about the common centre of mass, in WRF."""
    rng = np.random.default_rng(seed)
    mission, target = scenario(chaser=CHASER_BODY), target_state(rng)
    estimator = Fixed(target, ())
    composite = CompositeBody(mission, estimator)
    composite.body, composite.latched = BODY, frozenset({0})
    impulse = rng.uniform(-0.3, 0.3, 6)
    seen = ChaserObservation(
        0, np.ones(6), odometry=moving_odometry(rng, 0, 32, target.time_ns),
        impulse=AppliedImpulse.steady(impulse),
    )  # fmt: skip
    composite.disturb(Observation(32, target.time_ns, target.time_ns, (seen,)))
    (shock,) = estimator.shocks
    assert seen.odometry is not None
    own, r = matrix(seen.odometry.q_wxyz), matrix(target.q_wxyz)
    force, c = own @ impulse[:3], r @ BODY.centre_trf_m
    arm = np.array(seen.odometry.position_m) - target.position_m - c
    about_centre = own @ impulse[3:] + np.cross(arm, force)
    spin = np.linalg.solve(r @ BODY.inertia_kg_m2 @ r.T, about_centre)
    np.testing.assert_allclose(shock.omega_rad_s, r.T @ spin, atol=1e-12)
    np.testing.assert_allclose(
        shock.velocity_m_s, force / BODY.mass_kg + np.cross(spin, -c), atol=1e-12
    )


def test_stack_has_the_chaser_where_it_is_estimated() -> None:
    """Its mass properties are sums over the two bodies, in WRF."""
    rng = np.random.default_rng(4)
    mission, target = scenario(chaser=CHASER_BODY), target_state(rng)
    estimator = Fixed(target, ())
    composite = CompositeBody(mission, estimator)
    alone = composite.body
    o = moving_odometry(rng, 0, 32, target.time_ns)
    docking = DockingStatus(
        tick=32, sim_time_ns=target.time_ns, chaser=0, contact=True, armed=True, latched=True
    )
    seen = ChaserObservation(0, np.ones(6), odometry=o, docking=docking)
    composite.disturb(Observation(32, target.time_ns, target.time_ns, (seen,)))
    composite.update_body(target, (o, None))
    r, own = matrix(target.q_wxyz), matrix(o.q_wxyz)
    places = [target.position_m + r @ alone.centre_trf_m, np.array(o.position_m)]
    masses = [alone.mass_kg, MASS_KG]
    inertias = [r @ alone.inertia_kg_m2 @ r.T, own @ np.diag(INERTIA) @ own.T]
    centre = np.average(places, axis=0, weights=masses)
    total = sum(
        i - m * skew(p - centre) @ skew(p - centre)
        for i, m, p in zip(inertias, masses, places, strict=True)
    )
    np.testing.assert_allclose(
        composite.body.centre_trf_m, r.T @ (centre - target.position_m), atol=1e-12
    )
    np.testing.assert_allclose(composite.body.inertia_kg_m2, r.T @ total @ r, atol=1e-10)
    assert estimator.body is composite.body


def steady(start: tuple[Array, ...], dt_s: float, c: Array) -> tuple[Array, ...]:
    """A body that turns at its constant rate while its centre of mass moves uniformly."""
    p, v, q, w = start
    r, size = matrix(q), float(np.linalg.norm(w))
    k = skew(w / size)
    moved = r @ (np.eye(3) + math.sin(size * dt_s) * k + (1 - math.cos(size * dt_s)) * k @ k)
    centre_velocity = v + r @ np.cross(w, c)
    centre = p + r @ c + centre_velocity * dt_s
    return centre - moved @ c, centre_velocity - moved @ np.cross(w, c), moved, w


@SEEDS
def test_steady_motion_about_another_centre(seed: int) -> None:
    s = joint_state(np.random.default_rng(seed))
    start = (s.position_m, s.velocity_m_s, s.q_wxyz, s.omega_rad_s)
    found = steady_motion(start, 0.7, BODY.centre_trf_m)[0]
    for a, b in zip(found, steady(start, 0.7, BODY.centre_trf_m), strict=True):
        np.testing.assert_allclose(matrix(a) if len(a) == 4 else a, b, atol=1e-12)


@SEEDS
def test_estimate_at_a_time_continues_the_newest_tick_before_it(seed: int) -> None:
    """Mean and covariance between two ticks, after them, and at a tick itself."""
    rng = np.random.default_rng(seed)
    first, second = joint_state(rng, time_ns=10**9), joint_state(rng, time_ns=1_100_000_000)
    estimator = estimator_of(first, centre_of_mass_trf_m=tuple(BODY.centre_trf_m.tolist()))
    for s in (first, second):
        record = FilterTick(
            time_ns=s.time_ns, parameters=estimator.target, covered_s=0.1, chasers=()
        )
        record.state = FilterState(s.time_ns, (s,))
        estimator._buffer.records.append(record)
    for time_ns, s in (
        (1_060_000_000, first),
        (1_100_000_000, second),
        (1_310_000_000, second),
    ):
        found, dt_s = estimator.estimate_at(time_ns), (time_ns - s.time_ns) / 1e9
        start = (s.position_m, s.velocity_m_s, s.q_wxyz, s.omega_rad_s)
        here = steady(start, dt_s, BODY.centre_trf_m)
        for name, value in zip(("position_m", "velocity_m_s"), here[:2], strict=True):
            np.testing.assert_allclose(getattr(found, name), value, atol=1e-12)
        np.testing.assert_allclose(matrix(found.q_wxyz), here[2], atol=1e-12)
        columns, e = [], 1e-5
        for d in np.eye(len(s.covariance)):
            ends = []
            for sign in (1.0, -1.0):
                m = inject(s, sign * e * d)
                moved = steady(
                    (m.position_m, m.velocity_m_s, m.q_wxyz, m.omega_rad_s),
                    dt_s,
                    BODY.centre_trf_m,
                )
                ends.append(np.concatenate([*moved[:2], turn_between(here[2], moved[2]), moved[3]]))
            columns.append((ends[0] - ends[1]) / (2 * e))
        j = np.column_stack(columns)
        linear, angular = estimator.parameters.target_noise["constant_rates"]
        noise = process_noise(dt_s, linear**2, angular**2)
        np.testing.assert_allclose(
            found.covariance, j @ s.covariance @ j.T + noise, rtol=1e-5, atol=1e-11
        )


@SEEDS
def test_unknown_command_is_uncertain_by_what_a_wrench_of_its_size_can_do(seed: int) -> None:
    """The rate is that of the worst of all directions, on a body whose lightest axis is its
    second.
    """
    rng, inertia, period_s = np.random.default_rng(seed), np.array([0.42, 0.31, 0.53]), 0.1
    body = {"mass_kg": MASS_KG, "inertia_kg_m2": inertia.tolist()}
    p = parameters(scenario(chaser=body), navigation("lab"))
    state, wrench = joint_state(rng), rng.uniform(-0.5, 0.5, 6)
    covariances = []
    for command in (None, wrench):
        chasers = (
            MeasuredChaser(0, AppliedImpulse.steady(np.zeros(6))),
            MeasuredChaser(1, AppliedImpulse.steady(np.zeros(6)), last_command=command),
        )
        record = FilterTick(
            time_ns=state.time_ns + 10**8, parameters=p.target, covered_s=period_s, chasers=chasers
        )
        before, camera = FilterState(state.time_ns, (state,)), mounting_of(p.camera)
        (after,) = process_tick(before, record, 2, camera, p)[0].hypotheses
        covariances.append(after.covariance)
    directions = rng.normal(size=(20_000, 3))
    torques = directions / np.linalg.norm(directions, axis=1)[:, None] * np.linalg.norm(wrench[3:])
    rate = float(np.linalg.norm(torques / inertia, axis=1).max()) * period_s
    velocity = float(np.linalg.norm(wrench[:3])) * period_s / MASS_KG
    added = np.zeros(len(state.covariance))
    own = TARGET + CHASER
    added[own + 3 : own + 6], added[own + 9 : own + 12] = velocity**2, rate**2
    np.testing.assert_allclose(covariances[1] - covariances[0], np.diag(added), rtol=1e-3)


@SEEDS
def test_impulse_acts_in_the_time_that_it_covers(seed: int) -> None:
    """A prediction in one step moves as in two, of which the second has the impulse."""
    rng = np.random.default_rng(seed)
    state, p = joint_state(rng), parameters(scenario(chaser=CHASER_BODY), navigation("lab"))
    given = [AppliedImpulse(j, 0.02 * j[::-1], np.abs(j)) for j in rng.uniform(-0.05, 0.05, (2, 6))]
    nothing = [AppliedImpulse.steady(np.zeros(6))] * 2
    whole_ns, first_ns = 300_000_000, 200_000_000
    moved = []
    for impulses in (given, nothing):
        once = predict(state, state.time_ns + whole_ns, impulses, p, nominal_s=0.1)
        twice = predict(state, state.time_ns + first_ns, nothing, p)
        twice = predict(twice, state.time_ns + whole_ns, impulses, p)
        moved.append((once.positions_m, twice.positions_m))
    (once_m, twice_m), (still_once_m, still_twice_m) = moved
    acted_m = np.abs(twice_m - still_twice_m).max()
    np.testing.assert_allclose(
        once_m - still_once_m, twice_m - still_twice_m, atol=0.05 * float(acted_m)
    )


@SEEDS
def test_place_of_a_view_has_the_covariance_of_its_pose(seed: int) -> None:
    """By differences of the lens' place in TRF by position (IRF) and rotation (TRF)."""
    rng, h = np.random.default_rng(seed), 1e-6
    q, position = attitude(rng), rng.uniform(-2, 2, 3)
    turning = covariance(rng, [1e-3, 4e-3, 9e-3])
    placing = covariance(rng, [2e-3, 5e-3, 1e-2])
    pose = PoseSolution(
        position_m=tuple(position.tolist()), q_wxyz=tuple(q.tolist()),
        covariance=tuple(np.block([[np.eye(3), np.zeros((3, 3))], [np.zeros((3, 3)), turning]])
                         .ravel().tolist()),
        reprojection_rms_px=0.1,
    )  # fmt: skip
    measured = GeometryMeasurement(
        information=(1.0,), vector=(0.0,), position_m=pose.position_m,
        position_by_errors=tuple(rng.normal(size=3).tolist()),
        position_covariance_m2=tuple(placing.ravel().tolist()),
    )  # fmt: skip
    found = seen_place(pose, measured, 1)
    assert found is not None
    r = matrix(q)
    np.testing.assert_allclose(found.place_m, -r.T @ position, atol=1e-12)
    np.testing.assert_allclose(
        found.by_errors[:, 0], -r.T @ np.array(measured.position_by_errors), atol=1e-12
    )
    by_turn = np.column_stack(
        [
            -(matrix(so3.multiply(q, so3.exp(h * e))) - matrix(so3.multiply(q, so3.exp(-h * e)))).T
            @ position
            / (2 * h)
            for e in np.eye(3)
        ]
    )
    expected = r.T @ placing @ r + by_turn @ turning @ by_turn.T
    np.testing.assert_allclose(found.covariance, expected, atol=1e-9)


def tumbling_in_orbit(start: tuple[Array, ...], dt_s: float, n: float) -> tuple[Array, ...]:
    """``BODY`` in a frame that turns at ``n`` about its Z axis, X away from the Earth: Euler's
    equations with the gravity gradient in inertial axes; its centre of mass moves uniformly there.
    """
    p, v, q, w = start
    r, c, inertia = matrix(q), BODY.centre_trf_m, BODY.inertia_kg_m2

    def frame(time_s: float) -> Array:
        cos, sin = math.cos(n * time_s), math.sin(n * time_s)
        return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])

    def slope(s: Array) -> Array:
        body, rate = s[:9].reshape(3, 3), s[9:12]
        up = body.T @ frame(s[12])[:, 0]
        torque = 3 * n * n * np.cross(up, inertia @ up)
        alpha = np.linalg.solve(inertia, torque - np.cross(rate, inertia @ rate))
        return np.concatenate([(body @ skew(rate)).ravel(), alpha, [1.0]])

    begin = np.concatenate([r.ravel(), w + n * r[2], [0.0]])
    end = rk4(slope, begin, dt_s / 14, 14)
    moved = frame(dt_s).T @ end[:9].reshape(3, 3)
    rate = end[9:12] - n * moved[2]
    velocity = v + r @ np.cross(w, c)
    centre = p + r @ c + velocity * dt_s
    return centre - moved @ c, velocity - moved @ np.cross(rate, c), moved, rate


@SEEDS
def test_tumble_in_orbit_is_predicted_in_the_frame_that_turns(seed: int) -> None:
    """Mean and covariance, in an orbit of five minutes, of a body whose shape is known."""
    rng, dt_s, n = np.random.default_rng(seed), 0.7, 0.02
    p = changed(parameters(scenario(), navigation("lab")), mean_motion_rad_s=n)
    trace = float(np.trace(BODY.inertia_kg_m2))
    s = joint_state(rng)
    of_motion = s.covariance[:TARGET, :TARGET]
    size = len(s.covariance) + SHAPE
    s = replace(
        s, shape=BodyShape(BODY.inertia_kg_m2 / trace, BODY.centre_trf_m),
        covariance=np.pad(of_motion, (0, size - TARGET)),
    )  # fmt: skip
    moved, found = predict_target(s, s.time_ns + round(dt_s * 1e9), p)
    here = tumbling_in_orbit((s.position_m, s.velocity_m_s, s.q_wxyz, s.omega_rad_s), dt_s, n)
    np.testing.assert_allclose(moved.position_m, here[0], atol=1e-7)
    np.testing.assert_allclose(moved.velocity_m_s, here[1], atol=1e-7)
    np.testing.assert_allclose(matrix(moved.q_wxyz), here[2], atol=1e-7)
    np.testing.assert_allclose(moved.omega_rad_s, here[3], atol=1e-7)
    columns, e = [], 1e-5
    for d in np.eye(size)[:TARGET]:
        ends = []
        for sign in (1.0, -1.0):
            m = inject(s, sign * e * d)
            start = (m.position_m, m.velocity_m_s, m.q_wxyz, m.omega_rad_s)
            end = tumbling_in_orbit(start, dt_s, n)
            ends.append(np.concatenate([*end[:2], turn_between(here[2], end[2]), end[3]]))
        columns.append((ends[0] - ends[1]) / (2 * e))
    j = np.column_stack(columns)
    linear, angular = p.target_noise[p.target.motion_model]
    noise = process_noise(dt_s, linear**2, angular**2)
    expected = j @ of_motion @ j.T + noise
    np.testing.assert_allclose(found, expected, atol=2e-3 * np.abs(expected).max())


@SEEDS
def test_two_hypotheses_have_their_spread_in_the_covariance(seed: int) -> None:
    """The second moment about the first, of samples of the mixture by its weights."""
    rng = np.random.default_rng(seed)
    a = replace(joint_state(rng), log_likelihood=-3.0)
    b = inject(replace(a, log_likelihood=-3.7), rng.normal(0.0, 0.05, len(a.covariance)))
    covariances = [covariance(rng, np.full(12, s)) for s in (1e-2, 2e-2)]
    apart = np.concatenate(
        [
            b.position_m - a.position_m,
            b.velocity_m_s - a.velocity_m_s,
            so3.log(so3.inverse_multiply(a.q_wxyz, b.q_wxyz)),
            b.omega_rad_s - a.omega_rad_s,
        ]
    )
    odds = math.exp(-0.7)
    share = odds / (1.0 + odds)
    expected = (1.0 - share) * covariances[0] + share * (covariances[1] + np.outer(apart, apart))
    np.testing.assert_allclose(mixture_covariance([a, b], covariances), expected, atol=1e-12)


@SEEDS
def test_odometry_without_drift_is_less_the_drift(seed: int) -> None:
    rng = np.random.default_rng(seed)
    s, o = joint_state(rng), moving_odometry(rng, 1, 3, 10**9)
    # Odometry states the true position plus the drift.
    np.testing.assert_allclose(
        np.array(estimator_of(s).without_drift(o).position_m) + s.of(1, POSITION_DRIFT),
        o.position_m,
        atol=1e-12,
    )


def test_floors_of_sightings_are_in_their_own_units() -> None:
    rng = np.random.default_rng(0)
    stated = covariance(rng, [1e-3] * 3 + [2e-3] * 3)
    p = changed(
        parameters(scenario(), navigation("lab")), floor_sighting_m=0.02, floor_sighting_rad=0.5
    )
    solution = PoseSolution(
        position_m=(0.0, 0.0, 1.0),
        q_wxyz=(1.0, 0.0, 0.0, 0.0),
        covariance=tuple(stated.ravel().tolist()),
        reprojection_rms_px=0.1,
    )
    added = sighting_covariance(solution, p) - stated
    np.testing.assert_allclose(added, np.diag([0.02**2] * 3 + [0.5**2] * 3), atol=1e-15)


def test_floors_of_odometry_are_in_their_own_units() -> None:
    rng = np.random.default_rng(0)
    floors = {"position_m": 0.02, "velocity_m_s": 0.3, "attitude_rad": 0.5, "omega_rad_s": 0.7}
    p = changed(
        parameters(scenario(), navigation("lab")),
        **{f"floor_{name}": floor for name, floor in floors.items()},
    )
    noise = odometry_noise(moving_odometry(rng, 0, 0, 0), p)
    np.testing.assert_allclose(noise, np.diag(np.repeat(np.square([*floors.values()]), 3)))


@SEEDS
def test_expected_pose_is_the_target_in_the_moved_camera(seed: int) -> None:
    rng = np.random.default_rng(seed)
    target, ahead_s = target_state(rng), 0.4
    own = moving_odometry(rng, 0, 1, target.time_ns)
    camera = changed(scenario().camera_model(), q_crf_irf_wxyz=tuple(attitude(rng).tolist()))
    found = expected_pose(target, own, camera, target.time_ns, ahead_s)
    still = np.zeros(3)
    p_t, _, r_t, _ = steady(
        (target.position_m, target.velocity_m_s, target.q_wxyz, target.omega_rad_s), ahead_s, still
    )
    state = (own.position_m, own.velocity_m_s, own.q_wxyz, own.omega_rad_s)
    p_o, _, r_o, _ = steady(tuple(map(np.array, state)), ahead_s, still)
    lens, eye = p_o + r_o @ np.array(camera.position_crf_m), r_o @ matrix(camera.q_crf_irf_wxyz)
    np.testing.assert_allclose(found.position_m, eye.T @ (p_t - lens), atol=1e-12)
    np.testing.assert_allclose(matrix(found.q_wxyz), eye.T @ r_t, atol=1e-12)
    assert found.sim_time_ns == target.time_ns + 400_000_000


def test_published_estimate_is_that_of_the_filter() -> None:
    rng = np.random.default_rng(1)
    s = joint_state(rng, chasers=1)
    relative = estimator_of(s).relative_poses()[0]
    target, pushed = target_state(rng), rng.normal(size=6)
    chaser = SimpleNamespace(
        chaser=0, own=SimpleNamespace(disturbance=pushed), relative=relative, camera=None,
        visible=True,
    )  # fmt: skip
    estimation: Any = SimpleNamespace(target=target, chasers=(chaser,), innovations=None)
    message = target_message(observed(rng, target.time_ns), estimation)
    np.testing.assert_array_equal(message.relative[0].covariance, relative.covariance.ravel())
    np.testing.assert_array_equal(message.relative[0].force_N, pushed[:3])
    np.testing.assert_array_equal(message.relative[0].torque_N_m, pushed[3:])
    np.testing.assert_array_equal(message.velocity_m_s, target.velocity_m_s)
    np.testing.assert_array_equal(message.covariance, target.covariance.ravel())


def test_force_varies_in_a_coast_as_its_random_walk_begins_and_stays_as_large_as_stated() -> None:
    """The density of the white noise behind it is that of the walk, scaled with the force."""
    p = changed(parameters(scenario(chaser=CHASER_BODY), navigation("lab")), lasting_force_N=0.002)
    noise = p.coast_noise
    assert noise.varying_m_s2 == pytest.approx(0.002 / MASS_KG)
    density = 2.0 * noise.varying_m_s2**2 / noise.varying_s
    walk = (p.disturbance_force_N_sqrt_s / MASS_KG) ** 2
    assert density == pytest.approx(walk * (0.002 / p.disturbance_force_N) ** 2)
    target = process_noise(2.0, *(x * x for x in p.target_noise[p.target.motion_model]))
    assert noise.white_m_s2_sqrt_s**2 * 2.0 == pytest.approx(target[3, 3])
