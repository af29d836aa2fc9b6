"""One hypothesis of the target's state: prediction and measurement update of the error-state filter.

Error state: position, velocity (WRF), dtheta, omega (TRF), then for every camera seen so far its seven calibration
errors (``eyes``). Branches are values: nothing changes in place.
Source of the error-state equations: J. Sola, "Quaternion kinematics for the error-state Kalman filter".
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from chaserdock_models import scalar_rotations as so3

from . import motion_models as motion
from .camera_calibration import ERRORS, NO_ERROR, pose_prior, prior, seen_by
from .parameters import MekfParameters, chi_square_6
from .types import Array, CameraPose, Measurement, PoseHypothesis

POSE = np.array([0, 1, 2, 6, 7, 8])
_POSE_GRID = np.ix_(POSE, POSE)
_EYE3 = np.eye(3)


@dataclass(frozen=True, eq=False)
class Branch:
    """State and covariance at ``time_ns``.

    cameras: chaser of each bias slot; bias: (len(cameras), 7). covariance: (12 + 7 n, 12 + 7 n) with n
    slots. log_likelihood: of all measurements since the branch began. misses: per chaser, how
    many of its measurements were gated out in a row.
    """

    time_ns: int
    position_m: Array
    velocity_m_s: Array
    q_wxyz: Array
    omega_rad_s: Array
    cameras: tuple[int, ...]
    bias: Array
    covariance: Array
    log_likelihood: float
    misses: dict[int, int]


@dataclass(frozen=True, eq=False)
class Innovation:
    """Residual (6,), Jacobian (6, n), its covariance S (6, 6), R (6, 6), and r' S^-1 r."""

    residual: Array
    jacobian: Array
    s: Array
    noise: Array
    nis: float
    log_density: float
    log_determinant: float


def predict(branch: Branch, time_ns: int, p: MekfParameters) -> Branch:
    """The branch at ``time_ns`` (not before its own time: ValueError) by the motion model alone."""
    if time_ns == branch.time_ns:
        return branch
    if time_ns < branch.time_ns:
        raise ValueError(f"cannot predict backwards, from {branch.time_ns} to {time_ns} ns")
    dt = (time_ns - branch.time_ns) * 1e-9
    if p.motion_model == "torque_free":
        inertia = np.array(p.inertia_ratios, dtype=float)
        q, w, t = motion.torque_free(branch.q_wxyz, branch.omega_rad_s, dt, inertia, np.linalg.inv(inertia))
    else:
        q, w, t = motion.constant_rates(branch.q_wxyz, branch.omega_rad_s, dt)
    n = branch.covariance.shape[0]
    f = np.eye(n)
    f[0, 3] = f[1, 4] = f[2, 5] = dt
    f[6:12, 6:12] = t
    bias = branch.bias
    noise = np.zeros((n, n))
    noise[:12, :12] = motion.process_noise(
        dt, p.acceleration_noise_m_s2_sqrt_hz**2, p.angular_noise_rad_s2_sqrt_hz**2
    )
    if n > 12:
        fade = math.exp(-dt / p.bias_time_constant_s)
        i = np.arange(12, n)
        f[i, i] = fade
        noise[i, i] = (1.0 - fade * fade) * np.tile(prior(p).diagonal(), len(branch.cameras))
        bias = bias * fade
    position, velocity = branch.position_m + branch.velocity_m_s * dt, branch.velocity_m_s
    if any(p.centre_of_mass_trf_m):
        position, velocity, around = motion.about_centre(
            (branch.position_m, branch.velocity_m_s, branch.q_wxyz, branch.omega_rad_s),
            (q, w),
            f[:12, :12],
            np.array(p.centre_of_mass_trf_m),
            dt,
        )
        f[:12, :12] = around
    return replace(
        branch,
        time_ns=time_ns,
        position_m=position,
        velocity_m_s=velocity,
        q_wxyz=q,
        omega_rad_s=w,
        bias=bias,
        covariance=_symmetric(f @ branch.covariance @ f.T + noise),
    )


def with_cameras(branch: Branch, chasers: list[int], p: MekfParameters) -> Branch:
    """The branch with a bias slot for each of ``chasers``; as it is if biases are switched off."""
    new = tuple(c for c in chasers if c not in branch.cameras) if p.has_bias else ()
    if not new:
        return branch
    n = branch.covariance.shape[0]
    covariance = np.zeros((n + ERRORS * len(new), n + ERRORS * len(new)))
    covariance[:n, :n] = branch.covariance
    i = np.arange(n, covariance.shape[0])
    covariance[i, i] = np.tile(prior(p).diagonal(), len(new))
    bias = np.vstack([branch.bias, np.zeros((len(new), ERRORS))])
    return replace(branch, cameras=branch.cameras + new, bias=bias, covariance=covariance)


