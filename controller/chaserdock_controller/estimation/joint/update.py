# SPDX-License-Identifier: Apache-2.0
"""Updates of the joint filter by a tick's odometry and sightings, with a gate for each channel. Pure functions.

A channel whose residual does not fit is not used in that tick. After ``rejections_to_drop`` rejections in a row it is dropped
until it has fitted as often: a jump or a constant error then changes nothing. A velocity or rate that does not fit in two ticks in a
row, by no more than the thrusters can cause within a tick, is followed. Noise that exceeds the gate in a single tick, which
happens in about every flight, must not pass for a force. When most cameras are rejected together, the
target has moved in an unexpected way: its rates are widened, and if that does not help its pose is reinitialized.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from chaserdock_models import scalar_rotations as so3
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import Odometry, PoseSolution, Sighting
from numpy.typing import NDArray

from chaserdock_controller.estimation.target_hypotheses import POSE, RATES, TargetRates
from chaserdock_controller.estimation.types import PoseHypothesis

from .measurements import (
    CameraMounting,
    LinearizedMeasurement,
    linearize_odometry,
    linearize_sighting,
    odometry_noise,
    predict_sighting,
    sighting_covariance,
)
from .parameters import JointParameters
from .prediction import chaser_prior
from .state import (
    ATTITUDE,
    ATTITUDE_DRIFT,
    CHANNELS,
    CHASER,
    FOCAL,
    FORCE,
    GYRO_BIAS,
    POSITION,
    POSITION_DRIFT,
    RATE,
    SHIFT,
    SIGHTING_CHANNEL,
    TARGET,
    TORQUE,
    TURN,
    VELOCITY,
    JointState,
    block,
    difference,
    inject,
)

_RATES = (CHANNELS.index("velocity"), CHANNELS.index("rate"))
_TICK_S = 0.1
"""Time, at most about a tick, in which unexpected motion displaces a chaser."""


@dataclass(frozen=True)
class UpdateReport:
    """Chasers whose sightings were accepted and rejected."""

    accepted: tuple[int, ...] = ()
    rejected: tuple[int, ...] = ()


class _Channel(NamedTuple):
    number: int
    rows: slice
    gate: float


def start_chaser(state: JointState, i: int, odometry: Odometry, p: JointParameters) -> JointState:
    """Return the state with chaser ``i`` known from its odometry alone."""
    positions, velocities = state.positions_m.copy(), state.velocities_m_s.copy()
    attitudes, omegas = state.attitudes_wxyz.copy(), state.omegas_rad_s.copy()
    positions[i], velocities[i] = odometry.position_m, odometry.velocity_m_s
    attitudes[i], omegas[i] = so3.normalize(np.array(odometry.q_wxyz)), odometry.omega_rad_s
    extra, alive = state.extra.copy(), state.alive.copy()
    extra[i], alive[i] = 0.0, True
    rejections, nis = state.rejections.copy(), state.nis.copy()
    rejections[i], nis[i] = 0, 3.0
    covariance = state.covariance.copy()
    covariance[block(i), :] = covariance[:, block(i)] = 0.0
    own = np.zeros((CHASER, CHASER))
    e = np.arange(12, CHASER)
    own[e, e] = chaser_prior(p)
    own[:12, :12] = odometry_noise(odometry, p)
    # The measured state is the true one plus its error, hence the negative correlation.
    for part, drift in ((POSITION, POSITION_DRIFT), (ATTITUDE, ATTITUDE_DRIFT), (RATE, GYRO_BIAS)):
        prior = own[drift, drift].copy()
        own[part, part] += prior
        own[part, drift] = own[drift, part] = -prior
    covariance[block(i), block(i)] = own
    return replace(
        state,
        positions_m=positions,
        velocities_m_s=velocities,
        attitudes_wxyz=attitudes,
        omegas_rad_s=omegas,
        extra=extra,
        alive=alive,
        rejections=rejections,
        nis=nis,
        covariance=covariance,
    )


@dataclass(frozen=True, eq=False)
class SightedPose(PoseHypothesis):
    """Pose of the target by one sighting and the chaser's estimated state; ``cross`` (6, D): covariance with the error vector."""

    cross: Array


