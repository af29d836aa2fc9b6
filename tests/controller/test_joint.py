# SPDX-License-Identifier: Apache-2.0
"""The joint filter: Jacobians, consistency, late and contradictory measurements."""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from chaserdock_controller.bodies.target_body import TargetBody
from chaserdock_controller.estimation.joint import JointEstimator, kernels
from chaserdock_controller.estimation.joint.estimator import random_covariance, relative_poses
from chaserdock_controller.estimation.joint.measurements import (
    linearize,
    measurement,
    mounting_of,
    predict_sighting,
    sighting_covariance,
)
from chaserdock_controller.estimation.joint.parameters import (
    GATE_CHI_SQUARE,
    GATE_CHI_SQUARE_3,
    SightingNoise,
    parameters_of,
)
from chaserdock_controller.estimation.joint.prediction import disturbance, predict
from chaserdock_controller.estimation.joint.state import (
    ATTITUDE_DRIFT,
    CENTRE,
    CHASER,
    FORCE,
    POSITION_DRIFT,
    SIGHTING_CHANNEL,
    TARGET,
    TORQUE,
    VIEW,
    JointState,
    block,
    difference,
    empty_state,
    inject,
)
from chaserdock_controller.estimation.joint.update import update
from chaserdock_controller.estimation.types import EstimatorInputs, Shock
from chaserdock_controller.guidance.pointing import CALIBRATION_S, calibration_turns
from chaserdock_controller.interfaces import AppliedImpulse
from chaserdock_models import rotations
from chaserdock_models import scalar_rotations as so3
from chaserdock_models.rigid_body import propagate
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import Innovation, Odometry, PoseSolution
from chaserdock_protocol.scenario.navigation import NavigationErrors
from flight_cases import scenario
from joint_cases import PERIOD_S, SyntheticFlight, changed, navigation, odometry_in, parameters
from scipy.stats import chi2

SCENARIO = scenario()
STEP = 1e-6
AT_REST = [AppliedImpulse.steady(np.zeros(6))] * 2
LATCHED = TargetBody(1.0, np.diag([1.0, 2.0, 2.5]), np.array([0.3, -0.2, 0.1]))
"""Target and chaser."""


def random_state(seed: int, chasers: int = 2) -> JointState:
    """Return a state with a target at about 1 m, rates, and errors of every kind."""
    rng = np.random.default_rng(seed)
    spread = np.concatenate([np.full(TARGET, 0.2), *[_spread() for _ in range(chasers)]])
    state = msgspec.structs.replace(
        empty_state(0, chasers), target_known=True, alive=np.ones(chasers, dtype=bool)
    )
    places = np.array([[-1.0, 0.0, 0.0], [0.0, -1.0, 0.1]])[:chasers]
    return inject(
        msgspec.structs.replace(state, positions_m=places), spread * rng.normal(size=len(spread))
    )


def _spread() -> list[float]:
    return (
        np.repeat(
            [0.1, 0.05, 0.3, 0.1, 0.05, 0.005, 0.005, 0.02, 0.01, 0.001, 0.02, 0.01], 3
        ).tolist()
        + [0.01]
        + [0.3] * 6
    )


def fly(
    estimator: JointEstimator, flight: SyntheticFlight, seconds: float, change=lambda i: i
) -> list[float]:
    """Fly for a time; return the NEES of all chasers every second of the second half. ``change``
    replaces inputs.
    """
    nees, ticks = [], round(seconds / PERIOD_S)
    for k in range(ticks):
        estimate = estimator.update(change(flight.inputs()))
        flight.texts += [e.text for e in estimate.events]
        if k >= ticks // 2 and k % 15 == 0:
            nees += [flight.relative_error(estimator, i)[2] for i in range(flight.n)]
        flight.step()
    return nees


def estimator_for(errors: NavigationErrors, chasers: int) -> JointEstimator:
    return JointEstimator(parameters(SCENARIO, errors), chasers)


