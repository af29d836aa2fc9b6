# SPDX-License-Identifier: Apache-2.0
"""Motion of the target and the chasers between ticks, and the growth of the covariance. Pure functions.

A chaser is a rigid body under its commanded wrench and an unknown, slowly changing disturbance (F_d, T_d), both in body axes:
I omega' = T + T_d - c x (F + F_d) - omega x I omega, v' = C ((F + F_d) / m - omega' x c - omega x (omega x c)), where the
origin of CRF is at -c from the centre of mass.
In an orbit, the forces and torques of the Hill frame act as well (relative_motion.py). Its sensor errors
are Gauss-Markov processes or constants.
"""

from __future__ import annotations

import math
from collections.abc import Sequence, Set
from dataclasses import replace

import numpy as np
from chaserdock_models import rotations
from chaserdock_models import scalar_rotations as so3
from chaserdock_models.arrays import Array
from chaserdock_models.relative_motion import cw_matrix, cw_wrench
from chaserdock_models.rigid_body import newton_euler, rk4_step

from chaserdock_controller.estimation.body_shape import RATIOS, SHAPE
from chaserdock_controller.estimation.motion_models import free_shape, process_noise, propagate_target

from .parameters import JointParameters
from .state import (
    ATTITUDE,
    ATTITUDE_DRIFT,
    CENTRE,
    CHASER,
    EXTRA,
    FOCAL,
    FORCE,
    GYRO_BIAS,
    MOTION,
    POSITION,
    POSITION_DRIFT,
    RATE,
    SHIFT,
    TARGET,
    TORQUE,
    TURN,
    VELOCITY,
    VIEW,
    JointState,
    block,
)

_EYE3 = np.eye(3)
_YOUNG_S = 1.0
"""Least age of a shape in the rate at which measurements of it fade, s."""


def predict(
    state: JointState,
    time_ns: int,
    impulses: Array,
    p: JointParameters,
    latched: Set[int] = frozenset(),
    nominal_s: float = math.inf,
) -> JointState:
    """Propagate the state to ``time_ns``.

    ``impulses`` (N, 6): N s and N m s, body axes, that the actuators gave since then. ``nominal_s``: the time that they
    cover; beyond it the command is unknown. Raises ValueError for an earlier time.
    """
    dt = (time_ns - state.time_ns) * 1e-9
    if dt == 0.0:
        return state
    if dt < 0.0:
        raise ValueError(f"cannot predict backwards, from {state.time_ns} to {time_ns} ns")
    moved, target_transition = _predict_target(state, dt, p)
    n = state.chasers
    wrenches = impulses / dt + state.extra[:, :6]
    centres = state.extra[:, CENTRE.start - 12 : CENTRE.stop - 12].copy()
    for i in latched:
        wrenches[i] = centres[i] = 0.0
    rows = np.concatenate(
        [state.positions_m, state.velocities_m_s, state.attitudes_wxyz, state.omegas_rad_s], axis=1
    )
    totals = [at_origin(wrenches[i], centres[i], state.omegas_rad_s[i], p) for i in range(n)]
    mass, inertia = p.body.mass_kg, p.inertia
    for i, total in enumerate(totals):
        if p.mean_motion_rad_s:
            total = total + cw_wrench(p.mean_motion_rad_s, rows[i], mass, inertia)
        u = total.tolist()
        rows[i] = rk4_step(lambda y, u=u: newton_euler(y, u, mass, inertia), rows[i], dt)
    fade = _fading(state, dt, p)
    motion = _motion_transitions(state, wrenches, totals, centres, dt, p)
    covariance = _transform(target_transition, motion, fade, state.covariance)
    _add_noise(covariance, state, impulses, dt, p, latched, fade, max(0.0, dt - nominal_s))
    if state.ratio_information is not None:
        ratios = covariance[-SHAPE:, -SHAPE:][RATIOS, RATIOS]
        _fade_ratios(ratios, state.ratio_information, dt, state, p)
    return replace(
        moved,
        time_ns=time_ns,
        positions_m=rows[:, 0:3],
        velocities_m_s=rows[:, 3:6],
        attitudes_wxyz=rotations.normalize(rows[:, 6:10]),
        omegas_rad_s=rows[:, 10:13],
        extra=state.extra * fade[:, 12:],
        covariance=covariance,
    )


def predict_target(state: JointState, time_ns: int, p: JointParameters) -> tuple[JointState, Array]:
    """Return the state with the target's mean at ``time_ns``, and the target's covariance (12, 12) then."""
    dt = (time_ns - state.time_ns) * 1e-9
    if dt == 0.0:
        return state, state.covariance[:TARGET, :TARGET].copy()
    moved, f = _predict_target(state, dt, p)
    return moved, f @ target_covariance(state) @ f.T + _target_noise(dt, p)


def target_covariance(state: JointState) -> Array:
    """Return the covariance (12, 12) of the target's motion, or (20, 20) of its motion and shape."""
    if state.shape is None:
        return state.covariance[:TARGET, :TARGET]
    size = len(state.covariance)
    part = np.concatenate([np.arange(TARGET), np.arange(size - SHAPE, size)])
    return state.covariance[np.ix_(part, part)]


