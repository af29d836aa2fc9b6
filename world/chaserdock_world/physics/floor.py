# SPDX-License-Identifier: Apache-2.0
"""Keep bodies on a floor, on which they slide and turn about the vertical, in any engine.

The floor carries whatever would lift or tilt a body. Loads lose their parts out of the plane. Of
contacts and joints, the moments about horizontal axes are so large that a body does not tilt in a
step; what is left of a tilt or a vertical motion is removed after it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.plane import UP, levelled
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.planar import up_in_target

from chaserdock_world.plant import Plant, PrincipalFrame

from .engine import BodyMotion, RigidBodyEngine

_HELD_KG_M2 = 1e5
"""Moment of inertia about horizontal axes, kg m^2: a torque of 1 N m tilts a body by 1e-11 rad in a
step of 1 ms. Larger: the engines' solvers lose digits.
"""
_LEVEL = 1e-9
"""Vertical displacement (m) and speed (m/s), tilt (rad) and its rate (rad/s) that are left alone,
above rounding.
"""
_OUT_OF_PLANE = np.array([2, 3, 4])
"""Components of a load that the floor carries, axes of the engine's frame, whose z is vertical."""


def on_floor(scenario: Scenario, plants: Mapping[str, Plant]) -> dict[str, Plant]:
    """Return the bodies as they move on a floor: their third principal axis is the vertical.

    About it they have their moment of inertia. The scenario must be planar.
    """
    up = up_in_target(scenario)
    assert up is not None
    return {name: _plant_on_floor(p, UP if "/" in name else up) for name, p in plants.items()}


def _plant_on_floor(plant: Plant, up: Array) -> Plant:
    """Return a body as it moves on a floor; ``up`` (3,): the vertical in its axes."""
    moment = float(up @ plant.inertia_kg_m2 @ up)
    # The shortest rotation from z to the vertical.
    q = rotations.conjugate(levelled(rotations.IDENTITY, up))
    frame = PrincipalFrame(q, plant.centre_of_mass_m)
    return replace(plant, moments_kg_m2=(_HELD_KG_M2, _HELD_KG_M2, moment), frame=frame)


class Floor:
    """Hold the free ``bodies`` (numbers) of an engine at the heights at which they start."""

    def __init__(self, engine: RigidBodyEngine, bodies: Sequence[int]) -> None:
        self._engine = engine
        self._heights_m = {body: engine.motion(body)[0][2] for body in bodies}

    def carry(self, loads: Array) -> None:
        """Remove the parts of loads (n, 6), force and torque in the engine's axes, that the floor
        carries.
        """
        loads[:, _OUT_OF_PLANE] = 0.0

    def hold(self) -> None:
        """Put the bodies back on the floor after a step."""
        for body, height_m in self._heights_m.items():
            motion = self._engine.motion(body)
            if not _is_level(motion, height_m):
                self._engine.place(body, _level(motion, height_m))


def _is_level(motion: BodyMotion, height_m: float) -> bool:
    (_, _, z), (_, a, b, _), (_, _, speed), (p, q, _) = motion
    return max(abs(z - height_m), 2.0 * abs(a), 2.0 * abs(b), abs(speed), abs(p), abs(q)) < _LEVEL


def _level(motion: BodyMotion, height_m: float) -> BodyState:
    """Return the motion of a body without what leaves the plane."""
    (x, y, _), q_wxyz, (u, v, _), (_, _, yaw_rate) = motion
    position, velocity = np.array([x, y, height_m]), np.array([u, v, 0.0])
    return BodyState(position, velocity, levelled(np.array(q_wxyz), UP), yaw_rate * UP)
