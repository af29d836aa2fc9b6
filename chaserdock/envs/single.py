# SPDX-License-Identifier: Apache-2.0
"""One training environment of one chaser, as a Gymnasium ``Env``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
from chaserdock_protocol.scenario import Scenario

from . import loaded
from .batch import DockingBatch, Floats, ObservationArray
from .scene import RENDER_MODES, EnvironmentView, RgbImage
from .spaces import action_space, observation_space, require_finite, require_one_chaser
from .task import OUTCOMES, SUCCESSES

_METADATA: dict[str, Any] = {"render_modes": list(RENDER_MODES)}


class DockingEnv(gymnasium.Env[ObservationArray, Floats]):
    """See ``chaserdock.envs.make``.

    ``info["outcome"]``: one of ``OUTCOMES``; ``info["is_success"]``: whether it is a success.
    """

    metadata = _METADATA

    def __init__(self, scenario: str | Path | Scenario, *, render_mode: str | None = None) -> None:
        given = loaded(scenario)
        require_one_chaser(given)
        self._batch = DockingBatch(given, 1)
        self._view = EnvironmentView(given, render_mode)
        self.metadata = _METADATA | {"render_fps": given.time.rate_hz}
        self.render_mode = render_mode
        self.observation_space = observation_space(self._batch.task)
        self.action_space = action_space(self._batch.task)
        self._started = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ObservationArray, dict[str, Any]]:
        """Start an episode; ``seed``: see ``DockingBatch.start``. There are no ``options``."""
        super().reset(seed=seed)
        if not self._started and seed is None:
            seed = int(self.np_random.integers(2**32))
        self._started = True
        return self._batch.start(seed)[0, 0], {"outcome": OUTCOMES[0], "is_success": False}

    def step(self, action: Floats) -> tuple[ObservationArray, float, bool, bool, dict[str, Any]]:
        """Fly for a tick. Raises ValueError for an action of another shape or with numbers that are
        not finite.
        """
        require_finite(action, "action")
        if (shape := getattr(action, "shape", None)) != self.action_space.shape:
            raise ValueError(f"action: the shape is {shape}, not {self.action_space.shape}")
        done = self._batch.step(action[None, None])
        outcome = int(done.outcomes[0, 0])
        info = {"outcome": OUTCOMES[outcome], "is_success": outcome in SUCCESSES}
        ended = bool(done.terminated[0, 0]), bool(done.truncated[0, 0])
        return done.observations[0, 0], float(done.rewards[0, 0]), *ended, info

    def render(self) -> RgbImage | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return the picture (480, 640, 3), or show it; see ``EnvironmentView.show``."""
        return self._view.show(self._batch)

    def close(self) -> None:
        """Close the window, if there is one."""
        self._view.close()