@pytest.mark.parametrize("seed", range(3))
def test_jacobians_agree_with_finite_differences(seed: int) -> None:
    state, p = (
        random_state(seed),
        parameters(SCENARIO, navigation("orbit"), single_marker=SightingNoise(1.0, 1.0, 30.0)),
    )
    mounting = mounting_of(p.camera)
    flight = SyntheticFlight(SCENARIO, p.navigation, 2, seed)
    odometry, sighting = odometry_in(flight.inputs(), 1), flight.inputs().sightings[1].solutions[0]
    predicted = predict_sighting(state, 1, mounting)
    sighting = msgspec.structs.replace(
        sighting, position_m=vector(predicted.position_m), q_wxyz=vector(predicted.q_wxyz)
    )
    odometry = msgspec.structs.replace(odometry, q_wxyz=vector(state.attitudes_wxyz[1]))
    extra = state.extra.copy()
    extra[:, VIEW.start - 12 : VIEW.stop - 12] = 0.0
    extra[:, ATTITUDE_DRIFT.start - 12 : ATTITUDE_DRIFT.stop - 12] = (
        0.0  # attitude drift: the residual is linear at zero
    )
    state = msgspec.structs.replace(state, extra=extra)
    for measured in (
        measurement(2, 1, None, sighting, 1, mounting, p),
        measurement(2, 1, odometry, None, 0, mounting, p),
        measurement(2, 1, odometry, sighting, 1, mounting, p),
    ):
        z = linearize(state, measured)
        numeric = np.empty((len(z.residual), TARGET + 2 * CHASER))
        for k in range(numeric.shape[1]):
            e = np.zeros(numeric.shape[1])
            e[k] = STEP
            numeric[:, k] = (
                linearize(inject(state, -e), measured).residual
                - linearize(inject(state, e), measured).residual
            ) / (2 * STEP)
        np.testing.assert_allclose(z.by_target, numeric[:, :TARGET], atol=2e-5)
        np.testing.assert_allclose(z.by_chaser, numeric[:, block(1)], atol=2e-5)
        assert not numeric[:, block(0)].any()


@pytest.mark.parametrize("seed", range(2))
def test_predicted_covariance_is_that_of_the_propagated_error(seed: int) -> None:
    p = parameters(SCENARIO, navigation("orbit"))
    state = msgspec.structs.replace(
        random_state(seed), covariance=np.zeros((TARGET + 2 * CHASER,) * 2)
    )
    rng = np.random.default_rng(seed)
    given = [
        AppliedImpulse(
            *(rng.normal(size=(3, 6)) * np.repeat([0.02, 0.002], 3) * [[1], [0.03], [1]])
        )
        for _ in range(2)
    ]
    after = predict(state, round(PERIOD_S * 1e9), given, p)
    noise = after.covariance
    for k in range(TARGET + 2 * CHASER):
        e = np.zeros(TARGET + 2 * CHASER)
        e[k] = STEP
        moved = predict(inject(state, e), round(PERIOD_S * 1e9), given, p)
        column = difference(after, moved) / STEP
        unit = np.zeros_like(noise)
        unit[k, k] = 1.0
        grown = (
            predict(
                msgspec.structs.replace(state, covariance=unit), round(PERIOD_S * 1e9), given, p
            ).covariance
            - noise
        )
        np.testing.assert_allclose(grown, np.outer(column, column), atol=1e-3)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("period_s", [1.0 / 15.0, 0.2])
def test_a_prediction_takes_the_times_of_pulses_into_account(seed: int, period_s: float) -> None:
    """Against a fine integration of two pulses in any direction that may cancel, on a chaser with
    an offset centre of mass, a disturbance and a rate."""
    p, state = parameters(SCENARIO, navigation("orbit")), random_state(seed, 1)
    rng = np.random.default_rng(seed)
    pulses = rng.normal(size=(2, 6)) * np.repeat([1.0, 0.1], 3)
    pulses[1] -= pulses[0]
    begin_s, length_s = np.array([0.1, 0.7]) * period_s, 0.2 * period_s
    steps = 400
    x = np.concatenate(
        [
            state.positions_m[0],
            state.velocities_m_s[0],
            state.attitudes_wxyz[0],
            state.omegas_rad_s[0],
        ]
    )
    own = state.of(0, slice(FORCE.start, TORQUE.stop))
    given = np.zeros((3, 6))
    for k in range(steps):
        at_s = (k + 0.5) * period_s / steps
        parts = pulses * ((begin_s < at_s) & (at_s < begin_s + length_s))[:, None]
        h, wrench = period_s / steps, parts.sum(axis=0)
        given += [wrench * h, wrench * (h * (period_s / 2 - at_s)), np.abs(parts).sum(axis=0) * h]
        total = kernels.wrench_at_origin(
            wrench + own, state.of(0, CENTRE), x[10:13], p.body.mass_kg, np.array(p.body.inertia)
        )
        x = propagate(x, total, p.body, h)
    after = predict(
        state,
        state.time_ns + round(period_s * 1e9),
        [AppliedImpulse(given[0], given[1], given[2])],
        p,
    )
    steady = AppliedImpulse(given[0], np.zeros(6), given[2])
    without = predict(state, state.time_ns + round(period_s * 1e9), [steady], p)

    def errors(s: JointState) -> tuple[float, float]:
        turn = rotations.log(rotations.multiply(rotations.conjugate(x[6:10]), s.attitudes_wxyz[0]))
        return float(np.linalg.norm(s.positions_m[0] - x[:3])), float(np.linalg.norm(turn))

    for with_moment, as_constant in zip(errors(after), errors(without), strict=True):
        assert with_moment < 0.1 * as_constant


