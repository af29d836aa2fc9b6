# SPDX-License-Identifier: Apache-2.0
"""The observation of a training environment, from the states of the bodies or from estimates.

The environments' own is native/observe.h; both have the same definition (docs/learning.md), which
tests/chaserdock/test_policy.py compares.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.docking_geometry import centre_offset
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.scenario import FlightScenario, Scenario
from numpy.typing import ArrayLike

NAMES = (
    *(f"position_{k}_m" for k in "xyz"),
    *(f"velocity_{k}_m_s" for k in "xyz"),
    *(f"attitude_{k}" for k in "wxyz"),
    *(f"rate_{k}_rad_s" for k in "xyz"),
    *(f"target_rate_{k}_rad_s" for k in "xyz"),
)
"""First elements of an observation, in order."""


ADDED = {
    "inspect": (
        *(f"unseen_{k}_m" for k in "xyz"),
        *(f"unseen_normal_{k}" for k in "xyz"),
        "seen_share",
        *(f"sun_{k}" for k in "xyz"),
    ),
    "detumble": tuple(f"stack_velocity_{k}_m_s" for k in "xyz"),
}
"""Elements that a task of ``TASKS`` (task.py) adds."""


def names_of(chasers: int, task: str) -> tuple[str, ...]:
    """Return the names of the elements of an observation with this number of chasers in a task of
    ``TASKS`` (task.py).
    """
    others = (f"other_{i}_{k}_m" for i in range(1, chasers) for k in "xyz")
    return (*NAMES, *ADDED.get(task, ()), *others)


@dataclass(frozen=True, eq=False)
class Goal:
    """Where a chaser shall be: its centre (3,), TRF, and its attitude (4,), CRF to TRF."""

    position_m: Array
    q_wxyz: Array


def goal_of(scenario: Scenario | FlightScenario, chaser: int, task: str) -> Goal:
    """Return the goal of a chaser in a task of ``TASKS`` (task.py); with ``inspect`` it is TRF."""
    if task == "inspect":
        return Goal(np.zeros(3), rotations.IDENTITY)
    nominal = np.asarray(scenario.chasers[chaser].position_m, dtype=float)
    attitude = np.asarray(scenario.chasers[chaser].q_wxyz, dtype=float)
    port = scenario.docking.port_of(chaser)
    if task in ("latch", "detumble") and port is not None:
        return Goal(centre_offset(port, scenario.chaser.probe_reach_m, 0.0), attitude)
    if task == "hold":
        return Goal(nominal, attitude)
    towards = nominal / np.linalg.norm(nominal)
    return Goal(towards * scenario.approach.dock_distance_m, attitude)


def stack_elements(centre_m: Array, target: BodyState) -> Array:
    """Return what ``detumble`` adds to an observation: velocity (3,) of the stack's centre of mass,
    TRF axes, m/s. ``centre_m`` (3,): TRF, as ``stated_stack`` (stack.py) has it.
    """
    turning = rotations.cross(target.omega_rad_s, centre_m)
    return rotations.rotate_inverse(target.q_wxyz, target.velocity_m_s) + turning


def observation_of(
    goal: Goal,
    chaser: BodyState,
    target: BodyState,
    others_m: Sequence[Array] = (),
    added: ArrayLike = (),
) -> Array:
    """Return the observation (16 + k + 3 n,) of a chaser: see docs/learning.md.

    ``others_m``: positions (3,), WRF, of the other chasers, by number. ``added`` (k,): what the
    task adds: ``Coverage.elements`` (surface.py), ``stack_elements``.
    """
    into_target = rotations.conjugate(target.q_wxyz)
    position = rotations.rotate(into_target, chaser.position_m - target.position_m)
    velocity = rotations.rotate(into_target, chaser.velocity_m_s - target.velocity_m_s)
    velocity = velocity - rotations.cross(target.omega_rad_s, position)
    attitude = rotations.multiply(into_target, chaser.q_wxyz)
    rate = chaser.omega_rad_s - rotations.rotate_inverse(attitude, target.omega_rad_s)
    error = rotations.multiply(rotations.conjugate(goal.q_wxyz), attitude)
    if error[0] < 0.0:
        error = -error
    others = [rotations.rotate(into_target, at - chaser.position_m) for at in others_m]
    return np.concatenate(
        [position - goal.position_m, velocity, error, rate, target.omega_rad_s, added, *others]
    )
