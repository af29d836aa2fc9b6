# SPDX-License-Identifier: Apache-2.0
"""Record the loads at the ports of latched chasers, by the joint's reaction in every physics step.

A load is what a chaser exerts on its port. A rigid joint stops the relative motion of the bodies in
the single step in which its latch closes. The load of that step, at all ports, depends on the
length of the step; its impulse does not, and is recorded instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array

_HALF_TURN_ABOUT_Z = (0.0, 0.0, 0.0, 1.0)  # a quaternion, scalar first


def port_attitude(q_off_wxyz: Array) -> Array:
    """Return the attitude (4,) of a port's axes in TRF: x outward, z that of the docked chaser's
    CRF.

    ``q_off_wxyz`` (4,): docked attitude, CRF to TRF, with +X into the port.
    """
    return rotations.multiply(q_off_wxyz, _HALF_TURN_ABOUT_Z)


@dataclass(frozen=True, eq=False)
class IntervalLoads:
    """Loads of an interval, port axes.

    ``force_N`` and ``torque_N_m`` (3,): in its last step. ``peak_*``: largest magnitudes;
    ``peak_axial_N``: of the force along the axis; ``peak_shear_N``: across it;
    ``peak_bending_N_m``: of the torque across the axis. ``closing_impulse_N_s``: sum over the steps
    in which a latch closed.
    """

    force_N: Array = field(default_factory=lambda: np.zeros(3))
    torque_N_m: Array = field(default_factory=lambda: np.zeros(3))
    peak_force_N: float = 0.0
    peak_torque_N_m: float = 0.0
    peak_axial_N: float = 0.0
    peak_shear_N: float = 0.0
    peak_bending_N_m: float = 0.0
    closing_impulse_N_s: float = 0.0


@dataclass
class PortLoadRecorder:
    """Collect the loads at one port.

    ``q_port_wxyz`` (4,): axes of the port in the engine's frame of the target.
    """

    q_port_wxyz: Array
    step_s: float
    _rows: list[tuple[float, ...]] = field(default_factory=list)
    _closing_impulse_N_s: float = 0.0

    def add(
        self,
        reaction: Sequence[float],
        q_target_wxyz: Sequence[float],
        q_chaser_wxyz: Sequence[float],
        closing: bool,
    ) -> None:
        """Add the load of a step.

        ``reaction`` (6,): force in world axes and torque about the tip in the axes of the engine's
        frame of the chaser, exerted on the port; ``q_*_wxyz`` (4,): attitudes at the beginning of
        the step. ``closing``: a latch closes in it.
        """
        if closing:
            x, y, z = reaction[:3]
            self._closing_impulse_N_s += (x * x + y * y + z * z) ** 0.5 * self.step_s
        else:
            self._rows.append((*reaction, *q_target_wxyz, *q_chaser_wxyz))

    def take(self) -> IntervalLoads:
        """Return the loads since the last call."""
        rows, impulse = np.array(self._rows), self._closing_impulse_N_s
        self._rows, self._closing_impulse_N_s = [], 0.0
        if not len(rows):
            return IntervalLoads(closing_impulse_N_s=impulse)
        q_port = rotations.multiply(rotations.normalize(rows[:, 6:10]), self.q_port_wxyz)
        force = rotations.rotate_inverse(q_port, rows[:, :3])
        torque = rotations.rotate_inverse(
            q_port, rotations.rotate(rotations.normalize(rows[:, 10:]), rows[:, 3:6])
        )
        return IntervalLoads(
            force_N=force[-1],
            torque_N_m=torque[-1],
            peak_force_N=_largest(force),
            peak_torque_N_m=_largest(torque),
            peak_axial_N=_largest(force[:, :1]),
            peak_shear_N=_largest(force[:, 1:]),
            peak_bending_N_m=_largest(torque[:, 1:]),
            closing_impulse_N_s=impulse,
        )


def _largest(rows: Array) -> float:
    """Return the largest norm of rows (K, n)."""
    return float(np.linalg.norm(rows, axis=1).max())
