"""Fusion: the filter's mathematics, its consistency, and how it behaves when cameras are late, blind or lie."""

from __future__ import annotations

import ast
import math
import random
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from chaserdock_controller import fusion
from chaserdock_controller.fusion import (
    Measurement,
    Mekf,
    MekfParameters,
    PaperEstimator,
    PaperParameters,
    PoseHypothesis,
    TargetEstimate,
    make_estimator,
    motion,
    scalar,
    to_world,
)
from chaserdock_controller.fusion.branch import Branch, correct, innovate
from chaserdock_controller.fusion.paper import average_quaternion
from chaserdock_controller.fusion.parameters import chi_square_6
from chaserdock_controller.fusion.types import no_estimate
from chaserdock_protocol import rotations as rot
from hypothesis import given, settings
from hypothesis import strategies as st

V = np.array([0.015, 0.0075, 0.03])
W = np.array([0.015, 0.045, 0.03])
HZ = 15
SIGMA_P, SIGMA_A = 1e-3, math.radians(0.2)
R = np.diag([SIGMA_P**2] * 3 + [SIGMA_A**2] * 3)
NO_BIAS = MekfParameters(
    bias_position_m=0.0, bias_attitude_rad=0.0, floor_position_m=0.0, floor_attitude_rad=0.0
)
Q0 = rot.normalize([0.4, -0.5, 0.6, 0.2])

deterministic = settings(derandomize=True, deadline=None, max_examples=30)
vectors = st.lists(st.floats(-2.0, 2.0), min_size=3, max_size=3).map(np.array)
rotation_vectors = st.lists(st.floats(-1.7, 1.7), min_size=3, max_size=3).map(np.array)


def ns(k: float) -> int:
    return round(k / HZ * 1e9)


def truth(time_ns: int) -> tuple[np.ndarray, np.ndarray]:
    t = time_ns * 1e-9
    return np.array([1.0, -2.0, 0.5]) + V * t, rot.integrate(Q0, W, t)


def see(
    rng: np.random.Generator,
    chaser: int,
    time_ns: int,
    *,
    shift: np.ndarray | None = None,
    turn: np.ndarray | None = None,
    flip: np.ndarray | None = None,
    wrong_first: bool = False,
    markers: int = 4,
) -> Measurement:
    """A measurement with white noise R; ``shift`` and ``turn`` are errors in TRF; ``flip`` is a rotation
    vector in TRF axes that makes the second hypothesis of an ambiguous view."""
    p, q = truth(time_ns)
    p = p + rng.normal(size=3) * SIGMA_P
    if shift is not None:
        p = p + rot.rotate(q, shift)
    if turn is not None:
        q = rot.multiply(q, rot.exp(turn))
    q = rot.multiply(q, rot.exp(rng.normal(size=3) * SIGMA_A))
    hypotheses = [PoseHypothesis(p, q, R)]
    if flip is not None:
        hypotheses.append(PoseHypothesis(p, rot.multiply(q, rot.exp(flip)), R))
    if wrong_first:
        hypotheses.reverse()
    return Measurement(chaser, time_ns, tuple(hypotheses), markers)


def errors(e: TargetEstimate) -> np.ndarray:
    """True minus estimated state (12,), in the order of the covariance."""
    p, q = truth(e.time_ns)
    dtheta = rot.log(rot.multiply(rot.conjugate(e.q_wxyz), q))
    return np.concatenate([p - e.position_m, V - e.velocity_m_s, dtheta, W - e.omega_rad_s])


def nees(e: TargetEstimate) -> float:
    d = errors(e)
    return float(d @ np.linalg.solve(e.covariance, d))


def fly(
    estimator: Mekf | PaperEstimator, chasers: int, seconds: float, seed: int = 0
) -> list[TargetEstimate]:
    rng = np.random.default_rng(seed)
    return [
        estimator.update([see(rng, c, ns(k)) for c in range(chasers)], ns(k))
        for k in range(int(seconds * HZ))
    ]


def same(a: TargetEstimate, b: TargetEstimate) -> bool:
    """Equal bit for bit."""
    arrays = ("position_m", "velocity_m_s", "q_wxyz", "omega_rad_s", "covariance")
    plain = ("time_ns", "status", "sightings", "rejected")
    return all(getattr(a, n).tobytes() == getattr(b, n).tobytes() for n in arrays) and all(
        getattr(a, n) == getattr(b, n) for n in plain
    )


# --- mathematics -----------------------------------------------------------------------------------