def test_pulses_that_cancel_make_a_prediction_uncertain() -> None:
    p, state = parameters(SCENARIO, navigation("orbit")), random_state(1, 1)
    magnitude = np.array([0.02, 0.01, 0.03, 0.002, 0.001, 0.003])
    cancelled = AppliedImpulse(np.zeros(6), np.zeros(6), magnitude)
    sigma = [
        np.sqrt(np.diag(predict(state, state.time_ns + 100_000_000, [given], p).covariance))
        for given in (AppliedImpulse.steady(magnitude), cancelled, AT_REST[0])
    ]
    np.testing.assert_allclose(sigma[0], sigma[1], rtol=0.02)
    rates = [block(0).start + k for k in (*range(3, 6), *range(9, 12))]
    assert (sigma[1][rates] > 1.01 * sigma[2][rates]).all()


def test_drifts_of_odometry_fade() -> None:
    p, state = parameters(SCENARIO, navigation("orbit")), random_state(0)
    later = predict(state, state.time_ns + 10_000_000_000, AT_REST, p)
    n = p.navigation
    assert min(n.position_drift_m, n.attitude_drift_rad) > 0.0
    for part, time_s in (
        (POSITION_DRIFT, n.position_drift_time_s),
        (ATTITUDE_DRIFT, n.attitude_drift_time_s),
    ):
        expected = math.exp(-10.0 / time_s) * state.of(1, part)
        np.testing.assert_allclose(later.of(1, part), expected, rtol=1e-12)


@pytest.mark.parametrize("chasers", [1, 2])
def test_update_is_that_of_a_kalman_filter(chasers: int) -> None:
    """Mean and covariance by the textbook's formulas, with the dense Jacobian of all measurements
    of a chaser.
    """
    p = parameters(SCENARIO, navigation("orbit"))
    rng = np.random.default_rng(chasers)
    size = TARGET + chasers * CHASER
    spread = 0.01 * rng.normal(size=(size, size))
    state = msgspec.structs.replace(
        random_state(4, chasers), covariance=spread @ spread.T, updates=p.iterated_updates
    )
    flight, last = SyntheticFlight(SCENARIO, p.navigation, chasers, 5), chasers - 1
    odometry, sighting = odometry_in(flight.inputs(), last), flight.inputs().sightings[last]
    mounting, wide = mounting_of(p.camera), replace(p, gate_sighting=np.inf, gate_odometry=np.inf)
    after, report = update(state, {last: odometry}, {last: sighting}, mounting, wide)
    assert report.accepted == (last,)

    markers, solution = len(sighting.marker_ids), sighting.solutions[0]
    z = linearize(state, measurement(chasers, last, odometry, solution, markers, mounting, p))
    h = np.zeros((18, size))
    h[:, :TARGET], h[:, block(last)] = z.by_target, z.by_chaser
    gain = np.linalg.solve(h @ state.covariance @ h.T + z.noise, h @ state.covariance).T
    error, reset = gain @ z.residual, np.eye(size)
    for part in (slice(6, 9), slice(block(last).start + 6, block(last).start + 9)):
        reset[part, part] = so3.right_jacobian(error[part])
    kept = np.eye(size) - gain @ h
    expected = reset @ (kept @ state.covariance @ kept.T + gain @ z.noise @ gain.T) @ reset.T
    np.testing.assert_allclose(difference(state, after), error, atol=1e-9)
    np.testing.assert_allclose(after.covariance, expected, atol=1e-9)
    np.testing.assert_array_equal(after.covariance, after.covariance.T)


def test_covariance_of_another_size_is_refused() -> None:
    """A checkpoint may hold anything, and the kernels check no sizes."""
    p, state = parameters(SCENARIO, navigation("orbit")), random_state(0)
    wrong = msgspec.structs.replace(state, covariance=np.eye(TARGET + CHASER))
    with pytest.raises(ValueError, match=r"2 chasers with a covariance of shape \(55, 55\)"):
        predict(wrong, 1, AT_REST, p)
    with pytest.raises(ValueError, match="2 chasers"):
        update(wrong, {}, {}, mounting_of(p.camera), p)
    with pytest.raises(ValueError, match="other numbers of chasers"):
        predict(msgspec.structs.replace(state, alive=np.ones(1, dtype=bool)), 1, AT_REST, p)


def test_gates_are_quantiles_of_chi_square() -> None:
    assert pytest.approx(chi2.ppf(0.9999, 3), rel=1e-12) == GATE_CHI_SQUARE_3
    assert pytest.approx(chi2.ppf(0.9999, 6), rel=1e-12) == GATE_CHI_SQUARE


