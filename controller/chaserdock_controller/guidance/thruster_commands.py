# SPDX-License-Identifier: Apache-2.0
"""Operator commands that isolate and restore thrusters. No I/O."""

from __future__ import annotations

import math

from chaserdock_protocol.messages import OperatorCommand
from chaserdock_protocol.scenario.bodies import Body

from . import command_validation as validation
from .chaser_state import CommandResult

THRUSTER_COMMANDS = ("isolate", "restore")


class ThrusterCommands:
    """Thrusters of one chaser that operators have isolated or restored. Fault detection must not
    isolate restored ones.
    """

    def __init__(self, body: Body) -> None:
        self._thrusters = len(body.thrusters) if body.actuation == "thrusters" else 0
        self.isolated: set[int] = set()
        self.trusted: set[int] = set()
        self._last_commands: dict[int, tuple[float, OperatorCommand]] = {}

    def closed(self, stuck: tuple[int, ...]) -> tuple[int, ...]:
        """Return the thrusters that an operator has isolated, or that are ``stuck``."""
        return tuple(sorted({*self.isolated, *self.untrusted(stuck)}))

    def untrusted(self, thrusters: tuple[int, ...]) -> tuple[int, ...]:
        """Return those of ``thrusters`` that no operator has restored."""
        return tuple(k for k in thrusters if k not in self.trusted)

    def command(self, command: OperatorCommand, now_s: float) -> CommandResult:
        """Execute or refuse a command. Of different commands to one thruster in one tick only the
        first is accepted.
        """
        thruster, count = command.thruster, self._thrusters
        if count == 0:
            return CommandResult(False, validation.WITHOUT_THRUSTERS)
        if thruster is None or thruster >= count:
            reason = f"{command.command} needs a thruster; this body has 0 to {count - 1}"
            return CommandResult(False, reason)
        done_s, done = self._last_commands.get(thruster, (-math.inf, command))
        if done_s == now_s and done.command != command.command:
            return validation.superseded_by(done)
        self._last_commands[thruster] = now_s, command
        isolate = command.command == "isolate"
        chosen, other = (self.isolated, self.trusted) if isolate else (self.trusted, self.isolated)
        state = "isolated" if isolate else "restored"
        if thruster in chosen:
            return CommandResult(True, f"thruster {thruster} is already {state}")
        chosen.add(thruster)
        other.discard(thruster)
        return CommandResult(True, f"thruster {thruster} {state}")
