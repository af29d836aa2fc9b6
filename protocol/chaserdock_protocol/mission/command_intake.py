# SPDX-License-Identifier: Apache-2.0
"""Pass actuator commands from the network to actuators and latches, and reject those that do not
act.

No I/O.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple, Protocol

from chaserdock_models.clock import Timing

from chaserdock_protocol.messages import ActuatorCommand, Latch

from .observed_commander import ObservedCommander
from .open_tick import OpenTick

_MAX_CLOCK_ERROR_NS = 1_000_000_000
"""Largest difference (ns) between a command's effective time and its tick's. More comes from a
wrong clock.
"""


class CommandedActuators(Protocol):
    """Actuators of one chaser as the owner of a mission commands them."""

    def command(self, command: ActuatorCommand, effective_step: int, now_step: int) -> None:
        """Queue a command that acts from ``effective_step`` on; a late one acts at once."""
        ...

    def stop(self, step: int) -> None:
        """Stop the actuators at ``step``: the chaser is lost."""
        ...


class Taken(NamedTuple):
    """What became of a command.

    ``rejected``: why it does not act; empty if it does. ``hand_over``: why the commander changed
    with it; empty if it did not.
    """

    rejected: str = ""
    hand_over: str = ""


class CommandIntake:
    """Pass commands to ``actuators``, by the chasers' names, and stop actuators that get none.

    ``current_step``: returns the present physics step. ``command_latch(chaser, latch, step)``:
    commands a latch.
    """

    def __init__(
        self,
        timing: Timing,
        actuators: Mapping[str, CommandedActuators],
        current_step: Callable[[], int],
        command_latch: Callable[[int, Latch, int], None],
        watchdog_s: float = 0.5,
    ) -> None:
        self.commander = ObservedCommander()
        self._timing = timing
        self._actuators = actuators
        self._current_step = current_step
        self._command_latch = command_latch
        # At least two ticks, as a command acts until the next tick's arrives.
        self._watchdog_ns = round(max(watchdog_s, 2.0 / timing.rate_hz) * 1e9)
        self._commanded_ns: dict[str, int] = {}
        self._executed_tick: dict[int, int] = {}

    @property
    def names(self) -> tuple[str, ...]:
        """Return the names of all chasers, in the order of their numbers."""
        return tuple(self._actuators)

    def take(self, command: ActuatorCommand, opened: OpenTick, now_s: float, once: bool) -> Taken:
        """Apply a command, and note the reply to the open tick; or reject it.

        ``once``: whether a second reply to the same tick is rejected. ``now_s``: the clock by which
        silent commanders are reported.
        """
        taken = self._check(command, opened, now_s, once)
        if taken.rejected:
            return taken
        name = f"chaser/{command.chaser}"
        self._commanded_ns[name] = max(
            self._timing.tick_time_ns(command.tick), self._commanded_ns.get(name, 0)
        )
        effective_step = self._timing.step_of_time(command.effective_time_ns)
        self._actuators[name].command(command, effective_step, self._current_step())
        self._command_latch(command.chaser, command.latch, effective_step)
        return taken

    def _check(self, command: ActuatorCommand, opened: OpenTick, now_s: float, once: bool) -> Taken:
        name, hand_over = f"chaser/{command.chaser}", ""
        if name not in self._actuators or command.tick > opened.tick:
            return Taken("unexpected")
        listed = opened.instances.get(name, "")
        if listed and command.instance and command.instance != listed:
            # By another process of this chaser, while this one was taken for lost.
            return Taken("replaced")
        if command.tick < self._executed_tick.get(command.chaser, -1):
            return Taken("overtaken")  # by a command that the same chaser has executed later
        if command.source == "command":
            self._executed_tick[command.chaser] = command.tick
            hand_over = self.commander.update(command, opened.controllers, now_s)
        if command.tick == opened.tick:
            if command.chaser in opened.replied and once:
                return Taken("twice", hand_over)
            opened.replied.add(command.chaser)
        due_ns = self._timing.effective_ns(command.tick)
        wrong_clock = abs(command.effective_time_ns - due_ns) > _MAX_CLOCK_ERROR_NS
        return Taken("time" if wrong_clock else "", hand_over)

    def stop(self, name: str) -> None:
        """Stop the actuators of a chaser that was lost."""
        self._actuators[name].stop(self._current_step())
        self._commanded_ns.pop(name, None)

    def stop_uncommanded(self, now_ns: int) -> list[str]:
        """Stop actuators that no longer receive commands, as the watchdog of a valve driver does.

        Return what to report of each.
        """
        silent = [
            n for n, at_ns in self._commanded_ns.items() if now_ns - at_ns > self._watchdog_ns
        ]
        for name in silent:
            self.stop(name)
        return [f"{name}: no command for {self._watchdog_ns / 1e9:g} s" for name in silent]
