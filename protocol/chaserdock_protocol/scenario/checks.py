"""What a scenario's chasers may not be asked: checks over several of its sections."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from . import Scenario


def check_apart(scenario: Scenario) -> None:
    """Raises ValueError where two chasers start inside one another."""
    starts = [scenario.start_pose(i)[0] for i in range(len(scenario.chasers))]
    width = math.hypot(*scenario.chaser.size_m)
    for i, a in enumerate(starts):
        for j in range(i):
            apart = math.dist(a, starts[j])
            if apart < width:
                raise ValueError(
                    f"chasers.{j} and chasers.{i} start {apart:.3f} m apart, inside one another; "
                    f"their bodies need {width:.3f} m"
                )


def check_references(scenario: Scenario) -> None:
    """Raises ValueError where a chaser is to be where the controller may not take it."""
    limits = scenario.limits
    for i, c in enumerate(scenario.chasers):
        far = math.hypot(*c.position_m)
        for word, wrong, name in (
            ("nearer", far < limits.min_distance_target_m, "min_distance_target_m"),
            ("farther", far > limits.max_reference_distance_m, "max_reference_distance_m"),
        ):
            if wrong:
                raise ValueError(
                    f"chasers.{i}.position_m: {far:.3g} m from the target, {word} than limits.{name} "
                    f"({getattr(limits, name):g} m) allows"
                )
        for j, other in enumerate(scenario.chasers[:i]):
            apart = math.dist(c.position_m, other.position_m)
            if apart < limits.min_distance_chasers_m:
                raise ValueError(
                    f"chasers.{j} and chasers.{i} are to be {apart:.3g} m apart, nearer than "
                    f"limits.min_distance_chasers_m ({limits.min_distance_chasers_m:g} m) allows"
                )
