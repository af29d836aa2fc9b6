# SPDX-License-Identifier: Apache-2.0
"""Decide which wrench commands a chaser executes, and construct its actuator commands. No I/O."""

from __future__ import annotations

from typing import Literal, NamedTuple

import msgspec
import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.braking import brake_wrench
from chaserdock_models.wrench_set import wrench_matrix
from chaserdock_protocol import topics
from chaserdock_protocol.codec import vector
from chaserdock_protocol.leases import longest_lease_ticks
from chaserdock_protocol.messages import ActuatorCommand, Odometry, Tick, WrenchCommand
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.scenario.bodies import Body

from .lease_grantor import LeaseGrantor
from .local_damping import LocalDamping
from .outbox import Outbox


class Decision(NamedTuple):
    """What follows from a wrench command.

    ``execute``: the command to fly, None for a refused one. ``uncommanded_tick``: tick for which
    its sender gives no valid command; in lock-step only.
    """

    execute: WrenchCommand | None = None
    uncommanded_tick: int | None = None


class CommandGate:
    """Accept the commands of the controller that holds the chaser's lease, and refuse others.

    ``leases``: to whom this chaser has promised which ticks. ``executed_tick``: tick of the last
    actuator command that answers its tick; older commands are refused.
    """

    def __init__(
        self, scenario: FlightScenario, number: int, realtime: bool, outbox: Outbox
    ) -> None:
        self._scenario, self._number, self._realtime = scenario, number, realtime
        self._outbox = outbox
        self.leases = LeaseGrantor(number, scenario.time.rate_hz)
        self.executed_tick = -1
        self._term = 0
        self._refused = 0  # commands since the last one that was executed
        # Whether the current series of stale or otherwise refused commands has been reported.
        self._reported_stale = self._reported_refusal = False

    def begin_tick(self, tick: Tick) -> None:
        """Keep the lease or grant it to the next controller, and publish it."""
        if (lease := self.leases.update(tick)) is not None:
            self._outbox.publish(topics.LEASE, lease)

    def decide(self, command: WrenchCommand, tick: Tick | None, now_ns: int) -> Decision:
        """Decide on a command. ``tick``: the newest; ``now_ns``: the simulated time."""
        newest = -1 if tick is None else tick.tick
        # A command of a far tick would count as newer than all that follow, and would extend the
        # lease.
        early = command.tick > newest + longest_lease_ticks(self._scenario.time.rate_hz)
        stale = (
            f"for tick {command.tick}, the newest is {newest}"
            if early
            else self.leases.refusal(command)
        )
        if stale:
            self._outbox.count_rejected("wrench:early tick" if early else "wrench:stale term")
            return self._refuse_stale(command, stale, newest if early else command.tick, now_ns)
        if command.mode in ("none", "wait", "yield"):
            return self._without_command(command, tick)
        if command.tick == self.executed_tick and command.term > self._term:
            self._renew_lease(command, tick)
            return Decision()  # repeated by a controller that became commander within the tick
        due_ns = self._scenario.timing.effective_ns(command.tick)
        reason = refusal(
            command, self._number, self._scenario.chaser, self.executed_tick, now_ns, due_ns
        )
        if reason is not None:
            return self._refuse(command, reason, now_ns)
        self._renew_lease(command, tick)
        self._accept(command)
        # The tick states when a command takes effect, as all processes share it; the controller's
        # clock may be wrong.
        return Decision(execute=msgspec.structs.replace(command, effective_time_ns=due_ns))

    def _refuse_stale(
        self, command: WrenchCommand, reason: str, tick: int, now_ns: int
    ) -> Decision:
        """Refuse a command that its sender may not give in this tick."""
        self._refused += 1
        if not self._reported_stale:
            self._outbox.warn("command refused", reason, tick, now_ns)
        self._reported_stale = True
        # A holder that does not know its term sends nothing else in this tick.
        return self._without(tick) if self.leases.is_of_holder(command) else Decision()

    def _refuse(self, command: WrenchCommand, reason: str, now_ns: int) -> Decision:
        """Refuse a command that cannot be executed; the world waits for a safe one instead."""
        self._outbox.count_stale()
        self._refused += 1
        if not self._reported_refusal:
            self._outbox.warn("command refused", reason, command.tick, now_ns)
        self._reported_refusal = True
        return Decision(uncommanded_tick=command.tick)

    def _without_command(self, command: WrenchCommand, tick: Tick | None) -> Decision:
        """Continue without a command of the lease's holder, which sends none in this tick."""
        if command.mode == "yield":
            self.leases.give_back(command)
        elif command.mode == "none":
            self._renew_lease(command, tick)
        return self._without(command.tick)

    def _without(self, tick: int) -> Decision:
        # In real time the last command remains valid for its lifetime.
        return Decision() if self._realtime else Decision(uncommanded_tick=tick)

    def _accept(self, command: WrenchCommand) -> None:
        self._term = command.term
        if self._refused:
            detail = f"{self._refused} refused"
            self._outbox.event(
                "info", "commands accepted again", detail, command.tick, command.sim_time_ns
            )
        self._refused = 0
        self._reported_refusal = self._reported_stale = False

    def _renew_lease(self, command: WrenchCommand, tick: Tick | None) -> None:
        self.leases.renew(command)
        if self._realtime and tick is not None:
            # The holder may need it before this process receives the next tick.
            self._outbox.publish(topics.LEASE, self.leases.stated(tick))


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