@deterministic
@given(rotation_vectors, rotation_vectors)
def test_scalar_rotations_equal_the_shared_ones(a: np.ndarray, b: np.ndarray) -> None:
    qa, qb = rot.exp(a), rot.exp(b)
    np.testing.assert_allclose(scalar.qexp(a), qa, atol=1e-14)
    np.testing.assert_allclose(scalar.qmul(qa, qb), rot.multiply(qa, qb), atol=1e-14)
    np.testing.assert_allclose(scalar.qinv_mul(qa, qb), rot.multiply(rot.conjugate(qa), qb), atol=1e-14)
    np.testing.assert_allclose(scalar.qlog(qb), rot.log(qb), atol=1e-12)
    np.testing.assert_allclose(scalar.qmatrix(qa), rot.to_matrix(qa), atol=1e-14)
    np.testing.assert_array_equal(scalar.skew(a), rot.skew(a))


@deterministic
@given(rotation_vectors, vectors)
def test_right_jacobian_by_differences(phi: np.ndarray, d: np.ndarray) -> None:
    h = 1e-6
    moved = [rot.multiply(rot.conjugate(rot.exp(phi)), rot.exp(phi + s * h * d)) for s in (1.0, -1.0)]
    numeric = (rot.log(moved[0]) - rot.log(moved[1])) / (2 * h)
    np.testing.assert_allclose(scalar.right_jacobian(phi) @ d, numeric, atol=1e-8)


def test_small_angles_lose_nothing() -> None:
    for size in (0.0, 1e-12, 1e-6, 9.9e-5, 1.01e-4):
        phi = np.array([0.6, -0.8, 0.0]) * size
        np.testing.assert_allclose(scalar.qlog(scalar.qexp(phi)), phi, rtol=1e-9, atol=1e-300)
        np.testing.assert_allclose(scalar.right_jacobian(phi), np.eye(3) - 0.5 * rot.skew(phi), atol=1e-8)


INERTIA = np.array([[2.0, 0.1, 0.0], [0.1, 3.0, -0.2], [0.0, -0.2, 4.0]])


@pytest.mark.parametrize("model", motion.MODELS)
def test_transition_by_differences(model: str) -> None:
    w, dt, h = np.array([0.4, -0.9, 0.3]), 0.7, 1e-6

    def step(d: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        q = rot.multiply(Q0, rot.exp(d[:3]))
        if model == "constant_rates":
            return motion.constant_rates(q, w + d[3:], dt)
        return motion.torque_free(q, w + d[3:], dt, INERTIA, np.linalg.inv(INERTIA))

    q, _, transition = step(np.zeros(6))
    for i in range(6):
        d = h * np.eye(6)[i]
        (qa, wa, _), (qb, wb, _) = step(d), step(-d)
        back = rot.conjugate(q)
        dtheta = rot.log(rot.multiply(back, qa)) - rot.log(rot.multiply(back, qb))
        np.testing.assert_allclose(transition[:, i], np.concatenate([dtheta, wa - wb]) / (2 * h), atol=2e-6)


def test_torque_free_against_a_fine_integration() -> None:
    inertia = np.diag([1.0, 2.0, 2.5])
    q, w, n = np.array(Q0), np.array([0.05, 0.6, 0.1]), 4_000
    dt = 4.0 / n
    inverse = np.diag(1.0 / np.diag(inertia))
    for _ in range(n):  # explicit midpoint on small steps; attitude by the exponential map
        middle = w + 0.5 * dt * inverse @ -np.cross(w, inertia @ w)
        q = scalar.qmul(q, scalar.qexp(middle * dt))
        w = w + dt * inverse @ -np.cross(middle, inertia @ middle)
    got_q, got_w, _ = motion.torque_free(Q0, np.array([0.05, 0.6, 0.1]), 4.0, inertia, np.linalg.inv(inertia))
    assert float(rot.angle_between(q, got_q)) < 2e-6
    np.testing.assert_allclose(got_w, w, atol=2e-6)
    assert np.linalg.norm(got_w - [0.05, 0.6, 0.1]) > 0.02  # the rates did move


def test_torque_free_of_a_ball_is_constant_rates() -> None:
    a = motion.torque_free(Q0, W, 2.0, np.eye(3), np.eye(3))
    b = motion.constant_rates(Q0, W, 2.0)
    for x, y in zip(a, b, strict=True):
        np.testing.assert_allclose(x, y, atol=2e-8)


def test_process_noise_composes_and_is_positive() -> None:
    whole = motion.process_noise(0.5, 1e-8, 4e-8)
    f = np.eye(12)
    f[0:3, 3:6] = f[6:9, 9:12] = 0.3 * np.eye(3)
    parts = f @ motion.process_noise(0.2, 1e-8, 4e-8) @ f.T + motion.process_noise(0.3, 1e-8, 4e-8)
    np.testing.assert_allclose(whole, parts, atol=1e-20)
    assert np.linalg.eigvalsh(whole)[0] > 0.0


def _branch(bias: np.ndarray, covariance: np.ndarray) -> Branch:
    return Branch(0, np.array([1.0, 2.0, 3.0]), V, Q0, W, (7,), bias.reshape(1, 6), covariance, 0.0, {})


def test_measurement_jacobian_by_differences() -> None:
    p = MekfParameters()
    bias = np.array([0.02, -0.01, 0.03, 0.05, 0.02, -0.04])
    branch = _branch(bias, np.eye(18))
    rotation = rot.to_matrix(Q0)
    seen = PoseHypothesis(
        branch.position_m + rotation @ bias[:3], rot.multiply(Q0, rot.exp(bias[3:])), np.eye(6)
    )
    at_truth = innovate(branch, 7, seen, p)
    np.testing.assert_allclose(at_truth.residual, 0.0, atol=1e-12)
    h = 1e-6

    def residual(d: np.ndarray) -> np.ndarray:
        moved = replace(
            branch,
            position_m=branch.position_m + d[:3],
            q_wxyz=rot.multiply(Q0, rot.exp(d[6:9])),
            bias=(bias + d[12:]).reshape(1, 6),
        )
        return innovate(moved, 7, seen, p).residual

    for i in range(18):
        d = h * np.eye(18)[i]
        np.testing.assert_allclose(
            (residual(-d) - residual(d)) / (2 * h), at_truth.jacobian[:, i], atol=1e-7, err_msg=str(i)
        )


@deterministic
@given(st.integers(0, 2**32 - 1))
def test_correction_keeps_the_covariance_positive_and_shrinks_the_residual(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(18, 18)) * 10.0 ** rng.uniform(-4, -1, size=(18, 1))
    covariance = a @ a.T + 1e-12 * np.eye(18)
    branch = _branch(rng.normal(size=6) * 1e-3, covariance)
    pose = PoseHypothesis(
        branch.position_m + rng.normal(size=3) * 0.01, rot.multiply(Q0, rot.exp(rng.normal(size=3) * 0.02)), R
    )
    before = innovate(branch, 7, pose, MekfParameters())
    after = correct(branch, before)
    assert np.array_equal(after.covariance, after.covariance.T)
    assert np.linalg.eigvalsh(after.covariance)[0] > -1e-15
    assert abs(float(after.q_wxyz @ after.q_wxyz) - 1.0) < 1e-14
    assert innovate(after, 7, pose, MekfParameters()).nis <= before.nis * (1 + 1e-9)


def test_chi_square_quantiles() -> None:
    # Table values for 6 degrees of freedom.
    assert chi_square_6(0.95) == pytest.approx(12.592, abs=1e-3)
    assert chi_square_6(0.999) == pytest.approx(22.458, abs=1e-3)
    with pytest.raises(ValueError, match="between 0 and 1"):
        chi_square_6(1.0)


# --- geometry --------------------------------------------------------------------------------------

CAMERA_P = np.array([0.07, 0.0, 0.075])
CAMERA_Q = rot.from_matrix(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))


