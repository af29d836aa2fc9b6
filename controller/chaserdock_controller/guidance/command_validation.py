# SPDX-License-Identifier: Apache-2.0
"""Reasons for refusing a command; each function returns an empty string if there is none. Pure
functions.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import OperatorCommand, SightedMap
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.scenario.checks import angle_deg, shape_distance_m, shapes_apart_m
from numpy.typing import ArrayLike

from chaserdock_controller.interfaces import PlanningFailure

from .approach_cone import BESIDE_LINE_M
from .approach_line import ApproachLine
from .chaser_state import CommandResult
from .phases import Phase

WITHOUT_THRUSTERS = 'this mission\'s chasers fly without thrusters (chaser.actuation = "ideal")'


def why_stale(command: OperatorCommand, now_s: float) -> str:
    """Check a command's expiry time."""
    if command.expires_ns is None or command.expires_ns >= round(now_s * 1e9):
        return ""
    return f"stale: the command expired at {command.expires_ns / 1e9:.2f} s, now is {now_s:.2f} s"


def why_unknown_chaser(chaser: int, chasers: int) -> str:
    """Check a chaser's number."""
    return (
        ""
        if chaser < chasers
        else f"there is no chaser {chaser}; this mission has 0 to {chasers - 1}"
    )


def why_not_along(line: ApproachLine, offset_m: Array) -> str:
    """Check that a reference at ``offset_m`` (3,), TRF, is on the approach line."""
    aside = line.aside_m(offset_m)
    if aside > BESIDE_LINE_M:
        return f"the reference is {aside:.2f} m beside the approach line; retreat or goto first"
    return ""


def why_not_closed(scenario: FlightScenario, sighted: SightedMap | None) -> str:
    """Check that the loop of the map of an unknown target has closed: before, nothing flies near
    by it.
    """
    if not scenario.maps_target or (sighted is not None and sighted.closed):
        return ""
    return (
        "the loop of the map is open: until a side of the target has returned its rate is wrong by "
        "up to 1 %; wait"
    )


def why_not_calibrate(scenario: FlightScenario, phase: Phase, at_rest: bool) -> str:
    """Check that a chaser can fly the calibration manoeuvre."""
    if phase is not Phase.HOLD or not at_rest:
        return f"in phase {phase}; hold first"
    uncertain = scenario.navigation.errors().uncertain_mounting
    if scenario.estimator.name != "joint" or not uncertain:
        return (
            "the cameras are taken as exact: set navigation.camera_turn_deg (and estimator.name = "
            "joint)"
        )
    return ""


def why_not_inspect(scenario: FlightScenario, chaser: int, offset_m: Array, at_rest: bool) -> str:
    """Check that a chaser can fly around the target."""
    if not at_rest:
        return "the chaser moves; hold first"
    distance_m, own_m = scenario.inspection.distance_m, float(np.linalg.norm(offset_m))
    if reason := why_not_offset(scenario, chaser, (distance_m, 0.0, 0.0)):
        return reason
    if own_m > 2.0 * distance_m:
        return (
            f"the chaser is {own_m:.3g} m from the target; fly to less than twice "
            f"inspection.distance_m ({distance_m:g} m) first"
        )
    return ""


def why_not_offset(scenario: FlightScenario, chaser: int, offset_m: ArrayLike) -> str:
    """Check the distance from the target of a chaser at an offset (3,), TRF."""
    distance = float(np.linalg.norm(offset_m))
    nearest = scenario.limits.min_distance_target_m
    if not nearest < distance <= scenario.limits.max_reference_distance_m:
        return (
            f"the offset is {distance:.3g} m from the target; allowed are more than {nearest:.3g} m"
        )
    return why_not_off_shape(scenario, chaser, offset_m)


def why_not_off_shape(scenario: FlightScenario, chaser: int, offset_m: ArrayLike) -> str:
    """Check the distance of a chaser's shape, at an offset (3,), TRF, from the cuboids of the
    target.
    """
    least_m = scenario.limits.min_distance_shape_m
    if not least_m or (distance_m := shape_distance_m(scenario, chaser, offset_m)) >= least_m:
        return ""
    return (
        f"there the chaser is {distance_m:.3g} m from the target's shape; allowed are at least "
        f"{least_m:.3g} m"
    )


def why_not_in_cone(scenario: FlightScenario, chaser: int, offset_m: ArrayLike) -> str:
    """Check that an offset (3,), TRF, is in a chaser's approach cone."""
    cone_deg = scenario.approach.cone_deg
    if cone_deg is None:
        return ""
    off_deg = angle_deg(scenario.chasers[chaser].position_m, np.asarray(offset_m))
    if off_deg <= cone_deg:
        return ""
    return (
        f"the offset is {off_deg:.3g} degrees off the approach axis; the approach cone has "
        f"{cone_deg:g} degrees"
    )


def why_not_goto(
    scenario: FlightScenario, chaser: int, offset_m: ArrayLike | None, ends_m: Mapping[int, Array]
) -> str:
    """Check a chaser's offset (3,), TRF, against the target and the goals ``ends_m`` of the other
    chasers.
    """
    if offset_m is None:
        return "goto needs an offset"
    if reason := why_not_offset(scenario, chaser, offset_m):
        return reason
    least_m = scenario.limits.min_distance_shape_m
    for j, end_m in ends_m.items():
        apart = float(np.linalg.norm(end_m - np.asarray(offset_m)))
        if apart < scenario.limits.min_distance_chasers_m:
            return f"the offset is {apart:.3g} m from the goal of chaser {j}"
        if (
            least_m
            and (apart := shapes_apart_m(scenario, (chaser, offset_m), (j, end_m))) < least_m
        ):
            return (
                f"there the chaser is {apart:.3g} m from chaser {j} at its goal; allowed are at "
                f"least {least_m:.3g} m"
            )
    return ""


def superseded_by(done: OperatorCommand) -> CommandResult:
    """Return the refusal of a command because ``done`` came first in the same tick."""
    operator = f" by {done.operator}" if done.operator else ""
    return CommandResult(False, f"{done.command}{operator} came first in this tick")


def why_not_identify(scenario: FlightScenario) -> str:
    """Check that the scenario allows to identify the stack."""
    if not scenario.detumble.identification.enabled:
        return "detumble.identification.enabled is false"
    if not scenario.chaser.thrusters or scenario.chaser.actuation != "thrusters":
        return WITHOUT_THRUSTERS
    return ""


def refused_by(failure: PlanningFailure) -> tuple[str, ...]:
    """Return the operator commands that are refused while planning fails.

    Without any plan these are all that need one. With degraded plans `goto` stays allowed, so that
    an operator can lead a chaser out.
    """
    always = ("approach", "inspect")
    return (*always, "goto", "calibrate") if failure.without_plan else always
