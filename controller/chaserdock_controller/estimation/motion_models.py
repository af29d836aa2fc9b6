"""Motion models of the target: the mean one step on, and the transition matrix of the error state.

Error state (12): position and velocity (WRF), dtheta and omega (TRF), with q_true = q (x) exp(dtheta).
Process noise is white acceleration and white angular acceleration, given as spectral densities.
"""

from __future__ import annotations

import math

import numpy as np

from .so3 import qexp, qmatrix, qmul, qnormalize, right_jacobian, skew
from .types import Array

MODELS = ("constant_rates", "torque_free")
_EYE3 = np.eye(3)


def constant_rates(q_wxyz: Array, omega_rad_s: Array, dt_s: float) -> tuple[Array, Array, Array]:
    """Attitude (4,), body rate (3,) and the (6, 6) transition of (dtheta, domega) after ``dt_s`` at a
    constant body rate; exact. Source: Sola 2017, section 5.4 (right Jacobian for the rate column)."""
    phi = omega_rad_s * dt_s
    step = qexp(phi)
    transition = np.zeros((6, 6))
    transition[:3, :3] = qmatrix(step).T
    transition[:3, 3:] = right_jacobian(phi) * dt_s
    transition[3:, 3:] = _EYE3
    return qnormalize(qmul(q_wxyz, step)), omega_rad_s, transition


def torque_free(
    q_wxyz: Array, omega_rad_s: Array, dt_s: float, inertia: Array, inertia_inverse: Array
) -> tuple[Array, Array, Array]:
    """As ``constant_rates`` for a free rigid body: I omega' = (I omega) x omega.

    inertia (3, 3) in TRF axes, to any common factor; inertia_inverse (3, 3). State and variational
    equations are integrated together by RK4, in steps of at most 0.5 s and 0.1 rad.
    """
    n = max(1, math.ceil(abs(dt_s) * max(2.0, 10.0 * math.sqrt(float(omega_rad_s @ omega_rad_s)))))
    h = dt_s / n
    q, w, transition = q_wxyz, omega_rad_s, np.eye(6)

    def slope(q: Array, w: Array, t: Array) -> tuple[Array, Array, Array]:
        momentum = inertia @ w
        cross = skew(w)
        jacobian = np.zeros((6, 6))
        jacobian[:3, :3] = -cross
        jacobian[:3, 3:] = _EYE3
        jacobian[3:, 3:] = inertia_inverse @ (skew(momentum) - cross @ inertia)
        rate = np.array([0.0, *w.tolist()])
        return 0.5 * qmul(q, rate), -(inertia_inverse @ (cross @ momentum)), jacobian @ t

    for _ in range(n):
        q1, w1, t1 = slope(q, w, transition)
        q2, w2, t2 = slope(q + 0.5 * h * q1, w + 0.5 * h * w1, transition + 0.5 * h * t1)
        q3, w3, t3 = slope(q + 0.5 * h * q2, w + 0.5 * h * w2, transition + 0.5 * h * t2)
        q4, w4, t4 = slope(q + h * q3, w + h * w3, transition + h * t3)
        q = qnormalize(q + h / 6.0 * (q1 + 2.0 * q2 + 2.0 * q3 + q4))
        w = w + h / 6.0 * (w1 + 2.0 * w2 + 2.0 * w3 + w4)
        transition = transition + h / 6.0 * (t1 + 2.0 * t2 + 2.0 * t3 + t4)
    return q, w, transition


def to_centre(q_wxyz: Array, omega_rad_s: Array, centre_trf_m: Array) -> Array:
    """Matrix (12, 12) from the errors of TRF's origin to those of a point ``centre_trf_m`` (3,) fixed in TRF.

    The point is at p + R c and moves at v + R (omega x c); dtheta and omega stay.
    """
    rotation, turning = qmatrix(q_wxyz), np.cross(omega_rad_s, centre_trf_m)
    m = np.eye(12)
    m[0:3, 6:9] = -rotation @ skew(centre_trf_m)
    m[3:6, 6:9] = -rotation @ skew(turning)
    m[3:6, 9:12] = -rotation @ skew(centre_trf_m)
    return m


def about_centre(
    before: tuple[Array, Array, Array, Array],
    after: tuple[Array, Array],
    transition: Array,
    centre_trf_m: Array,
    dt_s: float,
) -> tuple[Array, Array, Array]:
    """Position, velocity (3,) of TRF's origin and transition (12, 12) where the centre of mass is elsewhere.

    ``before``: position, velocity, attitude, rate; ``after``: attitude and rate ``dt_s`` on; ``transition`` (12, 12)
    of a body whose centre of mass is TRF's origin. The centre of mass moves on at its constant velocity.
    """
    position, velocity, q, omega = before
    q_after, omega_after = after
    arm, arm_after = qmatrix(q) @ centre_trf_m, qmatrix(q_after) @ centre_trf_m
    turning = qmatrix(q) @ np.cross(omega, centre_trf_m)
    centre_velocity = velocity + turning
    there = position + arm + centre_velocity * dt_s
    back = np.linalg.inv(to_centre(q_after, omega_after, centre_trf_m))
    return (
        there - arm_after,
        centre_velocity - qmatrix(q_after) @ np.cross(omega_after, centre_trf_m),
        back @ transition @ to_centre(q, omega, centre_trf_m),
    )


def process_noise(dt_s: float, acceleration_density: float, angular_density: float) -> Array:
    """Covariance (12, 12) that white noise adds in ``dt_s``.

    acceleration_density in (m/s^2)^2/Hz, angular_density in (rad/s^2)^2/Hz (the squares of the
    parameters). The turn of the axes within the step is left out: it changes the attitude block by
    less than (|omega| dt)^2 / 12 of itself and never makes it too small.
    """
    q = np.zeros((12, 12))
    d3, d2, d1 = dt_s**3 / 3.0, dt_s**2 / 2.0, dt_s
    for block, density in ((0, acceleration_density), (6, angular_density)):
        i, j = slice(block, block + 3), slice(block + 3, block + 6)
        q[i, i] = density * d3 * _EYE3
        q[i, j] = q[j, i] = density * d2 * _EYE3
        q[j, j] = density * d1 * _EYE3
    return q
