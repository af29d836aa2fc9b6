"""Thrusters that drive a chaser in the world: valves open and close as commanded, or as they have failed.

A thruster's force acts at its place: that is a force and a torque about the centre of mass, constant in body axes over a
physics step, in which it is the mean of what the thrusters give. Propellant is accounted for; the mass stays the same.
"""

from __future__ import annotations

import numpy as np
from chaserdock_models.clock import Timing
from chaserdock_models.rotations import Array
from chaserdock_models.thruster_model import Valves
from chaserdock_models.wrench_set import wrench_matrix
from chaserdock_protocol.messages import ActuatorCommand
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.bodies import Body
from chaserdock_protocol.scenario.thrusters import FailureKind, ThrusterFailure

from .ideal import Actuators, Given, IdealActuators

_AHEAD_STEPS = 32


class ThrusterActuators:
    """The thrusters of one chaser: ``actuators.IdealActuators`` says what its members mean.

    Pulses have absolute times. What of them has passed when a late command comes is not made up for.
    """

    def __init__(self, body: Body, timing: Timing, failures: tuple[ThrusterFailure, ...]) -> None:
        self._timing = timing
        self._matrix = wrench_matrix(body.thrusters)
        self._valves = Valves(body.thrusters)
        for failure in failures:
            self._valves.fail(failure.thruster, failure.kind, round(failure.at_s * 1e9), failure.factor)
        self._ahead: Array = np.zeros((0, 6))
        self._ahead_from = 0
        self._impulse = np.zeros(6)
        self._absolute_N_s = 0.0
        self._refused = False
        self._late = 0
        self._taken_step = 0

    def fail(self, thruster: int, kind: FailureKind | None, factor: float | None, step: int) -> None:
        """From ``step`` on, until which ``take`` has been called, a thruster fails in a way; None: it works again."""
        self._valves.fail(thruster, kind, self._timing.time_ns(step), factor)
        self._ahead = np.zeros((0, 6))

    def command(self, command: ActuatorCommand, effective_step: int, now_step: int) -> None:
        """Takes a command's pulses and shut-off valves; what cannot be done counts as saturated."""
        now_ns = self._timing.time_ns(max(now_step, effective_step))
        for p in command.pulses:
            begin_ns = max(p.open_ns, now_ns)
            if p.close_ns > begin_ns and not self._valves.pulse(p.thruster, begin_ns, p.close_ns):
                self._refused |= begin_ns == p.open_ns
        self._valves.set_shut(command.isolated, now_ns)
        self._late += effective_step < now_step
        self._ahead = np.zeros((0, 6))

    def _look_ahead(self, step: int) -> Array:
        """Mean wrenches (K, 6) of the physics steps from ``step`` on, at least two."""
        row = step - self._ahead_from
        if not 0 <= row < len(self._ahead) - 1:
            edges_ns = np.array(
                [self._timing.time_ns(step + k) for k in range(_AHEAD_STEPS + 1)], dtype=float
            )
            impulses = self._valves.impulses(edges_ns) / np.diff(edges_ns)[:, None] * 1e9
            # So that what does not change is equal, whatever the last bits say.
            self._ahead, self._ahead_from, row = np.round(impulses, 12) @ self._matrix.T, step, 0
        return self._ahead[row:]

    def next_change(self, step: int) -> int | None:
        """The first step after ``step`` at which the wrench is another, or is not known yet."""
        ahead = self._look_ahead(step)
        differs = np.flatnonzero((ahead[1:] != ahead[0]).any(axis=1))
        return step + (int(differs[0]) + 1 if len(differs) else len(ahead))

    def act(self, step: int, steps: int, step_s: float) -> Array:
        """The wrench (6,), body axes, that acts from ``step`` on for ``steps`` steps, no change in between."""
        wrench = self._look_ahead(step)[0]
        self._impulse = self._impulse + wrench * (steps * step_s)
        self._absolute_N_s += float(np.abs(wrench[:3]).sum()) * steps * step_s
        return wrench

    def stop(self, step: int) -> None:
        """The chaser is gone: its valves close, but for what is stuck."""
        self._valves.stop(self._timing.time_ns(step))
        self._ahead = np.zeros((0, 6))

    def take(self, step: int) -> Given:
        """What was given since the last call, up to physics step ``step``."""
        since_ns, now_ns = self._timing.time_ns(self._taken_step), self._timing.time_ns(step)
        thrusters = self._valves.impulses(np.array([since_ns, now_ns]))[0]
        out = Given(
            self._impulse,
            self._absolute_N_s,
            self._refused,
            self._late,
            tuple(thrusters.tolist()),
            tuple(self._valves.open_s(since_ns, now_ns).tolist()),
            self._valves.propellant_kg(thrusters),
        )
        self._impulse, self._absolute_N_s, self._refused, self._late = np.zeros(6), 0.0, False, 0
        self._taken_step = step
        self._valves.forget_before(now_ns)
        return out


def actuators_of(scenario: Scenario, chaser: int) -> Actuators:
    """What drives a chaser, as the scenario has it."""
    if scenario.chaser.actuation == "ideal":
        return IdealActuators(scenario.chaser)
    failures = tuple(f for f in scenario.thruster_failure if f.chaser == chaser)
    return ThrusterActuators(scenario.chaser, scenario.timing, failures)
