# SPDX-License-Identifier: Apache-2.0
"""The stack of a target and its latched chasers: momentum, and wrenches of all thrusters. Pure
functions.

Wrenches are force and torque about the stack's centre of mass, in TRF axes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.mounting import MountedChaser
from chaserdock_models.wrench_set import ThrusterMount, wrench_matrix

from chaserdock_controller.bodies.target_body import TargetBody


@dataclass(frozen=True, eq=False)
class StackMotion:
    """Momentum of the stack, TRF axes: linear (3,), N s, and angular (3,) about its centre of mass,
    N m s.
    """

    linear_N_s: Array
    angular_N_m_s: Array

    @property
    def momentum(self) -> Array:
        """Return linear and angular momentum as one array (6,)."""
        return np.concatenate([self.linear_N_s, self.angular_N_m_s])

    def rates(self, body: TargetBody) -> tuple[float, float]:
        """Return the speed of the centre of mass (m/s) and the angular rate (rad/s)."""
        omega = np.linalg.solve(body.inertia_kg_m2, self.angular_N_m_s)
        return float(np.linalg.norm(self.linear_N_s)) / body.mass_kg, float(np.linalg.norm(omega))


def thruster_wrenches(
    body: TargetBody, chasers: Mapping[int, MountedChaser], thrusters: Sequence[ThrusterMount]
) -> Array:
    """Return the wrenches (6, N n) per 1 N of the ``n`` thrusters of every chaser, in the order of
    the mapping.
    """
    own = wrench_matrix(thrusters)
    return np.concatenate(
        [c.wrench_to_stack(own, body.centre_trf_m) for c in chasers.values()], axis=1
    )
