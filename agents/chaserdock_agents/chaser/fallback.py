# SPDX-License-Identifier: Apache-2.0
"""Fly a chaser that receives no commands.

Pure functions; SI units; WRF unless stated otherwise. Three modes in this order, recorded as
events: fly the last plan to the end of its horizon (``plan``), come to rest relative to the target
(``brake``), hold a position relative to it outside of the approach corridor (``hold``). The inputs
are the plan and the target estimate of the last executed command; the target is extrapolated with
constant velocity. Where the target was unknown, rest and position are those in WRF.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.braking import BRAKE_TIME_S, brake_wrench
from chaserdock_models.docking_geometry import centre_offset
from chaserdock_models.setpoint_tracking import Setpoint, track_setpoint
from chaserdock_models.wrench_set import wrench_matrix
from chaserdock_protocol.messages import Odometry, Plan, TargetEstimate
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.scenario.bodies import Body
from chaserdock_protocol.scenario.thrusters import thrusts_max

FallbackMode = Literal["plan", "brake", "hold"]

REST_M_S, REST_RAD_S = 0.004, math.radians(0.3)
"""A chaser slower than this (m/s relative to the target, rad/s in WRF) is at rest. Smaller: noise
keeps it from rest; larger: it holds a position while it still drifts.
"""
BRAKE_LIMIT_S = 5 * BRAKE_TIME_S
"""Longest time of ``brake``, s. The braking law does not reject a constant disturbance, which may
keep a chaser from rest.
"""
REST_PULSES = 2.0
"""A chaser with thrusters is at rest below the rates that this many shortest pulses of its
strongest thruster change.
"""
CLEARANCE_MARGIN_M = 0.05
"""Distance (m) of the hold position beyond the entry of the corridor (docs/redundancy.md). Larger:
more room for a chaser in the corridor; smaller: a shorter way out of it.
"""


@dataclass(frozen=True)
class LastCommand:
    """Plan and target estimate that belong to the last executed command."""

    plan: Plan | None = None
    target: TargetEstimate | None = None


class FallbackLimits(NamedTuple):
    """Limits of the fallback.

    ``clearance_m``: least distance of the hold position from the target. ``rest_m_s``,
    ``rest_rad_s``: speed and rate below which a chaser is at rest.
    """

    clearance_m: float
    rest_m_s: float
    rest_rad_s: float


@dataclass(frozen=True)
class FallbackState:
    """Mode of a chaser without commands.

    ``since_ns``: when ``brake`` began. For ``hold``: ``outward_w`` (3,), unit vector from the
    target to the chaser, and ``distance_m`` between them; without a known target the position
    itself (3,) and None.
    """

    mode: FallbackMode
    outward_w: Array | None = None
    distance_m: float | None = None
    since_ns: int = 0

    def text(self) -> str:
        """Return the detail of the event."""
        if self.mode == "plan":
            return "executing the last plan to its end"
        if self.mode == "brake":
            return "coming to rest"
        if self.distance_m is None:
            return "holding the current position, as the target is unknown"
        return f"holding at {self.distance_m:.2f} m from the extrapolated target"


def interpolate_plan(plan: Plan | None, time_ns: int) -> Setpoint | None:
    """Return the setpoint of a plan at a time.

    Before the plan's start it is the first one; None after its end or without a plan.
    """
    if plan is None or not plan.inputs:
        return None
    stages = len(plan.inputs) // 6
    elapsed_steps = max(0.0, (time_ns - plan.sim_time_ns) / 1e9 / plan.step_s)
    k = int(elapsed_steps)
    if k >= stages:
        return None
    p = np.reshape(plan.positions_m, (-1, 3))[k : k + 2]
    q = np.reshape(plan.quaternions_wxyz, (-1, 4))[k : k + 2]
    turn = rotations.log(rotations.multiply(rotations.conjugate(q[0]), q[1]))
    fraction = elapsed_steps - k
    return Setpoint(
        p[0] + fraction * (p[1] - p[0]),
        (p[1] - p[0]) / plan.step_s,
        rotations.multiply(q[0], rotations.exp(fraction * turn)),
        turn / plan.step_s,
        np.array(plan.inputs[6 * k : 6 * k + 6]),
    )


def extrapolate_target(target: TargetEstimate | None, time_ns: int) -> Array | None:
    """Return the extrapolated position (3,) of the target's origin; None if the target was not
    known.
    """
    if target is None or not target.is_known:
        return None
    elapsed_s = (time_ns - target.sim_time_ns) / 1e9
    return np.asarray(target.position_m) + elapsed_s * np.asarray(target.velocity_m_s)


def clearance_m(scenario: FlightScenario, chaser: int) -> float:
    """Return the distance from the target (m, centre to centre) at which a chaser is outside of its
    corridor.

    The corridor begins at the entry to the chaser's port or, for docking at a distance, at its
    nominal position.
    """
    port = scenario.docking.port_of(chaser)
    entry_m = math.hypot(*scenario.chasers[chaser].position_m) - CLEARANCE_MARGIN_M
    if port is not None:
        reach_m = scenario.chaser.probe_reach_m
        entry_m = float(np.linalg.norm(centre_offset(port, reach_m, scenario.docking.entry_m)))
    return max(scenario.limits.min_distance_target_m, entry_m) + CLEARANCE_MARGIN_M


def fallback_limits(scenario: FlightScenario, chaser: int) -> FallbackLimits:
    """Return the limits of a chaser's fallback.

    With thrusters they allow for rates of a few shortest pulses, which modulation cannot avoid.
    """
    body, rest_m_s, rest_rad_s = scenario.chaser, REST_M_S, REST_RAD_S
    if body.actuation == "thrusters":
        shortest_N_s = thrusts_max(body.thrusters) * [t.min_on_s for t in body.thrusters]
        impulses = REST_PULSES * wrench_matrix(body.thrusters) * shortest_N_s
        rates = np.linalg.norm(impulses[3:] / np.array(body.inertia)[:, None], axis=0)
        rest_m_s = max(rest_m_s, float(np.linalg.norm(impulses[:3], axis=0).max()) / body.mass_kg)
        rest_rad_s = max(rest_rad_s, float(rates.max()))
    return FallbackLimits(clearance_m(scenario, chaser), rest_m_s, rest_rad_s)


def target_velocity(target: TargetEstimate | None) -> Array:
    """Return the velocity (3,) of the target's origin, WRF; zero if the target was not known."""
    if target is None or not target.is_known:
        return np.zeros(3)
    return np.asarray(target.velocity_m_s)


