# SPDX-License-Identifier: Apache-2.0
"""The joint filter with chasers that are independent given the target, against all correlations."""

from __future__ import annotations

from dataclasses import replace as with_parameters

import numpy as np
import pytest
from chaserdock_controller.bodies.body_shape import SHAPE
from chaserdock_controller.estimation.joint import JointEstimator, JointParameters
from chaserdock_controller.estimation.joint import covariance as forms
from chaserdock_controller.estimation.joint.estimator import random_covariance, relative_poses
from chaserdock_controller.estimation.joint.floor import keep_on_floor
from chaserdock_controller.estimation.joint.hypotheses import unknown_rates
from chaserdock_controller.estimation.joint.measurements import mounting_of
from chaserdock_controller.estimation.joint.parameters import LevelFloor, TargetParameters
from chaserdock_controller.estimation.joint.prediction import predict
from chaserdock_controller.estimation.joint.star import ChasersGivenTarget
from chaserdock_controller.estimation.joint.state import (
    CHASER,
    RATES,
    TARGET,
    JointState,
    block,
    difference,
    start_shape,
    with_body,
)
from chaserdock_controller.estimation.joint.update import (
    sighted_pose,
    start_chaser,
    start_target,
    update,
)
from chaserdock_controller.interfaces import AppliedImpulse
from chaserdock_models.arrays import Array
from flight_cases import scenario
from general_position import covariance
from joint_cases import SyntheticFlight, joint_state, navigation, odometry_in, parameters
from msgspec.structs import replace

SCENARIO = scenario()
N = 3
PAIR = np.arange(TARGET + CHASER)


def dense_of(star: JointState) -> JointState:
    """Return the same state with the covariance of all errors."""
    given, hub, n = star.given_target, star.covariance, star.chasers
    assert given is not None
    end = TARGET + CHASER * n
    whole = np.zeros((end + len(hub) - TARGET,) * 2)
    rows = np.r_[:TARGET, end : len(whole)]
    whole[np.ix_(rows, rows)] = hub
    for i in range(n):
        cross = given.gains[i] @ hub
        whole[block(i), rows], whole[rows, block(i)] = cross, cross.T
        for j in range(n):
            whole[block(i), block(j)] = cross @ given.gains[j].T
        whole[block(i), block(i)] += given.covariances[i]
    return replace(star, covariance=whole, given_target=None)


def general(seed: int, p: JointParameters) -> JointState:
    """Return a state in star form in general position, with a shape if ``p`` has one."""
    rng = np.random.default_rng(seed)
    state = with_body(joint_state(rng, N), p.target)
    size = TARGET + (SHAPE if state.shape is not None else 0)
    hub, own = covariance(rng, np.full(size, 3e-3)), np.full(CHASER, 2e-3)
    given = ChasersGivenTarget(
        rng.normal(0.0, 0.3, (N, CHASER, size)), np.array([covariance(rng, own) for _ in range(N)])
    )
    return replace(state, covariance=hub, given_target=given)


def assert_same(star: JointState, dense: JointState, *, between_chasers: bool = True) -> None:
    """Assert that both forms have one mean and one covariance, at least of each pair."""
    np.testing.assert_allclose(difference(star, dense), 0.0, atol=1e-6)
    found = dense_of(star).covariance
    kept = np.ones_like(found, dtype=bool)
    if not between_chasers:
        for i in range(N):
            for j in range(N):
                kept[block(i), block(j)] = i == j
    variances = dense.covariance.diagonal()
    scale = np.sqrt(np.outer(variances, variances)) + 1e-30  # some are zero
    np.testing.assert_allclose((found / scale)[kept], (dense.covariance / scale)[kept], atol=1e-7)


def parameters_with(shape: bool) -> JointParameters:
    p = parameters(SCENARIO, navigation("lab"), gate_sighting=1e9, gate_odometry=1e9)
    body = tuple(tuple(row) for row in (1e-2 * np.eye(9)).tolist())
    target = TargetParameters(motion_model="torque_free", body_covariance=body)
    return with_parameters(p, target=target) if shape else p