def sighted_pose(
    state: JointState,
    i: int,
    solution: PoseSolution,
    markers: int,
    mounting: CameraMounting,
    p: JointParameters,
) -> SightedPose:
    """Return the pose of the target by a solution of chaser ``i``, with the camera's errors as estimated."""
    c = so3.to_matrix(state.attitudes_wxyz[i])
    delta = state.of(i, TURN)
    q_camera = so3.multiply(state.attitudes_wxyz[i], mounting.q_wxyz)
    scaled = np.array(solution.position_m) * [1.0, 1.0, 1.0 + float(state.of(i, FOCAL)[0])]
    line = so3.to_matrix(so3.exp(delta)) @ scaled + state.of(i, SHIFT)
    position = state.positions_m[i] + c @ (mounting.position_m + mounting.axes @ line)
    q = so3.multiply(q_camera, so3.multiply(so3.exp(delta), np.array(solution.q_wxyz)))
    moved = replace(state, position_m=position, q_wxyz=so3.normalize(q))
    predicted = predict_sighting(moved, i, mounting)
    to_pose = np.linalg.inv(predicted.by_target[:, POSE])
    ratios = p.sighting_noise(markers)
    noise = (ratios.white_ratio**2 + ratios.view_ratio**2) * sighting_covariance(solution, p)
    by_chaser = to_pose @ predicted.by_chaser
    cross = -by_chaser @ state.covariance[block(i), :]
    own = state.covariance[block(i), block(i)]
    covariance = by_chaser @ own @ by_chaser.T + to_pose @ noise @ to_pose.T
    return SightedPose(position, moved.q_wxyz, 0.5 * (covariance + covariance.T), cross)


def start_target(state: JointState, pose: SightedPose, rates: TargetRates, scale: float = 1.0) -> JointState:
    """Return the state with the target at a sighted pose with ``rates``.

    ``scale``: factor on the covariance of the pose.
    """
    covariance = state.covariance.copy()
    covariance[:TARGET, :] = covariance[:, :TARGET] = 0.0
    cross = pose.cross.copy()
    cross[:, :TARGET] = 0.0
    covariance[POSE, :], covariance[:, POSE] = cross, cross.T
    covariance[np.ix_(POSE, POSE)] = pose.covariance * scale
    covariance[np.ix_(RATES, RATES)] = rates.covariance
    rejections = state.rejections.copy()
    rejections[:, SIGHTING_CHANNEL] = 0
    return replace(
        state,
        position_m=pose.position_m,
        q_wxyz=pose.q_wxyz,
        velocity_m_s=rates.velocity_m_s,
        omega_rad_s=rates.omega_rad_s,
        covariance=covariance,
        log_likelihood=0.0,
        target_known=True,
        updates=0,
        rejections=rejections,
    )


class ReducedCovariance:
    """A covariance P - W'W during the updates of a tick, of which each adds rows to W.

    P itself is subtracted from once, at the end, as it is large: the result is that of updates one after the other.
    """

    def __init__(self, covariance: Array, rows: int) -> None:
        self._covariance, self._w = covariance.copy(), np.empty((rows, len(covariance)))
        self._rows = 0

    def innovation(self, i: int, z: LinearizedMeasurement) -> tuple[Array, Array]:
        """Return H P (k, D) and the innovation covariance (k, k) of a measurement of chaser ``i``."""
        own, p, w = block(i), self._covariance, self._w[: self._rows]
        cross = z.by_target @ p[:TARGET] + z.by_chaser @ p[own]
        if self._rows:
            seen = w[:, :TARGET] @ z.by_target.T + w[:, own] @ z.by_chaser.T
            cross -= seen.T @ w
        s = cross[:, :TARGET] @ z.by_target.T + cross[:, own] @ z.by_chaser.T + z.noise
        return cross, 0.5 * (s + s.T)

    def widen(self, variances: Array) -> None:
        """Add variances (D,)."""
        k = np.arange(len(variances))
        self._covariance[k, k] += variances

    def subtract(self, white: Array) -> None:
        """Subtract white' white, with ``white`` (k, D)."""
        self._w[self._rows : self._rows + len(white)] = white
        self._rows += len(white)

    def turn(self, part: slice, correction: Array) -> None:
        """Make a rotation error relative to the corrected attitude (Sola eq. 287)."""
        reset, p, w = so3.right_jacobian(correction), self._covariance, self._w[: self._rows]
        p[part] = reset @ p[part]
        p[:, part] = p[:, part] @ reset.T
        w[:, part] = w[:, part] @ reset.T

    def total(self) -> Array:
        """Return the covariance (D, D)."""
        w = self._w[: self._rows]
        out = w.T @ w
        # In place: with 16 chasers a third large array costs as much time as the product.
        return np.subtract(self._covariance, out, out=out)


