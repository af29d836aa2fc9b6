# SPDX-License-Identifier: Apache-2.0
"""Scenarios on a floor, `chaser.degrees_of_freedom = "planar"`: the vertical in TRF, and checks.

The vertical of the target's frame follows from the reference attitudes: chasers are level, so their
Z is up. Every check raises ValueError with the path of what leaves the plane.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.plane import UP, lean_rad
from numpy.typing import ArrayLike

if TYPE_CHECKING:
    from . import FlightScenario, Scenario

_LEVEL_RAD = 1e-6
"""Largest angle between directions of a scenario that count as equal: rounding of six digits."""
_LEVEL_M = 1e-6
"""Largest difference of heights that count as equal, m, and of vertical speeds, m/s: rounding."""
SPATIAL_COMMANDS = ("calibrate", "inspect", "identify", "detumble")
"""Commands that lead out of the plane, or use torques out of it."""


def up_in_target(scenario: FlightScenario) -> Array | None:
    """Return the vertical (3,), TRF, of a scenario on a floor; None in space."""
    if not scenario.chaser.is_planar:
        return None
    return rotations.rotate(scenario.chasers[0].q_wxyz, UP)


def height_m(scenario: FlightScenario, chaser: int, up: Array) -> float:
    """Return the height of a chaser's centre above the target's, m, which is constant."""
    return float(np.asarray(scenario.chasers[chaser].position_m) @ up)


def why_not_planar(
    scenario: FlightScenario, command: str, chaser: int, offset_m: ArrayLike | None = None
) -> str:
    """Return why a chaser on a floor refuses a command, to ``offset_m`` (3,), TRF; empty if it does
    not.
    """
    up = up_in_target(scenario)
    if up is None:
        return ""
    if command in SPATIAL_COMMANDS:
        return f"{command} needs six degrees of freedom; these bodies are planar"
    return "" if offset_m is None else _why_off_floor(scenario, chaser, offset_m, up)


def _why_off_floor(scenario: FlightScenario, chaser: int, place_m: ArrayLike, up: Array) -> str:
    """Return why a chaser on a floor cannot be at a place (3,), TRF; empty if it can."""
    level_m, own_m = height_m(scenario, chaser, up), float(np.asarray(place_m) @ up)
    if abs(own_m - level_m) <= _LEVEL_M:
        return ""
    return (
        f"{own_m:.6g} m above the target's centre, but chaser {chaser} is on a floor, at "
        f"{level_m:.6g} m"
    )


def check_planar_flight(scenario: FlightScenario) -> None:
    """Check that references, ports and commands of a scenario on a floor stay in the plane."""
    up = up_in_target(scenario)
    if up is None:
        return
    if scenario.orbit is not None:
        raise ValueError('orbit: excludes chaser.degrees_of_freedom = "planar", as on a floor')
    for i, c in enumerate(scenario.chasers):
        own = rotations.rotate(c.q_wxyz, UP)
        _check_along(f"chasers.{i}.q_wxyz: its Z axis (TRF)", own, up, "that of chasers.0")
        _check_in_view(scenario, i)
        above_m = height_m(scenario, i, up)
        if scenario.docking.kind == "held" and abs(above_m) > _LEVEL_M:
            raise ValueError(
                f"chasers.{i}.position_m: {above_m:.6g} m above the target's centre; docking.kind "
                "held approaches that centre, which on a floor must be at the same height"
            )
    for k, port in enumerate(scenario.docking.ports):
        if abs(float(np.asarray(port.axis) @ up)) > _LEVEL_RAD:
            raise ValueError(f"docking.ports.{k}.axis: points out of the plane of the floor")
        if reason := _why_off_floor(scenario, port.chaser, port.position_m, up):
            raise ValueError(f"docking.ports.{k}.position_m: {reason}")
    for k, entry in enumerate(scenario.timeline):
        for i in entry.chasers:
            if reason := why_not_planar(scenario, entry.command, i, entry.offset_m):
                key = "command" if entry.offset_m is None else "offset_m"
                raise ValueError(f"timeline.{k}.{key}: {reason}")


def check_planar(scenario: Scenario) -> None:
    """Check that the bodies of a scenario on a floor start level, and move in the plane."""
    up, target = up_in_target(scenario), scenario.target
    if up is None:
        return
    if lean_rad(target.q_wxyz, up) > _LEVEL_RAD:
        raise ValueError(
            "target.q_wxyz: the target leans, as the Z axis of chasers.0 is not vertical with "
            f"it (off by {math.degrees(lean_rad(target.q_wxyz, up)):.3g} degrees)"
        )
    if target.motion != "static":
        _check_level("target.velocity_m_s", target.velocity_m_s, UP, "m/s")
        across = np.cross(target.omega_rad_s, up)
        if np.abs(across).max() > _LEVEL_RAD:
            x, y, z = up.tolist()
            raise ValueError(
                "target.omega_rad_s: must be about the vertical, in TRF along "
                f"[{x:.6g}, {y:.6g}, {z:.6g}]"
            )
    for i, c in enumerate(scenario.chasers):
        _check_level(f"chasers.{i}.start_offset_m", c.start_offset_m, up, "m")
        _check_level(f"chasers.{i}.start_velocity_m_s", c.start_velocity_m_s, UP, "m/s")
        if any(c.start_rotation_rad[:2]):
            raise ValueError(
                f"chasers.{i}.start_rotation_rad: must be about Z, as the chaser is on a floor"
            )


def _check_along(name: str, vector: Array, other: Array, whose: str) -> None:
    apart_rad = float(np.linalg.norm(np.cross(vector, other)))
    if apart_rad > _LEVEL_RAD or vector @ other < 0.0:
        raise ValueError(f"{name} must be {whose}: chasers on a floor are level")


def _check_level(path: str, vector: ArrayLike, up: Array, unit: str) -> None:
    vertical = float(np.asarray(vector) @ up)
    if abs(vertical) > _LEVEL_M:
        raise ValueError(
            f"{path}: must be in the plane of the floor (its vertical part is {vertical:g} {unit})"
        )


def _check_in_view(scenario: FlightScenario, chaser: int) -> None:
    """Check that a chaser at its reference sees the target's centre, as it cannot pitch or roll."""
    c, camera = scenario.chasers[chaser], scenario.camera_model()
    lens_m, q = camera.irf_pose_in_world(c.position_m, c.q_wxyz)
    column, row = camera.project(rotations.rotate_inverse(q, -lens_m)).tolist()
    if not (0.0 <= column < camera.width_px and 0.0 <= row < camera.height_px):
        raise ValueError(
            f"chasers.{chaser}: its camera does not see the target's centre from its reference, "
            "and the chaser is on a floor, where it can only turn about Z"
        )
