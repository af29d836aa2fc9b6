"""What a chaser does that gets no commands. Pure functions; SI units; WRF unless said otherwise.

Three states, in this order and named in the log: it flies its last ``plan`` to the end of the horizon, comes to rest
(``brake``), then keeps a place relative to the target that is clear of the corridor it was in (``hold``). It knows what
came with the last command it flew: its plan, and the target's estimate, which it extrapolates by constant velocity.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.braking import brake_wrench
from chaserdock_models.docking_geometry import centre_offset
from chaserdock_protocol.messages import Odometry, Plan, TargetEstimate
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.bodies import Body

State = Literal["plan", "brake", "hold"]

REST_M_S, REST_RAD_S = 0.004, math.radians(0.3)
"""Slower than this a chaser is at rest."""
CLEAR_M = 0.05
"""So much farther out than where corridors begin it holds."""
# Second-order laws with a damping ratio of 0.9: of the position, slow enough to move at some cm/s, and the attitude.
_POSITION_RAD_S, _ATTITUDE_RAD_S, _DAMPING = 0.3, 0.6, 0.9
_KNOWN = ("tracking", "predicting")


@dataclass(frozen=True)
class Goal:
    """Where to be and how to move there: position, velocity (3,) WRF, attitude (4,) body to WRF, rate (3,) body;
    ``wrench`` (6,), body axes, that this takes."""

    position_m: Array
    velocity_m_s: Array
    q_wxyz: Array
    omega_rad_s: Array
    wrench: Array


@dataclass(frozen=True)
class LastWord:
    """What came with the last command that was flown."""

    plan: Plan | None = None
    target: TargetEstimate | None = None


@dataclass(frozen=True)
class Alone:
    """What a chaser without commands is doing. For ``hold``: ``out_w`` (3,) unit, from the target outwards, and
    ``distance_m`` from it; where no target is known, the place itself (3,) and None."""

    state: State
    out_w: Array | None = None
    distance_m: float | None = None

    def text(self) -> str:
        """For the log."""
        if self.state == "plan":
            return "flies its last plan to the end"
        if self.state == "brake":
            return "comes to rest"
        if self.distance_m is None:
            return "holds where it is: it knows of no target"
        return f"holds at {self.distance_m:.2f} m from where the target should be"


def planned(plan: Plan | None, time_ns: int) -> Goal | None:
    """What a plan has for a time; before it begins, its beginning; None when it is over, or there is none."""
    if plan is None or not plan.inputs:
        return None
    stages = len(plan.inputs) // 6
    after = max(0.0, (time_ns - plan.sim_time_ns) / 1e9 / plan.step_s)
    k = int(after)
    if k >= stages:
        return None
    p = np.reshape(plan.positions_m, (-1, 3))[k : k + 2]
    q = np.reshape(plan.quaternions_wxyz, (-1, 4))[k : k + 2]
    turn = rotations.log(rotations.multiply(rotations.conjugate(q[0]), q[1]))
    part = after - k
    return Goal(
        p[0] + part * (p[1] - p[0]),
        (p[1] - p[0]) / plan.step_s,
        rotations.multiply(q[0], rotations.exp(part * turn)),
        turn / plan.step_s,
        np.array(plan.inputs[6 * k : 6 * k + 6]),
    )


def target_at(target: TargetEstimate | None, time_ns: int) -> Array | None:
    """Where the target's origin (3,) should be; None when it was not known."""
    if target is None or target.status not in _KNOWN:
        return None
    after_s = (time_ns - target.sim_time_ns) / 1e9
    return np.asarray(target.position_m) + after_s * np.asarray(target.velocity_m_s)


def clear_m(scenario: Scenario, chaser: int) -> float:
    """Distance from the target (m, centre to centre) from which on a chaser is in no corridor of its own: beyond the
    entry to its port's or, where it docks at a distance, its nominal one, from which it approaches."""
    port = scenario.docking.port_of(chaser)
    entry_m = math.hypot(*scenario.chasers[chaser].position_m) - CLEAR_M
    if port is not None:
        reach_m = scenario.chaser.probe_reach_m
        entry_m = float(np.linalg.norm(centre_offset(port, reach_m, scenario.docking.entry_m)))
    return max(scenario.limits.min_distance_target_m, entry_m) + CLEAR_M


