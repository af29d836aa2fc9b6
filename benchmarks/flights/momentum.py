# SPDX-License-Identifier: Apache-2.0
"""Momentum of bodies in the simulated world, to check what conserves it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_world.physics.simulation import Physics


@dataclass(frozen=True, eq=False)
class GroupMomentum:
    """Of a group of bodies in WRF axes: common centre of mass (3,), m, momentum (3,), N s, and
    angular momentum (3,) about that centre, N m s.
    """

    centre_m: Array
    linear_N_s: Array
    angular_N_m_s: Array


def momentum_of(physics: Physics, names: Iterable[str]) -> GroupMomentum:
    """Return the momentum of the named bodies now, with their true mass properties."""
    masses, places, velocities, spins = [], [], [], []
    for name in names:
        s, plant = physics.state(name), physics.plants[name]
        arm = rotations.rotate(s.q_wxyz, plant.centre_of_mass_m)
        omega = rotations.rotate(s.q_wxyz, s.omega_rad_s)
        masses.append(plant.mass_kg)
        places.append(s.position_m + arm)
        velocities.append(s.velocity_m_s + rotations.cross(omega, arm))
        spins.append(rotations.rotate(s.q_wxyz, plant.inertia_kg_m2 @ s.omega_rad_s))
    mass, place = np.array(masses)[:, None], np.array(places)
    momentum = mass * np.array(velocities)
    centre = (mass * place).sum(axis=0) / mass.sum()
    angular = np.array(spins) + np.cross(place - centre, momentum)
    return GroupMomentum(centre, momentum.sum(axis=0), angular.sum(axis=0))
