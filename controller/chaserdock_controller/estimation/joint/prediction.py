# SPDX-License-Identifier: Apache-2.0
"""Motion of the target and the chasers between ticks, and growth of the covariance
(native/motion.c, covariance.c).

A chaser is a rigid body under its commanded wrench (F, T) and an unknown, slowly changing
disturbance (F_d, T_d), in body axes. The origin of CRF is at -c from the centre of mass:

I omega' = T + T_d - c x (F + F_d) - omega x I omega,
v' = C ((F + F_d) / m - omega' x c - omega x (omega x c)).

In an orbit the forces and torques of the Hill frame are added (relative_motion.py). The errors of
its sensors are Gauss-Markov processes or constants.
"""

from __future__ import annotations

import math
from collections.abc import Sequence, Set
from ctypes import c_double
from functools import lru_cache
from typing import Any

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.relative_motion import cw_wrench
from chaserdock_protocol.scenario.navigation import NavigationErrors
from msgspec.structs import replace
from numpy.typing import NDArray

from chaserdock_controller.bodies.body_shape import RATIOS, SHAPE
from chaserdock_controller.interfaces import AppliedImpulse

from . import kernels
from .kernels import CHASER_MEAN, TARGET_MEAN
from .motion_models import free_shape, process_noise, steady_motion
from .parameters import JointParameters
from .star import ChasersGivenTarget, assembled, taken_apart
from .state import (
    ATTITUDE_DRIFT,
    CENTRE,
    EXTRA,
    FOCAL,
    FORCE,
    GYRO_BIAS,
    POSITION_DRIFT,
    SHIFT,
    TARGET,
    TORQUE,
    TURN,
    VIEW,
    JointState,
    mean_fields,
    packed,
)

_YOUNG_S = 1.0
"""Least age, s, of a shape in the rate at which its measurements lose weight."""


def predict(
    state: JointState,
    time_ns: int,
    given: Sequence[AppliedImpulse],
    p: JointParameters,
    latched: Set[int] = frozenset(),
    nominal_s: float = math.inf,
) -> JointState:
    """Propagate the state to ``time_ns``.

    ``given``: what the actuators of each chaser gave since then. ``nominal_s``: the time that it
    covers, the last before ``time_ns``; before that the command is unknown. Raises ValueError for
    an earlier time.
    """
    dt = (time_ns - state.time_ns) * 1e-9
    if dt == 0.0:
        return state
    if dt < 0.0:
        raise ValueError(f"cannot predict backwards, from {state.time_ns} to {time_ns} ns")
    moved, target_transition = _predict_target(state, dt, p)
    n, orbital = state.chasers, np.zeros((state.chasers, 6))
    unknown_s = max(0.0, dt - nominal_s)
    applied = np.array([(g.impulse, g.moment, g.magnitude) for g in given], dtype=float)
    applied[:, 1] -= applied[:, 0] * (unknown_s / 2.0)  # about the middle of dt
    mean = packed(moved)
    if p.mean_motion_rad_s:
        for i, row in enumerate(mean[TARGET_MEAN:].reshape(n, CHASER_MEAN)[:, :13]):
            orbital[i] = cw_wrench(p.mean_motion_rad_s, row, p.body.mass_kg, p.inertia)
    noise = np.zeros((TARGET, TARGET))
    if state.target_known:
        noise = _target_noise(dt, p, bool(latched))
    motion = _motion(dt, p, unknown_s)
    chasers = (
        applied,
        orbital,
        np.array([math.exp(-dt / p.sighting_noise(k).view_time_s) for k in state.markers.tolist()]),
        chaser_prior(p),
        state.alive.astype(np.int64),
        np.array([i in latched for i in range(n)], dtype=np.int64),
    )
    if state.given_target is not None:
        covariance, seen = _predict_star(state, target_transition, noise, dt, p)
        seen = _predict_given_target(seen, motion, chasers, mean)
        return replace(
            moved, time_ns=time_ns, covariance=covariance, given_target=seen, **mean_fields(mean)
        )
    covariance = kernels.predict(
        motion,
        np.ascontiguousarray(target_transition[:, :TARGET]),
        noise,
        *chasers,
        mean,
        state.covariance,
    )
    if state.ratio_information is not None:
        _couple_shape(covariance, target_transition[:, TARGET:])
        ratios = covariance[-SHAPE:, -SHAPE:][RATIOS, RATIOS]
        _fade_ratios(ratios, state.ratio_information, dt, state, p)
    return replace(moved, time_ns=time_ns, covariance=covariance, **mean_fields(mean))


