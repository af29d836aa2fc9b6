# SPDX-License-Identifier: Apache-2.0
"""Relative motion in the Hill frame of an orbit (orbit.py).

Nonlinear: two-body gravity with differential J2, for the simulator. Linear, for prediction:
Clohessy and Wiltshire, Terminal Guidance System for Satellite Rendezvous, 1960; valid on a circular
orbit and for distances small against its radius.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Array
from .orbit import (
    EARTH_J2,
    EARTH_MU_M3_S2,
    EARTH_RADIUS_M,
    MAX_STEP_S,
    HillFrame,
    OrbitState,
    Scalars3,
    gravity,
    hill_frame,
)
from .rigid_body import rk4_step
from .scalar_rotations import rotated_components


def relative_acceleration(
    frame: HillFrame, position_m: Scalars3, velocity_m_s: Scalars3
) -> Scalars3:
    """Return the acceleration (3,) of a free body in the Hill frame, at this position and velocity
    (3,).

    In scalars, since the simulator calls it for every body in every physics step.
    """
    x, y, z = position_m
    u, v, w = velocity_m_s
    r = frame.radius_m
    a, _, c = frame.rate_rad_s
    da, _, dc = frame.rate_change_rad_s2
    # Gravity at R + rho minus that at R, without their cancellation (Battin's f(q)): q = |R +
    # rho|^2 / R^2 - 1.
    q = (2.0 * r * x + x * x + y * y + z * z) / (r * r)
    n2 = EARTH_MU_M3_S2 / r**3
    root = math.sqrt(1.0 + q)
    f = q * (3.0 + q * (3.0 + q)) / (1.0 + root * root * root)
    k = n2 / (root * root * root)
    gx, gy, gz = n2 * f * (r + x) / (root * root * root) - n2 * x, -k * y, -k * z
    if frame.j2:
        jx, jy, jz = _j2_difference(frame, x, y, z, q)
        gx, gy, gz = gx + jx, gy + jy, gz + jz
    # Coriolis, centrifugal and Euler terms of the rate (a, 0, c).
    ax = gx + 2.0 * c * v + dc * y + c * (c * x - a * z)
    ay = gy - 2.0 * (c * u - a * w) - (dc * x - da * z) + (a * a + c * c) * y
    az = gz - 2.0 * a * v - da * y - a * (c * x - a * z)
    return ax, ay, az


def _j2_difference(frame: HillFrame, x: float, y: float, z: float, q: float) -> Scalars3:
    """Return the acceleration of J2 at R + rho minus that at R, in the Hill frame; ``q``: |R +
    rho|^2 / R^2 - 1.
    """
    r = frame.radius_m
    px, py, pz = frame.pole
    k = -1.5 * frame.j2 * EARTH_MU_M3_S2 * EARTH_RADIUS_M**2 / r**4
    s0, bx = px, (r + x) / r
    s2 = 1.0 + q
    s1 = (px * (r + x) + py * y + pz * z) / r
    k1 = k / (s2 * s2 * math.sqrt(s2))
    near, far = 1.0 - 5.0 * s0 * s0, 1.0 - 5.0 * s1 * s1 / s2
    return (
        k1 * (far * bx + 2.0 * s1 * px) - k * (near + 2.0 * s0 * px),
        k1 * (far * y / r + 2.0 * s1 * py) - 2.0 * k * s0 * py,
        k1 * (far * z / r + 2.0 * s1 * pz) - 2.0 * k * s0 * pz,
    )


def relative_torque(
    frame: HillFrame, q_wxyz: Sequence[float], omega_rad_s: Scalars3, moments: Scalars3
) -> Scalars3:
    """Return the torque (3,), body axes, to add to a free rotation so that it is one in the Hill
    frame.

    ``q_wxyz`` (4,): principal axes to Hill frame. ``omega_rad_s`` (3,): rate against the Hill
    frame, body axes. The torque is the gravity gradient 3 mu / r^3 u x I u (u: away from the Earth)
    and the effect of the frame's rate W: with w = omega + W, I omega' = torque - w x I w + I (omega
    x W) - I W'.
    """
    w, x, y, z = q_wxyz
    ua, ub, uc = rotated_components(w, -x, -y, -z, 1.0, 0.0, 0.0)
    wa, wb, wc = rotated_components(w, -x, -y, -z, *frame.rate_rad_s)
    da, db, dc = rotated_components(w, -x, -y, -z, *frame.rate_change_rad_s2)
    a, b, c = omega_rad_s
    ia, ib, ic = moments
    ta, tb, tc = gravity_gradient(frame.radius_m, (ua, ub, uc), moments)
    # -(w x I w) minus the same for omega alone, which rigid-body integrators add themselves.
    ta -= (ic - ib) * ((b + wb) * (c + wc) - b * c)
    tb -= (ia - ic) * ((c + wc) * (a + wa) - c * a)
    tc -= (ib - ia) * ((a + wa) * (b + wb) - a * b)
    return (
        ta + ia * (b * wc - c * wb - da),
        tb + ib * (c * wa - a * wc - db),
        tc + ic * (a * wb - b * wa - dc),
    )


def gravity_gradient(radius_m: float, up: Scalars3, moments: Scalars3) -> Scalars3:
    """Return the torque (3,) of the gravity gradient, body axes. ``up`` (3,): unit vector away from
    the Earth, body axes.
    """
    k = 3.0 * EARTH_MU_M3_S2 / radius_m**3
    a, b, c = up
    ia, ib, ic = moments
    return k * (ic - ib) * b * c, k * (ia - ic) * c * a, k * (ib - ia) * a * b


def propagate_relative(
    orbit: OrbitState,
    position_m: ArrayLike,
    velocity_m_s: ArrayLike,
    duration_s: float,
    j2: float = EARTH_J2,
) -> tuple[Array, Array]:
    """Return position (3,) and velocity (3,) in an orbit's Hill frame of a free body after
    ``duration_s``, by RK4.
    """

    def derivative(s: Array) -> Array:
        frame = hill_frame(OrbitState(s[:3], s[3:6]), j2)
        x, y, z, u, v, w = s[6:].tolist()
        return np.concatenate(
            [s[3:6], gravity(s[:3], j2), s[9:], relative_acceleration(frame, (x, y, z), (u, v, w))]
        )

    y = np.concatenate(
        [orbit.position_m, orbit.velocity_m_s, np.ravel(position_m), np.ravel(velocity_m_s)]
    )
    count = max(1, math.ceil(abs(duration_s) / MAX_STEP_S))
    for _ in range(count):
        y = rk4_step(derivative, y, duration_s / count)
    return y[6:9], y[9:]


def cw_matrix(mean_motion_rad_s: float) -> Array:
    """Return the matrix (6, 6) of Clohessy-Wiltshire: d(position, velocity)/dt = matrix (position,
    velocity).
    """
    n = mean_motion_rad_s
    matrix = np.zeros((6, 6))
    matrix[:3, 3:] = np.eye(3)
    matrix[3, 0], matrix[5, 2] = 3.0 * n * n, -n * n
    matrix[3, 4], matrix[4, 3] = 2.0 * n, -2.0 * n
    return matrix


def cw_transition(mean_motion_rad_s: float, time_s: ArrayLike) -> Array:
    """Return the Clohessy-Wiltshire transition matrices (..., 6, 6) over ``time_s`` (...).

    A mean motion of 0 gives free motion. The closed form of Clohessy and Wiltshire; differences of
    nearly equal numbers are written without cancellation.
    """
    n, t = mean_motion_rad_s, np.asarray(time_s, dtype=float)
    phi = np.zeros((*t.shape, 6, 6))
    phi[..., range(6), range(6)] = 1.0
    if n == 0.0:
        phi[..., range(3), range(3, 6)] = t[..., None]
        return phi
    a = n * t
    s, c, versine = np.sin(a), np.cos(a), 2.0 * np.sin(0.5 * a) ** 2
    lag = _sine_lag(a)  # sin a - a
    phi[..., 0, 0], phi[..., 0, 3], phi[..., 0, 4] = 1.0 + 3.0 * versine, s / n, 2.0 * versine / n
    phi[..., 1, 0], phi[..., 1, 3], phi[..., 1, 4] = (
        6.0 * lag,
        -2.0 * versine / n,
        t + 4.0 * lag / n,
    )
    phi[..., 2, 2], phi[..., 2, 5] = c, s / n
    phi[..., 3, 0], phi[..., 3, 3], phi[..., 3, 4] = 3.0 * n * s, c, 2.0 * s
    phi[..., 4, 0], phi[..., 4, 3], phi[..., 4, 4] = (
        -6.0 * n * versine,
        -2.0 * s,
        1.0 - 4.0 * versine,
    )
    phi[..., 5, 2], phi[..., 5, 5] = -n * s, c
    return phi


def cw_response(mean_motion_rad_s: float, time_s: ArrayLike) -> Array:
    """Return the states (..., 6, 3) that a constant acceleration of 1 m/s^2 along each axis gives a
    body at rest in the origin after ``time_s`` (...): the integral of ``cw_transition``.

    A mean motion of 0 gives free motion.
    """
    n, t = mean_motion_rad_s, np.asarray(time_s, dtype=float)
    response = np.zeros((*t.shape, 6, 3))
    response[..., 3:, :] = cw_transition(n, t)[..., :3, 3:]
    if n == 0.0:
        response[..., range(3), range(3)] = 0.5 * np.square(t)[..., None]
        return response
    raised = 2.0 * np.square(np.sin(0.5 * n * t) / n)
    aside = -2.0 * _sine_lag(n * t) / (n * n)
    response[..., 0, 0], response[..., 0, 1] = raised, aside
    response[..., 1, 0], response[..., 1, 1] = -aside, 4.0 * raised - 1.5 * np.square(t)
    response[..., 2, 2] = raised
    return response


def cw_wrench(mean_motion_rad_s: float, state: Array, mass_kg: float, moments: Scalars3) -> Array:
    """Return the wrench (6,) that moves a body in free space as a circular orbit moves it in Hill
    axes.

    Force and torque in body axes. ``state`` (13,): position, velocity, attitude, rate as in
    ``rigid_body``. ``moments``: principal, along the body's axes.
    """
    n = mean_motion_rad_s
    frame = HillFrame(
        axes=np.eye(3),
        radius_m=(EARTH_MU_M3_S2 / (n * n)) ** (1.0 / 3.0),
        speed_m_s=(0.0, 0.0, 0.0),
        rate_rad_s=(0.0, 0.0, n),
        rate_change_rad_s2=(0.0, 0.0, 0.0),
        pole=(0.0, 0.0, 1.0),
        j2=0.0,
    )
    w, x, y, z, a, b, c = state[6:].tolist()
    force = mass_kg * cw_acceleration(n, state[:3], state[3:6])
    torque = relative_torque(frame, (w, x, y, z), (a, b, c), moments)
    return np.array([*rotated_components(w, -x, -y, -z, *force.tolist()), *torque])


def cw_acceleration(
    mean_motion_rad_s: float, position_m: ArrayLike, velocity_m_s: ArrayLike
) -> Array:
    """Return the accelerations (..., 3) of Clohessy-Wiltshire at positions (..., 3) and velocities
    (..., 3).
    """
    state = np.concatenate(
        [np.asarray(position_m, dtype=float), np.asarray(velocity_m_s, dtype=float)], axis=-1
    )
    return state @ cw_matrix(mean_motion_rad_s)[3:].T


def _sine_lag(angle: Array) -> Array:
    """Return sin(angle) - angle; a series where the difference would lose digits."""
    square = angle * angle
    series = (
        -angle
        * square
        / 6.0
        * (1.0 - square / 20.0 * (1.0 - square / 42.0 * (1.0 - square / 72.0)))
    )
    return np.where(np.abs(angle) < 0.1, series, np.sin(angle) - angle)