def test_to_world_geometry() -> None:
    # One metre ahead of a camera that looks along the chaser's X, a chaser turned by 90 degrees.
    q = rot.exp([0.0, 0.0, math.pi / 2])
    irf = rot.conjugate(CAMERA_Q)
    h = to_world([5.0, 0.0, 0.0], q, CAMERA_P, CAMERA_Q, [0.0, 0.0, 1.0], irf, np.diag([1.0, 1, 9, 1, 1, 1]))
    np.testing.assert_allclose(h.position_m, [5.0, 1.07, 0.075], atol=1e-12)
    assert float(rot.angle_between(h.q_wxyz, q)) < 1e-12
    np.testing.assert_allclose(np.diag(h.covariance), [1, 9, 1, 1, 1, 1], atol=1e-12)


def test_to_world_covariance_by_differences() -> None:
    rng = np.random.default_rng(3)
    p, q = rng.normal(size=3), rot.normalize(rng.normal(size=4))
    pi, qi = np.array([0.2, -0.1, 1.5]), rot.normalize(rng.normal(size=4))
    a, b = rng.normal(size=(6, 6)), rng.normal(size=(6, 6))
    ci, co = a @ a.T, b @ b.T
    h = to_world(p, q, CAMERA_P, CAMERA_Q, pi, qi, ci, co)

    def moved(d: np.ndarray) -> np.ndarray:
        m = to_world(
            p + d[0:3], rot.multiply(q, rot.exp(d[3:6])), CAMERA_P, CAMERA_Q,
            pi + d[6:9], rot.multiply(qi, rot.exp(d[9:12])), ci,
        )  # fmt: skip
        return np.concatenate([m.position_m, rot.log(rot.multiply(rot.conjugate(h.q_wxyz), m.q_wxyz))])

    j = np.column_stack([(moved(1e-6 * e) - moved(-1e-6 * e)) / 2e-6 for e in np.eye(12)])
    both = np.block([[co, np.zeros((6, 6))], [np.zeros((6, 6)), ci]])
    np.testing.assert_allclose(h.covariance, j @ both @ j.T, rtol=1e-6, atol=1e-6)
    with pytest.raises(ValueError, match="covariance_irf"):
        to_world(p, q, CAMERA_P, CAMERA_Q, pi, qi, np.eye(5))