@pytest.mark.parametrize("markers", [0, 1, 5])
def test_drawn_sightings_count_with_the_stated_covariance(markers: int) -> None:
    """They have white errors: nothing persists with a view, and only the floor is added."""
    drawn = scenario(perception={"name": "statistical"})
    p = parameters_of(drawn)
    noise = p.sighting_noise(markers)
    assert (noise.white_ratio, noise.view_ratio) == (1.0, 0.0)
    stated = np.diag([1e-11, 1e-11, 1e-9, 1e-10, 1e-10, 1e-11])
    solution = PoseSolution(
        position_m=(0.0, 0.0, 1.0),
        q_wxyz=(1.0, 0.0, 0.0, 0.0),
        covariance=vector(stated),
        reprojection_rms_px=0.0,
    )
    floor = np.repeat([p.floor_sighting_m**2, p.floor_sighting_rad**2], 3)
    np.testing.assert_allclose(sighting_covariance(solution, p), stated + np.diag(floor))
    assert parameters_of(scenario()).sighting_noise(markers).view_ratio > 0.0


@pytest.mark.slow
@pytest.mark.parametrize(("grade", "chasers"), [("lab", 1), ("lab", 4), ("orbit", 2)])
def test_relative_poses_are_consistent(grade: str, chasers: int) -> None:
    """The mean NEES over flights is 6; errors that are constant in a flight make single flights
    vary.
    """
    nees = []
    for seed in range(6):
        flight = SyntheticFlight(SCENARIO, navigation(grade), chasers, seed, disturbance=0.005)
        estimator = estimator_for(flight.errors, chasers)
        nees.append(np.mean(fly(estimator, flight, 16.0)))
        assert estimator.reinitialisations == 0
        assert estimator.newest is not None
        assert estimator.newest.gated <= 0.002 * estimator.newest.accepted + 6
    # Six flights with at least six independent components each: three sigma of the mean.
    assert 6.0 - 3 * np.sqrt(12 / 6) < np.mean(nees) < 6.0 + 3 * np.sqrt(12 / 6)


def innovations_of(
    estimator: JointEstimator, flight: SyntheticFlight, ticks: int, change=lambda i: i
) -> list[Innovation]:
    found: list[Innovation] = []
    for _ in range(ticks):
        found += estimator.update(change(flight.inputs())).innovations or ()
        flight.step()
    return found


def test_innovations_of_white_sightings_are_as_large_as_their_covariance_states() -> None:
    """The mean is chi-square of six degrees of freedom, on either side; with sightings half as
    noisy as assumed it is not.
    """
    means = []
    for assumed in (1.0, 2.0):
        errors = navigation("lab")
        white = SightingNoise(assumed, 0.0, 1.0)
        p = parameters(SCENARIO, errors, several_markers=white)
        flight = SyntheticFlight(SCENARIO, errors, 2, 17)
        estimator = JointEstimator(p, 2)
        innovations_of(estimator, flight, 30)  # settles
        found = innovations_of(estimator, flight, 120)
        assert [x.sim_time_ns for x in found] == sorted(x.sim_time_ns for x in found)
        assert [(x.chaser, x.freedoms, x.used) for x in found] == [(0, 6, True), (1, 6, True)] * 120
        means.append(np.mean([x.squared / x.freedoms for x in found]))
    bound = 4.0 * np.sqrt(2.0 / (6 * 240))
    assert abs(means[0] - 1.0) < bound
    assert means[1] < 0.5


def displaced(inputs: EstimatorInputs) -> EstimatorInputs:
    """Return the inputs with the second sighting displaced by half a metre."""
    good, bad = inputs.sightings
    solution = bad.solutions[0]
    place = vector(np.add(solution.position_m, [0.0, 0.5, 0.0]))
    wrong = msgspec.structs.replace(solution, position_m=place)
    return replace(inputs, sightings=(good, msgspec.structs.replace(bad, solutions=(wrong,))))


def test_innovation_of_a_rejected_sighting_is_stated_too() -> None:
    flight = SyntheticFlight(SCENARIO, navigation("lab"), 2, 11)
    estimator = estimator_for(flight.errors, 2)
    assert len(innovations_of(estimator, flight, 1)) == 1  # the other one starts the target
    innovations_of(estimator, flight, 30)

    good, bad = innovations_of(estimator, flight, 1, displaced)
    assert (good.chaser, good.used, bad.chaser, bad.used) == (0, True, 1, False)
    assert good.squared < GATE_CHI_SQUARE < 1e4 < bad.squared


def test_disturbances_are_estimated() -> None:
    flight = SyntheticFlight(SCENARIO, navigation("lab"), 2, 3, disturbance=0.005)
    estimator = estimator_for(flight.errors, 2)
    fly(estimator, flight, 30.0)
    assert estimator.state is not None
    for i, chaser in enumerate(flight.chasers):
        error = estimator.state.extra[i, :6] - chaser.disturbance
        own = estimator.state.covariance[block(i), block(i)]
        assert np.all(np.abs(error) < 4.0 * np.sqrt(np.diag(own)[12:18]))
        assert np.linalg.norm(error[:3]) < 0.004