def _predict_target(state: JointState, dt: float, p: JointParameters) -> tuple[JointState, Array]:
    """Return the state with the target after ``dt``, and the transition (12, 12), or (12, 20) if its shape is estimated."""
    if not state.target_known:
        return state, np.eye(TARGET, TARGET if state.shape is None else TARGET + SHAPE)
    motion = (state.position_m, state.velocity_m_s, state.q_wxyz, state.omega_rad_s)
    if state.shape is None:
        (position, velocity, q, omega), f = propagate_target(*motion, dt, p.target)
    else:
        (position, velocity, q, omega), f = free_shape(motion, dt, state.shape, p.mean_motion_rad_s)
    return replace(state, position_m=position, velocity_m_s=velocity, q_wxyz=q, omega_rad_s=omega), f


def _target_noise(dt: float, p: JointParameters) -> Array:
    linear, angular = p.target_noise[p.target.motion_model]
    return process_noise(dt, linear**2, angular**2)


def _fade_ratios(
    covariance: Array, information: Array, dt: float, state: JointState, p: JointParameters
) -> None:
    """Let the filter forget, in place, a part of what measurements told of the ratios of the inertia since the shape started.

    They were linearized at an earlier estimate, which was far from the truth at first: after the time t, what was measured at the
    time s weighs (s / t)^``ratio_memory``. The ``information`` (5, 5) from before the measurements is kept.
    """
    age = max((state.time_ns - state.shape_ns) * 1e-9, _YOUNG_S)
    share = p.ratio_memory * dt / (age + dt)
    covariance += share * (covariance - covariance @ information @ covariance)


def _fading(state: JointState, dt: float, p: JointParameters) -> Array:
    """Return the factors (N, CHASER) by which the components of the chasers decay in ``dt``; 1 where they do not."""
    fade, n = np.ones((state.chasers, CHASER)), p.navigation
    for part, sigma, time_s in (
        (POSITION_DRIFT, n.position_drift_m, n.position_drift_time_s),
        (ATTITUDE_DRIFT, n.attitude_drift_rad, n.attitude_drift_time_s),
    ):
        fade[:, part] = math.exp(-dt / time_s) if sigma > 0.0 else 1.0
    for i, markers in enumerate(state.markers.tolist()):
        fade[i, VIEW] = math.exp(-dt / p.sighting_noise(markers).view_time_s)
    return fade


def at_origin(wrench: Array, centre_m: Array, omega: Array, p: JointParameters) -> Array:
    """Return the wrench (6,) that moves a body with its centre of mass at the origin of CRF as ``wrench`` moves the chaser's
    origin; ``centre_m`` (3,): its centre of mass, CRF; ``omega`` (3,) rad/s."""
    if not centre_m.any():
        return wrench
    torque = wrench[3:] - so3.skew(centre_m) @ wrench[:3]
    alpha = _angular_acceleration(torque, omega, p)
    turning = so3.skew(omega)
    acceleration = so3.skew(alpha) @ centre_m + turning @ (turning @ centre_m)
    return np.concatenate([wrench[:3] - p.body.mass_kg * acceleration, torque])


def _angular_acceleration(torque: Array, omega: Array, p: JointParameters) -> Array:
    inertia = np.array(p.inertia)
    return (torque - so3.skew(omega) @ (inertia * omega)) / inertia


def disturbance(state: JointState, i: int, wrench: Array, p: JointParameters) -> Array:
    """Return the wrench (6,) that acts on chaser ``i``, as a body with its centre of mass at the origin of CRF, in addition to
    the commanded ``wrench``."""
    total = wrench + state.extra[i, :6]
    return at_origin(total, state.of(i, CENTRE), state.omegas_rad_s[i], p) - wrench


def _motion_transitions(
    state: JointState,
    wrenches: Array,
    totals: Sequence[Array],
    centres_m: Array,
    dt: float,
    p: JointParameters,
) -> Array:
    """Return the transition matrices (N, MOTION, MOTION) of the errors of motion and disturbance, to second order in ``dt``.

    ``totals``: the wrenches (6,) ``at_origin``.
    """
    n, inertia = state.chasers, np.array(p.inertia)
    a = np.zeros((n, MOTION, MOTION))
    for i in range(n):
        c, w = so3.to_matrix(state.attitudes_wxyz[i]), state.omegas_rad_s[i]
        centre, turning = so3.skew(centres_m[i]), so3.skew(w)
        total = totals[i]
        alpha = _angular_acceleration(total[3:], w, p)
        a[i, ATTITUDE, ATTITUDE] = -turning
        a[i, RATE, RATE] = (so3.skew(inertia * w) - turning * inertia) / inertia[:, None]
        a[i, RATE, FORCE] = -centre / inertia[:, None]
        a[i, RATE, TORQUE] = np.diag(1.0 / inertia)
        a[i, RATE, CENTRE] = so3.skew(wrenches[i, :3]) / inertia[:, None]
        a[i, VELOCITY] = c @ centre @ a[i, RATE]
        a[i, VELOCITY, ATTITUDE] = -c @ so3.skew(total[:3]) / p.body.mass_kg
        a[i, VELOCITY, RATE] += c @ (so3.skew(turning @ centres_m[i]) + turning @ centre)
        a[i, VELOCITY, FORCE] += c / p.body.mass_kg
        a[i, VELOCITY, CENTRE] -= c @ (so3.skew(alpha) + turning @ turning)
    a[:, POSITION, VELOCITY] = a[:, ATTITUDE, RATE] = _EYE3
    if p.mean_motion_rad_s:
        cw = cw_matrix(p.mean_motion_rad_s)[3:]
        a[:, VELOCITY, POSITION] += cw[:, :3]
        a[:, VELOCITY, VELOCITY] += cw[:, 3:]
    a *= dt
    return np.eye(MOTION) + a + 0.5 * (a @ a)


