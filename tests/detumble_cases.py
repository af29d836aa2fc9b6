# SPDX-License-Identifier: Apache-2.0
"""A target of 150 kg with `tetra12` chasers at the middles of its faces, shared by the tests of
detumbling.
"""

from __future__ import annotations

import math

import numpy as np
from chaserdock_controller.bodies.target_body import TargetBody, attach_bodies
from chaserdock_controller.guidance.detumble.stack import thruster_wrenches
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.mounting import MountedChaser, plume_free
from chaserdock_models.targets import Box
from chaserdock_protocol.scenario.bodies import Body

BODY = Body(body="tetra12", actuation="thrusters", size_m=(0.14, 0.33, 0.33))
SIZE_M = (1.0, 0.9, 0.8)
HALF = math.sqrt(0.5)
PORTS = (
    ((-0.5, 0.0, -0.05), (-1.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),
    ((0.0, -0.45, -0.05), (0.0, -1.0, 0.0), (HALF, 0.0, 0.0, HALF)),
    ((0.0, 0.45, -0.05), (0.0, 1.0, 0.0), (HALF, 0.0, 0.0, -HALF)),
    ((0.5, 0.0, -0.05), (1.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)),
)
"""Position, axis and attitude of the chaser of each port."""


def target_alone() -> TargetBody:
    """Return the target: principal axes turned against TRF, centre of mass beside its middle."""
    turn = rotations.to_matrix(rotations.exp(np.array([0.4, -0.3, 0.5])))
    return TargetBody(
        150.0, turn @ np.diag([15.0, 20.0, 25.0]) @ turn.T, np.array([0.06, -0.05, 0.04])
    )


def mounted(chasers: tuple[int, ...]) -> dict[int, MountedChaser]:
    """Return chasers at their ports."""
    found = {}
    for i in chasers:
        position, axis, q = PORTS[i]
        found[i] = MountedChaser(np.array(position) + 0.35 * np.array(axis), np.array(q))
    return found


def stack_of(chasers: dict[int, MountedChaser]) -> TargetBody:
    """Return the target with chasers fixed to it."""
    parts = [
        (BODY.mass_kg, np.asarray(BODY.inertia), c.position_m, c.q_wxyz) for c in chasers.values()
    ]
    return attach_bodies(target_alone(), parts)


def stack_thrusters(chasers: tuple[int, ...]) -> tuple[TargetBody, Array, Array]:
    """Return the stack, the wrenches (6, n) of its thrusters and their limits (n,), zero where the
    plume hits something.
    """
    found = mounted(chasers)
    body = stack_of(found)
    ports = [np.array(position) for position, _, _ in PORTS]
    free = plume_free(found, BODY.thrusters, math.radians(20.0), [Box(SIZE_M)], ports, BODY.size_m)
    return body, thruster_wrenches(body, found, BODY.thrusters), np.where(free, 1.5, 0.0)


def tumble(seed: int, body: TargetBody, rate_deg_s: float = 7.0, speed_m_s: float = 0.034) -> Array:
    """Return a seeded momentum (6,) of the stack, TRF axes."""
    rng = np.random.default_rng(seed)
    omega, velocity = rng.normal(size=3), rng.normal(size=3)
    omega *= math.radians(rate_deg_s) / np.linalg.norm(omega)
    velocity *= speed_m_s / np.linalg.norm(velocity)
    return np.concatenate([body.mass_kg * velocity, body.inertia_kg_m2 @ omega])
