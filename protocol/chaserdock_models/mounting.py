# SPDX-License-Identifier: Apache-2.0
"""Chasers fixed to the target, and which of their thrusters may fire there. Pure functions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from . import rotations
from .arrays import Array
from .plume import plume_hits
from .targets import Box
from .wrench_set import ThrusterMount


@dataclass(frozen=True, eq=False)
class MountedChaser:
    """A chaser fixed to the target: its centre (3,) and attitude (4,) in TRF."""

    position_m: Array
    q_wxyz: Array

    def to_target(self, points_m: Array) -> Array:
        """Return points (N, 3), CRF, in TRF."""
        return self.position_m + rotations.rotate(self.q_wxyz, points_m)

    def wrench_to_stack(self, wrench: Array, centre_m: Array) -> Array:
        """Return a wrench (6, ...) at CRF's origin in body axes as wrench about ``centre_m`` (3,)
        in TRF axes.
        """
        turn = rotations.to_matrix(self.q_wxyz)
        force = turn @ wrench[:3]
        arm = rotations.skew(self.position_m - centre_m)
        return np.concatenate([force, turn @ wrench[3:] + arm @ force])


def plume_free(
    chasers: Mapping[int, MountedChaser],
    thrusters: Sequence[ThrusterMount],
    half_angle_rad: float,
    target: Sequence[Box],
    ports_m: Sequence[Array],
    chaser_size_m: tuple[float, float, float],
) -> NDArray[np.bool_]:
    """Return which thrusters (N n,) may fire: those whose plume hits neither the target, a port,
    nor another chaser.

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