def test_disturbance_moves_a_body_as_its_shifted_centre_of_mass_does() -> None:
    state, p = random_state(4), parameters(SCENARIO, navigation("lab"))
    commanded = np.array([0.1, -0.2, 0.3, 0.01, 0.02, -0.03])
    wrench, centre_m, omega = (
        commanded + state.extra[0, :6],
        state.of(0, CENTRE),
        state.omegas_rad_s[0],
    )
    torque = wrench[3:] - np.cross(centre_m, wrench[:3])
    inertia = np.diag(p.inertia)
    alpha = np.linalg.solve(inertia, torque - np.cross(omega, inertia @ omega))
    lag_m_s2 = np.cross(alpha, centre_m) + np.cross(omega, np.cross(omega, centre_m))
    expected = np.concatenate([wrench[:3] - p.body.mass_kg * lag_m_s2, torque])
    assert np.linalg.norm(expected - wrench) > 1e-3
    np.testing.assert_allclose(
        commanded + disturbance(state, 0, commanded, p), expected, atol=1e-12
    )


@pytest.mark.parametrize("latched_at", [None, 20])
def test_late_sightings_give_the_same_state(latched_at: int | None) -> None:
    """Sightings that arrive up to half a second late, in any order, change nothing in the end, also
    from before a latch.
    """
    rng = np.random.default_rng(5)
    flight = SyntheticFlight(SCENARIO, navigation("lab"), 2, 5)
    prompt, late = estimator_for(flight.errors, 2), estimator_for(flight.errors, 2)
    held: list = []
    for k in range(40):
        inputs = flight.inputs()
        prompt.update(inputs)
        held += [(k + int(rng.integers(0, 8)), s) for s in inputs.sightings]
        due = [s for at, s in held if at <= k or k == 39]
        held = [(at, s) for at, s in held if at > k and k < 39]
        rng.shuffle(due)
        late.update(replace(inputs, sightings=tuple(due)))
        if k == latched_at:
            for estimator in (prompt, late):
                estimator.change_body(LATCHED, np.zeros((9, 9)))
        flight.step()
    assert prompt.state is not None
    assert late.state is not None
    np.testing.assert_array_equal(prompt.state.covariance, late.state.covariance)
    np.testing.assert_array_equal(prompt.state.position_m, late.state.position_m)
    np.testing.assert_array_equal(prompt.state.extra, late.state.extra)


def test_late_odometry_counts_at_its_tick() -> None:
    """Odometry that arrives two ticks late gives the same state as odometry that arrived in time.
    What is known already, or older than the records, changes nothing."""
    flight = SyntheticFlight(SCENARIO, navigation("lab"), 2, 5)
    prompt, late = estimator_for(flight.errors, 2), estimator_for(flight.errors, 2)
    measured, missing = [], flight.inputs()
    for tick in range(30):
        inputs = flight.inputs()
        measured.append(odometry_in(inputs, 1))
        missing = changed(inputs, 1, odometry=None)
        prompt.update(inputs if tick < 28 else missing)
        late.update(inputs if tick < 10 else changed(missing, 1, outdated=measured[-3]))
        flight.step()
    missing = replace(missing, time_ns=flight.time_ns, sightings=())
    late.update(changed(missing, 1, outdated=measured[0]))
    prompt.update(missing)
    assert prompt.state is not None
    assert late.state is not None
    np.testing.assert_array_equal(prompt.state.covariance, late.state.covariance)
    np.testing.assert_array_equal(prompt.state.position_m, late.state.position_m)
    np.testing.assert_array_equal(prompt.state.positions_m, late.state.positions_m)


@pytest.mark.parametrize(("channel", "shift"), [("position", 0.05), ("velocity", 0.02)])
def test_odometry_that_lies_is_dropped_and_reported(channel: str, shift: float) -> None:
    """The position of chaser 1 jumps by 50 mm, or it states 20 mm/s too much: it is reported within
    a second, and the relative pose stays good."""
    flight = SyntheticFlight(SCENARIO, navigation("lab"), 2, 7)
    estimator = estimator_for(flight.errors, 2)
    fly(estimator, flight, 10.0)
    usual_m = flight.relative_error(estimator, 1)[0]
    field = {"position": "position_m", "velocity": "velocity_m_s"}[channel]

    def lie(inputs: EstimatorInputs) -> EstimatorInputs:
        o = odometry_in(inputs, 1)
        wrong = msgspec.structs.replace(
            o, **{field: vector(np.add(getattr(o, field), [shift, 0.0, 0.0]))}
        )
        return changed(inputs, 1, odometry=wrong)

    flight.texts.clear()
    fly(estimator, flight, 1.0, lie)
    assert f"chaser 1: odometry {channel} contradicts the estimate; not used" in flight.texts
    fly(estimator, flight, 5.0, lie)
    assert flight.relative_error(estimator, 1)[0] < 2.0 * usual_m + 1e-3
    fly(estimator, flight, 2.0)
    assert f"chaser 1: odometry {channel} used again" in flight.texts


