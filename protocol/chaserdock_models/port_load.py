# SPDX-License-Identifier: Apache-2.0
"""Load at the port of a chaser that a tumbling target carries along."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .arrays import Array


@dataclass(frozen=True, eq=False)
class CarriedBody:
    """A rigid body: mass, inertia tensor (3, 3) about its centre of mass, and that centre (3,);
    TRF.
    """

    mass_kg: float
    inertia_kg_m2: Array
    centre_m: Array


def tumble_load(
    target: CarriedBody, chaser: CarriedBody, tip_m: Array, omega_rad_s: Array
) -> tuple[Array, Array]:
    """Return force (3,) and torque about the tip (3,), TRF, that a latched chaser exerts on its
    port.

    Target and chaser are one free body that rotates at ``omega_rad_s`` (3,), TRF, and nothing else
    acts on them. ``tip_m`` (3,): place of the port, TRF. Newton-Euler equations of the chaser under
    the composite's motion.
    """
    omega, total_kg = np.asarray(omega_rad_s, dtype=float), target.mass_kg + chaser.mass_kg
    apart = chaser.centre_m - target.centre_m
    reduced_kg = target.mass_kg * chaser.mass_kg / total_kg
    inertia = (
        target.inertia_kg_m2
        + chaser.inertia_kg_m2
        + reduced_kg * (float(apart @ apart) * np.eye(3) - np.outer(apart, apart))
    )
    alpha = np.linalg.solve(inertia, -np.cross(omega, inertia @ omega))
    arm = apart * (target.mass_kg / total_kg)
    force = chaser.mass_kg * (np.cross(alpha, arm) + np.cross(omega, np.cross(omega, arm)))
    torque = chaser.inertia_kg_m2 @ alpha + np.cross(omega, chaser.inertia_kg_m2 @ omega)
    return -force, np.cross(tip_m - chaser.centre_m, force) - torque
