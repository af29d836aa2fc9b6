"""How a free rigid target moves on, and what holding on to it makes of it. Pure functions; SI units, radians.

TRF's origin need not be the centre of mass: with a captured chaser it no longer is.
"""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import c_double, c_int64
from dataclasses import dataclass, fields

import numpy as np
from chaserdock_models.native import address, function
from chaserdock_models.rotations import cross, normalize, rotate, to_matrix
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True)
class TargetBody:
    """mass_kg; inertia_kg_m2 (3, 3) about the centre of mass, TRF axes; centre_trf_m (3,) the centre of mass."""

    mass_kg: float
    inertia_kg_m2: Array
    centre_trf_m: Array


@dataclass(frozen=True)
class TargetPath:
    """The target at K times: positions (K, 3) of TRF's origin in WRF, attitudes (K, 4); in TRF axes the rates,
    angular accelerations and the origin's acceleration, each (K, 3)."""

    positions_m: Array
    q_wxyz: Array
    omega_rad_s: Array
    alpha_rad_s2: Array
    acceleration_m_s2: Array

    def every(self, begin: int) -> TargetPath:
        """Every second instant, from the one numbered ``begin`` on."""
        return TargetPath(*(getattr(self, f.name)[begin::2] for f in fields(self)))


def joined(target: TargetBody, held: Sequence[tuple[float, Array, Array, Array]]) -> TargetBody:
    """The target with bodies fixed to it: each its mass, principal inertia (3,), centre (3,) and attitude (4,) in TRF.

    Parallel axes: I = sum of R I_i R' + m_i (d'd 1 - d d'), d from the common centre of mass (Goldstein, "Classical
    Mechanics", section 5.3).
    """
    parts = [(target.mass_kg, target.inertia_kg_m2, target.centre_trf_m)]
    for mass, inertia, centre, q in held:
        rotation = to_matrix(q)
        parts.append((mass, rotation @ np.diag(inertia) @ rotation.T, centre))
    mass = sum(m for m, _, _ in parts)
    centre = np.sum([m * c for m, _, c in parts], axis=0) / mass
    total = np.zeros((3, 3))
    for m, inertia, c in parts:
        d = c - centre
        total += inertia + m * (float(d @ d) * np.eye(3) - np.outer(d, d))
    return TargetBody(mass, total, centre)


def tumble(
    body: TargetBody,
    position_m: ArrayLike,
    velocity_m_s: ArrayLike,
    q_wxyz: ArrayLike,
    omega_rad_s: ArrayLike,
    step_s: float,
    steps: int,
) -> TargetPath:
    """The free body's motion at 0, step_s, ... steps * step_s from now.

    position and velocity (3,) of TRF's origin in WRF, q_wxyz (4,) TRF to WRF, omega (3,) in TRF. The centre of mass
    moves uniformly; Euler's equations I w' = (I w) x w by RK4, good to 1e-9 rad for steps of 0.05 s and rates of
    0.2 rad/s. Raises ValueError for a zero quaternion.
    """
    q, omega = normalize(q_wxyz), np.array(omega_rad_s, dtype=float)
    inertia, c = np.ascontiguousarray(body.inertia_kg_m2), body.centre_trf_m
    n = steps + 1
    qs, omegas, alphas = np.empty((n, 4)), np.empty((n, 3)), np.empty((n, 3))
    inverse = np.linalg.inv(inertia)
    function("tumble")(
        address(q), address(omega), address(inertia), address(inverse), c_double(step_s), c_int64(n), address(qs),
        address(omegas), address(alphas),
    )  # fmt: skip
    centre = np.asarray(position_m, dtype=float) + rotate(q, c)
    velocity = np.asarray(velocity_m_s, dtype=float) + rotate(q, cross(omega, c))
    times = step_s * np.arange(n)[:, None]
    positions = centre + times * velocity - rotate(qs, np.broadcast_to(c, (n, 3)))
    turning = cross(alphas, c) + cross(omegas, cross(omegas, c))
    return TargetPath(positions, qs, omegas, alphas, -turning)
