# SPDX-License-Identifier: Apache-2.0
"""Predicted motion of the target, reference poses and feed-forward wrenches.

The target moves at constant velocity (WRF) and constant body rate. Pure functions; SI units,
radians.
"""

from __future__ import annotations

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.rotations import (
    conjugate,
    cross,
    exp,
    multiply,
    normalize,
    rotate,
    rotate_inverse,
)
from numpy.typing import ArrayLike

from chaserdock_controller.bodies.target_body import TargetPath


def predict_target(
    position_m: ArrayLike,
    velocity_m_s: ArrayLike,
    q_wxyz: ArrayLike,
    omega_rad_s: ArrayLike,
    times_s: ArrayLike,
) -> tuple[Array, Array]:
    """Return target positions (K, 3) in WRF and attitudes (K, 4) body to world at ``times_s`` (K,)
    from now.

    position and velocity (3,) in WRF, q_wxyz (4,), omega (3,) in TRF. Exact for constant velocity
    and body rate: q(t) = q (x) exp(omega t). Raises ValueError for a zero quaternion.
    """
    times = np.asarray(times_s, dtype=float)[:, None]
    positions = np.asarray(position_m, dtype=float) + times * np.asarray(velocity_m_s, dtype=float)
    turned = multiply(normalize(q_wxyz), exp(times * np.asarray(omega_rad_s, dtype=float)))
    return positions, normalize(turned)


def reference_trajectory(
    position_m: ArrayLike,
    velocity_m_s: ArrayLike,
    q_wxyz: ArrayLike,
    omega_rad_s: ArrayLike,
    offset_position_m: ArrayLike,
    q_off_wxyz: ArrayLike,
    times_s: ArrayLike,
) -> Array:
    """Return reference poses (K, 7): p (WRF, m), q_wxyz (chaser body to world) at ``times_s`` (K,).

    Target arguments as in `predict_target`; offset_position_m (K, 3) or (3,) in TRF, q_off_wxyz
    (4,) or (K, 4) chaser body to TRF. p_ref = p_tar + q_tar p_off q_tar*, q_ref = q_tar q_off
    (paper, section 4.1).
    """
    positions, attitudes = predict_target(position_m, velocity_m_s, q_wxyz, omega_rad_s, times_s)
    return references_on(positions, attitudes, offset_position_m, normalize(q_off_wxyz))


def references_on(
    positions_m: Array, attitudes_wxyz: Array, offset_position_m: ArrayLike, q_off_wxyz: ArrayLike
) -> Array:
    """Return reference poses (..., K, 7) for a target at ``positions_m`` (K, 3), WRF, with
    ``attitudes_wxyz`` (K, 4).

    As `reference_trajectory`, but for any motion of the target and, by leading axes, for several
    chasers. ``q_off_wxyz`` has unit length.
    """
    return np.concatenate(
        [
            positions_m + rotate(attitudes_wxyz, offset_position_m),
            multiply(attitudes_wxyz, q_off_wxyz),
        ],
        axis=-1,
    )


def reference_state(
    position_m: ArrayLike,
    velocity_m_s: ArrayLike,
    q_wxyz: ArrayLike,
    omega_rad_s: ArrayLike,
    offset_position_m: ArrayLike,
    offset_velocity_m_s: ArrayLike,
    q_off_wxyz: ArrayLike,
) -> Array:
    """Return the state (13,) of a chaser exactly on its reference: p, v (WRF), q_wxyz, omega
    (chaser body).

    Target arguments as in `predict_target`; offset position and velocity (3,) in TRF.
    """
    q, q_off = normalize(q_wxyz), normalize(q_off_wxyz)
    omega, offset = np.asarray(omega_rad_s, dtype=float), np.asarray(offset_position_m, dtype=float)
    relative = np.asarray(offset_velocity_m_s, dtype=float) + cross(omega, offset)
    return np.concatenate(
        [
            np.asarray(position_m, dtype=float) + rotate(q, offset),
            np.asarray(velocity_m_s, dtype=float) + rotate(q, relative),
            multiply(q, q_off),
            rotate(conjugate(q_off), omega),
        ]
    )


def seen_from(
    target: TargetPath, position_m: Array, velocity_m_s: Array, acceleration_m_s2: Array
) -> tuple[Array, Array, Array]:
    """Return a motion (K, 3), given relative to TRF's origin in WRF, as positions, velocities and
    accelerations (K, 3) in TRF.

    It inverts the acceleration in a rotating frame, see ``feed_forward``.
    """
    q, omega, alpha = target.q_wxyz, target.omega_rad_s, target.alpha_rad_s2
    p = rotate_inverse(q, position_m)
    v = rotate_inverse(q, velocity_m_s) - cross(omega, p)
    a = rotate_inverse(q, acceleration_m_s2) - cross(alpha, p) - 2.0 * cross(omega, v)
    return p, v, a - cross(omega, cross(omega, p))


def feed_forward(
    omega_rad_s: ArrayLike,
    offset_position_m: ArrayLike,
    offset_velocity_m_s: ArrayLike,
    offset_acceleration_m_s2: ArrayLike,
    q_off_wxyz: ArrayLike,
    mass_kg: float,
    inertia_kg_m2: ArrayLike,
    alpha_rad_s2: ArrayLike = (0.0, 0.0, 0.0),
    origin_acceleration_m_s2: ArrayLike = (0.0, 0.0, 0.0),
) -> Array:
    """Return the force and torque (..., K, 6), N and N m in chaser body axes, that follow the
    reference.

    omega, alpha (its derivative) and the acceleration of TRF's origin: each (3,) or (K, 3), in TRF
    axes. Offset position, velocity and acceleration: (..., K, 3) in TRF, one row per instant, with
    leading axes for several chasers. For an input held over a stage give the stage's middle.
    q_off_wxyz: unit length, (4,) or (..., K, 4), chaser body to TRF; its own rotation is neglected.

    Acceleration in a rotating frame: a = a_0 + p'' + alpha x p + 2 omega x p' + omega x (omega x p)
    (Goldstein, "Classical Mechanics", eq. 4.91), turned into body axes. Torque: I alpha_b + omega_b
    x I omega_b. Position, velocity and attitude of the target cancel: in body axes the wrench is
    the same anywhere. Raises ValueError for a mass that is not positive.
    """
    if not mass_kg > 0.0:
        raise ValueError(f"mass_kg must be positive, not {mass_kg!r}")
    omega = np.asarray(omega_rad_s, dtype=float)
    p, v, a = np.broadcast_arrays(
        np.atleast_2d(np.asarray(offset_position_m, dtype=float)),
        np.asarray(offset_velocity_m_s, dtype=float),
        np.asarray(offset_acceleration_m_s2, dtype=float),
    )
    alpha, inertia = np.asarray(alpha_rad_s2, dtype=float), np.asarray(inertia_kg_m2, dtype=float)
    acceleration = a + 2.0 * cross(omega, v) + cross(omega, cross(omega, p))
    acceleration = (
        acceleration + cross(alpha, p) + np.asarray(origin_acceleration_m_s2, dtype=float)
    )
    q_off = np.asarray(q_off_wxyz, dtype=float)
    omega_body = rotate_inverse(q_off, omega)
    torque = cross(omega_body, omega_body @ inertia.T) + rotate_inverse(q_off, alpha) @ inertia.T
    force = mass_kg * rotate_inverse(q_off, acceleration)
    wrench = np.empty((*force.shape[:-1], 6))
    wrench[..., :3], wrench[..., 3:] = force, torque
    return wrench