def test_command_of_a_chaser_without_odometry_is_uncertain() -> None:
    """A chaser whose odometry is missing flies by a plan that the controller does not know: its
    velocity is uncertain by as much as its last command would change it."""
    flight = SyntheticFlight(SCENARIO, navigation("lab"), 2, 7)
    known, unknown = estimator_for(flight.errors, 2), estimator_for(flight.errors, 2)
    for _ in range(30):
        inputs = flight.inputs()
        known.update(inputs)
        unknown.update(inputs)
        flight.step()
    inputs = flight.inputs()
    missing = replace(changed(inputs, 1, odometry=None), sightings=())
    known.update(missing)
    last = np.array([0.3, 0.0, 0.0, 0.0, 0.0, 0.0])
    unknown.update(changed(missing, 1, last_command=last))
    assert known.state is not None
    assert unknown.state is not None
    velocity = block(1).start + 3 + np.arange(3)
    added = np.diag(unknown.state.covariance)[velocity] - np.diag(known.state.covariance)[velocity]
    expected = (0.3 * PERIOD_S / known.parameters.body.mass_kg) ** 2
    np.testing.assert_allclose(added, expected, rtol=0.05)


@pytest.mark.parametrize("turns", [True, False], ids=["all channels", "translation"])
def test_chaser_that_contradicts_all_measurements_is_started_again(turns: bool) -> None:
    """After a motion that nothing explained, odometry of a chaser that sees nothing is rejected,
    all or that of translation: within two seconds its estimate starts again from the odometry, and
    is consistent with it from then on."""
    flight = SyntheticFlight(SCENARIO, navigation("lab"), 2, 7)
    estimator = estimator_for(flight.errors, 2)
    fly(estimator, flight, 5.0)
    assert estimator.state is not None
    start_ns = estimator.state.time_ns
    stated: list[Odometry] = []

    def moved(inputs: EstimatorInputs) -> EstimatorInputs:
        o, since_s = odometry_in(inputs, 1), (inputs.time_ns - start_ns) * 1e-9
        turn = so3.exp(np.array([0.0, 0.0, 0.2 + 0.3 * since_s]) if turns else np.zeros(3))
        elsewhere = msgspec.structs.replace(
            o,
            position_m=vector(np.add(o.position_m, [0.2 + 0.05 * since_s, 0.0, 0.0])),
            velocity_m_s=vector(np.add(o.velocity_m_s, [0.05, 0.0, 0.0])),
            q_wxyz=vector(so3.multiply(np.array(o.q_wxyz), turn)),
            omega_rad_s=vector(so3.to_matrix(turn).T @ o.omega_rad_s + [0.0, 0.0, 0.3 * turns]),
        )
        stated.append(elsewhere)
        sightings = tuple(s for s in inputs.sightings if s.chaser != 1)
        return replace(changed(inputs, 1, odometry=elsewhere), sightings=sightings)

    flight.texts.clear()
    fly(estimator, flight, 2.0, moved)
    restart = (
        "chaser 1: no measurement supported its estimate for 1 s; started again from its odometry"
    )
    assert flight.texts.count(restart) == 1
    np.testing.assert_allclose(estimator.state.positions_m[1], stated[-1].position_m, atol=0.01)
    assert (estimator.state.rejections[1, 1:] < 5).all()


def test_chaser_whose_sightings_and_pose_contradict_the_estimate_is_started_again() -> None:
    """When odometry that was wrong from the start becomes right, the rates fit all the time, but
    support no pose.
    """
    flight = SyntheticFlight(SCENARIO, navigation("lab"), 3, 7)
    estimator = estimator_for(flight.errors, 3)

    def displaced(inputs: EstimatorInputs) -> EstimatorInputs:
        o = odometry_in(inputs, 1)
        elsewhere = msgspec.structs.replace(
            o, position_m=vector(np.add(o.position_m, [0.0, 0.0, 0.17]))
        )
        return changed(inputs, 1, odometry=elsewhere)

    fly(estimator, flight, 5.0, displaced)
    assert estimator.state is not None
    assert estimator.state.rejections[1, SIGHTING_CHANNEL] > 0
    fly(estimator, flight, 2.0)
    honest = odometry_in(flight.inputs(), 1)
    np.testing.assert_allclose(estimator.state.positions_m[1], honest.position_m, atol=0.01)
    assert not estimator.state.rejections[1].any()