# --- consistency and accuracy ----------------------------------------------------------------------


@pytest.mark.parametrize("chasers", [1, 2, 4])
def test_nees_is_in_its_band_when_the_model_is_true(chasers: int) -> None:
    """Truth with the filter's own process noise and white measurements: the mean NEES must be 12."""
    noise = 1e-3
    p = replace(NO_BIAS, acceleration_noise_m_s2_sqrt_hz=noise, angular_noise_rad_s2_sqrt_hz=noise)
    factor = np.linalg.cholesky(motion.process_noise(1 / HZ, noise**2, noise**2))
    values = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        x, v, q, w = np.zeros(3), V, Q0, W
        f = Mekf(p)
        for k in range(60):
            if k:
                d = factor @ rng.normal(size=12)
                x, v = x + v / HZ + d[:3], v + d[3:6]
                q, w = rot.multiply(rot.integrate(q, w, 1 / HZ), rot.exp(d[6:9])), w + d[9:]
            group = []
            for c in range(chasers):
                zq = rot.multiply(q, rot.exp(rng.normal(size=3) * SIGMA_A))
                group.append(
                    Measurement(c, ns(k), (PoseHypothesis(x + rng.normal(size=3) * SIGMA_P, zq, R),), 4)
                )
            e = f.update(group, ns(k))
            if k >= 30 and k % 10 == 9:
                dtheta = rot.log(rot.multiply(rot.conjugate(e.q_wxyz), q))
                d = np.concatenate([x - e.position_m, v - e.velocity_m_s, dtheta, w - e.omega_rad_s])
                values.append(float(d @ np.linalg.solve(e.covariance, d)))
    # 36 values, correlated in threes: at least 12 independent ones, whose mean has sigma sqrt(24 / 12).
    assert 12 - 3 * math.sqrt(2) < np.mean(values) < 12 + 3 * math.sqrt(2)


def test_steady_accuracy_with_two_chasers() -> None:
    d = np.array([errors(e) for seed in range(2) for e in fly(Mekf(), 2, 30.0, seed)[15 * HZ :]])
    rms = np.sqrt((d.reshape(-1, 4, 3) ** 2).sum(axis=2).mean(axis=0))
    assert rms[0] < 0.5e-3
    assert rms[1] < 0.3e-3
    assert rms[2] < math.radians(0.05)
    assert rms[3] < math.radians(0.05)


def test_more_cameras_are_better_and_the_covariance_knows() -> None:
    one, four = fly(Mekf(NO_BIAS), 1, 10.0)[-1], fly(Mekf(NO_BIAS), 4, 10.0)[-1]
    ratio = np.sqrt(np.diag(one.covariance) / np.diag(four.covariance))
    # Constant-velocity filter, n cameras: pose sigma goes with n^(-3/8), rate sigma with n^(-1/8).
    np.testing.assert_allclose(ratio, np.tile(np.repeat([4 ** (3 / 8), 4 ** (1 / 8)], 3), 2), rtol=0.05)
    assert four.sightings == 4


def test_disagreeing_calibrations_do_not_lock_each_other_out() -> None:
    """Biases drawn as the parameters say: nobody is gated out for long and the covariance is honest.
    The same without bias states and with a white floor of their size is overconfident."""
    p = MekfParameters()
    floor = replace(NO_BIAS, floor_position_m=p.bias_position_m, floor_attitude_rad=p.bias_attitude_rad)
    values, naive, gated = [], [], 0
    for seed in range(6):
        rng = np.random.default_rng(seed)
        shift = rng.normal(size=(2, 3)) * p.bias_position_m
        turn = rng.normal(size=(2, 3)) * p.bias_attitude_rad
        f, g = Mekf(), Mekf(floor)
        e = n = no_estimate(0)
        for k in range(10 * HZ):
            group = [see(rng, c, ns(k), shift=shift[c], turn=turn[c]) for c in range(2)]
            e, n = f.update(group, ns(k)), g.update(group, ns(k))
        values.append(nees(e))
        naive.append(nees(n))
        gated += f.gated
        assert f.reinitialisations == 0
    assert gated == 0
    assert np.mean(values) < 18.0
    assert np.mean(naive) > 3.0 * np.mean(values)


# --- order and time --------------------------------------------------------------------------------


@pytest.mark.parametrize("make", [Mekf, PaperEstimator])
def test_order_within_a_call_does_not_matter(make: type) -> None:
    rng = np.random.default_rng(1)
    shuffle = random.Random(1)
    a, b = make(), make()
    for k in range(0, 30, 3):
        group = [see(rng, c, ns(k + j)) for c in range(3) for j in range(3)]
        other = list(group)
        shuffle.shuffle(other)
        assert same(a.update(group, ns(k + 2)), b.update(other, ns(k + 2)))
    assert a.drain_events() == b.drain_events()