def update(
    state: JointState,
    odometry: Mapping[int, Odometry],
    sightings: Mapping[int, Sighting],
    mounting: CameraMounting,
    p: JointParameters,
) -> tuple[JointState, UpdateReport]:
    """Update the state at its time with the odometry and the sightings of the chasers."""
    accepted: list[int] = []
    rejected: list[int] = []
    chasers = [i for i in sorted(odometry.keys() | sightings.keys()) if state.alive[i]]
    covariance = ReducedCovariance(state.covariance, 18 * len(chasers))
    for i in chasers:
        sighting = sightings.get(i) if state.target_known else None
        state, fits = _update_chaser(state, covariance, i, odometry.get(i), sighting, mounting, p)
        if sighting is not None and sighting.solutions:
            (accepted if fits[SIGHTING_CHANNEL] else rejected).append(i)
    markers = state.markers.copy()
    for i in accepted:
        markers[i] = len(sightings[i].marker_ids)
    updates = state.updates + bool(accepted)
    state = replace(state, covariance=covariance.total(), updates=updates, markers=markers)
    return state, UpdateReport(tuple(accepted), tuple(rejected))


def _update_chaser(
    prior: JointState,
    covariance: ReducedCovariance,
    i: int,
    odometry: Odometry | None,
    sighting: Sighting | None,
    mounting: CameraMounting,
    p: JointParameters,
) -> tuple[JointState, dict[int, bool]]:
    """Update with the measurements of one chaser; return the state, and which channels were used."""
    markers = len(sighting.marker_ids) if sighting is not None else 0
    solution = _likeliest(prior, covariance, i, sighting, mounting, p)
    z = _linearize(prior, i, odometry, solution, markers, mounting, p)
    channels = _channels(odometry is not None, solution is not None, p)
    cross, s = covariance.innovation(i, z)
    state, fits = _gate(prior, i, channels, z.residual, s, p)
    if any(not fits.get(k, True) and prior.rejections[i, k] for k in _RATES):
        variances = _unexpected_motion(i, cross.shape[1], p)
        covariance.widen(variances)
        wider_cross, wider_s = covariance.innovation(i, z)
        wider_state, wider_fits = _gate(prior, i, channels, z.residual, wider_s, p)
        if all(fit for k, fit in wider_fits.items() if k != SIGHTING_CHANNEL):
            cross, s, fits = wider_cross, wider_s, wider_fits
            state = replace(wider_state, nis=state.nis)
        else:
            covariance.widen(-variances)
    used = [c.rows for c in channels if fits[c.number]]
    if not used:
        return state, fits
    rows = slice(None)
    if len(used) < len(channels):
        rows = np.concatenate([np.arange(r.start, r.stop) for r in used])
    prior = state
    nonlinear = fits.get(SIGHTING_CHANNEL, False) and prior.updates < p.iterated_updates
    white, correction = cross[:0], np.zeros(cross.shape[1])
    for k in range(p.iterations if nonlinear else 1):
        if k:
            z = _linearize(state, i, odometry, solution, markers, mounting, p)
            cross, s = covariance.innovation(i, z)
        factor = np.linalg.cholesky(s[rows][:, rows])
        residual = z.residual[rows]
        if k:
            e = difference(prior, state)
            residual = residual + z.by_target[rows] @ e[:TARGET] + z.by_chaser[rows] @ e[block(i)]
        # The inverse of so small a matrix, well conditioned by the noise, takes a seventh of the time of solving for all columns.
        inverse = np.linalg.inv(factor)
        white = inverse @ cross[rows]
        correction = (inverse @ residual) @ white
        state = inject(prior, correction)
    covariance.subtract(white)
    for part in (ATTITUDE, _attitude_of(i)):
        covariance.turn(part, correction[part])
    return state, fits


def _unexpected_motion(i: int, size: int, p: JointParameters) -> Array:
    """Return the variances (``size``,) that a force and a torque without a command add to chaser ``i`` within a tick."""
    variances, own = np.zeros(size), block(i).start
    for part, sigma in (
        (VELOCITY, p.unexpected_velocity_m_s),
        (POSITION, p.unexpected_velocity_m_s * _TICK_S),
        (RATE, p.unexpected_omega_rad_s),
        (ATTITUDE, p.unexpected_omega_rad_s * _TICK_S),
        (FORCE, p.force_max_N),
        (TORQUE, p.torque_max_N_m),
    ):
        variances[own + part.start : own + part.stop] = sigma**2
    return variances


