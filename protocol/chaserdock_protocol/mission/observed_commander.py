# SPDX-License-Identifier: Apache-2.0
"""Observe in the commands that chasers execute which controller commands. Decides nothing.

No I/O; time is passed in.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from chaserdock_protocol.leases import commander_of
from chaserdock_protocol.messages import ActuatorCommand


@dataclass
class ObservedCommander:
    """The controller ``name`` with the newest ``term`` that a chaser has flown."""

    name: str = ""
    term: int = 0
    _instance: str = ""
    _commanded_s: float = 0.0

    def update(self, command: ActuatorCommand, controllers: Mapping[str, str], now_s: float) -> str:
        """Take an executed command; return a change of commander as text for the log, empty without
        one.

        ``controllers``: those connected, name to instance.
        """
        if command.term <= self.term:
            self._commanded_s = now_s if command.term == self.term else self._commanded_s
            return ""
        before, instance, silent_s = self.name, self._instance, now_s - self._commanded_s
        self.term, self.name, self._commanded_s = command.term, commander_of(command.term), now_s
        self._instance = controllers.get(self.name, "")
        if not before or (before, instance) == (self.name, self._instance):
            return ""
        connected = controllers.get(before) == instance
        reason = (
            f"no command of {before} executed for {silent_s:.2f} s"
            if connected
            else f"{before} lost"
        )
        return f"term {self.term}: {self.name} leads: {reason}"