def innovate(
    branch: Branch, chaser: int, eye: CameraPose, h: PoseHypothesis, p: MekfParameters
) -> Innovation:
    """How the measured pose ``h`` differs from the branch's prediction, and how much that may be.

    The residual's Jacobian is exact at zero error; the camera's own errors are part of the prediction.
    """
    n = branch.covariance.shape[0]
    jacobian = np.zeros((6, n))
    jacobian[3:, 6:9] = _EYE3
    residual = np.empty(6)
    if p.has_bias:
        k = branch.cameras.index(chaser)
        expected = seen_by(eye, branch.position_m, branch.q_wxyz, branch.bias[k])
        column = 12 + ERRORS * k
        jacobian[:3, :3] = expected.by_position
        jacobian[:, column : column + ERRORS] = expected.by_errors
        residual[:3] = h.position_m - expected.position_m
        residual[3:] = so3.log(so3.inverse_multiply(expected.q_wxyz, h.q_wxyz))
    else:
        jacobian[:3, :3] = _EYE3
        residual[:3] = h.position_m - branch.position_m
        residual[3:] = so3.log(so3.inverse_multiply(branch.q_wxyz, h.q_wxyz))
    noise = measurement_noise(h, p)
    s = jacobian @ branch.covariance @ jacobian.T + noise
    factor = np.linalg.cholesky(s)
    white = np.linalg.solve(factor, residual)
    nis = float(white @ white)
    log_determinant = 2.0 * sum(math.log(x) for x in factor.diagonal().tolist())
    return Innovation(residual, jacobian, s, noise, nis, -0.5 * (nis + log_determinant), log_determinant)


def correct(branch: Branch, i: Innovation) -> Branch:
    """The branch after the measurement behind ``i``: Joseph form, error injected and reset."""
    ph = branch.covariance @ i.jacobian.T
    gain = np.linalg.solve(i.s, ph.T).T
    a = np.eye(branch.covariance.shape[0]) - gain @ i.jacobian
    covariance = a @ branch.covariance @ a.T + gain @ i.noise @ gain.T
    d = gain @ i.residual
    dtheta = d[6:9]
    # The new dtheta is counted from the corrected attitude: Sola eq. 287, with the exact Jr.
    reset = so3.right_jacobian(dtheta)
    covariance[6:9] = reset @ covariance[6:9]
    covariance[:, 6:9] = covariance[:, 6:9] @ reset.T
    return replace(
        branch,
        position_m=branch.position_m + d[:3],
        velocity_m_s=branch.velocity_m_s + d[3:6],
        q_wxyz=so3.normalize(so3.multiply(branch.q_wxyz, so3.exp(dtheta))),
        omega_rad_s=branch.omega_rad_s + d[9:12],
        bias=branch.bias + d[12:].reshape(-1, ERRORS),
        covariance=_symmetric(covariance),
    )


def best_innovation(branch: Branch, m: Measurement, p: MekfParameters) -> tuple[int, Innovation]:
    """Index and innovation of the likeliest hypothesis of a measurement that has at least one."""
    found = [innovate(branch, m.chaser, m.eye, h, p) for h in m.hypotheses]
    best = max(range(len(found)), key=lambda k: (found[k].log_density, -k))
    return best, found[best]


def absorb(
    branch: Branch, group: list[Measurement], p: MekfParameters
) -> tuple[Branch, tuple[int, ...], tuple[int, ...]]:
    """Puts the measurements of one exposure (not empty ones) into a branch that is at its time.

    The cameras follow each other in the order given, unless the prediction is vague: then those that
    most others agree with come first, and of these the closest to the prediction, so that a lying
    camera does not lead. Returns the branch, the chasers accepted and the chasers gated out.
    """
    gate = chi_square_6(p.gate_probability)
    branch = with_cameras(branch, [m.chaser for m in group], p)
    order = group
    if len(group) > 1 and _vague(branch, group, p):
        found = [best_innovation(branch, m, p) for m in group]
        support = agreement([(m.hypotheses[k], m.eye) for m, (k, _) in zip(group, found, strict=True)], p)
        ranks = sorted((-support[i], found[i][1].nis, i) for i in range(len(group)))
        order = [group[i] for _, _, i in ranks]

    likelihood = branch.log_likelihood
    misses = dict(branch.misses)
    accepted: list[int] = []
    rejected: list[int] = []
    for m in order:
        _, innovation = best_innovation(branch, m, p)
        if innovation.nis <= gate:
            branch = correct(branch, innovation)
            likelihood += innovation.log_density
            misses[m.chaser] = 0
            accepted.append(m.chaser)
        else:
            # A gross outlier says no more against a branch than one just outside of the gate.
            likelihood -= 0.5 * (gate + innovation.log_determinant)
            misses[m.chaser] = misses.get(m.chaser, 0) + 1
            rejected.append(m.chaser)
    branch = replace(branch, log_likelihood=likelihood, misses=misses)
    return branch, tuple(sorted(accepted)), tuple(sorted(rejected))


