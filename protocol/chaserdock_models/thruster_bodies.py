# SPDX-License-Identifier: Apache-2.0
"""Built-in chaser bodies with thrusters: defaults of the scenario's section ``chaser``."""

from __future__ import annotations

import math
from typing import Any

_CYCLIC_AXES = ((0, 1, 2), (1, 2, 0), (2, 0, 1))  # rotations by thirds about a diagonal
_FAST = {"min_on_s": 0.005, "rise_s": 0.001, "fall_s": 0.001}
_HALF_TURNS = ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1))  # about x, y and z


def _tetra12() -> dict[str, Any]:
    """Return a cube with three 1.5 N thrusters on each of four corners.

    They are one thruster under the 12 tetrahedral rotations. With any one stuck off or stuck on,
    all six degrees of freedom stay controllable.
    """
    arm_m, direction = 0.163, (-0.525, -0.525, 0.669)
    length = math.hypot(*direction)
    thrusters = [
        {
            "position_m": tuple(arm_m * sign for sign in signs),
            "direction": tuple(
                s * direction[axis] / length for s, axis in zip(signs, axes, strict=True)
            ),
            "thrust_N": 1.5,
        }
        for axes in _CYCLIC_AXES
        for signs in _HALF_TURNS
    ]
    return {
        "mass_kg": 17.8,
        "size_m": (2 * arm_m,) * 3,
        "inertia_kg_m2": (0.315,) * 3,
        "force_max_N": 1.5,
        "torque_max_N_m": 0.15,
        "thrusters": tuple(thrusters),
    }


def _slider() -> dict[str, Any]:
    """Return the paper's body with four 2.3 N thrusters on each corner of its plate.

    Two act in the plane, one up, one down. The paper's 2 N and 0.05 N m on all axes at once stay
    available with any one thruster lost.
    """
    arm_m = 0.125
    thrusters = [
        {
            "position_m": (x * arm_m, y * arm_m, 0.0),
            "direction": direction,
            "thrust_N": 2.3,
            **_FAST,
        }
        for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1))
        for direction in ((-x, 0.0, 0.0), (0.0, -y, 0.0), (0.0, 0.0, 1.0), (0.0, 0.0, -1.0))
    ]
    return {
        "mass_kg": 30.0,
        "size_m": (0.25, 0.25, 0.05),
        "force_max_N": 2.0,
        "torque_max_N_m": 0.05,
        "thrusters": tuple(thrusters),
    }


def _atmos() -> dict[str, Any]:
    """Return the free flyer ATMOS of KTH's planar laboratory: eight 1.5 N thrusters, two on each
    corner.

    Mass, inertia about the vertical, thrust and arm as published (P. Roque et al., "Towards Open-
    Source and Modular Space Systems with ATMOS", 2025); the other moments, which a floor holds, are
    taken equal. With any one thruster lost, force and torque stay controllable.
    """
    arm_m = 0.17
    thrusters = [
        {"position_m": (x * arm_m, y * arm_m, 0.0), "direction": direction, "thrust_N": 1.5}
        for x, y in ((1, 1), (-1, 1), (-1, -1), (1, -1))
        for direction in ((-x, 0.0, 0.0), (0.0, -y, 0.0))
    ]
    return {
        "mass_kg": 17.8,
        "size_m": (2 * arm_m, 2 * arm_m, 0.4),
        "inertia_kg_m2": (0.315,) * 3,
        "force_max_N": 1.5,
        "torque_max_N_m": 0.15,
        "degrees_of_freedom": "planar",
        "thrusters": tuple(thrusters),
    }


BODIES: dict[str, dict[str, Any]] = {
    "slider": _slider(),
    "tetra12": _tetra12(),
    "atmos": _atmos(),
}
