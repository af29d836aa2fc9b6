# SPDX-License-Identifier: Apache-2.0
"""Motion models of the target: prediction of the mean, and transition matrix of the error state.

Error state (12): position and velocity (WRF), dtheta and omega (TRF), with q_true = q (x)
exp(dtheta). Process noise is white acceleration and white angular acceleration, given as spectral
densities.
"""

from __future__ import annotations

import math

import numpy as np
from chaserdock_models import rotations
from chaserdock_models import scalar_rotations as so3
from chaserdock_models.arrays import Array
from chaserdock_models.rigid_body import rk4_step

from chaserdock_controller.bodies.body_shape import RATIO_BASIS, SHAPE, BodyShape

_EYE3, _EYE12, _ZERO3 = np.eye(3), np.eye(12), np.zeros(3)


def constant_rates(q_wxyz: Array, omega_rad_s: Array, dt_s: float) -> tuple[Array, Array, Array]:
    """Return attitude (4,), body rate (3,) and the (6, 6) transition of (dtheta, domega) after
    ``dt_s`` at a constant body rate (exact). Source: Sola 2017, section 5.4 (right Jacobian for the
    rate column)."""
    phi = omega_rad_s * dt_s
    step = so3.exp(phi)
    transition = np.zeros((6, 6))
    transition[:3, :3] = so3.to_matrix(step).T
    transition[:3, 3:] = so3.right_jacobian(phi) * dt_s
    transition[3:, 3:] = _EYE3
    return so3.normalize(so3.multiply(q_wxyz, step)), omega_rad_s, transition


def free_shape(
    motion: tuple[Array, Array, Array, Array],
    dt_s: float,
    shape: BodyShape,
    mean_motion_rad_s: float = 0.0,
) -> tuple[tuple[Array, Array, Array, Array], Array]:
    """Return position, velocity, attitude and rate of TRF after ``dt_s``, and the transition (12,
    20) by their errors and the error of ``shape``.

    The body rotates freely and its centre of mass moves at constant velocity.
    ``mean_motion_rad_s``: WRF turns at this rate about its Z axis, as the Hill frame of a circular
    orbit does, and the gravity gradient acts.
    """
    position, velocity, q, omega = motion
    q_after, omega_after, turned = _rotation(q, omega, dt_s, shape, mean_motion_rad_s)
    f = np.zeros((12, 12 + SHAPE))
    f[0:12, 0:12] = _EYE12
    f[0, 3] = f[1, 4] = f[2, 5] = dt_s
    f[6:12, 6:17] = turned
    c = shape.centre_m
    r, r_after = so3.to_matrix(q), so3.to_matrix(q_after)
    spin, spin_after = so3.skew(omega), so3.skew(omega_after)
    centre_velocity = velocity + r @ (spin @ c)
    centre = position + r @ c + centre_velocity * dt_s
    # Errors of TRF's origin are mapped to those of the centre of mass (there), and back. The
    # inverse of such a matrix is 2 - itself.
    there, back = to_centre(q, omega, c), 2.0 * _EYE12 - to_centre(q_after, omega_after, c)
    by_centre = f[:, 0:3] @ r + f[:, 3:6] @ (r @ spin)
    by_centre[0:3] -= r_after
    by_centre[3:6] -= r_after @ spin_after
    f[:, 0:12] = f[:, 0:12] @ there
    f[:, 17:20] = by_centre
    position_after = centre - r_after @ c
    return (
        position_after,
        centre_velocity - r_after @ (spin_after @ c),
        q_after,
        omega_after,
    ), back @ f