@deterministic
@given(st.randoms(use_true_random=False))
def test_late_measurements_end_in_the_same_state(shuffle: random.Random) -> None:
    """Deliveries up to half a second late and out of order, with an outlier and an ambiguous start."""
    rng = np.random.default_rng(5)
    flip = np.array([0.0, 0.7, 0.0])
    sent = [
        see(rng, c, ns(k), flip=flip if k < 3 else None, shift=np.full(3, 0.3) if (k, c) == (9, 1) else None)
        for k in range(20)
        for c in range(2)
    ]
    in_time = Mekf()
    for k in range(20):
        in_time.update([m for m in sent if m.time_ns == ns(k)], ns(k))
    deliveries = [(m.time_ns + shuffle.randrange(0, 500_000_000), i, m) for i, m in enumerate(sent)]
    late = Mekf()
    for arrival, _, m in sorted(deliveries):
        late.update([m], arrival)
    now = ns(19) + 600_000_000
    assert same(late.update([], now), in_time.update([], now))
    assert late.late_dropped == 0
    assert (late.accepted, late.gated) == (in_time.accepted, in_time.gated)


def test_too_late_too_early_twice_and_unusable_are_counted_and_change_nothing() -> None:
    rng = np.random.default_rng(0)
    f = Mekf()
    before = no_estimate(0)
    for k in range(60):
        before = f.update([see(rng, 0, ns(k))], ns(k))
    good = see(rng, 1, ns(59))
    h = good.hypotheses[0]
    bad = [
        replace(h, position_m=np.full(3, np.nan)),
        replace(h, q_wxyz=np.full(4, np.nan)),
        replace(h, q_wxyz=np.array([2.0, 0, 0, 0])),
        replace(h, covariance=-h.covariance),
        replace(h, covariance=np.triu(np.ones((6, 6)))),
        replace(h, covariance=np.eye(5)),
    ]
    unusable = [replace(good, hypotheses=(x,)) for x in bad]
    after = f.update([see(rng, 1, ns(2)), see(rng, 0, ns(70)), see(rng, 0, ns(59)), *unusable], ns(59))
    assert same(before, after)
    assert (f.late_dropped, f.early_dropped, f.duplicates, f.invalid) == (1, 1, 1, 6)
    assert sum("unusable" in text for _, text in f.drain_events()) == 6


def test_estimate_at_is_pure_and_predicts() -> None:
    f = Mekf(NO_BIAS)
    last = fly(f, 2, 20.0)[-1]
    ahead = last.time_ns + 3_000_000_000
    first, again = f.estimate_at(ahead), f.estimate_at(ahead)
    assert same(first, again)
    assert same(f.estimate_at(last.time_ns), last)
    p, q = truth(ahead)
    assert np.linalg.norm(p - first.position_m) < 2e-3
    assert float(rot.angle_between(q, first.q_wxyz)) < math.radians(0.3)
    assert first.status == "predicting"
    with pytest.raises(ValueError, match="as old as"):
        f.estimate_at(last.time_ns - 5_000_000_000)


def test_nothing_seen() -> None:
    f = Mekf()
    e = f.update([Measurement(0, 0, (), 0)], 0)
    assert (e.status, e.sightings) == ("none", 0)
    assert np.isfinite(e.covariance).all()
    assert f.estimate_at(ns(100)).status == "none"


def test_sign_of_the_quaternion_means_nothing() -> None:
    rng = np.random.default_rng(2)
    a, b = Mekf(), Mekf()
    for k in range(30):
        m = see(rng, 0, ns(k))
        h = m.hypotheses[0]
        flipped = replace(m, hypotheses=(replace(h, q_wxyz=-h.q_wxyz if k % 2 else h.q_wxyz),))
        x, y = a.update([m], ns(k)), b.update([flipped], ns(k))
        assert float(rot.angle_between(x.q_wxyz, y.q_wxyz)) < 1e-12
        np.testing.assert_allclose(x.covariance, y.covariance, atol=1e-18)
    assert b.gated == 0


# --- what goes wrong -------------------------------------------------------------------------------


def test_blind_for_five_seconds() -> None:
    f = Mekf(NO_BIAS)
    rng = np.random.default_rng(4)
    last = fly(f, 2, 10.0, seed=4)[-1]
    e = no_estimate(0)
    for k in range(10 * HZ, 15 * HZ):
        e = f.update([Measurement(c, ns(k), (), 0) for c in range(2)], ns(k))
    assert (e.status, e.sightings) == ("predicting", 0)
    assert nees(e) < 33.0  # 0.999 quantile for 12 degrees of freedom
    assert np.all(np.diag(e.covariance) > np.diag(last.covariance))
    e = f.update([see(rng, c, ns(15 * HZ)) for c in range(2)], ns(15 * HZ))
    assert (e.status, e.sightings, e.rejected) == ("tracking", 2, ())
    assert f.reinitialisations == 0