def _predict_star(
    state: JointState, transition: Array, noise: Array, dt: float, p: JointParameters
) -> tuple[Array, ChasersGivenTarget]:
    """Return the target's covariance (H, H) after ``dt``, and the present errors of the chasers by
    the target's error then.
    """
    assert state.given_target is not None
    f, added = np.eye(len(state.covariance)), np.zeros_like(state.covariance)
    f[:TARGET], added[:TARGET, :TARGET] = transition, noise
    covariance = f @ state.covariance @ f.T
    if state.ratio_information is not None:
        ratios = covariance[-SHAPE:, -SHAPE:][RATIOS, RATIOS]
        before = ratios.copy()
        _fade_ratios(ratios, state.ratio_information, dt, state, p)
        added[-SHAPE:, -SHAPE:][RATIOS, RATIOS] = ratios - before
    covariance[:TARGET, :TARGET] += noise
    covariance = 0.5 * (covariance + covariance.T)
    return covariance, state.given_target.after(state.covariance, f, added, covariance)


def _predict_given_target(
    before: ChasersGivenTarget,
    motion: kernels.MotionParameters,
    chasers: tuple[NDArray[Any], ...],
    mean: Array,
) -> ChasersGivenTarget:
    """Return the errors of the chasers by the target's after their own motion, and predict their
    ``mean`` in place. ``chasers``: arguments of ``kernels.predict`` by chaser.

    The kernel transforms gains as it does covariances with a target that rests.
    """
    each = mean[TARGET_MEAN:].reshape(-1, CHASER_MEAN)
    gains, rests = np.empty_like(before.gains), np.empty_like(before.covariances)
    given, orbital, fade_view, prior, alive, latched = chasers
    hub = np.zeros((gains.shape[2],) * 2)
    for i, own in enumerate(each):
        k, one = slice(i, i + 1), np.concatenate([mean[:TARGET_MEAN], own])
        moved = kernels.predict(
            motion, np.eye(TARGET), np.zeros((TARGET, TARGET)), given[k], orbital[k], fade_view[k],
            prior, alive[k], latched[k], one, assembled(hub, *before.of(i)),
        )  # fmt: skip
        own[:] = one[TARGET_MEAN:]
        _, gains[i], rests[i] = taken_apart(moved)
    return ChasersGivenTarget(gains, rests)


def _motion(dt: float, p: JointParameters, unknown_s: float) -> kernels.MotionParameters:
    """Return the kernel's parameters for a prediction over ``dt``, of which the command is unknown
    for ``unknown_s``.
    """
    n = p.navigation
    return kernels.MotionParameters(
        dt,
        p.body.mass_kg,
        (c_double * 3)(*p.inertia),
        p.mean_motion_rad_s,
        math.exp(-dt / n.position_drift_time_s) if n.position_drift_m > 0.0 else 1.0,
        math.exp(-dt / n.attitude_drift_time_s) if n.attitude_drift_rad > 0.0 else 1.0,
        unknown_s,
        p.control_force_share,
        p.control_torque_share,
        p.control_arm_m,
        p.force_max_N,
        p.torque_max_N_m,
        p.disturbance_force_N_sqrt_s,
        p.disturbance_torque_N_m_sqrt_s,
        p.latched_acceleration_m_s2,
        p.latched_acceleration_rad_s2,
    )


def predict_target(state: JointState, time_ns: int, p: JointParameters) -> tuple[JointState, Array]:
    """Predict only the target: return the state with its mean at ``time_ns``, and its covariance
    (12, 12) then.
    """
    dt = (time_ns - state.time_ns) * 1e-9
    if dt == 0.0:
        return state, state.covariance[:TARGET, :TARGET].copy()
    moved, f = _predict_target(state, dt, p)
    return moved, f @ target_covariance(state) @ f.T + _target_noise(dt, p)


def target_covariance(state: JointState) -> Array:
    """Return the covariance (12, 12) of the target's motion, or (20, 20) of its motion and
    shape.
    """
    if state.shape is None:
        return state.covariance[:TARGET, :TARGET]
    size = len(state.covariance)
    part = np.concatenate([np.arange(TARGET), np.arange(size - SHAPE, size)])
    return state.covariance[np.ix_(part, part)]