@pytest.mark.parametrize("shape", [False, True])
@pytest.mark.parametrize("seed", range(2))
def test_update_is_that_of_all_correlations(seed: int, shape: bool) -> None:
    """Odometry and sightings of all chasers; one has none, and one no sighting."""
    p = parameters_with(shape)
    star, flight = general(seed, p), SyntheticFlight(SCENARIO, p.navigation, N, seed)
    inputs, mounting = flight.inputs(), mounting_of(p.camera)
    odometry = {i: odometry_in(inputs, i) for i in (0, 2)}
    sightings = {s.chaser: s for s in inputs.sightings if s.chaser == 2}
    # Residuals of a sigma or so: corrections are small, so that the order of their injection does
    # not matter.
    star = replace(star, updates=100)
    near = _at_truth(star, flight)
    after = [update(s, odometry, sightings, mounting, p)[0] for s in (near, dense_of(near))]
    assert_same(*after)
    assert after[0].log_likelihood == pytest.approx(after[1].log_likelihood, rel=1e-9)
    assert np.array_equal(after[0].rejections, after[1].rejections)


def _at_truth(state: JointState, flight: SyntheticFlight) -> JointState:
    """Return the state with a mean near the truth of a flight."""
    t, chasers = flight.target, np.array([c.state for c in flight.chasers])
    return replace(
        state,
        position_m=t[:3].copy(), velocity_m_s=t[3:6].copy(), q_wxyz=t[6:10].copy(),
        omega_rad_s=t[10:13].copy(), positions_m=chasers[:, :3], velocities_m_s=chasers[:, 3:6],
        attitudes_wxyz=chasers[:, 6:10], omegas_rad_s=chasers[:, 10:13],
        extra=np.zeros_like(state.extra),
    )  # fmt: skip


@pytest.mark.parametrize("shape", [False, True])
def test_prediction_is_not_more_certain_than_with_all_correlations(shape: bool) -> None:
    """The target and its covariance with each chaser stay; the covariance of all errors does not
    become smaller in any direction, nor more than N times as large.
    """
    p, rng = parameters_with(shape), np.random.default_rng(5)
    star = general(3, p)
    given = [AppliedImpulse(j, 0.02 * j, np.abs(j)) for j in rng.uniform(-0.05, 0.05, (N, 6))]
    time_ns = star.time_ns + 200_000_000
    after = [predict(s, time_ns, given, p, frozenset({1})) for s in (star, dense_of(star))]
    _assert_bounded(*after)


def _assert_bounded(star: JointState, dense: JointState) -> None:
    np.testing.assert_allclose(difference(star, dense), 0.0, atol=1e-6)
    found, whole = dense_of(star).covariance, dense.covariance
    sigmas = np.sqrt(whole.diagonal())
    more = (found - whole) / np.outer(sigmas, sigmas)
    chasers = np.zeros(len(more), dtype=bool)
    for i in range(N):
        chasers[block(i)] = True
    np.testing.assert_allclose(more[~chasers], 0.0, atol=1e-9)
    assert np.linalg.eigvalsh(0.5 * (more + more.T)).min() > -1e-9
    assert 0.0 < more.diagonal().max() < N - 1


def test_prediction_without_noise_of_the_target_keeps_all_correlations() -> None:
    p = with_parameters(parameters_with(False), target_noise={"constant_rates": (0.0, 0.0)})
    star = general(4, p)
    given = [AppliedImpulse.steady(np.zeros(6))] * N
    time_ns = star.time_ns + 200_000_000
    assert_same(*(predict(s, time_ns, given, p) for s in (star, dense_of(star))))


