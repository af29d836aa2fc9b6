# SPDX-License-Identifier: Apache-2.0
"""Track the bodies of a scenario on an engine, by name, with states in their own frames."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.rigid_body import BodyState

from chaserdock_world.plant import Plant

from .definitions import TARGET
from .engine import BodyMotion, RigidBodyEngine
from .target_motion import PrescribedMotion


class MovingBodies:
    """Names and numbers of the bodies on ``engine``, and their motion after ``step_count`` steps.

    ``prescribed``: motion of the target, None if the engine integrates it. ``before``: motion of
    the free bodies, by number, at the beginning of the last step; while steps are made one by one.
    """

    def __init__(
        self,
        engine: RigidBodyEngine,
        plants: Mapping[str, Plant],
        prescribed: PrescribedMotion | None,
    ) -> None:
        self.engine, self.plants, self.prescribed = engine, plants, prescribed
        self.names = tuple(plants)
        self.numbers = {name: number for number, name in enumerate(plants)}
        self.before: dict[int, BodyMotion] = {}
        self.step_count = 0

    def state(self, name: str) -> BodyState:
        """Return the current state of a body; that of a prescribed target is exact."""
        if name == TARGET and self.prescribed is not None:
            return self.prescribed.at(self.step_count)
        return self._state_of(name, self.engine.motion(self.numbers[name]))

    def state_before(self, name: str) -> BodyState:
        """Return the state of a free body at the beginning of the last step."""
        return self._state_of(name, self.before[self.numbers[name]])

    def _state_of(self, name: str, motion: BodyMotion) -> BodyState:
        """Return the state of a body's frame from the engine's motion of it."""
        position, q_wxyz, velocity, omega_world = motion
        q = rotations.normalize(q_wxyz)
        omega = rotations.rotate_inverse(q, omega_world)
        state = BodyState(np.array(position), np.array(velocity), q, omega)
        return self.plants[name].from_engine(state)

    def place(self, name: str, state: BodyState) -> None:
        """Set the state of a body. Contacts are not checked."""
        self.engine.place(self.numbers[name], self.plants[name].to_engine(state))

    def place_target(self) -> None:
        """Move the engine's copy of a prescribed target, if that is due."""
        if self.prescribed is not None and self.prescribed.is_placed_at(self.step_count):
            self.place(TARGET, self.state(TARGET))