def _predict_target(state: JointState, dt: float, p: JointParameters) -> tuple[JointState, Array]:
    """Return the state with the target advanced by ``dt``, and the transition: (12, 12), or (12,
    20) with a shape.
    """
    if not state.target_known:
        return state, np.eye(TARGET, TARGET if state.shape is None else TARGET + SHAPE)
    motion = (state.position_m, state.velocity_m_s, state.q_wxyz, state.omega_rad_s)
    if state.shape is None:
        centre = np.array(p.target.centre_of_mass_trf_m)
        (position, velocity, q, omega), f = steady_motion(motion, dt, centre)
    else:
        (position, velocity, q, omega), f = free_shape(motion, dt, state.shape, p.mean_motion_rad_s)
    return replace(
        state, position_m=position, velocity_m_s=velocity, q_wxyz=q, omega_rad_s=omega
    ), f


def _target_noise(dt: float, p: JointParameters, is_stack: bool = False) -> Array:
    """Return the process noise (12, 12) of the target. ``is_stack``: include disturbances by
    latched chasers.
    """
    linear, angular = p.target_noise[p.target.motion_model]
    if is_stack:
        linear, angular = (
            math.hypot(linear, p.stack_noise[0]),
            math.hypot(angular, p.stack_noise[1]),
        )
    return _process_noise(dt, linear**2, angular**2)


_process_noise = lru_cache(maxsize=16)(process_noise)
"""Process noise, cached for the few durations that occur. Callers must not change the result."""


def _couple_shape(covariance: Array, by_shape: Array) -> None:
    """Add to a predicted covariance, in place, the effect of the uncertain shape on the target's
    motion. ``by_shape`` (12, 8): the transition.
    """
    covariance[:TARGET] += by_shape @ covariance[-SHAPE:]
    covariance[:, :TARGET] += covariance[:, -SHAPE:] @ by_shape.T


def _fade_ratios(
    covariance: Array, information: Array, dt: float, state: JointState, p: JointParameters
) -> None:
    """Reduce, in place, the weight of past measurements of the inertia ratios since the shape was
    started.

    They were linearized at earlier estimates, at first far from the truth. After a time t since the
    start, what was measured at the time s weighs (s / t)^``ratio_memory``. The prior
    ``information`` (5, 5) keeps its weight.
    """
    age = max((state.time_ns - state.shape_ns) * 1e-9, _YOUNG_S)
    share = p.ratio_memory * dt / (age + dt)
    covariance += share * (covariance - covariance @ information @ covariance)


def disturbance(state: JointState, i: int, wrench: Array, p: JointParameters) -> Array:
    """Return the wrench (6,) that acts on chaser ``i`` in addition to the commanded ``wrench``, for
    a body with its centre of mass at the origin of CRF.
    """
    total, centre_m, omega = (
        wrench + state.extra[i, :6],
        state.of(i, CENTRE).copy(),
        state.omegas_rad_s[i].copy(),
    )
    at_origin = kernels.wrench_at_origin(
        total, centre_m, omega, p.body.mass_kg, np.array(p.inertia)
    )
    return at_origin - wrench


def chaser_prior(p: JointParameters) -> Array:
    """Return the initial variances (EXTRA,) of a chaser's additive states."""
    return _prior_of(
        p.navigation,
        p.disturbance_force_N,
        p.disturbance_torque_N_m,
        p.centre_of_mass_m,
        p.camera_turn_rad,
    ).copy()


@lru_cache(maxsize=8)
def _prior_of(
    n: NavigationErrors, force_N: float, torque_N_m: float, centre_m: float, turn: float
) -> Array:
    prior = np.zeros(EXTRA)
    for part, sigma in (
        (FORCE, force_N),
        (TORQUE, torque_N_m),
        (CENTRE, centre_m),
        (POSITION_DRIFT, math.hypot(n.position_drift_m, n.position_bias_m)),
        (ATTITUDE_DRIFT, math.hypot(n.attitude_drift_rad, n.attitude_bias_rad)),
        (GYRO_BIAS, n.gyro_bias_rad_s),
        (TURN, turn),
        (SHIFT, n.camera_shift_m),
        (FOCAL, n.camera_focal_share),
        (VIEW, 1.0),
    ):
        prior[part.start - 12 : part.stop - 12] = sigma**2
    return prior