@pytest.mark.parametrize("shape", [False, True])
def test_starts_and_noise_are_those_of_all_correlations(shape: bool) -> None:
    """A start of the target or of its shape forgets what chasers know of each other by the earlier
    one.
    """
    p = parameters_with(shape)
    star, flight = general(6, p), SyntheticFlight(SCENARIO, p.navigation, N, 1)
    inputs, mounting = flight.inputs(), mounting_of(p.camera)
    both = star, dense_of(star)
    solution = inputs.sightings[1].solutions[0]

    def restarted(s: JointState) -> JointState:
        pose = sighted_pose(s, 1, solution, 4, mounting, p)
        return start_target(s, pose, unknown_rates(p.target), 2.0)

    assert_same(*(restarted(s) for s in both), between_chasers=False)
    assert_same(*(start_chaser(s, 2, odometry_in(inputs, 2), p) for s in both))
    variances = np.arange(1.0, 7.0) * 1e-6
    assert_same(*(forms.with_chaser_noise(s, 1, RATES, variances) for s in both))
    _assert_bounded(*(forms.with_target_noise(s, RATES, variances) for s in both))
    if shape:
        assert_same(*(start_shape(s, p.target) for s in both), between_chasers=False)


def test_floor_is_that_of_all_correlations() -> None:
    star = general(7, parameters_with(False))
    level = np.array([1.0, 0.0, 0.0, 0.0])
    flat = np.array([1.0, 1.0, 0.0])
    star = replace(
        star, q_wxyz=level, attitudes_wxyz=np.tile(level, (N, 1)),
        velocity_m_s=star.velocity_m_s * flat, velocities_m_s=star.velocities_m_s * flat,
        omega_rad_s=star.omega_rad_s * (1.0 - flat), omegas_rad_s=star.omegas_rad_s * (1.0 - flat),
    )  # fmt: skip
    floor = LevelFloor((0.0, 0.0, 1.0))
    after = [keep_on_floor(s, floor) for s in (star, dense_of(star))]
    assert_same(*after)
    assert after[0].log_likelihood == pytest.approx(after[1].log_likelihood)


def test_results_read_from_both_forms_are_equal() -> None:
    star = general(8, parameters_with(True))
    dense, chasers = dense_of(star), [0, 2]
    for a, b in zip(relative_poses(star, chasers), relative_poses(dense, chasers), strict=True):
        np.testing.assert_allclose(a.covariance, b.covariance, rtol=1e-9, atol=1e-15)
    _close(forms.of_chaser(star, 1), forms.of_chaser(dense, 1))
    _close(
        forms.between(star, 1, PAIR[:20], PAIR[5:]), forms.between(dense, 1, PAIR[:20], PAIR[5:])
    )
    _close(random_covariance(star, 1), random_covariance(dense, 1))


def _close(a: Array, b: Array) -> None:
    np.testing.assert_allclose(a, b, atol=1e-9 * np.abs(b).max())


def test_flight_in_star_form_is_as_accurate_as_with_all_correlations() -> None:
    """Both filters get the same measurements of four chasers with all sensor errors."""
    errors, results = navigation("lab"), []
    for most_dense in (0, 16):
        p = parameters(SCENARIO, errors, most_dense_chasers=most_dense)
        estimator, flight = JointEstimator(p, 4), SyntheticFlight(SCENARIO, errors, 4, 2)
        found = []
        for k in range(150):
            estimator.update(flight.inputs())
            if k > 75:
                found += [flight.relative_error(estimator, i) for i in range(4)]
            flight.step()
        assert (estimator.state.given_target is None) == (most_dense == 16)  # type: ignore[union-attr]
        results.append(np.mean(found, axis=0))
    (star_m, star_rad, star_nees), (dense_m, dense_rad, dense_nees) = results
    assert star_m == pytest.approx(dense_m, rel=0.05)
    assert star_rad == pytest.approx(dense_rad, rel=0.05)
    assert star_nees == pytest.approx(dense_nees, rel=0.15)
