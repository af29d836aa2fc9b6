# SPDX-License-Identifier: Apache-2.0
"""Simulate a chaser's thrusters: valves that open and close as commanded, with failures.

The wrench about the centre of mass is constant in body axes over a physics step and equals the mean
over the step.
"""

from __future__ import annotations

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.clock import Timing
from chaserdock_models.thruster_model import Valves
from chaserdock_models.wrench_set import wrench_matrix
from chaserdock_protocol.messages import ActuatorCommand, ThrusterPulse
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.bodies import Body
from chaserdock_protocol.scenario.thrusters import FailureKind, Thruster, ThrusterFailure

from chaserdock_world.plant import ActuationErrors, actuation_errors

from .ideal import ActuatorOutput, Actuators, IdealActuators

_LOOK_AHEAD_STEPS = 32
"""Physics steps for which wrenches are computed at once. A change of the pulses discards the rest;
32 steps take 32 us, two take 38 us.
"""


class ThrusterActuators:
    """Simulate the thrusters of one chaser; implements ``Actuators``.

    Pulses have absolute times. The part of a pulse that has passed when a late command arrives is
    lost.
    """

    def __init__(
        self,
        body: Body,
        timing: Timing,
        failures: tuple[ThrusterFailure, ...],
        errors: ActuationErrors | None = None,
    ) -> None:
        self._timing, self._errors = timing, errors
        thrusters = body.thrusters if errors is None else true_thrusters(body.thrusters, errors)
        self._shortest_ns = [round(t.min_on_s * 1e9) for t in thrusters]
        self._matrix = wrench_matrix(thrusters)
        self._valves = Valves(thrusters)
        for failure in failures:
            self._valves.fail(
                failure.thruster, failure.kind, round(failure.at_s * 1e9), failure.factor
            )
        self._wrenches: Array = np.zeros((0, 6))
        self._thrusts: Array = np.zeros((0, len(thrusters)))
        self._wrenches_from = 0
        self._impulse = np.zeros(6)
        self._absolute_N_s = 0.0
        self._saturated = False
        self._late = 0
        self._taken_step = 0

    def fail(
        self, thruster: int, kind: FailureKind | None, factor: float | None, step: int
    ) -> None:
        """Make a thruster fail from ``step`` on, or with ``kind`` None work again.

        ``take_output`` must have been called up to ``step``.
        """
        self._valves.fail(thruster, kind, self._timing.time_ns(step), factor)
        self._wrenches = np.zeros((0, 6))

    def command(self, command: ActuatorCommand, effective_step: int, now_step: int) -> None:
        """See ``Actuators.command``. A pulse that the valve cannot execute counts as saturated."""
        now_ns = self._timing.time_ns(max(now_step, effective_step))
        delay_ns = 0 if self._errors is None else round(self._errors.delay(effective_step) * 1e9)
        for p in command.pulses:
            open_ns = p.open_ns + delay_ns
            begin_ns, close_ns = max(open_ns, now_ns), open_ns + self._width_ns(p)
            if close_ns > begin_ns and not self._valves.pulse(p.thruster, begin_ns, close_ns):
                self._saturated |= begin_ns == open_ns
        self._valves.set_shut(command.isolated, now_ns)
        self._late += effective_step < now_step
        self._wrenches = np.zeros((0, 6))

    def _width_ns(self, pulse: ThrusterPulse) -> int:
        """Return how long a pulse opens its valve: as commanded, up to scatter."""
        width, k = pulse.close_ns - pulse.open_ns, pulse.thruster
        if self._errors is None or not self._errors.scatter_share or k >= len(self._shortest_ns):
            return width
        scattered = round(width * float(self._errors.scatter(k, pulse.open_ns, 1)[0]))
        return scattered if width < self._shortest_ns[k] else max(scattered, self._shortest_ns[k])

    def _wrenches_after(self, step: int) -> Array:
        """Return mean wrenches (K, 6) of the physics steps from ``step`` on, at least two."""
        row = step - self._wrenches_from
        if not 0 <= row < len(self._wrenches) - 1:
            edges_ns = np.array(
                [self._timing.time_ns(step + k) for k in range(_LOOK_AHEAD_STEPS + 1)], dtype=float
            )
            impulses = self._valves.impulses(edges_ns) / np.diff(edges_ns)[:, None] * 1e9
            # Rounded so that equal wrenches compare equal regardless of the last bits.
            self._thrusts = np.round(impulses, 12)
            self._wrenches, self._wrenches_from, row = self._thrusts @ self._matrix.T, step, 0
        return self._wrenches[row:]

    def next_change(self, step: int) -> int | None:
        """See ``Actuators.next_change``."""
        wrenches = self._wrenches_after(step)
        changes = np.flatnonzero((wrenches[1:] != wrenches[0]).any(axis=1))
        return step + (int(changes[0]) + 1 if len(changes) else len(wrenches))

    def act(self, step: int, steps: int, step_s: float) -> Array:
        """See ``Actuators.act``."""
        wrench = self._wrenches_after(step)[0]
        self._impulse = self._impulse + wrench * (steps * step_s)
        self._absolute_N_s += float(np.abs(wrench[:3]).sum()) * steps * step_s
        return wrench

    def thrusts(self, step: int) -> Array:
        """See ``Actuators.thrusts``."""
        self._wrenches_after(step)
        return self._thrusts[step - self._wrenches_from]

    def stop(self, step: int) -> None:
        """See ``Actuators.stop``. Valves that are stuck stay open."""
        self._valves.stop(self._timing.time_ns(step))
        self._wrenches = np.zeros((0, 6))

    def take_output(self, step: int) -> ActuatorOutput:
        """See ``Actuators.take_output``."""
        since_ns, now_ns = self._timing.time_ns(self._taken_step), self._timing.time_ns(step)
        thrusters = self._valves.impulses(np.array([since_ns, now_ns]))[0]
        output = ActuatorOutput(
            self._impulse,
            self._absolute_N_s,
            self._saturated,
            self._late,
            tuple(thrusters.tolist()),
            tuple(self._valves.open_s(since_ns, now_ns).tolist()),
            self._valves.propellant_kg(thrusters),
        )
        self._impulse, self._absolute_N_s, self._saturated, self._late = np.zeros(6), 0.0, False, 0
        self._taken_step = step
        self._valves.forget_before(now_ns)
        return output


def true_thrusters(stated: tuple[Thruster, ...], errors: ActuationErrors) -> tuple[Thruster, ...]:
    """Return the thrusters with their true thrust and direction."""
    return tuple(
        t.model_copy(
            update={
                "thrust_N": t.thrust_N * (1.0 + share),
                "direction": tuple(rotations.rotate(rotations.exp(turn), t.direction).tolist()),
            }
        )
        for t, share, turn in zip(
            stated, errors.thrust_share.tolist(), errors.thrust_turn_rad, strict=True
        )
    )


def make_actuators(scenario: Scenario, chaser: int) -> Actuators:
    """Return the actuators that the scenario gives to a chaser."""
    drawn = actuation_errors(scenario, chaser)
    errors = None if drawn.none else drawn
    if scenario.chaser.actuation == "ideal":
        return IdealActuators(scenario.chaser, errors, scenario.time.physics_hz)
    failures = tuple(f for f in scenario.thruster_failure if f.chaser == chaser)
    return ThrusterActuators(scenario.chaser, scenario.timing, failures, errors)
