# SPDX-License-Identifier: Apache-2.0
"""One hypothesis of the target's state: prediction and measurement update of the error-state
filter.

Error state: position, velocity (WRF), dtheta, omega (TRF), then for every camera seen so far its
seven calibration errors (``camera_calibration``). Hypotheses are immutable values. Source of the
error-state equations: J. Sola, "Quaternion kinematics for the error-state Kalman filter".
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from chaserdock_models import scalar_rotations as so3
from msgspec import field
from msgspec.structs import replace

from . import motion_models as motion
from .camera_calibration import ERRORS, NO_ERROR, pose_prior_covariance, predict_measurement, prior
from .parameters import MekfParameters
from .target_hypotheses import POSE, RATES, TargetHypothesis, TargetRates, poses_agree
from .types import Array, CameraPose, Measurement, PoseHypothesis

_POSE_GRID = np.ix_(POSE, POSE)
_EYE3 = np.eye(3)


class StateHypothesis(TargetHypothesis, frozen=True, eq=False, kw_only=True):
    """State of the target and of the cameras' errors at ``time_ns``; covariance (12 + 7 n, 12 + 7
    n).

    cameras: chaser of each of n bias slots. bias: (n, 7). rejections: number of consecutive
    rejected measurements of each chaser.
    """

    cameras: tuple[int, ...] = ()
    bias: Array = field(default_factory=lambda: np.zeros((0, ERRORS)))
    rejections: dict[int, int] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Innovation:
    """Residual r (6,), Jacobian (6, n), innovation covariance S (6, 6), noise R (6, 6), and nis =
    r' S^-1 r.
    """

    residual: Array
    jacobian: Array
    s: Array
    noise: Array
    nis: float
    log_density: float
    log_determinant: float


def predict(hypothesis: StateHypothesis, time_ns: int, p: MekfParameters) -> StateHypothesis:
    """Propagate the hypothesis to ``time_ns`` by the motion model. Raises ValueError for an earlier
    time.
    """
    if time_ns == hypothesis.time_ns:
        return hypothesis
    if time_ns < hypothesis.time_ns:
        raise ValueError(f"cannot predict backwards, from {hypothesis.time_ns} to {time_ns} ns")
    dt = (time_ns - hypothesis.time_ns) * 1e-9
    (position, velocity, q, w), own = motion.propagate_target(
        hypothesis.position_m,
        hypothesis.velocity_m_s,
        hypothesis.q_wxyz,
        hypothesis.omega_rad_s,
        dt,
        p,
    )
    n = hypothesis.covariance.shape[0]
    f = np.eye(n)
    f[:12, :12] = own
    bias = hypothesis.bias
    noise = np.zeros((n, n))
    noise[:12, :12] = motion.process_noise(
        dt, p.acceleration_noise_m_s2_sqrt_hz**2, p.angular_noise_rad_s2_sqrt_hz**2
    )
    if n > 12:
        fade = math.exp(-dt / p.bias_time_constant_s)
        i = np.arange(12, n)
        f[i, i] = fade
        noise[i, i] = (1.0 - fade * fade) * np.tile(prior(p).diagonal(), len(hypothesis.cameras))
        bias = bias * fade
    return replace(
        hypothesis,
        time_ns=time_ns,
        position_m=position,
        velocity_m_s=velocity,
        q_wxyz=q,
        omega_rad_s=w,
        bias=bias,
        covariance=_symmetric(f @ hypothesis.covariance @ f.T + noise),
    )


def with_cameras(
    hypothesis: StateHypothesis, chasers: list[int], p: MekfParameters
) -> StateHypothesis:
    """Return the hypothesis with a bias slot for each of ``chasers``; unchanged if biases are
    switched off.
    """
    new = tuple(c for c in chasers if c not in hypothesis.cameras) if p.has_bias else ()
    if not new:
        return hypothesis
    n = hypothesis.covariance.shape[0]
    covariance = np.zeros((n + ERRORS * len(new), n + ERRORS * len(new)))
    covariance[:n, :n] = hypothesis.covariance
    i = np.arange(n, covariance.shape[0])
    covariance[i, i] = np.tile(prior(p).diagonal(), len(new))
    bias = np.vstack([hypothesis.bias, np.zeros((len(new), ERRORS))])
    return replace(hypothesis, cameras=hypothesis.cameras + new, bias=bias, covariance=covariance)


def innovate(
    hypothesis: StateHypothesis,
    chaser: int,
    camera: CameraPose,
    h: PoseHypothesis,
    p: MekfParameters,
) -> Innovation:
    """Return the innovation of the measured pose ``h`` and its covariance.

    The Jacobian of the residual is exact at zero error. The camera's errors are part of the
    prediction.
    """
    n = hypothesis.covariance.shape[0]
    jacobian = np.zeros((6, n))
    jacobian[3:, 6:9] = _EYE3
    residual = np.empty(6)
    if p.has_bias:
        k = hypothesis.cameras.index(chaser)
        expected = predict_measurement(
            camera, hypothesis.position_m, hypothesis.q_wxyz, hypothesis.bias[k]
        )
        column = 12 + ERRORS * k
        jacobian[:3, :3] = expected.by_position
        jacobian[:, column : column + ERRORS] = expected.by_errors
        residual[:3] = h.position_m - expected.position_m
        residual[3:] = so3.log(so3.inverse_multiply(expected.q_wxyz, h.q_wxyz))
    else:
        jacobian[:3, :3] = _EYE3
        residual[:3] = h.position_m - hypothesis.position_m
        residual[3:] = so3.log(so3.inverse_multiply(hypothesis.q_wxyz, h.q_wxyz))
    noise = measurement_noise(h, p)
    s = jacobian @ hypothesis.covariance @ jacobian.T + noise
    factor = np.linalg.cholesky(s)
    white = np.linalg.solve(factor, residual)
    nis = float(white @ white)
    log_determinant = 2.0 * sum(math.log(x) for x in factor.diagonal().tolist())
    return Innovation(
        residual, jacobian, s, noise, nis, -0.5 * (nis + log_determinant), log_determinant
    )


def correct(hypothesis: StateHypothesis, i: Innovation) -> StateHypothesis:
    """Apply the Kalman update for innovation ``i``: Joseph form, then error injection and reset."""
    ph = hypothesis.covariance @ i.jacobian.T
    gain = np.linalg.solve(i.s, ph.T).T
    a = np.eye(hypothesis.covariance.shape[0]) - gain @ i.jacobian
    covariance = a @ hypothesis.covariance @ a.T + gain @ i.noise @ gain.T
    d = gain @ i.residual
    dtheta = d[6:9]
    # Reset: dtheta is relative to the corrected attitude (Sola eq. 287, with the exact Jr).
    reset = so3.right_jacobian(dtheta)
    covariance[6:9] = reset @ covariance[6:9]
    covariance[:, 6:9] = covariance[:, 6:9] @ reset.T
    return replace(
        hypothesis,
        position_m=hypothesis.position_m + d[:3],
        velocity_m_s=hypothesis.velocity_m_s + d[3:6],
        q_wxyz=so3.normalize(so3.multiply(hypothesis.q_wxyz, so3.exp(dtheta))),
        omega_rad_s=hypothesis.omega_rad_s + d[9:12],
        bias=hypothesis.bias + d[12:].reshape(-1, ERRORS),
        covariance=_symmetric(covariance),
    )


def best_innovation(
    hypothesis: StateHypothesis, m: Measurement, p: MekfParameters
) -> tuple[int, Innovation]:
    """Return index and innovation of the likeliest hypothesis of a measurement that has at least
    one.
    """
    innovations = [innovate(hypothesis, m.chaser, m.camera, h, p) for h in m.hypotheses]
    best = max(range(len(innovations)), key=lambda k: (innovations[k].log_density, -k))
    return best, innovations[best]


def update_hypothesis(
    hypothesis: StateHypothesis, group: list[Measurement], p: MekfParameters
) -> tuple[StateHypothesis, tuple[int, ...], tuple[int, ...]]:
    """Update a hypothesis with the non-empty measurements of one exposure at its time.

    The cameras are processed in the given order. If the prediction is vague, the cameras that agree
    with most others come first, and among these the closest to the prediction; a faulty camera then
    does not pull the state away. Returns the hypothesis, the accepted chasers and the rejected
    chasers.
    """
    gate = p.gate_chi_square
    hypothesis = with_cameras(hypothesis, [m.chaser for m in group], p)
    order = group
    if len(group) > 1 and _is_vague(hypothesis, group, p):
        best = [best_innovation(hypothesis, m, p) for m in group]
        support = count_agreements(
            [(m.hypotheses[k], m.camera) for m, (k, _) in zip(group, best, strict=True)], p
        )
        ranks = sorted((-support[i], best[i][1].nis, i) for i in range(len(group)))
        order = [group[i] for _, _, i in ranks]

    likelihood = hypothesis.log_likelihood
    rejections = dict(hypothesis.rejections)
    accepted: list[int] = []
    rejected: list[int] = []
    for m in order:
        _, innovation = best_innovation(hypothesis, m, p)
        if innovation.nis <= gate:
            hypothesis = correct(hypothesis, innovation)
            likelihood += innovation.log_density
            rejections[m.chaser] = 0
            accepted.append(m.chaser)
        else:
            # Bound the penalty: a gross outlier counts as much as one at the gate.
            likelihood -= 0.5 * (gate + innovation.log_determinant)
            rejections[m.chaser] = rejections.get(m.chaser, 0) + 1
            rejected.append(m.chaser)
    hypothesis = replace(hypothesis, log_likelihood=likelihood, rejections=rejections)
    return hypothesis, tuple(sorted(accepted)), tuple(sorted(rejected))


def count_agreements(
    poses: list[tuple[PoseHypothesis, CameraPose]], p: MekfParameters
) -> list[int]:
    """Count for each pose the others that agree within noise, floor and the cameras' prior errors."""
    counts = [0] * len(poses)
    for i in range(len(poses)):
        for j in range(i):
            if measurements_agree(*poses[i], *poses[j], p):
                counts[i] += 1
                counts[j] += 1
    return counts


