# SPDX-License-Identifier: Apache-2.0
"""State of the joint filter, and the layout of its error vector.

The error vector has 12 components for the target, then ``CHASER`` for each chaser. Both begin with
position and velocity (WRF), rotation (body axes, q_true = q (x) exp(dtheta)) and angular rate (body
axes). A chaser's additive states follow. The last ``SHAPE`` components, of a torque-free target
only, are those of its ``BodyShape``.
"""

from __future__ import annotations

import numpy as np
from chaserdock_models.arrays import Array
from msgspec import Struct
from msgspec.structs import replace
from numpy.typing import NDArray

from chaserdock_controller.bodies.body_shape import (
    RATIOS,
    SHAPE,
    BodyShape,
    shape_covariance,
    shape_of,
)

from . import kernels
from .kernels import CHASER, CHASER_MEAN, TARGET, TARGET_MEAN
from .parameters import BodyPrior, TargetParameters
from .star import ChasersGivenTarget

POSITION, VELOCITY, ATTITUDE, RATE = (slice(k, k + 3) for k in (0, 3, 6, 9))
POSE, RATES = np.array([0, 1, 2, 6, 7, 8]), np.array([3, 4, 5, 9, 10, 11])
"""Components of a body's error that belong to its pose and to its rates."""
FORCE, TORQUE = slice(12, 15), slice(15, 18)
"""Disturbance on the chaser, body axes, N and N m."""
CENTRE = slice(18, 21)
"""Offset of the chaser's centre of mass from the origin of CRF, m (CRF)."""
POSITION_DRIFT, ATTITUDE_DRIFT, GYRO_BIAS = slice(21, 24), slice(24, 27), slice(27, 30)
"""Errors of its odometry that do not average out: position drift, m (WRF); attitude drift, rad
(CRF); gyro bias, rad/s (CRF).
"""
TURN, SHIFT, FOCAL = slice(30, 33), slice(33, 36), slice(36, 37)
"""Errors of its camera (see ``measurements``): rotation vector and shift in IRF, relative error of
the focal length.
"""
VIEW = slice(37, 43)
"""Error of its sightings that persists with the view, in units of the stated sigmas."""
EXTRA = CHASER - 12
"""Number of a chaser's additive states: components of its error that are added without a
rotation.
"""
# Index of sightings in `CHANNELS`.
SIGHTING_CHANNEL = 0
CHANNELS = ("sighting", "position", "velocity", "attitude", "rate")
"""Measurements that are gated separately."""


class JointState(Struct, frozen=True, eq=False, kw_only=True):
    """State of the joint filter after the tick at ``time_ns``, for a target and N chasers.

    Target (meaningless until ``target_known``):

    position_m, velocity_m_s, q_wxyz, omega_rad_s: as in ``TargetState``.
    shape: of a torque-free target, else None. It was started at ``shape_ns`` from ``prior``.
    ratio_information (5, 5): (pseudo-)inverse of the prior covariance of the inertia ratios.
    updates: ticks with sightings since the start of the target.
    log_likelihood: of all measurements since then.

    Chasers:

    positions_m, velocities_m_s, attitudes_wxyz, omegas_rad_s: (N, 3) or (N, 4).
    extra (N, EXTRA): additive states.
    alive (N,): chasers whose state is known.
    odometry_ns (N,): time of the newest odometry.
    measured_ns (N,): time of the newest measurement that was used.
    rejections (N, len(CHANNELS)): counts that decide which channels are used.
    markers (N,): markers in the newest sighting of each chaser; 1 before the first one.
    view_units (N, 6, 6): mean of the stated covariances, where it defines the unit of the view
        error; 0 before the first sighting, and where the newest covariance defines it.
    view_units_ns (N,): time of the newest sighting in that mean.
    nis (N, 4): moving averages of the normalized innovation squared of odometry's channels.

    covariance: (12 + CHASER N, 12 + CHASER N), or ``SHAPE`` more with a ``shape``. With
        ``given_target`` only (12, 12), or ``SHAPE`` more.
    given_target: the chasers' part of the covariance in star form (see ``covariance``).
    """

    time_ns: int
    position_m: Array
    velocity_m_s: Array
    q_wxyz: Array
    omega_rad_s: Array
    covariance: Array
    positions_m: Array
    velocities_m_s: Array
    attitudes_wxyz: Array
    omegas_rad_s: Array
    extra: Array
    alive: NDArray[np.bool_]
    odometry_ns: NDArray[np.int64]
    measured_ns: NDArray[np.int64]
    rejections: NDArray[np.int64]
    nis: Array
    markers: NDArray[np.int64]
    view_units: Array
    view_units_ns: NDArray[np.int64]
    target_known: bool = False
    updates: int = 0
    shape: BodyShape | None = None
    prior: BodyPrior | None = None
    ratio_information: Array | None = None
    shape_ns: int = 0
    log_likelihood: float = 0.0
    given_target: ChasersGivenTarget | None = None

    @property
    def chasers(self) -> int:
        """Return the number of chasers."""
        return len(self.positions_m)

    def of(self, chaser: int, part: slice) -> Array:
        """Return additive states of a chaser. ``part``: their components in its error."""
        return self.extra[chaser, part.start - 12 : part.stop - 12]