def _gate(
    state: JointState, i: int, channels: Sequence[_Channel], residual: Array, s: Array, p: JointParameters
) -> tuple[JointState, dict[int, bool]]:
    """Count which channels fit; return the state with the counts, and by channel whether it is used."""
    rejections, nis, likelihood = state.rejections.copy(), state.nis.copy(), state.log_likelihood
    fits: dict[int, bool] = {}
    for channel in channels:
        r, part = residual[channel.rows], s[channel.rows, channel.rows]
        value = float(r @ np.linalg.solve(part, r)) if len(r) > 3 else _normalized_square3(part, r)
        fits[channel.number] = _count(rejections, i, channel, value, p)
        if channel.number == SIGHTING_CHANNEL:
            # Bound the penalty: a gross outlier counts as much as one at the gate.
            likelihood -= 0.5 * (min(value, channel.gate) + float(np.linalg.slogdet(part)[1]))
        else:
            k = channel.number - 1
            nis[i, k] += (min(value, 10.0 * channel.gate) - nis[i, k]) / p.overconfident_ticks
    return replace(state, rejections=rejections, nis=nis, log_likelihood=likelihood), fits


def _normalized_square3(a: Array, b: Array) -> float:
    """Return b' A^-1 b for a symmetric A (3, 3) and b (3,) by its adjugate, in Python's floats, faster than LAPACK."""
    (p, q, r), (_, s, t), (_, _, u) = a.tolist()
    x, y, z = b.tolist()
    pp, pq, pr = s * u - t * t, r * t - q * u, q * t - r * s
    qq, qr, rr = p * u - r * r, q * r - p * t, p * s - q * q
    square = pp * x * x + qq * y * y + rr * z * z + 2.0 * (pq * x * y + pr * x * z + qr * y * z)
    return square / (p * pp + q * pq + r * pr)


def _likeliest(
    state: JointState,
    covariance: ReducedCovariance,
    i: int,
    sighting: Sighting | None,
    mounting: CameraMounting,
    p: JointParameters,
) -> PoseSolution | None:
    """Return the likeliest solution of a sighting, the first one of equals; None without any."""
    solutions = sighting.solutions if sighting is not None else ()
    if sighting is None or len(solutions) < 2:
        return solutions[0] if solutions else None

    def log_density(solution: PoseSolution) -> float:
        z = linearize_sighting(state, i, solution, len(sighting.marker_ids), mounting, p)
        s = covariance.innovation(i, z)[1]
        return -0.5 * (float(z.residual @ np.linalg.solve(s, z.residual)) + float(np.linalg.slogdet(s)[1]))

    return max(solutions, key=log_density)


def _attitude_of(i: int) -> slice:
    first = TARGET + CHASER * i
    return slice(first + ATTITUDE.start, first + ATTITUDE.stop)


def _channels(has_odometry: bool, has_sighting: bool, p: JointParameters) -> list[_Channel]:
    channels, row = [], 0
    if has_sighting:
        channels.append(_Channel(SIGHTING_CHANNEL, slice(0, 6), p.gate_sighting))
        row = 6
    if has_odometry:
        for k in range(1, len(CHANNELS)):
            channels.append(_Channel(k, slice(row, row + 3), p.gate_odometry))
            row += 3
    return channels


def _count(
    rejections: NDArray[np.int64], i: int, channel: _Channel, value: float, p: JointParameters
) -> bool:
    """Update the count of a channel's rejections; return whether the channel is used."""
    count, limit = int(rejections[i, channel.number]), p.rejections_to_drop
    if not value <= channel.gate:  # rejects NaN as well
        rejections[i, channel.number] = min(count + 1, 2 * limit)
        return False
    rejections[i, channel.number] = count - 1 if count >= limit else 0
    return count < limit


def _linearize(
    state: JointState,
    i: int,
    odometry: Odometry | None,
    solution: PoseSolution | None,
    markers: int,
    mounting: CameraMounting,
    p: JointParameters,
) -> LinearizedMeasurement:
    parts = []
    if solution is not None:
        parts.append(linearize_sighting(state, i, solution, markers, mounting, p))
    if odometry is not None:
        parts.append(linearize_odometry(state, i, odometry, p))
    if len(parts) == 1:
        return parts[0]
    a, b = parts
    noise = np.zeros((18, 18))
    noise[:6, :6], noise[6:, 6:] = a.noise, b.noise
    return LinearizedMeasurement(
        np.concatenate([a.residual, b.residual]),
        np.concatenate([a.by_target, b.by_target]),
        np.concatenate([a.by_chaser, b.by_chaser]),
        noise,
    )