def test_lost_and_found_again_with_the_rates_kept() -> None:
    f = Mekf()
    rng = np.random.default_rng(4)
    fly(f, 1, 5.0, seed=4)
    omega = f.estimate_at(ns(5 * HZ)).omega_rad_s
    k = 400 * HZ
    assert f.update([], ns(k)).status == "lost"
    assert [t for _, t in f.drain_events()].count("lost") == 1
    e = f.update([see(rng, 0, ns(k + 1))], ns(k + 1))
    assert e.status == "tracking"
    assert np.linalg.norm(e.omega_rad_s - omega) < 1e-12
    assert f.reinitialisations == 1
    assert "found again by chaser 0" in [t for _, t in f.drain_events()]


def test_a_start_too_vague_for_one_exposure_adds_up() -> None:
    """One small far marker, 8 degrees a frame: "lost" at first, but not begun again every time."""
    f = Mekf()
    rng = np.random.default_rng(16)
    vague = np.diag([0.01**2] * 3 + [math.radians(8.0) ** 2] * 3)
    states = []
    for k in range(4 * HZ):
        m = see(rng, 0, ns(k), markers=1)
        h = m.hypotheses[0]
        q = rot.multiply(h.q_wxyz, rot.exp(rng.normal(size=3) * math.radians(8.0)))
        h = PoseHypothesis(h.position_m + rng.normal(size=3) * 0.01, q, vague)
        states.append(f.update([replace(m, hypotheses=(h,))], ns(k)))
    assert states[0].status == "lost"
    assert states[-1].status == "tracking"
    assert f.reinitialisations == 0
    assert f.accepted == 4 * HZ
    assert nees(states[-1]) < 33.0
    assert math.degrees(np.linalg.norm(errors(states[-1])[6:9])) < 6.0


def test_a_lying_camera_that_began_is_outvoted_by_cameras_at_other_times() -> None:
    f = Mekf()
    rng = np.random.default_rng(17)
    e = no_estimate(0)
    for k in range(4 * HZ):
        for c in range(3):
            t = ns(k) + c * 20_000_000
            if c == 0 or k > HZ:
                shift = np.array([0.0, 0.2, 0.0]) if c == 0 else None
                e = f.update([see(rng, c, t, shift=shift)], t)
    assert f.reinitialisations == 1
    assert (e.sightings, e.rejected) == (1, ())
    assert np.linalg.norm(errors(e)[:3]) < 2e-3
    assert f.estimate_at(ns(4 * HZ - 1)).rejected == (0,)


@pytest.mark.parametrize("liar", [0, 1, 2])
@pytest.mark.parametrize("alone_s", [0, 1])
def test_a_lying_camera_among_three_is_gated_out(liar: int, alone_s: int) -> None:
    """20 cm and 15 degrees off all the time; also when it was the only one to see the target at first."""
    f = Mekf()
    rng = np.random.default_rng(6)
    shift, turn = np.array([0.2, 0.0, 0.0]), np.array([0.0, 0.0, math.radians(15.0)])
    e = no_estimate(0)
    for k in range((5 + alone_s) * HZ):
        group = [
            see(rng, c, ns(k), shift=shift, turn=turn) if c == liar else see(rng, c, ns(k))
            for c in range(3)
            if c == liar or k >= alone_s * HZ
        ]
        e = f.update(group, ns(k))
    assert e.rejected == (liar,)
    assert e.sightings == 2
    assert np.linalg.norm(errors(e)[:3]) < 2e-3
    assert np.linalg.norm(errors(e)[6:9]) < math.radians(0.3)
    texts = [t for _, t in f.drain_events()]
    assert f"chaser {liar} gated out: 10 in a row" in texts
    assert f.reinitialisations == (1 if alone_s else 0)


def test_a_liar_does_not_lead_while_the_prediction_is_vague() -> None:
    """All come back at the same moment, after a blindness that left a wide but not lost prediction."""
    f = Mekf(
        replace(MekfParameters(), acceleration_noise_m_s2_sqrt_hz=3e-3, angular_noise_rad_s2_sqrt_hz=3e-3)
    )
    rng = np.random.default_rng(8)
    fly(f, 3, 4.0, seed=8)
    k = 12 * HZ
    assert f.estimate_at(ns(k)).status == "predicting"
    group = [see(rng, 0, ns(k), shift=np.array([0.03, 0.0, 0.0])), see(rng, 1, ns(k)), see(rng, 2, ns(k))]
    e = f.update(group, ns(k))
    assert e.rejected == (0,)
    assert e.sightings == 2


def test_gross_outliers_are_rejected() -> None:
    f = Mekf()
    rng = np.random.default_rng(9)
    bad = 0
    e = no_estimate(0)
    for k in range(10 * HZ):
        outlier = k > 10 and rng.random() < 0.2
        shift = rng.normal(size=3) if outlier else None
        e = f.update([see(rng, 0, ns(k), shift=shift), see(rng, 1, ns(k))], ns(k))
        bad += outlier
    assert bad > 15
    assert f.gated == bad
    assert np.linalg.norm(errors(e)[:3]) < 2e-3


