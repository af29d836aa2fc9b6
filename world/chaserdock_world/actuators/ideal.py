# SPDX-License-Identifier: Apache-2.0
"""Simulate ideal actuators, which give the commanded wrench, and define the interface of all.

Commands wait until they take effect. Ideal actuators limit each axis of a command to the body's
limits.
"""

from __future__ import annotations

import heapq
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, limited
from chaserdock_protocol.messages import ActuatorCommand
from chaserdock_protocol.scenario.bodies import Body

from chaserdock_world.physics.simulation import Physics
from chaserdock_world.plant import ActuationErrors


class ActuatorOutput(NamedTuple):
    """Output of a chaser's actuators over an interval.

    ``impulse`` (6,): N s and N m s, body axes. ``absolute_impulse_N_s``: time integral of the sum
    of the force components' magnitudes. ``saturated``: whether a command exceeded the limits.
    ``late``: number of commands that came after their effective time. Fields of thrusters: see
    ``BodyTruth``.
    """

    impulse: Array
    absolute_impulse_N_s: float
    saturated: bool
    late: int
    thruster_impulse_N_s: tuple[float, ...] = ()
    thruster_open_s: tuple[float, ...] = ()
    propellant_kg: float = 0.0


class Actuators(Protocol):
    """Actuators of one chaser. Steps are physics steps."""

    def command(self, command: ActuatorCommand, effective_step: int, now_step: int) -> None:
        """Queue a command that acts from ``effective_step`` on; a late one acts at once and is
        counted.
        """
        ...

    def next_change(self, step: int) -> int | None:
        """Return the first step after ``step`` at which the wrench may change, None if none is
        known.
        """
        ...

    def act(self, step: int, steps: int, step_s: float) -> Array:
        """Return the wrench (6,), body axes, N and N m, from ``step`` on, and account for it.

        It is accounted for during ``steps`` steps, in which it must not change (see
        ``next_change``).
        """
        ...

    def thrusts(self, step: int) -> Array:
        """Return the thrust (n,), N, of every thruster from ``step`` on, as long as the wrench does
        not change.
        """
        ...

    def stop(self, step: int) -> None:
        """Stop the actuators at ``step``: the chaser is lost."""
        ...

    def take_output(self, step: int) -> ActuatorOutput:
        """Return the output since the last call, up to ``step``."""
        ...


@dataclass
class IdealActuators:
    """Actuators that give the commanded wrench within the body's limits, up to ``errors``."""

    body: Body
    errors: ActuationErrors | None = None
    physics_hz: int = 960
    wrench: Array = field(default_factory=lambda: np.zeros(6))
    impulse: list[float] = field(default_factory=lambda: [0.0] * 6)
    absolute_impulse_N_s: float = 0.0
    saturated: bool = False
    late: int = 0
    _queue: list[tuple[int, int, int, Array]] = field(default_factory=list)
    _received: int = 0
    _last_step: int = 0
    _values: list[float] = field(default_factory=lambda: [0.0] * 6)
    _absolute_N: float = 0.0

    def command(self, command: ActuatorCommand, effective_step: int, now_step: int) -> None:
        """See ``Actuators.command``."""
        limit = self.body.wrench_max
        wrench = np.array([*command.force_N, *command.torque_N_m])
        self.saturated |= bool((np.abs(wrench) > limit * (1 + 1e-6)).any())
        self.late += effective_step < now_step
        # A restarted chaser counts ``seq`` from zero again; the order of arrival decides, and
        # arrays are never compared.
        self._received += 1
        wrench = limited(wrench, limit)
        if self.errors is not None:
            wrench = given_wrench(self.errors, wrench, effective_step)
            delayed = effective_step + round(self.errors.delay(effective_step) * self.physics_hz)
            # Jitter does not change the order of commands.
            effective_step = self._last_step = max(delayed, now_step, self._last_step)
        heapq.heappush(self._queue, (effective_step, command.seq, self._received, wrench))

    def next_change(self, step: int) -> int | None:
        """See ``Actuators.next_change``."""
        if not self._queue:
            return None
        return min((entry[0] for entry in self._queue if entry[0] > step), default=None)

    def act(self, step: int, steps: int, step_s: float) -> Array:
        """See ``Actuators.act``."""
        while self._queue and self._queue[0][0] <= step:
            self._set_wrench(heapq.heappop(self._queue)[3])
        duration_s = steps * step_s
        self.impulse = [a + b * duration_s for a, b in zip(self.impulse, self._values, strict=True)]
        self.absolute_impulse_N_s += self._absolute_N * steps * step_s
        return self.wrench

    def _set_wrench(self, wrench: Array) -> None:
        self.wrench, self._values = wrench, wrench.tolist()
        self._absolute_N = float(np.abs(wrench[:3]).sum())

    def thrusts(self, step: int) -> Array:
        """See ``Actuators.thrusts``: there are no thrusters."""
        return np.zeros(0)

    def stop(self, step: int) -> None:
        """See ``Actuators.stop``."""
        self._queue.clear()
        self._set_wrench(np.zeros(6))

    def take_output(self, step: int) -> ActuatorOutput:
        """See ``Actuators.take_output``."""
        output = ActuatorOutput(
            np.array(self.impulse), self.absolute_impulse_N_s, self.saturated, self.late
        )
        self.impulse, self.absolute_impulse_N_s, self.saturated, self.late = (
            [0.0] * 6,
            0.0,
            False,
            0,
        )
        return output


def given_wrench(errors: ActuationErrors, wrench: Array, step: int) -> Array:
    """Return the wrench (6,) that actuators with errors give for a command that acts from ``step``
    on.
    """
    wrench = wrench * (1.0 + errors.thrust_share)
    if errors.scatter_share:
        wrench = wrench * errors.scatter(0, step, 6)
    turns = errors.thrust_turn_rad
    parts = (rotations.rotate(rotations.exp(turns[k]), wrench[3 * k : 3 * k + 3]) for k in range(2))
    return np.concatenate(list(parts))


def fly_to(
    end_step: int, physics: Physics, actuators: Mapping[str, Actuators], step_s: float
) -> set[tuple[str, str]]:
    """Advance the physics to ``end_step`` under the actuators' wrenches; return the pairs of bodies
    that touched.
    """
    touched: set[tuple[str, str]] = set()
    while (step := physics.step_count) < end_step:
        changes = (physics.next_change(step), *(a.next_change(step) for a in actuators.values()))
        until = min((c for c in changes if c is not None), default=end_step)
        steps = min(until, end_step) - step
        wrenches = {name: a.act(step, steps, step_s) for name, a in actuators.items()}
        if physics.plumes is not None:
            states = {name: physics.state(name) for name in physics.bodies}
            thrusts = {name: a.thrusts(step) for name, a in actuators.items()}
            for name, load in physics.plumes.act(states, thrusts, steps * step_s).items():
                wrenches[name] = wrenches[name] + load if name in wrenches else load
        if physics.burns_propellant:
            for name, a in actuators.items():
                physics.burn(name, a.thrusts(step), steps * step_s)
        touched |= physics.advance(steps, wrenches)
    return touched
