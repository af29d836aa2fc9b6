# SPDX-License-Identifier: Apache-2.0
"""Inject thruster faults on request of an operator in flight.

They are requested at any time, applied and answered between ticks.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping

from chaserdock_models.clock import Timing
from chaserdock_protocol.messages import CommandReply, ThrusterFaultCommand
from chaserdock_protocol.scenario import Scenario

from .ideal import Actuators
from .thrusters import ThrusterActuators


class ThrusterFaultHandler:
    """Collect thruster fault commands and apply them at the next tick, unknown to the chaser."""

    def __init__(self, scenario: Scenario, actuators: Mapping[str, Actuators]) -> None:
        self._scenario, self._actuators = scenario, actuators
        self._requests: list[tuple[ThrusterFaultCommand, Callable[[CommandReply], None]]] = []
        self._state: dict[tuple[int, int], tuple[str, float | None]] = {
            (f.chaser, f.thruster): (f.kind, f.factor) for f in scenario.thruster_failure
        }
        self._lock = threading.Lock()

    def submit(self, command: ThrusterFaultCommand, reply: Callable[[CommandReply], None]) -> None:
        """Queue a command; the next ``apply_pending`` replies to it. Runs on Zenoh's thread."""
        with self._lock:
            self._requests.append((command, reply))

    def apply_pending(self, tick: int, timing: Timing) -> list[tuple[str, str]]:
        """Apply or refuse the queued commands at the opening of ``tick`` and reply; return events
        (what, detail).
        """
        with self._lock:
            requests, self._requests = self._requests, []
        events = []
        for command, reply in requests:
            refusal = self._refusal(command)
            reason = refusal or self._apply(command, tick, timing)
            operator = command.operator or "an operator"
            what = "thruster fault refused" if refusal else "thruster fault by command"
            which = f"chaser {command.chaser} thruster {command.thruster} {command.kind}"
            events.append((what, f"{which}, by {operator}: {reason}"))
            reply(
                CommandReply(
                    tick=tick,
                    sim_time_ns=timing.tick_time_ns(tick),
                    command=f"thruster fault {command.kind}",
                    chaser=command.chaser,
                    accepted=not refusal,
                    reason=reason,
                    operator=command.operator,
                )
            )
        return events

    def _refusal(self, command: ThrusterFaultCommand) -> str:
        body, chasers = self._scenario.chaser, len(self._scenario.chasers)
        if not body.thruster_faults_by_command:
            return (
                "this mission does not allow thruster faults (set "
                "chaser.thruster_faults_by_command = true)"
            )
        if command.chaser >= chasers:
            return f"there is no chaser {command.chaser}; this mission has 0 to {chasers - 1}"
        if body.actuation != "thrusters":
            return 'the chasers of this mission have no thrusters (chaser.actuation = "ideal")'
        if command.thruster >= len(body.thrusters):
            return (
                f"there is no thruster {command.thruster}; the body has 0 to "
                f"{len(body.thrusters) - 1}"
            )
        if (command.kind == "weak") != (command.factor is not None):
            return "factor is required for weak and not allowed otherwise"
        if command.factor is not None and not 0.0 <= command.factor <= 1.0:
            return f"factor must be from 0 to 1, not {command.factor:g}"
        return ""

    def _apply(self, command: ThrusterFaultCommand, tick: int, timing: Timing) -> str:
        """Make the thruster fail, or repair it, from ``tick`` on; return the result as text."""
        key, requested = (command.chaser, command.thruster), (command.kind, command.factor)
        result = f"thruster {command.thruster} is {command.kind.replace('_', ' ')}"
        if self._state.get(key, ("healthy", None)) == requested:
            return f"{result} already"
        self._state[key] = requested
        actuators = self._actuators[f"chaser/{command.chaser}"]
        assert isinstance(actuators, ThrusterActuators)
        kind = None if command.kind == "healthy" else command.kind
        actuators.fail(command.thruster, kind, command.factor, timing.step_of_tick(tick))
        return f"{result} from {timing.tick_time_ns(tick) / 1e9:.2f} s on"
