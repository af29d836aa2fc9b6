# SPDX-License-Identifier: Apache-2.0
"""The target as a free rigid body: predicted path, and mass properties with captured chasers.

The origin of TRF need not be the centre of mass; with a captured chaser it is not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from chaserdock_models.arrays import Array, IntArray
from chaserdock_models.rigid_body import free_rotation
from chaserdock_models.rotations import cross, normalize, rotate, to_matrix
from numpy.typing import ArrayLike


@dataclass(frozen=True)
class TargetBody:
    """Mass properties of the target.

    ``inertia_kg_m2`` (3, 3): about the centre of mass, TRF axes. ``centre_trf_m`` (3,): centre of
    mass in TRF.
    """

    mass_kg: float
    inertia_kg_m2: Array
    centre_trf_m: Array


@dataclass(frozen=True)
class TargetPath:
    """Motion of the target at K times.

    Positions (K, 3) of TRF's origin in WRF; attitudes (K, 4), TRF to WRF. Angular rates and
    accelerations, and the acceleration of TRF's origin, each (K, 3) in TRF axes.
    """

    positions_m: Array
    q_wxyz: Array
    omega_rad_s: Array
    alpha_rad_s2: Array
    acceleration_m_s2: Array

    def at(self, instants: slice | IntArray) -> TargetPath:
        """Return the path at a subset of the times."""
        return TargetPath(*(getattr(self, f.name)[instants] for f in fields(self)))


def attach_bodies(
    target: TargetBody, attached: Sequence[tuple[float, Array, Array, Array]]
) -> TargetBody:
    """Return the mass properties of the target with bodies fixed to it.

    ``attached``: for each body its mass, principal inertia (3,), centre (3,) and attitude (4,) in
    TRF. Parallel axes: I = sum of R I_i R' + m_i (d'd 1 - d d'), d from the common centre of mass
    (Goldstein, "Classical Mechanics", section 5.3).
    """
    parts = [(target.mass_kg, target.inertia_kg_m2, target.centre_trf_m)]
    for mass, inertia, centre, q in attached:
        rotation = to_matrix(q)
        parts.append((mass, rotation @ np.diag(inertia) @ rotation.T, centre))
    mass = sum(m for m, _, _ in parts)
    centre = np.sum([m * c for m, _, c in parts], axis=0) / mass
    total = np.zeros((3, 3))
    for m, inertia, c in parts:
        d = c - centre
        total += inertia + m * (float(d @ d) * np.eye(3) - np.outer(d, d))
    return TargetBody(mass, total, centre)


def predict_path(
    body: TargetBody,
    position_m: ArrayLike,
    velocity_m_s: ArrayLike,
    q_wxyz: ArrayLike,
    omega_rad_s: ArrayLike,
    step_s: float,
    steps: int,
) -> TargetPath:
    """Return the free body's motion at 0, step_s, ... steps * step_s from now.

    position and velocity (3,) of TRF's origin in WRF, q_wxyz (4,) TRF to WRF, omega (3,) in TRF.
    The centre of mass moves at constant velocity; ``free_rotation`` integrates the attitude. Raises
    ValueError for a zero quaternion.
    """
    q, omega, c = normalize(q_wxyz), np.array(omega_rad_s, dtype=float), body.centre_trf_m
    n = steps + 1
    qs, omegas, alphas = free_rotation(q_wxyz, omega, body.inertia_kg_m2, step_s, n)
    centre = np.asarray(position_m, dtype=float) + rotate(q, c)
    velocity = np.asarray(velocity_m_s, dtype=float) + rotate(q, cross(omega, c))
    times = step_s * np.arange(n)[:, None]
    positions = centre + times * velocity - rotate(qs, np.broadcast_to(c, (n, 3)))
    centripetal = cross(alphas, c) + cross(omegas, cross(omegas, c))
    return TargetPath(positions, qs, omegas, alphas, -centripetal)
