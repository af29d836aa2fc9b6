# SPDX-License-Identifier: Apache-2.0
"""The stack of the task ``detumble``: the target with all chasers latched to their ports, one rigid
body, moved by the chasers' actuators (docs/detumble.md).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from chaserdock_controller.bodies.target_body import TargetBody, attach_bodies
from chaserdock_controller.estimation.composite_body import target_body
from chaserdock_controller.guidance.detumble.allocation import spans_all_directions
from chaserdock_controller.guidance.detumble.stack import thruster_wrenches
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.mounting import MountedChaser
from chaserdock_protocol.errors import ScenarioError
from chaserdock_protocol.scenario import FlightScenario, Scenario
from chaserdock_protocol.scenario.mounting import nominal_mounting, plume_free_thrusters
from chaserdock_world.plant import Plant, PrincipalFrame, principal_axes
from numpy.typing import NDArray

_TRF_ORIGIN = np.zeros(3)


def mounted_chasers(scenario: Scenario | FlightScenario) -> dict[int, MountedChaser]:
    """Return the nominal poses of all chasers at their ports. Raises ValueError without a port."""
    return {i: nominal_mounting(scenario, i) for i in range(len(scenario.chasers))}


def stated_stack(scenario: Scenario | FlightScenario) -> TargetBody:
    """Return the mass properties of the stack as the scenario states them, which flight software
    knows.
    """
    body, inertia = scenario.chaser, np.array(scenario.chaser.inertia)
    return attach_bodies(
        target_body(scenario),
        [
            (body.mass_kg, inertia, mount.position_m, mount.q_wxyz)
            for mount in mounted_chasers(scenario).values()
        ],
    )


def stack_plant(target: Plant, chasers: Sequence[Plant], mounts: Sequence[MountedChaser]) -> Plant:
    """Return the true body of the stack, in TRF, of the true bodies of its parts."""
    parts, disturbance = [], target.disturbance
    for plant, mount in zip(chasers, mounts, strict=True):
        turn = rotations.IDENTITY if plant.frame is None else plant.frame.q_wxyz
        centre = mount.to_target(plant.centre_of_mass_m)
        q = rotations.multiply(mount.q_wxyz, turn)
        parts.append((plant.mass_kg, np.array(plant.moments_kg_m2), centre, q))
        disturbance = disturbance + mount.wrench_to_stack(plant.disturbance, _TRF_ORIGIN)
    alone = TargetBody(target.mass_kg, target.inertia_kg_m2, target.centre_of_mass_m)
    body = attach_bodies(alone, parts)
    moments, axes = principal_axes(body.inertia_kg_m2)
    return Plant(body.mass_kg, moments, PrincipalFrame(axes, body.centre_trf_m), disturbance)


def columns_in_stack(stack: Plant, mount: MountedChaser, columns: Array) -> Array:
    """Return the wrenches (n, 6) of a latched chaser's actuators in the stack's principal frame.
    ``columns`` (n, 6): at CRF's origin in its axes.
    """
    in_target = mount.wrench_to_stack(columns.T, _TRF_ORIGIN).T
    return np.array([stack.wrench_in_engine(wrench) for wrench in in_target])


def closed_thrusters(scenario: Scenario) -> NDArray[np.int64]:
    """Return which thrusters (chasers, n) must not fire, as their plume hits something: 1.

    Raises ScenarioError if the others cannot push and turn the stack in every direction.
    """
    mounts, body = mounted_chasers(scenario), stated_stack(scenario)
    free = plume_free_thrusters(scenario, set(mounts))
    open_ = np.array([free[i] for i in sorted(mounts)])
    limits_N = np.where(open_, [t.thrust_N for t in scenario.chaser.thrusters], 0.0)
    wrenches = thruster_wrenches(body, mounts, scenario.chaser.thrusters)
    if not spans_all_directions(wrenches, limits_N.ravel()):
        raise ScenarioError(
            f"{scenario.name}: learning.task: the thrusters whose plume is free "
            f"({_counts(free)}) cannot push and turn the stack in every direction"
        )
    return (~open_).astype(np.int64)


def _counts(free: Mapping[int, NDArray[np.bool_]]) -> str:
    return ", ".join(f"{row.sum()} of {len(row)} of chaser {i}" for i, row in free.items())
