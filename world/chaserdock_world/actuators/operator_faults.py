"""Thrusters that an operator has fail in flight, for tests: asked for at any time, decided and answered between ticks."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping

from chaserdock_models.clock import Timing
from chaserdock_protocol.messages import CommandReply, ThrusterFaultCommand
from chaserdock_protocol.scenario import Scenario

from .ideal import Actuators
from .thrusters import ThrusterActuators

Reply = Callable[[CommandReply], None]


class ThrusterFaultHandler:
    """What operators ask of thrusters until the next tick; what of it was done is for the log, the chaser is not told."""

    def __init__(self, scenario: Scenario, actuators: Mapping[str, Actuators]) -> None:
        self._scenario, self._actuators = scenario, actuators
        self._asked: list[tuple[ThrusterFaultCommand, Reply]] = []
        self._state: dict[tuple[int, int], tuple[str, float | None]] = {
            (f.chaser, f.thruster): (f.kind, f.factor) for f in scenario.thruster_failure
        }
        self._lock = threading.Lock()

    def ask(self, command: ThrusterFaultCommand, reply: Reply) -> None:
        """Notes a wish; answered by the next ``decide``. Runs on Zenoh's thread."""
        with self._lock:
            self._asked.append((command, reply))

    def decide(self, tick: int, timing: Timing) -> list[tuple[str, str]]:
        """Does or refuses what was asked for, at the opening of ``tick``, and answers; (what, detail) for the log."""
        with self._lock:
            asked, self._asked = self._asked, []
        told = []
        for command, reply in asked:
            why_not = self._why_not(command)
            reason = why_not or self._do(command, tick, timing)
            by = command.operator or "an operator"
            what = "thruster fault refused" if why_not else "thruster fault by command"
            told.append(
                (
                    what,
                    f"chaser {command.chaser} thruster {command.thruster} {command.kind}, by {by}: {reason}",
                )
            )
            reply(
                CommandReply(
                    tick=tick,
                    sim_time_ns=timing.tick_time_ns(tick),
                    command=f"thruster fault {command.kind}",
                    chaser=command.chaser,
                    accepted=not why_not,
                    reason=reason,
                    operator=command.operator,
                )
            )
        return told

    def _why_not(self, command: ThrusterFaultCommand) -> str:
        chaser, chasers, thrusters = (
            self._scenario.chaser,
            len(self._scenario.chasers),
            len(self._scenario.chaser.thrusters),
        )
        if not chaser.thruster_faults_by_command:
            return "this mission does not allow it (chaser.thruster_faults_by_command = true does)"
        if command.chaser >= chasers:
            return f"there is no chaser {command.chaser}; this mission has 0 to {chasers - 1}"
        if chaser.actuation != "thrusters":
            return 'this mission\'s chasers fly without thrusters (chaser.actuation = "ideal")'
        if command.thruster >= thrusters:
            return f"there is no thruster {command.thruster}; the body has 0 to {thrusters - 1}"
        if (command.kind == "weak") != (command.factor is not None):
            return "factor goes with weak, and weak needs it"
        if command.factor is not None and not 0.0 <= command.factor <= 1.0:
            return f"factor must be from 0 to 1, not {command.factor:g}"
        return ""

    def _do(self, command: ThrusterFaultCommand, tick: int, timing: Timing) -> str:
        """Makes the thruster fail, or mends it, from the opening of ``tick`` on; says what has come of it."""
        key, wanted = (command.chaser, command.thruster), (command.kind, command.factor)
        words = f"thruster {command.thruster} is {command.kind.replace('_', ' ')}"
        if self._state.get(key, ("healthy", None)) == wanted:
            return f"{words} already"
        self._state[key] = wanted
        actuators = self._actuators[f"chaser/{command.chaser}"]
        assert isinstance(actuators, ThrusterActuators)
        kind = None if command.kind == "healthy" else command.kind
        actuators.fail(command.thruster, kind, command.factor, timing.step_of_tick(tick))
        return f"{words} from {timing.tick_time_ns(tick) / 1e9:.2f} s on"