def test_a_jump_of_the_target_re_initialises_and_keeps_the_rates() -> None:
    f = Mekf()
    rng = np.random.default_rng(10)
    fly(f, 2, 5.0, seed=10)
    jump = np.array([0.0, 0.5, 0.0])
    states = [f.update([see(rng, c, ns(k), shift=jump) for c in range(2)], ns(k)) for k in range(75, 95)]
    assert [s.sightings for s in states] == [0] * 9 + [2] * 11
    assert states[8].status == "predicting"
    assert f.reinitialisations == 1
    assert any(t.startswith("re-initialised") for _, t in f.drain_events())
    e = states[9]
    assert np.linalg.norm(e.omega_rad_s - W) < math.radians(1.0)
    assert np.linalg.norm(e.velocity_m_s - V) < 0.02


FLIP = np.array([0.0, math.radians(40.0), 0.0])


def test_flips_in_flight_are_chosen_by_innovation() -> None:
    f = Mekf()
    rng = np.random.default_rng(11)
    fly(f, 1, 2.0, seed=11)
    for k in range(30, 90):
        e = f.update([see(rng, 0, ns(k), flip=FLIP, wrong_first=bool(k % 3))], ns(k))
        assert np.linalg.norm(errors(e)[6:9]) < math.radians(1.5)
    assert f.gated == 0


@pytest.mark.parametrize("wrong_first", [False, True])
@pytest.mark.parametrize("helper", ["same exposure", "later", "own second look"])
def test_an_ambiguous_start_is_resolved(wrong_first: bool, helper: str) -> None:
    f = Mekf()
    rng = np.random.default_rng(12)
    e = no_estimate(0)
    for k in range(40):
        flip = None if helper == "own second look" and k >= 10 else FLIP
        group = [see(rng, 0, ns(k), flip=flip, wrong_first=wrong_first, markers=1)]
        if helper == "same exposure" or (helper == "later" and k >= 10):
            group.append(see(rng, 1, ns(k)))
        e = f.update(group, ns(k))
        if helper != "same exposure" and k == 5:  # both attitudes are still open, and the covariance says so
            assert math.sqrt(e.covariance[7, 7]) > math.radians(10.0)
    assert np.linalg.norm(errors(e)[6:9]) < math.radians(0.5)
    assert math.sqrt(e.covariance[7, 7]) < math.radians(1.0)
    resolved = "ambiguity resolved" in [t for _, t in f.drain_events()]
    assert resolved == (helper != "same exposure")
    assert f.reinitialisations == 0


def test_an_ambiguity_that_stays_times_out() -> None:
    f = Mekf()
    rng = np.random.default_rng(13)
    e = no_estimate(0)
    for k in range(6 * HZ):
        e = f.update([see(rng, 0, ns(k), flip=FLIP)], ns(k))
    assert any("timed out" in t for _, t in f.drain_events())
    assert math.sqrt(e.covariance[7, 7]) < math.radians(2.0)


def test_a_single_first_marker_starts_wider() -> None:
    covariances = []
    for markers in (1, 4):
        e = Mekf(NO_BIAS).update([see(np.random.default_rng(0), 0, 0, markers=markers)], 0)
        covariances.append(np.diag(e.covariance)[[0, 1, 2, 6, 7, 8]])
    np.testing.assert_allclose(covariances[0], 9.0 * covariances[1])


def test_torque_free_target_is_followed() -> None:
    """A fast asymmetric tumble: the right model follows what constant rates cannot."""
    ratios = ((1.0, 0.0, 0.0), (0.0, 2.0, 0.0), (0.0, 0.0, 2.5))
    inertia = np.array(ratios)
    inverse = np.linalg.inv(inertia)
    result = {}
    for model in motion.MODELS:
        rng = np.random.default_rng(14)
        f = Mekf(replace(MekfParameters(), motion_model=model, inertia_ratios=ratios))
        q, w = Q0, np.array([0.1, 0.5, 0.2])
        e = no_estimate(0)
        for k in range(10 * HZ):
            if k:
                q, w, _ = motion.torque_free(q, w, (ns(k) - ns(k - 1)) * 1e-9, inertia, inverse)
            zq = rot.multiply(q, rot.exp(rng.normal(size=3) * SIGMA_A))
            z = PoseHypothesis(rng.normal(size=3) * SIGMA_P, zq, R)
            e = f.update([Measurement(0, ns(k), (z,), 4)], ns(k))
        result[model] = math.degrees(np.linalg.norm(e.omega_rad_s - w))
    assert result["torque_free"] < 0.05
    assert result["constant_rates"] > 5 * result["torque_free"]


