"""Why a command is not obeyed, in words; empty when nothing stands against it. Pure functions."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from chaserdock_models.rotations import Array
from chaserdock_protocol.messages import OperatorCommand
from chaserdock_protocol.scenario import Scenario
from numpy.typing import ArrayLike

from .approach_cone import BESIDE_LINE_M


def why_stale(command: OperatorCommand, now_s: float) -> str:
    """Why a command comes too late, or nothing."""
    if command.expires_ns is None or command.expires_ns >= round(now_s * 1e9):
        return ""
    return f"stale: it was to be done by {command.expires_ns / 1e9:.2f} s, it is {now_s:.2f} s"


def why_not_along(scenario: Scenario, chaser: int, offset_m: Array) -> str:
    """Of an approach along the line of the nominal offset, from a reference at ``offset_m`` (3,), TRF."""
    nominal = np.asarray(scenario.chasers[chaser].position_m)
    along = float(offset_m @ nominal) / math.hypot(*nominal)
    aside = math.sqrt(max(0.0, float(offset_m @ offset_m) - along * along))
    if along <= 0.0 or aside > BESIDE_LINE_M:
        return f"its reference is {aside:.2f} m beside its approach line; retreat or goto first"
    return ""


def why_not_calibrate(scenario: Scenario, phase: str, at_rest: bool) -> str:
    """Of the calibration manoeuvre."""
    if phase != "hold" or not at_rest:
        return f"in phase {phase}; hold first"
    if not scenario.estimator.estimates_cameras:
        return "the cameras are taken as exact: set estimator.camera_bias_attitude_deg (and name = mekf)"
    return ""


def why_not_there(scenario: Scenario, offset_m: ArrayLike) -> str:
    """Of a place (3,), TRF."""
    distance = float(np.linalg.norm(offset_m))
    nearest = scenario.limits.min_distance_target_m
    if not nearest < distance <= scenario.limits.max_reference_distance_m:
        return f"the offset is {distance:.3g} m from the target; allowed are more than {nearest:.3g} m"
    return ""


def why_not_goto(scenario: Scenario, offset_m: ArrayLike | None, ends_m: Mapping[int, Array]) -> str:
    """Of a place (3,), TRF, where the other chasers will be at ``ends_m``, by their numbers."""
    if offset_m is None:
        return "goto needs an offset"
    if reason := why_not_there(scenario, offset_m):
        return reason
    for j, end_m in ends_m.items():
        apart = float(np.linalg.norm(end_m - np.asarray(offset_m)))
        if apart < scenario.limits.min_distance_chasers_m:
            return f"the offset is {apart:.3g} m from where chaser {j} is to be"
    return ""
