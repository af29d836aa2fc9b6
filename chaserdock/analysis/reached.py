"""Whether a chaser came to where the time line sent it, judged on ground truth."""

from __future__ import annotations

import numpy as np
from chaserdock_models import rotations
from chaserdock_protocol.scenario import Scenario

from .flight import Flight


def reached_time(flight: Flight, chaser: int) -> float | None:
    """Since when (s, simulated) a chaser has been at the goal of its last ``goto``, to the end; None if it is not.

    The goal is the scenario's own, on the true target, whatever the controller took it for. A chaser that the
    time line sends nowhere has none.
    """
    goal, success = flight.scenario.goal_of(chaser), flight.scenario.success
    if goal is None:
        return None
    sent_s, offset_m = goal
    target, own = flight.truth["target"], flight.truth[f"chaser/{chaser}"]
    n = min(len(target.time_s), len(own.time_s))
    place = target.position_m[:n] + rotations.rotate(target.q_wxyz[:n], np.array(offset_m))
    away = np.linalg.norm(own.position_m[:n] - place, axis=1) > success.reached_position_m
    outside = np.flatnonzero(away | (target.time_s[:n] < sent_s))
    first = int(outside[-1]) + 1 if len(outside) else 0
    return float(target.time_s[first]) if first < n else None


def not_reached(scenario: Scenario, chaser: int, time_s: float | None) -> list[str]:
    """What ``success.reached`` finds fault with, given when the chaser was there for good."""
    success, goal = scenario.success, scenario.goal_of(chaser)
    if chaser not in success.reached or goal is None:
        return []
    if time_s is None:
        return [f"chaser {chaser} is not within {success.reached_position_m:g} m of the goal it was sent to"]
    took_s = time_s - goal[0]
    if success.reached_within_s is not None and took_s > success.reached_within_s:
        return [
            f"chaser {chaser} reached its goal after {took_s:.1f} s, at most {success.reached_within_s:g} s allowed"
        ]
    return []
