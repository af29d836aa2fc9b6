# SPDX-License-Identifier: Apache-2.0
"""Define the bodies of a scenario for an engine: masses, collision shapes, initial states."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.scenario import Scenario

from chaserdock_world.plant import Plant, true_mesh

from .collision_hulls import collision_hulls, triangles_of
from .engine import (
    CollisionSolid,
    ContactSpring,
    EngineSetup,
    RigidBodyDefinition,
    SolidBox,
    SolidCapsule,
    SolidHull,
)
from .latch import capture_ports
from .target_motion import prescribed_state

TARGET = "target"
PROBE_RADIUS_M = 0.006
"""Radius, m, of the probe's rod and of its round tip (docs/docking.md)."""
_Z_TO_X_WXYZ = np.array([0.5**0.5, 0.0, 0.5**0.5, 0.0])
"""Rotates an engine's capsule, which is along z, to x."""


@dataclass(frozen=True)
class ContactParameters:
    """Compliance of each body in a contact of docking by capture.

    Chosen so that a touch at 1 cm/s rebounds at 0.35 of its speed and penetrates 0.3 mm
    (docs/docking.md), with PyBullet's rule that stiffnesses are in series and dampings add up.
    """

    stiffness_N_m: float = 1e4
    damping_N_s_m: float = 100.0


def engine_setup(scenario: Scenario, plants: Mapping[str, Plant]) -> EngineSetup:
    """Return the bodies in the order of ``plants``: the target, then the chasers."""
    names = tuple(plants)
    bodies = [
        _target_definition(scenario, plants[TARGET]),
        *(_chaser_definition(scenario, i, plants[f"chaser/{i}"]) for i in range(len(names) - 1)),
    ]
    latching = [f"chaser/{port.chaser}" for port in capture_ports(scenario)]
    joints = tuple((names.index(TARGET), names.index(name)) for name in latching)
    spring = _contact_spring(scenario, plants[TARGET])
    return EngineSetup(bodies, 1.0 / scenario.time.physics_hz, spring, joints)


def _contact_spring(scenario: Scenario, target: Plant) -> ContactSpring | None:
    """Return the contact of docking by capture; bodies that are not meant to touch are hard."""
    if scenario.docking.kind != "capture":
        return None
    parameters, mass_kg = ContactParameters(), scenario.chaser.mass_kg
    effective_kg = target.mass_kg * mass_kg / (target.mass_kg + mass_kg)
    return ContactSpring(parameters.stiffness_N_m, parameters.damping_N_s_m, effective_kg)


def _target_definition(scenario: Scenario, plant: Plant) -> RigidBodyDefinition:
    model, mesh = scenario.target_model(), true_mesh(scenario)
    hulls = collision_hulls(mesh) if model.hulls and mesh is not None else []
    solids: list[CollisionSolid] = [
        SolidHull(plant.part_in_engine(hull, rotations.IDENTITY)[0], triangles_of(hull))
        for hull in hulls
    ]
    if not hulls:
        solids = [
            SolidBox(
                [s / 2 for s in box.size_m],
                *plant.part_in_engine(np.array(box.position_m), np.asarray(box.q_wxyz)),
            )
            for box in model.boxes
        ]
    prescribed = scenario.target.motion != "torque_free"
    mass_kg = 0.0 if prescribed else plant.mass_kg
    state = plant.to_engine(prescribed_state(scenario, 0.0))
    return RigidBodyDefinition(mass_kg, plant.moments_kg_m2, solids, state)


def _chaser_definition(scenario: Scenario, i: int, plant: Plant) -> RigidBodyDefinition:
    body = scenario.chaser
    half = [s / 2 for s in body.size_m]
    solids: list[CollisionSolid] = [
        SolidBox(half, *plant.part_in_engine(np.zeros(3), rotations.IDENTITY))
    ]
    if scenario.docking.kind == "capture":
        # The probe: a massless capsule from the body's front to the tip.
        length = body.probe_reach_m - half[0] - PROBE_RADIUS_M
        middle = np.array([half[0] + length / 2, 0.0, 0.0])
        place = plant.part_in_engine(middle, _Z_TO_X_WXYZ)
        solids.append(SolidCapsule(PROBE_RADIUS_M, length, *place))
    position, attitude = scenario.start_pose(i)
    velocity = np.asarray(scenario.chasers[i].start_velocity_m_s)
    state = plant.to_engine(BodyState(position, velocity, attitude, np.zeros(3)))
    return RigidBodyDefinition(plant.mass_kg, plant.moments_kg_m2, solids, state)
