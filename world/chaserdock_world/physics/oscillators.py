# SPDX-License-Identifier: Apache-2.0
"""Simulate masses on springs that a body carries: flexible panels, fuel that sloshes, propellant.

The engine integrates the rest of the body. Each mass moves freely in WRF, and a spring and a damper
along each axis of the body pull it to its place; the rest receives the opposite force at the same
point. So the forces between them depend on motion only, never on accelerations, and contacts,
latches and loads on the rest act as they do on the real body, in any engine. Momentum is conserved
to rounding, angular momentum as well as by the engine.

A mass moves as the engines move bodies (engine.py), by a scheme of second order whose velocities
are those of half a step before. So the dampers take the relative velocity extrapolated to the time
of the positions. The springs take the stretch and a twelfth of its second difference, with which
the frequency is exact up to the fourth order of the step.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.oscillators import MassDistribution, rest_fault, rigid_rest
from chaserdock_protocol.scenario import Scenario, ScenarioError
from chaserdock_protocol.scenario.oscillators import Oscillator, point_masses

from chaserdock_world.plant import Plant, PrincipalFrame, principal_axes

from .definitions import TARGET
from .engine import BodyMotion

RESIDUAL_SHARE = 0.01
"""Share of the propellant that cannot be used: the mass of an empty tank's contents, so that it
still has a motion."""


class BodyOscillators:
    """The masses on springs of one body, n of them, in steps of ``step_s``.

    ``plant``: of the rest of the body; ``masses_kg`` (n,); ``places_m`` (n, 3), body axes.
    """

    def __init__(
        self, oscillators: tuple[Oscillator, ...], masses_kg: Array, plant: Plant, step_s: float
    ) -> None:
        frame = plant.frame or PrincipalFrame(rotations.IDENTITY, np.zeros(3))
        self.masses_kg, self._step_s = masses_kg, step_s
        self._turn = rotations.to_matrix(frame.q_wxyz)  # engine's to body axes
        # Places from the centre of mass of the rest.
        self._places_m = np.array([o.position_m for o in oscillators]) - frame.offset_m
        omega = 2.0 * math.pi * np.array([o.frequencies_hz for o in oscillators])
        damping = np.array([o.damping_shares for o in oscillators])
        self._stiffness = omega**2  # N/m per kg
        self._damping = 2.0 * damping * omega  # N s/m per kg
        self._burns = np.array([o.propellant for o in oscillators])
        self._residual_kg = RESIDUAL_SHARE * float(masses_kg[self._burns].sum())
        self._positions_m = self._velocities = self._relative = np.zeros((0, 3))

    def settle(self, motion: BodyMotion) -> None:
        """Put the masses at rest in their places on a body that moves so."""
        position, q_wxyz, velocity, omega = motion
        arms = self._places_m @ self._to_world(q_wxyz).T
        self._positions_m = position + arms
        self._velocities = velocity + rotations.cross(np.array(omega), arms)
        self._relative = np.zeros_like(arms)

    def _to_world(self, q_wxyz: tuple[float, ...]) -> Array:
        """Return the rotation (3, 3) from body axes to WRF for an attitude of the engine's."""
        return rotations.to_matrix(np.array(q_wxyz)) @ self._turn.T

    def deflections_m(self, motion: BodyMotion) -> Array:
        """Return the displacements (n, 3) of the masses from their places, body axes."""
        position, q_wxyz, _, _ = motion
        return (self._positions_m - position) @ self._to_world(q_wxyz) - self._places_m

    def momenta(self) -> tuple[Array, Array, Array]:
        """Return masses (n,), positions (n, 3) and velocities (n, 3), WRF."""
        return self.masses_kg, self._positions_m, self._velocities

    def step(self, motion: BodyMotion, forces_N: Array | None = None) -> tuple[Array, Array]:
        """Move the masses by a step; return what they exert on the rest in it.

        Force (3,) and torque (3,) about its centre of mass, in the engine's axes. ``motion``: of
        the rest at the beginning of the step. ``forces_N`` (n, 3): others on the masses, WRF.
        """
        position, q_wxyz, velocity, omega = motion
        h, world = self._step_s, self._to_world(q_wxyz)
        arms = self._positions_m - position
        arms_body = arms @ world
        relative = (self._velocities - velocity - rotations.cross(np.array(omega), arms)) @ world
        change = relative - self._relative
        self._relative = relative
        stretch = arms_body - self._places_m + (h / 12.0) * change
        pull = self._stiffness * stretch + self._damping * (relative + 0.5 * change)
        acceleration = -pull @ world.T
        if forces_N is not None:
            acceleration = acceleration + forces_N / self.masses_kg[:, None]
        self._velocities = self._velocities + h * acceleration
        self._positions_m = self._positions_m + h * self._velocities
        pull = self.masses_kg[:, None] * pull
        products = arms_body.T @ pull  # sum of arm x force, from its outer products
        torque = np.array(
            [
                products[1, 2] - products[2, 1],
                products[2, 0] - products[0, 2],
                products[0, 1] - products[1, 0],
            ]
        )
        return pull.sum(axis=0) @ self._turn, torque @ self._turn

    def burn(self, propellant_kg: float) -> None:
        """Reduce the masses that are propellant, in proportion, down to what cannot be used."""
        left = float(self.masses_kg[self._burns].sum())
        if left > 0.0:
            share = max(left - propellant_kg, self._residual_kg) / left
            self.masses_kg = np.where(self._burns, share * self.masses_kg, self.masses_kg)


def carried_by(
    scenario: Scenario, plants: Mapping[str, Plant]
) -> tuple[dict[str, Plant], dict[str, BodyOscillators]]:
    """Return the rigid rests of ``plants``, and what they carry on springs, by name.

    Raises ScenarioError if a drawn body cannot carry what the scenario states.
    """
    rests, carried = dict(plants), {}
    for name, plant in plants.items():
        stated = scenario.truth.oscillators("target" if name == TARGET else "chaser")
        if stated:
            masses_kg, places_m = point_masses(stated, plant.mass_kg)
            whole = MassDistribution(plant.mass_kg, plant.centre_of_mass_m, plant.inertia_kg_m2)
            rest = rigid_rest(whole, masses_kg, places_m)
            if fault := rest_fault(rest):
                raise ScenarioError(f"{scenario.name}: truth.oscillator: {name} as drawn: {fault}")
            moments, q_wxyz = principal_axes(rest.inertia_kg_m2)
            frame = PrincipalFrame(q_wxyz, rest.centre_m)
            rests[name] = replace(plant, mass_kg=rest.mass_kg, moments_kg_m2=moments, frame=frame)
            step_s = 1.0 / scenario.time.physics_hz
            carried[name] = BodyOscillators(stated, masses_kg, rests[name], step_s)
    return rests, carried
