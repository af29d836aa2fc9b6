"""What a chaser does with commands: pass on what it can trust, brake when it cannot. Pure functions."""

from __future__ import annotations

from typing import Literal

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.braking import brake_wrench
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import ActuatorCommand, Odometry, Tick, WrenchCommand
from chaserdock_protocol.scenario.bodies import Body


def refusal(command: WrenchCommand, chaser: int, body: Body, last_tick: int, now_ns: int) -> str | None:
    """Why a wrench command must not be flown, or None.

    ``last_tick`` is the newest tick whose command was flown, ``now_ns`` the newest simulated time known.
    """
    if command.chaser != chaser:
        return f"it is for chaser {command.chaser}"
    if command.tick <= last_tick:
        return f"it answers tick {command.tick}, and one for tick {last_tick} was flown already"
    if command.expires_ns <= now_ns:
        return f"it expired at {command.expires_ns / 1e9:.3f} s, and it is {now_ns / 1e9:.3f} s"
    # A little above the limits is rounding; more is not a command for this body.
    strongest_N = max(map(abs, command.force_N))
    if strongest_N > body.force_max_N * 1.01:
        return f"its force of {strongest_N:.3g} N exceeds the body's {body.force_max_N:.3g} N"
    strongest_N_m = max(map(abs, command.torque_N_m))
    if strongest_N_m > body.torque_max_N_m * 1.01:
        return f"its torque of {strongest_N_m:.3g} N m exceeds the body's {body.torque_max_N_m:.3g} N m"
    return None


def stale_term(command: WrenchCommand, tick: Tick | None, last_term: int) -> str | None:
    """Why the sender of a command does not command any more, or None.

    ``tick``: the newest one known; ``last_term``: of the newest command flown. A term that is newer than both is the
    world's word, too: its tick is still on its way.
    """
    known = max(last_term, tick.term if tick is not None else 0)
    if command.term < known:
        return f"stale term: it is of term {command.term}, and term {known} has begun"
    if tick is None or command.term > tick.term or not tick.term:
        return None
    if (command.commander, command.instance) != (tick.commander, tick.instance):
        return f"stale term: {command.commander} {command.instance} does not command term {tick.term}"
    return None


def brake(odometry: Odometry, body: Body, effective_ns: int, latched: bool = False) -> ActuatorCommand:
    """The command that brings a chaser to rest in WRF: see ``braking``. One that holds on to the target stays quiet."""
    wrench = np.zeros(6) if latched else brake_wrench(odometry, body)
    return own_command(odometry, effective_ns, "brake", wrench)


def own_command(
    odometry: Odometry, effective_ns: int, source: Literal["plan", "brake", "hold"], wrench: Array
) -> ActuatorCommand:
    """A chaser's own command, of which no controller knows; ``wrench`` (6,): force and torque, body axes."""
    return ActuatorCommand(
        tick=odometry.tick,
        sim_time_ns=odometry.sim_time_ns,
        chaser=odometry.chaser,
        effective_time_ns=effective_ns,
        source=source,
        force_N=vector(wrench[:3]),
        torque_N_m=vector(wrench[3:]),
    )


def passed_on(command: WrenchCommand) -> ActuatorCommand:
    """The controller's command as the chaser's own."""
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