def measurements_agree(
    a: PoseHypothesis,
    camera_a: CameraPose,
    b: PoseHypothesis,
    camera_b: CameraPose,
    p: MekfParameters,
) -> bool:
    """Test whether the difference of two simultaneous measured poses is within the chi-square gate
    of their errors.
    """
    s = _pose_covariance(a, camera_a, p) + _pose_covariance(b, camera_b, p)
    return poses_agree(a, b, s, p.gate_chi_square)


def _pose_covariance(h: PoseHypothesis, camera: CameraPose, p: MekfParameters) -> Array:
    """Return the covariance (6, 6) of a measured pose including its camera's prior errors."""
    noise = measurement_noise(h, p)
    return noise + pose_prior_covariance(camera, h.position_m, h.q_wxyz, p) if p.has_bias else noise


def start(
    time_ns: int, m: Measurement, h: PoseHypothesis, rates: TargetRates, p: MekfParameters
) -> StateHypothesis:
    """Create a hypothesis from one measured pose and from rates.

    The covariance contains the correlation of the pose error with the camera's bias.
    """
    scale = p.single_marker_scale**2 if m.markers == 1 else 1.0
    covariance = np.zeros((12, 12))
    covariance[np.ix_(RATES, RATES)] = rates.covariance
    covariance[_POSE_GRID] = measurement_noise(h, p) * scale
    q = so3.normalize(h.q_wxyz)
    hypothesis = StateHypothesis(
        time_ns=time_ns,
        position_m=h.position_m,
        velocity_m_s=rates.velocity_m_s,
        q_wxyz=q,
        omega_rad_s=rates.omega_rad_s,
        covariance=covariance,
    )
    if not p.has_bias:
        return hypothesis
    hypothesis = with_cameras(hypothesis, [m.chaser], p)
    # The measured pose is the true pose plus the effect of the camera's errors, hence the negative
    # correlation.
    spread = predict_measurement(
        m.camera, hypothesis.position_m, hypothesis.q_wxyz, NO_ERROR
    ).by_errors
    covariance = hypothesis.covariance.copy()
    covariance[_POSE_GRID] += spread @ prior(p) @ spread.T
    cross = -spread @ prior(p)
    covariance[POSE, 12:] = cross
    covariance[12:, POSE] = cross.T
    return replace(hypothesis, covariance=_symmetric(covariance))


def measurement_noise(h: PoseHypothesis, p: MekfParameters) -> Array:
    """Return the measured covariance (6, 6) plus the white floor."""
    return h.covariance + _diagonal(p.floor_position_m, p.floor_attitude_rad)


@lru_cache(maxsize=64)
def _diagonal(position_m: float, attitude_rad: float) -> Array:
    matrix = np.diag([position_m**2] * 3 + [attitude_rad**2] * 3)
    matrix.flags.writeable = False
    return matrix


def _is_vague(hypothesis: StateHypothesis, group: list[Measurement], p: MekfParameters) -> bool:
    """Test whether the prediction is more than twice as uncertain as a measurement."""
    prior = hypothesis.covariance.diagonal()
    for m in group:
        for h in m.hypotheses:
            allowed = 4.0 * _pose_covariance(h, m.camera, p).diagonal()
            if prior[0:3].sum() > allowed[:3].sum() or prior[6:9].sum() > allowed[3:].sum():
                return True
    return False


def _symmetric(m: Array) -> Array:
    return 0.5 * (m + m.T)