def empty_state(time_ns: int, chasers: int, *, star: bool = False) -> JointState:
    """Return a state in which nothing is known. ``star``: with the covariance in star form."""
    n = chasers
    size = TARGET if star else TARGET + CHASER * n
    given = ChasersGivenTarget(np.zeros((n, CHASER, TARGET)), np.zeros((n, CHASER, CHASER)))
    return JointState(
        time_ns=time_ns,
        position_m=np.zeros(3),
        velocity_m_s=np.zeros(3),
        q_wxyz=np.array([1.0, 0.0, 0.0, 0.0]),
        omega_rad_s=np.zeros(3),
        positions_m=np.zeros((n, 3)),
        velocities_m_s=np.zeros((n, 3)),
        attitudes_wxyz=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        omegas_rad_s=np.zeros((n, 3)),
        extra=np.zeros((n, EXTRA)),
        covariance=np.zeros((size, size)),
        alive=np.zeros(n, dtype=bool),
        odometry_ns=np.zeros(n, dtype=np.int64),
        measured_ns=np.zeros(n, dtype=np.int64),
        rejections=np.zeros((n, len(CHANNELS)), dtype=np.int64),
        nis=np.full((n, len(CHANNELS) - 1), 3.0),
        markers=np.ones(n, dtype=np.int64),
        view_units=np.zeros((n, 6, 6)),
        view_units_ns=np.zeros(n, dtype=np.int64),
        given_target=given if star else None,
    )


def with_body(state: JointState, p: TargetParameters) -> JointState:
    """Return the state for a target that is the body of ``p`` from now on. The shape restarts if
    that is another body.
    """
    if p.motion_model != "torque_free" or state.prior == p.body_prior:
        return state
    return start_shape(state, p)


def start_shape(state: JointState, p: TargetParameters) -> JointState:
    """Return the state with the shape of the target restarted from the knowledge in ``p``."""
    inertia = np.array(p.inertia_ratios, dtype=float)
    given = state.given_target
    own = TARGET if given is not None else TARGET + CHASER * state.chasers
    covariance = np.zeros((own + SHAPE, own + SHAPE))
    covariance[:own, :own] = state.covariance[:own, :own]
    if p.body_covariance:
        covariance[own:, own:] = shape_covariance(inertia, np.array(p.body_covariance))
    if given is not None:
        cross, marginal = given.covariances_by(state.covariance)
        cross = np.pad(cross[:, :, :TARGET], ((0, 0), (0, 0), (0, SHAPE)))
        given = ChasersGivenTarget.of_covariances(covariance, cross, marginal)
    return replace(
        state,
        shape=shape_of(inertia, np.array(p.centre_of_mass_trf_m)),
        prior=p.body_prior,
        ratio_information=np.linalg.pinv(
            covariance[own:, own:][RATIOS, RATIOS], rcond=1e-12, hermitian=True
        ),
        shape_ns=state.time_ns,
        covariance=covariance,
        given_target=given,
    )


def block(chaser: int) -> slice:
    """Return the components of a chaser in the error vector."""
    return slice(TARGET + CHASER * chaser, TARGET + CHASER * (chaser + 1))


def packed(state: JointState) -> Array:
    """Return target and chasers as one new array, the layout of the kernels (see ``kernels``)."""
    mean = np.empty(TARGET_MEAN + CHASER_MEAN * state.chasers)
    mean[0:3], mean[3:6] = state.position_m, state.velocity_m_s
    mean[6:10], mean[10:13] = state.q_wxyz, state.omega_rad_s
    each = mean[TARGET_MEAN:].reshape(-1, CHASER_MEAN)
    each[:, 0:3], each[:, 3:6] = state.positions_m, state.velocities_m_s
    each[:, 6:10], each[:, 10:13], each[:, 13:] = (
        state.attitudes_wxyz,
        state.omegas_rad_s,
        state.extra,
    )
    return mean


def mean_fields(mean: Array) -> dict[str, Array]:
    """Return the fields of ``JointState`` that ``packed`` collects, as views of ``mean``."""
    each = mean[TARGET_MEAN:].reshape(-1, CHASER_MEAN)
    return {
        "position_m": mean[0:3],
        "velocity_m_s": mean[3:6],
        "q_wxyz": mean[6:10],
        "omega_rad_s": mean[10:13],
    } | {
        "positions_m": each[:, 0:3],
        "velocities_m_s": each[:, 3:6],
        "attitudes_wxyz": each[:, 6:10],
        "omegas_rad_s": each[:, 10:13],
        "extra": each[:, 13:],
    }


def inject(state: JointState, error: Array) -> JointState:
    """Return the state corrected by an error vector; the covariance stays."""
    end = TARGET + CHASER * state.chasers
    shape = None if state.shape is None else state.shape.corrected(error[end:])
    return replace(
        state, shape=shape, **mean_fields(kernels.inject(packed(state), np.array(error)))
    )


def difference(a: JointState, b: JointState) -> Array:
    """Return the error vector that takes the state ``a`` to ``b``."""
    error = kernels.difference(packed(a), packed(b))
    if a.shape is None or b.shape is None:
        return error
    return np.concatenate([error, a.shape.error_of(b.shape)])