def _transform(target: Array, motion: Array, fade: Array, covariance: Array) -> Array:
    """Return F P F' for the F of ``target`` (12, 12) and, for each chaser, ``motion`` (N, MOTION, MOTION) and the decay ``fade``
    (N, CHASER) of its other components. With ``target`` (12, 20) the target moves by its shape, too, which is constant."""
    n, size = len(motion), len(covariance)
    end = TARGET + CHASER * n

    def left(m: Array) -> Array:
        out = np.empty((size, size))
        np.matmul(target[:, :TARGET], m[:TARGET], out=out[:TARGET])
        if end < size:
            out[:TARGET] += target[:, TARGET:] @ m[end:]
            out[end:] = m[end:]
        before, after = (x[TARGET:end].reshape(n, CHASER, size) for x in (m, out))
        np.matmul(motion, before[:, :MOTION], out=after[:, :MOTION])
        np.multiply(before[:, MOTION:], fade[:, MOTION:, None], out=after[:, MOTION:])
        return out

    result = left(np.ascontiguousarray(left(covariance).T))
    result = result + result.T
    result *= 0.5
    return result


def _add_noise(
    covariance: Array,
    state: JointState,
    impulses: Array,
    dt: float,
    p: JointParameters,
    latched: Set[int],
    fade: Array,
    unknown_s: float,
) -> None:
    """Add the process noise of ``dt``, of which the command is unknown for ``unknown_s``, to the covariance in place."""
    if state.target_known:
        covariance[:TARGET, :TARGET] += _target_noise(dt, p)
    inertia, m = np.array(p.inertia), p.body.mass_kg
    drifts = (1.0 - fade[:, 12:] ** 2) * chaser_prior(p)
    drifts[:, 0:3] = p.disturbance_force_N_sqrt_s**2 * dt
    drifts[:, 3:6] = p.disturbance_torque_N_m_sqrt_s**2 * dt
    for i in np.flatnonzero(state.alive).tolist():
        force, torque = float(np.linalg.norm(impulses[i, :3])), np.abs(impulses[i, 3:])
        if i in latched:
            velocity = np.full(3, (p.latched_acceleration_m_s2 * dt) ** 2)
            omega = np.full(3, (p.latched_acceleration_rad_s2 * dt) ** 2)
        else:
            velocity = np.full(
                3, (p.control_force_share * force / m) ** 2 + (p.force_max_N * unknown_s / m) ** 2
            )
            omega = (p.control_torque_share * torque) ** 2 + (p.control_arm_m * force) ** 2
            omega = (omega + (p.torque_max_N_m * unknown_s) ** 2) / inertia**2
        noise = covariance[block(i), block(i)]
        # The impulse acts, on average, in the middle of the interval.
        for at, rate, variance in ((POSITION, VELOCITY, velocity), (ATTITUDE, RATE, omega)):
            a, r = np.arange(at.start, at.stop), np.arange(rate.start, rate.stop)
            noise[r, r] += variance
            noise[a, a] += variance * dt**2 / 3.0
            noise[a, r] += variance * dt / 2.0
            noise[r, a] += variance * dt / 2.0
        e = np.arange(12, CHASER)
        noise[e, e] += drifts[i] if i not in latched else np.concatenate([np.zeros(6), drifts[i, 6:]])


def chaser_prior(p: JointParameters) -> Array:
    """Return the prior variances (EXTRA,) of a chaser's additive states."""
    n, prior = p.navigation, np.zeros(EXTRA)
    for part, sigma in (
        (FORCE, p.disturbance_force_N),
        (TORQUE, p.disturbance_torque_N_m),
        (CENTRE, p.centre_of_mass_m),
        (POSITION_DRIFT, math.hypot(n.position_drift_m, n.position_bias_m)),
        (ATTITUDE_DRIFT, math.hypot(n.attitude_drift_rad, n.attitude_bias_rad)),
        (GYRO_BIAS, n.gyro_bias_rad_s),
        (TURN, p.camera_turn_rad),
        (SHIFT, n.camera_shift_m),
        (FOCAL, n.camera_focal_share),
        (VIEW, 1.0),
    ):
        prior[part.start - 12 : part.stop - 12] = sigma**2
    return prior