def agreement(poses: list[tuple[PoseHypothesis, CameraPose]], p: MekfParameters) -> list[int]:
    """For each pose, how many of the others agree with it within noise, floor and the cameras' prior errors."""
    counts = [0] * len(poses)
    for i in range(len(poses)):
        for j in range(i):
            if agree(*poses[i], *poses[j], p):
                counts[i] += 1
                counts[j] += 1
    return counts


def agree(
    a: PoseHypothesis, eye_a: CameraPose, b: PoseHypothesis, eye_b: CameraPose, p: MekfParameters
) -> bool:
    """Whether two measured poses of the same time differ by no more than their errors explain."""
    d = np.concatenate([a.position_m - b.position_m, so3.log(so3.inverse_multiply(b.q_wxyz, a.q_wxyz))])
    s = _spread(a, eye_a, p) + _spread(b, eye_b, p)
    return float(d @ np.linalg.solve(s, d)) <= chi_square_6(p.gate_probability)


def _spread(h: PoseHypothesis, eye: CameraPose, p: MekfParameters) -> Array:
    """Covariance (6, 6) of a measured pose, its camera's unknown errors among it."""
    noise = measurement_noise(h, p)
    return noise + pose_prior(eye, h.position_m, h.q_wxyz, p) if p.has_bias else noise


def start(
    time_ns: int, m: Measurement, h: PoseHypothesis, rates: tuple[Array, Array, Array], p: MekfParameters
) -> Branch:
    """A branch from one measured pose and from rates: velocity, omega and their (6, 6) covariance.

    The pose's error is correlated with the camera's bias, and says so.
    """
    scale = p.single_marker_scale**2 if m.markers <= 1 else 1.0
    velocity, omega, rate_covariance = rates
    covariance = np.zeros((12, 12))
    r = np.array([3, 4, 5, 9, 10, 11])
    covariance[np.ix_(r, r)] = rate_covariance
    covariance[_POSE_GRID] = measurement_noise(h, p) * scale
    branch = Branch(
        time_ns, h.position_m, velocity, so3.normalize(h.q_wxyz), omega, (), np.zeros((0, ERRORS)), covariance,
        0.0, {},
    )  # fmt: skip
    if not p.has_bias:
        return branch
    branch = with_cameras(branch, [m.chaser], p)
    # Measured is the pose plus what the camera's errors do to it: the pose has that error, with the sign turned.
    spread = seen_by(m.eye, branch.position_m, branch.q_wxyz, NO_ERROR).by_errors
    covariance = branch.covariance.copy()
    covariance[_POSE_GRID] += spread @ prior(p) @ spread.T
    cross = -spread @ prior(p)
    covariance[POSE, 12:] = cross
    covariance[12:, POSE] = cross.T
    return replace(branch, covariance=_symmetric(covariance))


def measurement_noise(h: PoseHypothesis, p: MekfParameters) -> Array:
    """The measured covariance (6, 6) plus the white floor."""
    return h.covariance + _diagonal(p.floor_position_m, p.floor_attitude_rad)


def pose_sigmas(covariance: Array) -> tuple[float, float]:
    """Largest one-sigma of position (m) and of attitude (rad) of a (12+, 12+) covariance."""
    position = np.linalg.eigvalsh(covariance[0:3, 0:3])[-1]
    attitude = np.linalg.eigvalsh(covariance[6:9, 6:9])[-1]
    return math.sqrt(max(float(position), 0.0)), math.sqrt(max(float(attitude), 0.0))


@lru_cache(maxsize=64)
def _diagonal(position_m: float, attitude_rad: float) -> Array:
    matrix = np.diag([position_m**2] * 3 + [attitude_rad**2] * 3)
    matrix.flags.writeable = False
    return matrix


def _vague(branch: Branch, group: list[Measurement], p: MekfParameters) -> bool:
    """Whether the prediction is so much wider than the measurements that it can hardly judge them."""
    prior = branch.covariance.diagonal()
    for m in group:
        for h in m.hypotheses:
            allowed = 4.0 * _spread(h, m.eye, p).diagonal()
            if prior[0:3].sum() > allowed[:3].sum() or prior[6:9].sum() > allowed[3:].sum():
                return True
    return False


def _symmetric(m: Array) -> Array:
    return 0.5 * (m + m.T)