@pytest.mark.parametrize(("ticks", "follows"), [(1, False), (2, True)])
def test_only_a_repeated_misfit_of_the_velocity_passes_for_a_force(
    ticks: int, follows: bool
) -> None:
    """A velocity 6 mm/s off in one tick is noise; in two ticks in a row it may be a stuck
    thruster.
    """
    flight = SyntheticFlight(SCENARIO, navigation("lab"), 1, 4)
    estimator = estimator_for(flight.errors, 1)
    fly(estimator, flight, 5.0)
    forces_N = []
    for k in range(ticks + 3):
        inputs = flight.inputs()
        o = odometry_in(inputs, 0)
        if k < ticks:
            o = msgspec.structs.replace(
                o, velocity_m_s=vector(np.add(o.velocity_m_s, [0.006, 0.0, 0.0]))
            )
        estimator.update(changed(inputs, 0, odometry=o))
        flight.step()
        assert estimator.state is not None
        forces_N.append(float(np.linalg.norm(estimator.state.extra[0, :3])))
    assert (max(forces_N) > 0.2) is follows
    assert (max(forces_N) > 0.01) is follows


def test_odometry_noisier_than_stated_is_reported() -> None:
    flight = SyntheticFlight(SCENARIO, navigation("lab"), 1, 2)
    estimator = estimator_for(flight.errors, 1)

    def overconfident(inputs: EstimatorInputs) -> EstimatorInputs:
        o = odometry_in(inputs, 0)
        stated = vector(np.reshape(o.velocity_covariance_m2_s2, (3, 3)) / 9.0)
        o = msgspec.structs.replace(o, velocity_covariance_m2_s2=stated)
        return changed(inputs, 0, odometry=o)

    fly(estimator, flight, 8.0, overconfident)
    assert any("velocity is overconfident" in text for text in flight.texts)
    honest = SyntheticFlight(SCENARIO, navigation("lab"), 1, 2)
    fly(estimator_for(honest.errors, 1), honest, 8.0)
    assert not any("overconfident" in text for text in honest.texts)


@pytest.mark.slow
def test_target_without_sightings_stays_predicted() -> None:
    """After 20 s without sight the relative position is still within a few millimetres, and its
    covariance says so.
    """
    flight = SyntheticFlight(SCENARIO, navigation("lab"), 4, 11)
    estimator = estimator_for(flight.errors, 4)
    fly(estimator, flight, 20.0)
    fly(estimator, flight, 20.0, lambda inputs: replace(inputs, sightings=()))
    errors = [flight.relative_error(estimator, i) for i in range(4)]
    assert max(e[0] for e in errors) < 7e-3
    assert np.mean([e[2] for e in errors]) < chi2.ppf(0.999, 6)


@pytest.mark.parametrize("wrong_first", [False, True])
def test_ambiguous_start_is_resolved_by_a_clear_view(wrong_first: bool) -> None:
    flight = SyntheticFlight(SCENARIO, navigation("lab"), 1, 12)
    estimator = estimator_for(flight.errors, 1)
    flip = rotations.exp([0.0, math.radians(40.0), 0.0])

    def ambiguous(inputs: EstimatorInputs) -> EstimatorInputs:
        right = inputs.sightings[0].solutions[0]
        other = msgspec.structs.replace(
            right, q_wxyz=vector(rotations.multiply(right.q_wxyz, flip))
        )
        pair = (other, right) if wrong_first else (right, other)
        sighting = msgspec.structs.replace(inputs.sightings[0], solutions=pair, marker_ids=(0,))
        return replace(inputs, sightings=(sighting,))

    fly(estimator, flight, 0.4, ambiguous)
    sigma = math.sqrt(estimator.estimate_at(flight.time_ns).covariance[7, 7])
    assert sigma > math.radians(10.0)  # both attitudes are still open
    fly(estimator, flight, 2.0)
    assert "initialised by chaser 0, ambiguous: two hypotheses" in flight.texts
    assert flight.texts[-1] == "ambiguity resolved"
    estimate = estimator.estimate_at(flight.time_ns)
    assert rotations.angle_between(estimate.q_wxyz, flight.target[6:10]) < math.radians(1.5)
    assert math.sqrt(estimate.covariance[7, 7]) < math.radians(1.0)


def test_target_that_jumps_is_initialized_again() -> None:
    flight = SyntheticFlight(SCENARIO, navigation("lab"), 2, 13)
    estimator = estimator_for(flight.errors, 2)
    fly(estimator, flight, 4.0)
    flight.target[:3] += [0.0, 0.0, 0.3]
    fly(estimator, flight, 2.0)
    assert estimator.reinitialisations == 1
    assert any(text.startswith("re-initialised by chaser") for text in flight.texts)
    assert (
        np.linalg.norm(estimator.estimate_at(flight.time_ns).position_m - flight.target[:3]) < 0.01
    )