def _rotation(
    q_wxyz: Array, omega_rad_s: Array, dt_s: float, shape: BodyShape, mean_motion_rad_s: float
) -> tuple[Array, Array, Array]:
    """Return attitude, rate, and the transition (6, 11) of (dtheta, domega) by themselves and by
    the inertia ratios.

    W is the rate of WRF in TRF axes, with W' = -omega x W. The body turns in inertial space at
    Omega = omega + W: I Omega' = T - Omega x I Omega, omega' = Omega' + omega x W, with the gravity
    gradient T = 3 n^2 u x I u and u away from the Earth. The transition neglects the change of T
    with an error (at most 4e-6 1/s^2).

    Attitude and rate: RK4 in steps of at most 0.5 s and 0.1 rad. Transition of a step: third order,
    with the derivatives in its middle.
    """
    steps = max(
        1, math.ceil(abs(dt_s) * max(2.0, 10.0 * math.sqrt(float(omega_rad_s @ omega_rad_s))))
    )
    inertia, n, h = shape.inertia, mean_motion_rad_s, dt_s / steps
    inverse = np.linalg.inv(inertia)

    def frame(q: Array) -> tuple[Array, Array]:
        """Return W and T."""
        if n == 0.0:
            return _ZERO3, _ZERO3
        axes = so3.to_matrix(q)
        return n * axes[2], 3.0 * n * n * (so3.skew(axes[0]) @ (inertia @ axes[0]))

    def derivative(y: Array) -> Array:
        w = y[4:]
        turning, torque = frame(y[:4])
        total = w + turning
        alpha = inverse @ (torque - so3.skew(total) @ (inertia @ total))
        q_rate = 0.5 * so3.multiply(y[:4], np.array([0.0, *w.tolist()]))
        return np.concatenate([q_rate, alpha if n == 0.0 else alpha + so3.skew(w) @ turning])

    y, transition = np.concatenate([q_wxyz, omega_rad_s]), np.eye(6, 11)
    for _ in range(steps):
        middle = y + 0.5 * h * derivative(y)
        y = rk4_step(derivative, y, h)
        y[:4] = so3.normalize(y[:4])
        middle[4:] = 0.5 * (middle[4:] + y[4:] - 0.5 * h * derivative(y)[4:])
        w = middle[4:]
        turning, torque = frame(so3.normalize(middle[:4]))
        total = w + turning
        spin, momentum = so3.skew(total), inertia @ total
        alpha = inverse @ (torque - spin @ momentum)
        a = np.zeros((6, 6))
        a[:3, :3] = -so3.skew(w)
        a[:3, 3:] = _EYE3
        a[3:, 3:] = inverse @ (so3.skew(momentum) - spin @ inertia)
        if n:
            turned = so3.skew(turning)
            a[3:, :3] = (a[3:, 3:] + so3.skew(w)) @ turned
            a[3:, 3:] -= turned
        a *= h
        change = a @ transition
        change[3:, 6:] -= h * (inverse @ (RATIO_BASIS @ alpha + (RATIO_BASIS @ total) @ spin.T).T)
        second = a @ change
        transition = transition + change + 0.5 * second + (a @ second) / 6.0
    return y[:4], y[4:], transition


def to_centre(q_wxyz: Array, omega_rad_s: Array, centre_trf_m: Array) -> Array:
    """Return the matrix (12, 12) from errors of TRF's origin to errors of a point ``centre_trf_m``
    (3,) fixed in TRF.

    The point is at p + R c and moves at v + R (omega x c); dtheta and omega are unchanged.
    """
    rotation, spin = so3.to_matrix(q_wxyz), rotations.cross(omega_rad_s, centre_trf_m)
    m = np.eye(12)
    m[0:3, 6:9] = -rotation @ so3.skew(centre_trf_m)
    m[3:6, 6:9] = -rotation @ so3.skew(spin)
    m[3:6, 9:12] = -rotation @ so3.skew(centre_trf_m)
    return m


def steady_motion(
    motion: tuple[Array, Array, Array, Array], dt_s: float, centre_trf_m: Array
) -> tuple[tuple[Array, Array, Array, Array], Array]:
    """Return position, velocity, attitude and rate of TRF after ``dt_s``, and the transition (12,
    12) by their errors.

    The body rate is constant, and the centre of mass moves at constant velocity.
    """
    position, velocity, q, omega = motion
    q_after, omega_after, turned = constant_rates(q, omega, dt_s)
    f = np.eye(12)
    f[0, 3] = f[1, 4] = f[2, 5] = dt_s
    f[6:12, 6:12] = turned
    if not centre_trf_m.any():
        return (position + velocity * dt_s, velocity, q_after, omega_after), f
    r, r_after = so3.to_matrix(q), so3.to_matrix(q_after)
    centre_velocity = velocity + r @ rotations.cross(omega, centre_trf_m)
    centre = position + r @ centre_trf_m + centre_velocity * dt_s
    position_after = centre - r_after @ centre_trf_m
    velocity_after = centre_velocity - r_after @ rotations.cross(omega_after, centre_trf_m)
    back = np.linalg.inv(to_centre(q_after, omega_after, centre_trf_m))
    f = back @ f @ to_centre(q, omega, centre_trf_m)
    return (position_after, velocity_after, q_after, omega_after), f


def process_noise(dt_s: float, acceleration_density: float, angular_density: float) -> Array:
    """Return the covariance (12, 12) that white noise adds in ``dt_s``.

    acceleration_density in (m/s^2)^2/Hz, angular_density in (rad/s^2)^2/Hz (the squares of the
    parameters). The rotation of the axes within the step is neglected: it changes the attitude
    block by less than (|omega| dt)^2 / 12 of itself and never makes it too small.
    """
    q = np.zeros((12, 12))
    d3, d2, d1 = dt_s**3 / 3.0, dt_s**2 / 2.0, dt_s
    for block, density in ((0, acceleration_density), (6, angular_density)):
        i, j = slice(block, block + 3), slice(block + 3, block + 6)
        q[i, i] = density * d3 * _EYE3
        q[i, j] = q[j, i] = density * d2 * _EYE3
        q[j, j] = density * d1 * _EYE3
    return q