def is_at_rest(odometry: Odometry, velocity_m_s: Array, limits: FallbackLimits) -> bool:
    """Return whether a chaser moves with ``velocity_m_s`` (3,), WRF, and does not rotate."""
    speed_m_s = math.hypot(*(np.asarray(odometry.velocity_m_s) - velocity_m_s))
    return speed_m_s < limits.rest_m_s and math.hypot(*odometry.omega_rad_s) < limits.rest_rad_s


def next_state(
    state: FallbackState | None,
    odometry: Odometry,
    effective_ns: int,
    last: LastCommand,
    limits: FallbackLimits,
) -> FallbackState:
    """Return the fallback state that follows ``state`` (None: the fallback starts). Modes only
    advance.

    ``effective_ns``: when the actuator command of this tick takes effect. Braking ends at rest, or
    after ``BRAKE_LIMIT_S``. A chaser that is farther away than ``limits.clearance_m`` keeps its
    distance.
    """
    mode = None if state is None else state.mode
    if mode in (None, "plan") and interpolate_plan(last.plan, effective_ns) is not None:
        return FallbackState("plan")
    if state is not None and state.mode == "hold":
        return state
    since_ns = state.since_ns if state is not None and state.mode == "brake" else effective_ns
    if (effective_ns - since_ns) / 1e9 < BRAKE_LIMIT_S and not is_at_rest(
        odometry, target_velocity(last.target), limits
    ):
        return FallbackState("brake", since_ns=since_ns)
    position, target = (
        np.asarray(odometry.position_m),
        extrapolate_target(last.target, odometry.sim_time_ns),
    )
    if target is None or not np.any(position - target):
        return FallbackState("hold", position)
    distance_m = float(np.linalg.norm(position - target))
    return FallbackState(
        "hold", (position - target) / distance_m, max(distance_m, limits.clearance_m)
    )


def hold_setpoint(state: FallbackState, odometry: Odometry, last: LastCommand) -> Setpoint:
    """Return the setpoint of mode ``hold``: moves with the target and keeps the current
    attitude.
    """
    assert state.outward_w is not None
    zero = np.zeros(3)
    q = np.asarray(odometry.q_wxyz)
    target = extrapolate_target(last.target, odometry.sim_time_ns)
    if state.distance_m is None or target is None or last.target is None:
        return Setpoint(state.outward_w, zero, q, zero, np.zeros(6))
    position = target + state.distance_m * state.outward_w
    return Setpoint(position, np.asarray(last.target.velocity_m_s), q, zero, np.zeros(6))


def fallback_wrench(
    state: FallbackState, odometry: Odometry, effective_ns: int, last: LastCommand, body: Body
) -> Array:
    """Return force and torque (6,), body axes, of a chaser without commands."""
    if state.mode == "hold":
        return track_setpoint(odometry, body, hold_setpoint(state, odometry, last))
    current = interpolate_plan(last.plan, odometry.sim_time_ns) if state.mode == "plan" else None
    effective = interpolate_plan(last.plan, effective_ns)
    if current is None or effective is None:
        return brake_wrench(odometry, body, target_velocity(last.target))
    # Errors at the time of the odometry, feed-forward at the time the command takes effect.
    setpoint = Setpoint(
        current.position_m,
        current.velocity_m_s,
        current.q_wxyz,
        current.omega_rad_s,
        effective.wrench,
    )
    return track_setpoint(odometry, body, setpoint)
