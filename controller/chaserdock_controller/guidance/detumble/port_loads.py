# SPDX-License-Identifier: Apache-2.0
"""Loads of latched chasers on their ports, and selection of thrusters that may fire together within
the load limits. Pure functions.

Scaling the thrusts does not lower peak loads, because every pulse is fully on. Only firing one
thruster after the other does.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.mounting import MountedChaser
from chaserdock_models.rigid_body import RigidBody

from chaserdock_controller.bodies.target_body import TargetBody

_MARGIN = 0.9
"""Share of the limits that is used; the rest is left for model errors and vibrations of the
joint.
"""


def _directions(count: int) -> Array:
    """Return unit vectors (count, 3) that cover the sphere evenly (Fibonacci's spiral)."""
    k = np.arange(count) + 0.5
    height, turn = 1.0 - 2.0 * k / count, math.pi * (1.0 + math.sqrt(5.0)) * k
    radius = np.sqrt(1.0 - height**2)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), height], axis=1)


_DIRECTIONS = _directions(200)
"""Directions in which loads are bounded. A load between two of them is at most 2 % larger."""


@dataclass(frozen=True, eq=False)
class LoadModel:
    """Loads at P ports as a function of thrusts.

    ``constant`` (P, 6) plus ``by_thrust`` (P, 6, n) times the thrusts: force and torque about the
    tip, TRF axes. ``limits`` (P, 2): of their magnitudes, infinite if unlimited.
    """

    constant: Array
    by_thrust: Array
    limits: Array


def load_model(
    body: TargetBody,
    omega_rad_s: Array,
    wrenches: Array,
    chasers: Mapping[int, MountedChaser],
    own: Mapping[int, tuple[slice, Array]],
    chaser: RigidBody,
    tips_m: Mapping[int, Array],
    limits: Mapping[int, tuple[float, float]],
) -> LoadModel:
    """Return the load model of the ports of ``chasers``.

    ``wrenches`` (6, n): per 1 N of every thruster about the stack's centre of mass, TRF axes.
    ``own``: slice of a chaser's thrusters, and their wrenches about its centre in its axes.
    ``tips_m``: points of the ports (TRF). ``limits``: force and torque.
    """
    inverse = np.linalg.inv(body.inertia_kg_m2)
    free = -inverse @ rotations.cross(omega_rad_s, body.inertia_kg_m2 @ omega_rad_s)
    constants, by_thrusts, bounds = [], [], []
    spin = rotations.skew(omega_rad_s)
    for i, mounted in chasers.items():
        turn = rotations.to_matrix(mounted.q_wxyz)
        inertia = turn @ np.diag(chaser.inertia) @ turn.T
        arm = mounted.position_m - body.centre_trf_m
        at_tip = rotations.skew(mounted.position_m - tips_m[i])
        # The part of a chaser's thrust that accelerates the chaser itself does not load its port.
        linear = wrenches[:3] / body.mass_kg - rotations.skew(arm) @ inverse @ wrenches[3:]
        force = -chaser.mass_kg * linear
        torque = -inertia @ inverse @ wrenches[3:]
        columns, unit = own.get(i, (slice(0, 0), np.zeros((6, 0))))
        force[:, columns] += turn @ unit[:3]
        torque[:, columns] += turn @ unit[3:]
        centripetal = rotations.cross(free, arm) + spin @ spin @ arm
        still = -chaser.mass_kg * centripetal
        gyroscopic = -(inertia @ free + rotations.cross(omega_rad_s, inertia @ omega_rad_s))
        constants.append(np.concatenate([still, gyroscopic + at_tip @ still]))
        by_thrusts.append(np.concatenate([force, torque + at_tip @ force]))
        bounds.append(limits.get(i, (np.inf, np.inf)))
    return LoadModel(np.array(constants), np.array(by_thrusts), np.array(bounds))


def fire_in_turn(model: LoadModel, wanted: Array, full_N: Array) -> Array:
    """Select thrusters that may fire together, the most wanted first, from those ``wanted`` (n,).
    Returns a mask (n,).

    No subset of them exceeds a limit either: pulses differ in width, and when some end the others'
    load remains.
    """
    chosen = np.zeros(len(wanted), dtype=bool)
    ports = len(model.constant)
    # Largest component of the loads along each direction, over all subsets of the chosen thrusters.
    along = model.constant.reshape(ports, 2, 3) @ _DIRECTIONS.T
    more = np.einsum("pckn,dk->pcdn", model.by_thrust.reshape(ports, 2, 3, -1), _DIRECTIONS)
    for k in np.argsort(-wanted, kind="stable"):
        if wanted[k] <= 0.0:
            break
        added = along + np.maximum(0.0, full_N[k] * more[..., k])
        if (added.max(axis=2) <= _MARGIN * model.limits).all():
            chosen[k], along = True, added
    return chosen