def at_rest(odometry: Odometry) -> bool:
    """Whether a chaser moves and turns no more, WRF."""
    return math.hypot(*odometry.velocity_m_s) < REST_M_S and math.hypot(*odometry.omega_rad_s) < REST_RAD_S


def goes_on(
    before: Alone | None, odometry: Odometry, effective_ns: int, last: LastWord, least_m: float
) -> Alone:
    """What a chaser does now that did ``before`` (None: has just become alone). A state never comes again.

    ``effective_ns``: when what it tells its actuators acts. ``least_m``: distance from the target to hold at, at least;
    one that is farther away stays as far.
    """
    state = None if before is None else before.state
    if state in (None, "plan") and planned(last.plan, effective_ns) is not None:
        return Alone("plan")
    if state != "hold" and not at_rest(odometry):
        return Alone("brake")
    if before is not None and before.state == "hold":
        return before
    here, target = np.asarray(odometry.position_m), target_at(last.target, odometry.sim_time_ns)
    if target is None or not np.any(here - target):
        return Alone("hold", here)
    distance_m = float(np.linalg.norm(here - target))
    return Alone("hold", (here - target) / distance_m, max(distance_m, least_m))


def steered(odometry: Odometry, body: Body, goal: Goal) -> Array:
    """Force and torque (6,), body axes, within the body's limits, that keep a chaser to a goal."""
    pull = goal.position_m - np.asarray(odometry.position_m)
    push = goal.velocity_m_s - np.asarray(odometry.velocity_m_s)
    acceleration = _POSITION_RAD_S**2 * pull + 2 * _DAMPING * _POSITION_RAD_S * push
    force = goal.wrench[:3] + body.mass_kg * rotations.rotate_inverse(odometry.q_wxyz, acceleration)
    turn = rotations.log(rotations.multiply(rotations.conjugate(odometry.q_wxyz), goal.q_wxyz))
    spin = goal.omega_rad_s - np.asarray(odometry.omega_rad_s)
    alpha = _ATTITUDE_RAD_S**2 * turn + 2 * _DAMPING * _ATTITUDE_RAD_S * spin
    torque = goal.wrench[3:] + np.asarray(body.inertia) * alpha
    return np.concatenate(
        [
            np.clip(force, -body.force_max_N, body.force_max_N),
            np.clip(torque, -body.torque_max_N_m, body.torque_max_N_m),
        ]
    )


def held(alone: Alone, odometry: Odometry, last: LastWord) -> Goal:
    """Where a chaser holds now: it moves along with the target, and keeps its attitude."""
    assert alone.out_w is not None
    still, quiet = np.zeros(3), np.zeros(6)
    q = np.asarray(odometry.q_wxyz)
    target = target_at(last.target, odometry.sim_time_ns)
    if alone.distance_m is None or target is None or last.target is None:
        return Goal(alone.out_w, still, q, still, quiet)
    place = target + alone.distance_m * alone.out_w
    return Goal(place, np.asarray(last.target.velocity_m_s), q, still, quiet)


def wrench_of(alone: Alone, odometry: Odometry, effective_ns: int, last: LastWord, body: Body) -> Array:
    """Force and torque (6,), body axes, of a chaser without commands."""
    if alone.state == "hold":
        return steered(odometry, body, held(alone, odometry, last))
    goal = planned(last.plan, odometry.sim_time_ns) if alone.state == "plan" else None
    soon = planned(last.plan, effective_ns)
    if goal is None or soon is None:
        return brake_wrench(odometry, body)
    # Errors as of the odometry, the plan's own wrench as of when it acts.
    return steered(
        odometry, body, Goal(goal.position_m, goal.velocity_m_s, goal.q_wxyz, goal.omega_rad_s, soon.wrench)
    )