def test_one_of_two_cameras_that_errs_is_no_majority() -> None:
    """Its sightings are dropped; the target is not started again."""
    flight = SyntheticFlight(SCENARIO, navigation("lab"), 2, 11)
    estimator = estimator_for(flight.errors, 2)
    fly(estimator, flight, 5.0)

    fly(estimator, flight, 2.0, displaced)
    assert estimator.reinitialisations == 0
    assert flight.texts[-1] == "chaser 1 gated out: 5 in a row"
    found = estimator.estimate_at(flight.time_ns)
    assert np.linalg.norm(found.position_m - flight.target[:3]) < 5e-3
    assert np.linalg.norm(found.velocity_m_s - flight.target[3:6]) < 2e-3


def test_pushed_target_without_sightings_is_lost_and_reacquired() -> None:
    flight = SyntheticFlight(SCENARIO, navigation("lab"), 2, 14)
    estimator = estimator_for(flight.errors, 2)
    fly(estimator, flight, 4.0)
    estimator.disturb(Shock(0.5, 0.5))
    fly(estimator, flight, 1.0, lambda inputs: replace(inputs, sightings=()))
    assert estimator.estimate_at(flight.time_ns).status == "lost"
    flight.target[:3] += [0.0, 0.0, 4.0]
    fly(estimator, flight, 1.0)
    assert estimator.estimate_at(flight.time_ns).status == "tracking"
    assert estimator.reinitialisations == 1
    assert flight.texts.index("lost") < next(
        i for i, t in enumerate(flight.texts) if t.startswith("reacquired by chaser")
    )


@pytest.mark.parametrize("seed", range(4))
def test_mounting_rotation_is_observable_with_calibration_manoeuvre_only(seed: int) -> None:
    """One camera with a mounting error of 0.3 degrees (one sigma), and exact odometry."""
    residual_rad = {}
    for manoeuvre in (True, False):
        flight = SyntheticFlight(SCENARIO, navigation("exact", camera_turn_deg=0.3), 1, seed)
        estimator = JointEstimator(parameters(SCENARIO, flight.errors), 1)
        for k in range(round((CALIBRATION_S + 2.0) / PERIOD_S)):
            if manoeuvre:
                flight.turns[0] = calibration_turns([k * PERIOD_S])[0]
            estimator.update(flight.inputs())
            flight.step()
        found = estimator.cameras()[0]
        off = found.turn_rad - flight.chasers[0].camera_turn_rad
        residual_rad[manoeuvre] = float(np.linalg.norm(off))
        assert residual_rad[manoeuvre] < 4.0 * math.sqrt(float(np.trace(found.covariance[:3, :3])))
        if manoeuvre:
            assert math.sqrt(float(np.trace(found.covariance[:3, :3]))) < math.radians(0.08)
        else:  # rotation about the line of sight is unobservable
            assert math.sqrt(float(found.covariance[2, 2])) > math.radians(0.25)
    assert residual_rad[True] < math.radians(0.08)


def test_relative_pose_has_the_covariance_of_its_errors() -> None:
    state, rng = random_state(9), np.random.default_rng(9)
    a = rng.normal(size=(TARGET + 2 * CHASER,) * 2) * 1e-4
    state = msgspec.structs.replace(state, covariance=a @ a.T)
    pose = relative_poses(state, [0, 1])[1]
    draws = []
    for _ in range(4000):
        other = relative_poses(inject(state, a @ rng.normal(size=len(a))), [1])[0]
        turn = rotations.log(rotations.multiply(rotations.conjugate(pose.q_wxyz), other.q_wxyz))
        draws.append(np.concatenate([other.position_m - pose.position_m, turn]))
    sample = np.cov(np.array(draws).T)
    scale = np.sqrt(np.outer(np.diag(pose.covariance), np.diag(pose.covariance)))
    np.testing.assert_allclose(sample / scale, pose.covariance / scale, atol=0.12)


def test_random_covariance_is_that_of_a_pose_with_known_camera_and_view() -> None:
    """The same as after an exact measurement of the errors that a latched chaser keeps."""
    state, rng = random_state(9), np.random.default_rng(9)
    a = rng.normal(size=(TARGET + 2 * CHASER,) * 2) * 1e-4
    p = a @ a.T
    h = np.eye(len(p))[TARGET + CHASER + 30 : TARGET + CHASER + 43]
    gain = p @ h.T @ np.linalg.inv(h @ p @ h.T)
    known = msgspec.structs.replace(state, covariance=p - gain @ h @ p)
    expected = relative_poses(known, [1])[0].covariance
    found = random_covariance(msgspec.structs.replace(state, covariance=p), 1)
    np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-12)
