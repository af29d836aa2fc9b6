# SPDX-License-Identifier: Apache-2.0
"""The stack of a target and the chasers latched to it: its momentum, and the wrenches of all thrusters. Pure functions.

Wrenches are force and torque about the centre of mass of the stack, in TRF axes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.plume import plume_hits
from chaserdock_models.targets import Box
from chaserdock_models.wrench_set import ThrusterMount, wrench_matrix
from numpy.typing import NDArray

from chaserdock_controller.estimation.target_body import TargetBody


@dataclass(frozen=True, eq=False)
class MountedChaser:
    """A chaser fixed to the target: its centre (3,) and attitude (4,) in TRF."""

    position_m: Array
    q_wxyz: Array

    def to_target(self, points_m: Array) -> Array:
        """Return points (N, 3), CRF, in TRF."""
        return self.position_m + rotations.rotate(self.q_wxyz, points_m)

    def wrench_to_stack(self, wrench: Array, centre_m: Array) -> Array:
        """Return a wrench (6, ...) at CRF's origin in body axes as wrench about ``centre_m`` (3,) in TRF axes."""
        turn = rotations.to_matrix(self.q_wxyz)
        force = turn @ wrench[:3]
        arm = rotations.skew(self.position_m - centre_m)
        return np.concatenate([force, turn @ wrench[3:] + arm @ force])


@dataclass(frozen=True, eq=False)
class StackMotion:
    """Momentum of the stack, TRF axes: linear (3,), N s, and angular (3,) about its centre of mass, N m s."""

    linear_N_s: Array
    angular_N_m_s: Array

    @property
    def momentum(self) -> Array:
        """Return both (6,)."""
        return np.concatenate([self.linear_N_s, self.angular_N_m_s])

    def rates(self, body: TargetBody) -> tuple[float, float]:
        """Return the speed of the centre of mass (m/s) and the angular rate (rad/s)."""
        omega = np.linalg.solve(body.inertia_kg_m2, self.angular_N_m_s)
        return float(np.linalg.norm(self.linear_N_s)) / body.mass_kg, float(np.linalg.norm(omega))


def stack_motion(body: TargetBody, velocity_m_s: Array, q_wxyz: Array, omega_rad_s: Array) -> StackMotion:
    """Return the momentum of a stack with velocity (3,) of TRF's origin in WRF, attitude (4,) and rate (3,) in TRF."""
    own = rotations.rotate_inverse(q_wxyz, velocity_m_s) + rotations.cross(omega_rad_s, body.centre_trf_m)
    return StackMotion(body.mass_kg * own, body.inertia_kg_m2 @ omega_rad_s)


def thruster_wrenches(
    body: TargetBody, chasers: Mapping[int, MountedChaser], thrusters: Sequence[ThrusterMount]
) -> Array:
    """Return the wrenches (6, N n) of 1 N of each of the ``n`` thrusters of every chaser, in the order of the mapping."""
    own = wrench_matrix(thrusters)
    return np.concatenate([c.wrench_to_stack(own, body.centre_trf_m) for c in chasers.values()], axis=1)


def plume_free(
    chasers: Mapping[int, MountedChaser],
    thrusters: Sequence[ThrusterMount],
    half_angle_rad: float,
    target: Sequence[Box],
    ports_m: Sequence[Array],
    chaser_size_m: tuple[float, float, float],
) -> NDArray[np.bool_]:
    """Return which thrusters (N n,) may fire: those whose plume hits neither the target, a port, nor another chaser.

    ``ports_m``: points (3,), TRF.
    """
    free = np.ones((len(chasers), len(thrusters)), dtype=bool)
    positions = np.array([t.position_m for t in thrusters])
    directions = np.array([t.direction for t in thrusters])
    for row, (number, chaser) in enumerate(chasers.items()):
        others = [c for i, c in chasers.items() if i != number]
        boxes = [*target, *(body_box(c, chaser_size_m) for c in others)]
        nozzles, forces = chaser.to_target(positions), rotations.rotate(chaser.q_wxyz, directions)
        for k, (nozzle, force) in enumerate(zip(nozzles, forces, strict=True)):
            free[row, k] = not plume_hits(nozzle, force, half_angle_rad, boxes, ports_m)
    return free.reshape(-1)


def body_box(chaser: MountedChaser, size_m: tuple[float, float, float]) -> Box:
    """Return the box of a chaser's body in TRF."""
    x, y, z = chaser.position_m.tolist()
    qw, qx, qy, qz = chaser.q_wxyz.tolist()
    return Box(size_m, (x, y, z), (qw, qx, qy, qz))
