# SPDX-License-Identifier: Apache-2.0
"""Updates of the joint filter by a tick's odometry and sightings, with one gate per channel. Pure
functions.

- A channel whose residual does not fit is not used in that tick. After ``rejections_to_drop``
  consecutive rejections it is dropped until it has fitted as often. A jump or a constant error
  then changes nothing.
- A chaser without support for ``restart_after_s``, by a measurement of translation and one of
  rotation, is restarted from its odometry. An estimate that contradicts all measurements cannot
  recover otherwise.
- A velocity or rate that fails its gate in two consecutive ticks, by no more than thrusters can
  cause within a tick, is followed. Noise exceeds the gate in a single tick in about every flight
  and must not pass for a force.
- A sighting by shape that fails its gate in ``rejections_to_new_view`` consecutive ticks, by no
  more than a new view can cause, is followed, unless most cameras disagree with the estimate.
- When most cameras are rejected together, the target has moved unexpectedly. Its rates are
  widened; if that does not help, its pose is reinitialized.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from chaserdock_models import scalar_rotations as so3
from chaserdock_models.arrays import Array
from chaserdock_protocol.codec import MAX_MAGNITUDE
from chaserdock_protocol.messages import Innovation, Odometry, PoseSolution, Sighting
from msgspec.structs import replace
from numpy.typing import NDArray

from . import kernels
from .covariance import of_chaser, with_started_chaser, with_started_target
from .hypotheses import TargetRates
from .measurements import (
    CameraMounting,
    measurement,
    odometry_noise,
    predict_sighting,
    sighting_covariance,
)
from .parameters import JointParameters
from .prediction import chaser_prior
from .running_update import RunningUpdate, running_update
from .state import (
    ATTITUDE,
    ATTITUDE_DRIFT,
    CHANNELS,
    CHASER,
    FOCAL,
    FORCE,
    GYRO_BIAS,
    POSE,
    POSITION,
    POSITION_DRIFT,
    RATE,
    RATES,
    SHIFT,
    SIGHTING_CHANNEL,
    TARGET,
    TORQUE,
    TURN,
    VELOCITY,
    VIEW,
    JointState,
    block,
)

_POSE = (CHANNELS.index("position"), CHANNELS.index("attitude"))
_RATES = (CHANNELS.index("velocity"), CHANNELS.index("rate"))
_POSE_FREEDOMS = 6
"""Degrees of freedom of a sighting: position and attitude."""
_SIGHTING, _ODOMETRY = frozenset({SIGHTING_CHANNEL}), frozenset(range(1, len(CHANNELS)))


@dataclass(frozen=True)
class UpdateReport:
    """Chasers whose sightings were accepted and rejected, and the innovations of both."""

    accepted: tuple[int, ...] = ()
    rejected: tuple[int, ...] = ()
    innovations: tuple[Innovation, ...] = ()


class _Channel(NamedTuple):
    number: int
    rows: range
    gate: float


class _Gates(NamedTuple):
    """Result of the gates of one chaser: numbers of the channels to use, counts of rejections,
    normalized innovations of odometry, the log likelihood, and the normalized innovation squared of
    the sighting (0 without one).
    """

    fits: dict[int, bool]
    rejections: list[int]
    nis: list[float]
    log_likelihood: float
    sighting: float


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
    measured = state.measured_ns.copy()
    measured[i] = state.time_ns

    own = np.zeros((CHASER, CHASER))
    e = np.arange(12, CHASER)
    own[e, e] = chaser_prior(p)
    own[:12, :12] = odometry_noise(odometry, p)

    # The measured state is the true one plus its error, hence the negative correlation.
    for part, drift in ((POSITION, POSITION_DRIFT), (ATTITUDE, ATTITUDE_DRIFT), (RATE, GYRO_BIAS)):
        prior = own[drift, drift].copy()
        own[part, part] += prior
        own[part, drift] = own[drift, part] = -prior

    return replace(
        # The other states keep their estimates, but are no longer correlated with this chaser.
        with_started_chaser(state, i, own),
        positions_m=positions,
        velocities_m_s=velocities,
        attitudes_wxyz=attitudes,
        omegas_rad_s=omegas,
        extra=extra,
        alive=alive,
        measured_ns=measured,
        rejections=rejections,
        nis=nis,
    )


@dataclass(frozen=True, eq=False)
class SightedPose:
    """Pose of the target by one sighting and the estimated state of ``chaser``.

    position_m (3,): origin of TRF in WRF. q_wxyz (4,): TRF to WRF. covariance (6, 6): of position
    (WRF axes) and dtheta (TRF axes), q_true = q (x) exp(dtheta). by_chaser (6, CHASER): negative of
    the derivatives of this error by the chaser's.
    """

    position_m: Array
    q_wxyz: Array
    covariance: Array
    chaser: int
    by_chaser: Array

    def agrees(self, other: SightedPose, gate: float) -> bool:
        """Test whether another pose at the same time differs by no more than the gate."""
        turn = so3.log(so3.inverse_multiply(other.q_wxyz, self.q_wxyz))
        d = np.concatenate([self.position_m - other.position_m, turn])
        return float(d @ np.linalg.solve(self.covariance + other.covariance, d)) <= gate


def sighted_pose(
    state: JointState,
    i: int,
    solution: PoseSolution,
    markers: int,
    mounting: CameraMounting,
    p: JointParameters,
) -> SightedPose:
    """Return the pose of the target by a solution of chaser ``i``, corrected by the estimated
    camera errors.
    """
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
    covariance = by_chaser @ of_chaser(state, i) @ by_chaser.T + to_pose @ noise @ to_pose.T
    return SightedPose(position, moved.q_wxyz, 0.5 * (covariance + covariance.T), i, by_chaser)


def start_target(
    state: JointState, pose: SightedPose, rates: TargetRates, scale: float = 1.0
) -> JointState:
    """Return the state with the target at a sighted pose with ``rates``.

    ``scale``: factor on the covariance of the pose.
    """
    own = np.zeros((TARGET, TARGET))
    own[np.ix_(POSE, POSE)] = pose.covariance * scale
    own[np.ix_(RATES, RATES)] = rates.covariance
    rejections = state.rejections.copy()
    rejections[:, SIGHTING_CHANNEL] = 0
    return replace(
        with_started_target(state, pose.chaser, pose.by_chaser, own),
        position_m=pose.position_m,
        q_wxyz=pose.q_wxyz,
        velocity_m_s=rates.velocity_m_s,
        omega_rad_s=rates.omega_rad_s,
        log_likelihood=0.0,
        target_known=True,
        updates=0,
        rejections=rejections,
    )


def with_view_units(
    state: JointState, sightings: Mapping[int, Sighting], p: JointParameters
) -> JointState:
    """Return the state with the running means of stated covariances updated by these sightings.

    A stated covariance changes from image to image with the points in use; the error that persists
    with the view does not. In units of the newest covariance, these changes would make that error
    seem observable.
    """
    stated = {
        i: sighting_covariance(s.solutions[0], p)
        for i, s in sightings.items()
        if s.solutions and p.sighting_noise(len(s.marker_ids)).units_time_s
    }
    if not stated:
        return state
    units, units_ns = state.view_units.copy(), state.view_units_ns.copy()
    for i, covariance in stated.items():
        if not _is_positive_definite(covariance):
            continue
        memory_s = p.sighting_noise(len(sightings[i].marker_ids)).units_time_s
        age_s = (state.time_ns - units_ns[i]) * 1e-9 if units[i].any() else math.inf
        kept = math.exp(-age_s / memory_s)
        units[i], units_ns[i] = kept * units[i] + (1.0 - kept) * covariance, state.time_ns
    return replace(state, view_units=units, view_units_ns=units_ns)


def _is_positive_definite(covariance: Array) -> bool:
    try:
        return bool(np.isfinite(np.linalg.cholesky(covariance)).all())
    except np.linalg.LinAlgError:
        return False


def _view_units(state: JointState, i: int, markers: int, p: JointParameters) -> Array | None:
    """Return the covariance (6, 6) that defines the unit of a sighting's view error; None for the
    stated one.
    """
    return state.view_units[i] if p.sighting_noise(markers).units_time_s else None


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
    innovations: list[Innovation] = []
    state = with_view_units(state, sightings, p)
    running, measured = running_update(state), state.measured_ns.copy()
    # If most cameras disagree with the estimate, the target has moved.
    disagreeing = sum(bool(state.rejections[i, SIGHTING_CHANNEL]) for i in sightings)
    new_views = 2 * disagreeing <= len(sightings)
    for i in sorted(odometry.keys() | sightings.keys()):
        if not state.alive[i]:
            continue
        sighting = sightings.get(i) if state.target_known else None
        gates = _update_chaser(running, i, odometry.get(i), sighting, new_views, mounting, p)
        fits = {} if gates is None else gates.fits
        if _is_supported(fits, bool(running.rejections[i, SIGHTING_CHANNEL])):
            measured[i] = state.time_ns
        if gates is not None and sighting is not None and sighting.solutions:
            used = fits[SIGHTING_CHANNEL]
            (accepted if used else rejected).append(i)
            innovations += _innovation(sighting, gates.sighting, used)
    markers = state.markers.copy()
    for i in accepted:
        markers[i] = len(sightings[i].marker_ids)
    report = UpdateReport(tuple(accepted), tuple(rejected), tuple(innovations))
    finished = running.finished(state.updates + bool(accepted), markers)
    return replace(finished, measured_ns=measured), report


def _innovation(sighting: Sighting, squared: float, used: bool) -> list[Innovation]:
    """Return the innovation of a sighting, nothing if it is not finite."""
    if not math.isfinite(squared):
        return []
    return [
        Innovation(
            chaser=sighting.chaser,
            sim_time_ns=sighting.sim_time_ns,
            squared=min(squared, MAX_MAGNITUDE),
            freedoms=_POSE_FREEDOMS,
            used=used,
        )
    ]


def _is_supported(fits: Mapping[int, bool], contradicted: bool) -> bool:
    """Return whether measurements support a chaser's estimate: a sighting, or odometry of
    translation and of rotation.

    One of two channels each is enough, as the other may be wrong. While sightings ``contradicted``
    the estimate, position and attitude must both fit.
    """
    if fits.get(SIGHTING_CHANNEL, False):
        return True
    needed = ((k,) for k in _POSE) if contradicted else zip(_POSE, _RATES, strict=True)
    return all(any(fits.get(k, False) for k in channels) for channels in needed)


def _update_chaser(
    running: RunningUpdate,
    i: int,
    odometry: Odometry | None,
    sighting: Sighting | None,
    new_views: bool,
    mounting: CameraMounting,
    p: JointParameters,
) -> _Gates | None:
    """Update by the measurements of one chaser. Returns which channels were used; None without a
    measurement.

    ``new_views``: follow errors of views that jump.
    """
    place, markers = running.place(i), len(sighting.marker_ids) if sighting is not None else 0
    solution = _likeliest(running, i, sighting, mounting, p)
    if odometry is None and solution is None:
        return None

    view = _view_units(running.state, i, markers, p)
    z = measurement(*place, odometry, solution, markers, mounting, p, view)
    channels = _channels(
        odometry is not None, solution is not None, p.gate_sighting, p.gate_odometry
    )

    gates = _gate(running, i, channels, running.values(z), p)
    if not all(gates.fits.values()) and any(
        not gates.fits.get(k, True) and running.rejections[i, k] for k in _RATES
    ):
        gates = _follow(
            running, i, z, channels, gates, _unexpected_motion(i, running, p), _ODOMETRY, p
        )

    if (
        new_views
        and view is not None
        and p.rejections_to_new_view <= gates.rejections[SIGHTING_CHANNEL] <= p.rejections_to_drop
    ):
        gates = _follow(running, i, z, channels, gates, _new_view(i, running), _SIGHTING, p)

    running.rejections[i], running.nis[i] = gates.rejections, gates.nis
    running.log_likelihood = gates.log_likelihood

    used = _rows(tuple(c.rows for c in channels if gates.fits[c.number]))
    if len(used):
        nonlinear = (
            gates.fits.get(SIGHTING_CHANNEL, False) and running.state.updates < p.iterated_updates
        )
        running.correct(z, used, p.iterations if nonlinear else 1)
    return gates


def _follow(
    running: RunningUpdate,
    i: int,
    z: kernels.NativeMeasurement,
    channels: Sequence[_Channel],
    gates: _Gates,
    change: Array,
    judged: frozenset[int],
    p: JointParameters,
) -> _Gates:
    """If the channels ``judged`` fit after an unexpected ``change`` (variances), widen the
    covariance by it. Returns the gates.

    Afterwards the running innovation belongs to the widened covariance.
    """
    diagonal = np.einsum("ii->i", running.covariance)
    before = diagonal.copy()
    diagonal += change
    wider = _gate(running, i, channels, running.values(z), p)
    if all(fit for k, fit in wider.fits.items() if k in judged):
        return wider._replace(nis=gates.nis, sighting=gates.sighting)
    diagonal[:] = before
    running.values(z)
    return gates


def _unexpected_motion(i: int, running: RunningUpdate, p: JointParameters) -> Array:
    """Return the variances (D,) that an uncommanded force and torque within a tick add to chaser
    ``i``.
    """
    variances, own = np.zeros(len(running.covariance)), block(running.place(i)[1]).start
    for part, sigma in (
        (VELOCITY, p.unexpected_velocity_m_s),
        (POSITION, p.unexpected_velocity_m_s * p.tick_s),
        (RATE, p.unexpected_omega_rad_s),
        (ATTITUDE, p.unexpected_omega_rad_s * p.tick_s),
        (FORCE, p.force_max_N),
        (TORQUE, p.torque_max_N_m),
    ):
        variances[own + part.start : own + part.stop] = sigma**2
    return variances


def _new_view(i: int, running: RunningUpdate) -> Array:
    """Return the variances (D,) to add to the view error of chaser ``i`` so that it is unknown
    again.
    """
    variances, own = np.zeros(len(running.covariance)), block(running.place(i)[1]).start
    variances[own + VIEW.start : own + VIEW.stop] = 1.0
    return variances


def _gate(
    running: RunningUpdate,
    i: int,
    channels: Sequence[_Channel],
    values: Sequence[float],
    p: JointParameters,
) -> _Gates:
    """Test which channels fit, and count. ``values``: as ``RunningUpdate.values`` returns them."""
    rejections, nis, likelihood = (
        running.rejections[i].tolist(),
        running.nis[i].tolist(),
        running.log_likelihood,
    )
    sighting = 0.0
    fits: dict[int, bool] = {}
    for number, _, gate in channels:
        value = values[number]
        rejections[number], fits[number] = _count(rejections[number], value, gate, p)
        if number == SIGHTING_CHANNEL:
            # Bound the penalty: a gross outlier counts as much as one at the gate.
            likelihood -= 0.5 * (min(value, gate) + math.log(values[-1]))
            sighting = value
        else:
            nis[number - 1] += (min(10.0 * gate, value) - nis[number - 1]) / p.overconfident_ticks
    return _Gates(fits, rejections, nis, likelihood, sighting)


def _likeliest(
    running: RunningUpdate,
    i: int,
    sighting: Sighting | None,
    mounting: CameraMounting,
    p: JointParameters,
) -> PoseSolution | None:
    """Return the likeliest solution of a sighting, the first of equals; None without a sighting."""
    solutions = sighting.solutions if sighting is not None else ()
    if sighting is None or len(solutions) < 2:
        return solutions[0] if solutions else None

    def log_density(solution: PoseSolution) -> float:
        markers = len(sighting.marker_ids)
        view = _view_units(running.state, i, markers, p)
        z = measurement(*running.place(i), None, solution, markers, mounting, p, view)
        values = running.values(z)
        return -0.5 * (values[SIGHTING_CHANNEL] + math.log(values[-1]))

    return max(solutions, key=log_density)


@cache
def _channels(
    has_odometry: bool, has_sighting: bool, gate_sighting: float, gate_odometry: float
) -> tuple[_Channel, ...]:
    channels, row = [], 0
    if has_sighting:
        channels.append(_Channel(SIGHTING_CHANNEL, range(_POSE_FREEDOMS), gate_sighting))
        row = _POSE_FREEDOMS
    if has_odometry:
        for k in range(1, len(CHANNELS)):
            channels.append(_Channel(k, range(row, row + 3), gate_odometry))
            row += 3
    return tuple(channels)


@cache
def _rows(parts: tuple[range, ...]) -> NDArray[np.int64]:
    """Return the rows of channels (cached: callers must not change them)."""
    return np.array([row for part in parts for row in part], dtype=np.int64)


def _count(count: int, value: float, gate: float, p: JointParameters) -> tuple[int, bool]:
    """Return the new count of a channel's rejections after a squared residual ``value``, and
    whether the channel is used.
    """
    limit = p.rejections_to_drop
    if not value <= gate:  # rejects NaN as well
        return min(count + 1, 2 * limit), False
    return (count - 1 if count >= limit else 0), count < limit
