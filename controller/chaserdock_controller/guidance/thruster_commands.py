# SPDX-License-Identifier: Apache-2.0
"""Operator commands that isolate and restore thrusters. No I/O."""

from __future__ import annotations

import math

from chaserdock_protocol.messages import OperatorCommand
from chaserdock_protocol.scenario import FlightScenario

from . import command_validation as validation
from .chaser_state import CommandResult

THRUSTER_COMMANDS = ("isolate", "restore")


class ThrusterCommandHandler:
    """Thrusters that operators have isolated or restored, by chaser."""

    def __init__(self, scenario: FlightScenario) -> None:
        self._chasers = len(scenario.chasers)
        body = scenario.chaser
        self._thrusters = len(body.thrusters) if body.actuation == "thrusters" else 0
        self._isolated: dict[int, set[int]] = {}
        self._trusted: dict[int, set[int]] = {}
        self._last_commands: dict[tuple[int, int], tuple[float, OperatorCommand]] = {}

    def isolated(self, chaser: int) -> tuple[int, ...]:
        """Return the thrusters that an operator has isolated."""
        return tuple(sorted(self._isolated.get(chaser, ())))

    def trusted(self, chaser: int) -> tuple[int, ...]:
        """Return the thrusters that an operator has restored, which fault detection must not
        isolate.
        """
        return tuple(sorted(self._trusted.get(chaser, ())))

    def command(self, command: OperatorCommand, now_s: float) -> CommandResult:
        """Apply or refuse a command. Of different commands to one thruster in one tick only the
        first is accepted.
        """
        i, thruster = command.chaser, command.thruster
        reason = validation.why_unknown_chaser(i, self._chasers) or validation.why_stale(
            command, now_s
        )
        if not reason and self._thrusters == 0:
            reason = 'this mission\'s chasers fly without thrusters (chaser.actuation = "ideal")'
        if reason:
            return CommandResult(False, reason)
        if thruster is None or thruster >= self._thrusters:
            reason = f"{command.command} needs a thruster; this body has 0 to {self._thrusters - 1}"
            return CommandResult(False, reason)
        done_s, done = self._last_commands.get((i, thruster), (-math.inf, command))
        if done_s == now_s and done.command != command.command:
            return validation.superseded_by(done)
        self._last_commands[i, thruster] = now_s, command
        isolated, trusted = self._isolated.setdefault(i, set()), self._trusted.setdefault(i, set())
        isolate = command.command == "isolate"
        chosen, other = (isolated, trusted) if isolate else (trusted, isolated)
        state = "isolated" if isolate else "restored"
        if thruster in chosen:
            return CommandResult(True, f"thruster {thruster} is already {state}")
        chosen.add(thruster)
        other.discard(thruster)
        return CommandResult(True, f"thruster {thruster} {state}")