def test_events_are_told_once_even_when_exposures_are_replayed() -> None:
    f = Mekf()
    rng = np.random.default_rng(15)
    f.update([see(rng, 0, ns(5))], ns(5))
    assert [t for _, t in f.drain_events()] == ["initialised by chaser 0"]
    f.update([see(rng, 0, ns(6))], ns(6))
    assert f.drain_events() == []
    f.update([see(rng, 1, ns(5))], ns(6))  # replays the start
    assert f.drain_events() == []
    f.update([see(rng, 1, ns(4))], ns(6))  # it turns out that another one saw it first
    assert f.drain_events() == [(ns(4), "initialised by chaser 1")]


# --- the paper's combiner --------------------------------------------------------------------------


def test_average_quaternion_ignores_signs() -> None:
    a, b = rot.exp([0.0, 0.0, 0.2]), rot.exp([0.0, 0.0, 0.6])
    np.testing.assert_allclose(average_quaternion([a, -b]), rot.exp([0.0, 0.0, 0.4]), atol=1e-12)
    with pytest.raises(ValueError, match="no quaternions"):
        average_quaternion([])


def test_paper_estimator_follows_with_its_known_faults() -> None:
    d = np.array([errors(e) for e in fly(PaperEstimator(), 2, 20.0)[10 * HZ :]])
    rms = np.sqrt((d.reshape(-1, 4, 3) ** 2).sum(axis=2).mean(axis=0))
    lag_s = 2.0 / HZ  # of a mean over five poses
    assert 0.8 * lag_s * np.linalg.norm(V) < rms[0] < 2.0 * lag_s * np.linalg.norm(V)
    assert 0.8 * lag_s * np.linalg.norm(W) < rms[2] < 2.0 * lag_s * np.linalg.norm(W)
    assert rms[1] < 5e-3
    assert math.radians(0.05) < rms[3] < math.radians(1.0)
    e = fly(PaperEstimator(), 2, 1.0)[-1]
    assert np.isfinite(e.covariance).all()


def test_paper_estimator_removes_outliers_and_recovers() -> None:
    rng = np.random.default_rng(0)
    f = PaperEstimator()
    e = no_estimate(0)
    for k in range(30):
        shift = np.array([0.5, 0.0, 0.0]) if k == 20 else None
        group = [see(rng, 0, ns(k), shift=shift), see(rng, 1, ns(k)), see(rng, 2, ns(k))]
        e = f.update(group, ns(k))
        assert e.rejected == ((0,) if k == 20 else ())
    assert np.linalg.norm(errors(e)[:3]) < 0.01
    jump = np.array([0.0, 3.0, 0.0])
    states = [f.update([see(rng, 0, ns(k), shift=jump)], ns(k)) for k in range(60, 80)]
    assert f.reinitialisations == 1
    p, q = truth(ns(79))
    assert np.linalg.norm(p + rot.rotate(q, jump) - states[-1].position_m) < 0.05
    assert f.estimate_at(ns(79 + 10 * HZ)).status == "lost"
    assert same(replace(f.estimate_at(ns(80)), time_ns=ns(79)), states[-1])  # held, not predicted


# --- interface -------------------------------------------------------------------------------------


def test_make_estimator() -> None:
    assert isinstance(make_estimator("mekf"), Mekf)
    assert isinstance(make_estimator("paper", PaperParameters(window=3)), PaperEstimator)
    with pytest.raises(ValueError, match="known: mekf, paper"):
        make_estimator("ukf")
    with pytest.raises(TypeError, match="MekfParameters"):
        make_estimator("mekf", PaperParameters())
    with pytest.raises(TypeError, match="PaperParameters"):
        make_estimator("paper", MekfParameters())


@pytest.mark.parametrize(
    "wrong",
    [
        {"motion_model": "spline"},
        {"gate_probability": 1.0},
        {"bias_position_m": 0.0},
        {"buffer_s": -1.0},
        {"initial_omega_rad_s": math.nan},
        {"single_marker_scale": 0.5},
        {"inertia_ratios": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 3.0))},
        {"inertia_ratios": ((1.0, 0.5, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))},
    ],
)
def test_wrong_parameters_are_refused(wrong: dict) -> None:
    with pytest.raises(ValueError, match=next(iter(wrong)).replace("motion_model", "motion model")):
        MekfParameters(**wrong)
    with pytest.raises(ValueError, match="window"):
        PaperParameters(window=0)


def test_no_clock_and_no_global_randomness() -> None:
    allowed = {"__future__", "bisect", "chaserdock_protocol", "collections", "dataclasses", "functools"}
    allowed |= {"itertools", "math", "numpy", "typing"}
    files = sorted(Path(fusion.__file__).parent.glob("*.py"))
    assert len(files) >= 8
    for file in files:
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                assert {a.name.split(".")[0] for a in node.names} <= allowed, file
            elif isinstance(node, ast.ImportFrom) and node.level == 0:
                assert (node.module or "").split(".")[0] in allowed, (file, node.module)
            elif isinstance(node, ast.Attribute):
                assert node.attr != "random", file
