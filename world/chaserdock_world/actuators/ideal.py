"""What drives a chaser in the world: commands held back until they take effect, bounded by the actuators.

``ideal`` actuation gives the commanded wrench itself, cut off at the body's limits per axis; thrusters are in
``thruster_actuators``.
"""

from __future__ import annotations

import heapq
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import numpy as np
from chaserdock_models.rotations import Array
from chaserdock_protocol.messages import ActuatorCommand
from chaserdock_protocol.scenario.bodies import Body

from chaserdock_world.physics.simulation import Physics


class Given(NamedTuple):
    """What actuators gave since they were last asked: impulse (6,), body axes, and the time integral of the force
    components' magnitudes; whether a command was more than they can do, how many came late; of thrusters, see BodyTruth."""

    impulse: Array
    absolute_impulse_N_s: float
    saturated: bool
    late: int
    thruster_impulse_N_s: tuple[float, ...] = ()
    thruster_open_s: tuple[float, ...] = ()
    propellant_kg: float = 0.0


class Actuators(Protocol):
    """What drives one chaser: see ``IdealActuators`` for the meaning of each member."""

    def command(self, command: ActuatorCommand, effective_step: int, now_step: int) -> None: ...

    def next_change(self, step: int) -> int | None: ...

    def act(self, step: int, steps: int, step_s: float) -> Array: ...

    def stop(self, step: int) -> None: ...

    def take(self, step: int) -> Given: ...


@dataclass
class IdealActuators:
    """Commands of one chaser in the order of their effect, and what has been given so far."""

    body: Body
    wrench: Array = field(default_factory=lambda: np.zeros(6))
    impulse: Array = field(default_factory=lambda: np.zeros(6))
    absolute_impulse_N_s: float = 0.0
    saturated: bool = False
    late: int = 0
    _waiting: list[tuple[int, int, int, Array]] = field(default_factory=list)
    _taken: int = 0

    def command(self, command: ActuatorCommand, effective_step: int, now_step: int) -> None:
        """Takes a command that is to act from ``effective_step`` on; a late one acts at once, and is counted."""
        limit = np.repeat([self.body.force_max_N, self.body.torque_max_N_m], 3)
        asked = np.array([*command.force_N, *command.torque_N_m])
        given = np.clip(asked, -limit, limit)
        self.saturated |= bool(np.any(np.abs(asked) > limit * (1 + 1e-6)))
        self.late += effective_step < now_step
        # A chaser started anew counts from zero again: then the last to come decides, and arrays are never compared.
        self._taken += 1
        heapq.heappush(self._waiting, (effective_step, command.seq, self._taken, given))

    def next_change(self, step: int) -> int | None:
        """The first step after ``step`` at which another command takes effect, if one waits."""
        return min((w[0] for w in self._waiting if w[0] > step), default=None)

    def act(self, step: int, steps: int, step_s: float) -> Array:
        """The wrench (6,), body axes, that acts from physics step ``step`` on, for ``steps`` steps of ``step_s``.

        There must be no change in between (see ``next_change``).
        """
        while self._waiting and self._waiting[0][0] <= step:
            self.wrench = heapq.heappop(self._waiting)[3]
        self.impulse = self.impulse + self.wrench * (steps * step_s)
        self.absolute_impulse_N_s += float(np.abs(self.wrench[:3]).sum()) * steps * step_s
        return self.wrench

    def stop(self, step: int) -> None:
        """The chaser is gone at physics step ``step``: nothing acts any more."""
        self._waiting.clear()
        self.wrench = np.zeros(6)

    def take(self, step: int) -> Given:
        """What was given since the last call, up to physics step ``step``."""
        out = Given(self.impulse, self.absolute_impulse_N_s, self.saturated, self.late)
        self.impulse, self.absolute_impulse_N_s, self.saturated, self.late = np.zeros(6), 0.0, False, 0
        return out


def fly_to(
    end_step: int, physics: Physics, actuators: Mapping[str, Actuators], step_s: float
) -> set[tuple[str, str]]:
    """Advances the physics to ``end_step`` under what the actuators give; the pairs of bodies that touched."""
    touched: set[tuple[str, str]] = set()
    while (step := physics.step_count) < end_step:
        changes = (a.next_change(step) for a in actuators.values())
        until = min((c for c in changes if c is not None), default=end_step)
        steps = min(until, end_step) - step
        touched |= physics.advance(steps, {name: a.act(step, steps, step_s) for name, a in actuators.items()})
    return touched
