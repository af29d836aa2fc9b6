# SPDX-License-Identifier: Apache-2.0
"""Validation of wrench commands by a chaser, and construction of actuator commands. Pure functions."""

from __future__ import annotations

from typing import Literal

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.braking import brake_wrench
from chaserdock_models.wrench_set import wrench_matrix
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import ActuatorCommand, Odometry, WrenchCommand
from chaserdock_protocol.scenario.bodies import Body

from .local_damping import LocalDamping


def refusal(
    command: WrenchCommand, chaser: int, body: Body, last_tick: int, now_ns: int, due_ns: int
) -> str | None:
    """Return why a wrench command must not be executed, or None.

    ``last_tick``: the newest tick whose command was executed; ``now_ns``: the newest simulated time
    known; ``due_ns``: when commands of its tick take effect.
    """
    if command.chaser != chaser:
        return f"addressed to chaser {command.chaser}"
    if command.tick <= last_tick:
        return f"for tick {command.tick}, but a command for tick {last_tick} was already executed"
    if command.expires_ns <= now_ns:
        return f"expired at {command.expires_ns / 1e9:.3f} s, now {now_ns / 1e9:.3f} s"
    # The controller's clock is ahead; commands of one that is behind have expired.
    if command.effective_time_ns - due_ns > command.expires_ns - command.sim_time_ns:
        due = f"commands for tick {command.tick} do at {due_ns / 1e9:.3f} s"
        return f"takes effect at {command.effective_time_ns / 1e9:.3f} s, {due}"
    if command.thrusts_N:
        return _thrusts_refusal(command.thrusts_N, body)
    # The margin covers rounding.
    largest_N = max(map(abs, command.force_N))
    if largest_N > body.force_max_N * 1.01:
        return f"force of {largest_N:.3g} N exceeds the body's {body.force_max_N:.3g} N"
    largest_N_m = max(map(abs, command.torque_N_m))
    if largest_N_m > body.torque_max_N_m * 1.01:
        return f"torque of {largest_N_m:.3g} N m exceeds the body's {body.torque_max_N_m:.3g} N m"
    return None


def _thrusts_refusal(thrusts_N: tuple[float, ...], body: Body) -> str | None:
    """Return why commanded thrusts cannot be given, or None."""
    count = len(body.thrusters) if body.actuation == "thrusters" else 0
    if len(thrusts_N) != count:
        return f"thrusts of {len(thrusts_N)} thrusters, but the body has {count}"
    for k, (thrust_N, thruster) in enumerate(zip(thrusts_N, body.thrusters, strict=True)):
        if not 0.0 <= thrust_N <= thruster.thrust_N * 1.01:
            return f"thrust of {thrust_N:.3g} N exceeds thruster {k}'s {thruster.thrust_N:.3g} N"
    return None


def brake_command(
    odometry: Odometry, body: Body, effective_ns: int, latched: bool = False
) -> ActuatorCommand:
    """Return the command that brings a chaser to rest in WRF (see ``braking``); a latched chaser
    gets a zero wrench.
    """
    wrench = np.zeros(6) if latched else brake_wrench(odometry, body)
    return autonomous_command(odometry, effective_ns, "brake", wrench)


def autonomous_command(
    odometry: Odometry, effective_ns: int, source: Literal["plan", "brake", "hold"], wrench: Array
) -> ActuatorCommand:
    """Return an actuator command of the chaser itself; ``wrench`` (6,): force and torque, body
    axes.
    """
    return ActuatorCommand(
        tick=odometry.tick,
        sim_time_ns=odometry.sim_time_ns,
        chaser=odometry.chaser,
        effective_time_ns=effective_ns,
        source=source,
        force_N=vector(wrench[:3]),
        torque_N_m=vector(wrench[3:]),
    )


def damping_command(
    damping: LocalDamping, odometry: Odometry, effective_ns: int, body: Body
) -> tuple[ActuatorCommand, Array]:
    """Return the command of a latched chaser that damps the stack, and its thrusts (n,)."""
    thrusts_N = damping.thrusts_N(odometry)
    wrench = wrench_matrix(body.thrusters) @ thrusts_N
    return autonomous_command(odometry, effective_ns, "brake", wrench), thrusts_N


def passed_on(command: WrenchCommand) -> ActuatorCommand:
    """Return the actuator command that executes a command of the controller."""
    return ActuatorCommand(
        tick=command.tick,
        sim_time_ns=command.sim_time_ns,
        chaser=command.chaser,
        effective_time_ns=command.effective_time_ns,
        source="command",
        force_N=command.force_N,
        torque_N_m=command.torque_N_m,
        latch=command.latch,
        term=command.term,
    )
