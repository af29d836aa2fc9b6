"""What the controller knows of the chasers' thrusters: limits, impulse under way, and what operators want. No I/O."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import OperatorCommand, ThrusterReport
from chaserdock_protocol.scenario import Scenario

from chaserdock_controller.guidance import command_validation as validation
from chaserdock_controller.guidance.chaser_state import CommandResult

THRUSTER_COMMANDS = ("isolate", "restore")


class ThrusterCommandHandler:
    """The newest report of every chaser, and the standing wishes of operators."""

    def __init__(self, scenario: Scenario) -> None:
        self._chasers = len(scenario.chasers)
        body = scenario.chaser
        self._thrusters = len(body.thrusters) if body.actuation == "thrusters" else 0
        self._nominal = np.array([body.force_max_N] * 3 + [body.torque_max_N_m] * 3)
        self._reports: dict[int, ThrusterReport] = {}
        self._isolated: dict[int, set[int]] = {}
        self._trusted: dict[int, set[int]] = {}
        self._done: dict[tuple[int, int], tuple[float, OperatorCommand]] = {}

    def take(self, reports: Mapping[int, ThrusterReport]) -> None:
        """Notes reports, by chaser."""
        self._reports.update(reports)

    def limits(self, chaser: int) -> Array:
        """Greatest force and torque (6,) per body axis that a chaser can be asked for now."""
        report = self._reports.get(chaser)
        if report is None:
            return self._nominal.copy()
        return np.minimum(self._nominal, np.abs([*report.force_max_N, *report.torque_max_N_m]))

    def coming(self, chaser: int, tick: int) -> Array | None:
        """Impulse (6,), body axes, that pulses under way give beside a tick's command, if it is told."""
        report = self._reports.get(chaser)
        if report is None or report.tick != tick:
            return None
        return np.array([*report.coming_impulse_N_s, *report.coming_angular_impulse_N_m_s])

    def given(self, tick: int) -> dict[int, Array]:
        """Impulse (6,), body axes, that thrusters gave from the tick before to ``tick``, of the chasers that tell."""
        return {
            i: np.array([*r.given_impulse_N_s, *r.given_angular_impulse_N_m_s])
            for i, r in self._reports.items()
            if r.tick == tick
        }

    def isolated(self, chaser: int) -> tuple[int, ...]:
        """Thrusters that an operator wants shut off."""
        return tuple(sorted(self._isolated.get(chaser, ())))

    def trusted(self, chaser: int) -> tuple[int, ...]:
        """Thrusters that an operator vouches for."""
        return tuple(sorted(self._trusted.get(chaser, ())))

    def command(self, command: OperatorCommand, now_s: float) -> CommandResult:
        """Does what an operator or the time line asks for, or says why not.

        Of ``isolate`` and ``restore`` for one thruster in one tick the first counts.
        """
        i, thruster = command.chaser, command.thruster
        reason = validation.why_unknown_chaser(i, self._chasers) or validation.why_stale(command, now_s)
        if reason:
            return CommandResult(False, reason)
        if self._thrusters == 0:
            return CommandResult(
                False, 'this mission\'s chasers fly without thrusters (chaser.actuation = "ideal")'
            )
        if thruster is None or thruster >= self._thrusters:
            return CommandResult(
                False, f"{command.command} needs a thruster; this body has 0 to {self._thrusters - 1}"
            )
        done_s, done = self._done.get((i, thruster), (-math.inf, command))
        if done_s == now_s and done.command != command.command:
            return validation.superseded_by(done)
        self._done[i, thruster] = now_s, command
        shut, trusted = self._isolated.setdefault(i, set()), self._trusted.setdefault(i, set())
        wanted, other = (shut, trusted) if command.command == "isolate" else (trusted, shut)
        if thruster in wanted:
            return CommandResult(
                True, f"thruster {thruster} is already {'isolated' if wanted is shut else 'restored'}"
            )
        wanted.add(thruster)
        other.discard(thruster)
        return CommandResult(True, f"thruster {thruster} {'isolated' if wanted is shut else 'restored'}")
