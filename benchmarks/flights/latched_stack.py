# SPDX-License-Identifier: Apache-2.0
"""The true stack of a target and chasers that are latched with small errors at their ports."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from chaserdock_controller.bodies.target_body import TargetBody, attach_bodies
from chaserdock_controller.guidance.detumble.stack import StackMotion
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.mounting import MountedChaser
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.plant import Plant

_PORT_ERROR_M, _PORT_ERROR_RAD = 0.002, math.radians(0.3)
"""Largest errors of a latched chaser's place and attitude per axis."""


def with_port_error(scenario: Scenario, chaser: int, nominal: MountedChaser) -> MountedChaser:
    """Return the pose of a chaser that is latched with errors drawn from the scenario's seed."""
    rng = np.random.default_rng([scenario.seed, 0x57A, chaser])
    place = nominal.position_m + rng.uniform(-_PORT_ERROR_M, _PORT_ERROR_M, 3)
    turn = rotations.exp(rng.uniform(-_PORT_ERROR_RAD, _PORT_ERROR_RAD, 3))
    return MountedChaser(place, rotations.multiply(nominal.q_wxyz, turn))


def body_of_plant(plant: Plant) -> TargetBody:
    """Return the mass properties of a true body."""
    return TargetBody(plant.mass_kg, plant.inertia_kg_m2, plant.centre_of_mass_m)


def attach_plants(
    target: TargetBody, plants: Mapping[int, Plant], mounted: Mapping[int, MountedChaser]
) -> TargetBody:
    """Return the true mass properties of a target with the mounted chasers."""
    parts = []
    for i, chaser in mounted.items():
        plant, q = plants[i], chaser.q_wxyz
        centre = chaser.position_m + rotations.rotate(q, plant.centre_of_mass_m)
        axes = q if plant.frame is None else rotations.multiply(q, plant.frame.q_wxyz)
        parts.append((plant.mass_kg, np.array(plant.moments_kg_m2), centre, axes))
    return attach_bodies(target, parts)


def stack_motion(
    body: TargetBody, velocity_m_s: Array, q_wxyz: Array, omega_rad_s: Array
) -> StackMotion:
    """Return the momentum of a stack with velocity (3,) of TRF's origin in WRF, attitude (4,) and
    rate (3,) in TRF.
    """
    own = rotations.rotate_inverse(q_wxyz, velocity_m_s) + rotations.cross(
        omega_rad_s, body.centre_trf_m
    )
    return StackMotion(body.mass_kg * own, body.inertia_kg_m2 @ omega_rad_s)


def moving_with(target: BodyState, place_m: Array, q_wxyz: Array) -> BodyState:
    """Return the state of a body fixed to the target at a place (3,) and attitude (4,) in TRF."""
    arm = rotations.rotate(target.q_wxyz, place_m)
    omega_world = rotations.rotate(target.q_wxyz, target.omega_rad_s)
    return BodyState(
        target.position_m + arm,
        target.velocity_m_s + np.cross(omega_world, arm),
        rotations.multiply(target.q_wxyz, q_wxyz),
        rotations.rotate_inverse(q_wxyz, target.omega_rad_s),
    )
