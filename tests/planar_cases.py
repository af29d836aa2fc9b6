# SPDX-License-Identifier: Apache-2.0
"""Bodies on a floor in general position: the target's axes lean, none of its yaw, place or rate is
zero.

Places and attitudes are stated in level axes at the target's centre, and turned into TRF.
"""

from __future__ import annotations

import math
from typing import Any

from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.scenario import Scenario, parse_scenario

LEVEL_TO_TRF: Array = rotations.exp((0.5, -0.8, 0.3))
"""Attitude (4,) of the level axes in TRF."""
UP_TRF: Array = rotations.rotate(LEVEL_TO_TRF, (0.0, 0.0, 1.0))
YAW_RAD, RATE_RAD_S = 0.7, math.radians(3.0)
"""Attitude of the level axes in WRF, and rate of the target, about the vertical."""
HEIGHT_M = -0.05
"""Height of the chasers above the target's centre."""
TARGET_KG, CHASER_KG = 40.0, 17.8
PORT_M = 0.25
"""Distance of the ports from the vertical through the target's centre."""

MARKERS = ((0.16, -0.14, 0.14), (0.16, 0.14, 0.14), (0.04, -0.05, 0.03), (0.04, 0.05, 0.03),
           (0.04, -0.05, -0.05), (0.04, 0.05, -0.05))  # fmt: skip
"""Edge, and place right of and above the middle of a side, m, of the markers on each side."""


def in_trf(x: float, y: float, z: float = 0.0) -> list[float]:
    """Return a vector of level axes in TRF."""
    return rotations.rotate(LEVEL_TO_TRF, (x, y, z)).tolist()


def yawed(yaw_rad: float) -> list[float]:
    """Return the attitude (4,), CRF to TRF, of a level chaser."""
    turn = rotations.exp((0.0, 0.0, yaw_rad))
    return rotations.multiply(LEVEL_TO_TRF, turn).tolist()


def chaser(bearing_rad: float, height_m: float = HEIGHT_M) -> dict[str, Any]:
    """Return a chaser that faces the target from a bearing in level axes, 1 m away."""
    place = in_trf(math.cos(bearing_rad), math.sin(bearing_rad), height_m)
    return {"position_m": place, "q_wxyz": yawed(bearing_rad + math.pi)}


def port(number: int, bearing_rad: float) -> dict[str, Any]:
    """Return a port on the side of the target at a bearing in level axes."""
    x, y = math.cos(bearing_rad), math.sin(bearing_rad)
    place = in_trf(PORT_M * x, PORT_M * y, HEIGHT_M)
    return {"chaser": number, "position_m": place, "axis": in_trf(x, y)}


def values(engine: str = "pybullet", **changes: Any) -> dict[str, Any]:
    """Return a scenario of two chasers with ports, a cube of 0.5 m with its faces level, and
    disturbed ones, errors and forces in all six directions.
    """
    own = {
        "name": "floor",
        "duration_s": 10.0,
        "world": {"engine": engine},
        "truth": {
            "chaser": {"centre_of_mass_m": 0.005, "thrust_turn_deg": 1.0, "force_N": 0.005},
            "target": {"inertia_share": 0.15, "inertia_turn_deg": 5.0, "centre_of_mass_m": 0.01},
        },
        "target": {
            "model": "cube",
            "geometry": {
                "dictionary": "DICT_4X4_50",
                "cuboids": [
                    {"size_m": [2 * PORT_M] * 3, "q_wxyz": LEVEL_TO_TRF.tolist()},
                ],
                "markers": [
                    {"id": len(MARKERS) * side + k, "side_m": size_m, "face": face, "at_m": [x, y]}
                    for side, face in enumerate(("+x", "-x", "+y", "-y"))
                    for k, (size_m, x, y) in enumerate(MARKERS)
                ],
            },
            "motion": "torque_free",
            "mass_kg": TARGET_KG,
            "inertia_kg_m2": [1.3, 1.5, 1.7],
            "inertia_products_kg_m2": [0.1, -0.2, 0.15],
            "position_m": [0.4, -0.3, 0.25],
            "q_wxyz": target_attitude().tolist(),
            "velocity_m_s": [0.004, -0.003, 0.0],
            "omega_rad_s": (RATE_RAD_S * UP_TRF).tolist(),
        },
        "chaser": {"body": "atmos", "actuation": "thrusters", "size_m": [0.2, 0.3, 0.3]},
        "limits": {"min_distance_target_m": 0.75},
        "docking": {"kind": "capture", "ports": [port(0, 0.0), port(1, math.pi / 2)]},
        "chasers": [chaser(0.0), chaser(math.pi / 2)],
    }
    return own | changes


def target_attitude() -> Array:
    """Return the attitude (4,), TRF to WRF, with which the target starts."""
    turn = rotations.exp((0.0, 0.0, YAW_RAD))
    return rotations.multiply(turn, rotations.conjugate(LEVEL_TO_TRF))


def scenario(engine: str = "pybullet", **changes: Any) -> Scenario:
    return parse_scenario(values(engine, **changes), "test")
