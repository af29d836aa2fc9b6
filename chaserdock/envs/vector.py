# SPDX-License-Identifier: Apache-2.0
"""Many training environments of one chaser, as a Gymnasium ``VectorEnv``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from chaserdock_protocol.scenario import Scenario
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import NDArray

from . import loaded
from .batch import DockingBatch, Floats, ObservationArray
from .scene import RENDER_MODES, EnvironmentView, RgbImage
from .spaces import action_space, observation_space, require_one_chaser
from .task import SUCCESSES

_METADATA: dict[str, Any] = {
    "render_modes": list(RENDER_MODES),
    "autoreset_mode": AutoresetMode.NEXT_STEP,
}


class DockingVectorEnv(VectorEnv[ObservationArray, Floats, NDArray[Any]]):
    """See ``chaserdock.envs.make_vec``. What is done starts anew with the next step.

    ``info["outcome"]`` (n,): index in ``OUTCOMES`` (task.py); ``info["is_success"]`` (n,): whether
    that is among ``SUCCESSES``; ``info["rejected"]`` (n,): number of actions of the episode that
    were not finite, and were taken as zero.
    """

    metadata = _METADATA

    def __init__(
        self, scenario: str | Path | Scenario, num_envs: int = 1, *, render_mode: str | None = None
    ) -> None:
        given = loaded(scenario)
        require_one_chaser(given)
        self._batch = DockingBatch(given, num_envs)
        self._view = EnvironmentView(given, render_mode)
        self.metadata = _METADATA | {"render_fps": given.time.rate_hz}
        self.render_mode, self.num_envs = render_mode, num_envs
        self.single_observation_space = observation_space(self._batch.task)
        self.single_action_space = action_space(self._batch.task)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._started = False

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ObservationArray, dict[str, Any]]:
        """Start all episodes; ``seed``: see ``DockingBatch.start``. There are no ``options``."""
        super().reset(seed=seed)
        if not self._started and seed is None:
            seed = int(self.np_random.integers(2**32))
        self._started = True
        observations = self._batch.start(seed)[:, 0]
        zeros = np.zeros(self.num_envs, np.int64)
        return observations, {
            "outcome": zeros, "is_success": zeros.astype(bool), "rejected": zeros.copy(),
        }  # fmt: skip

    def step(
        self, actions: Floats
    ) -> tuple[ObservationArray, NDArray[Any], NDArray[Any], NDArray[Any], dict[str, Any]]:
        """Fly all for a tick with actions (n, actuators). Raises ValueError for another shape."""
        given = np.asarray(actions)
        if given.shape != self.action_space.shape:
            raise ValueError(f"actions: the shape is {given.shape}, not {self.action_space.shape}")
        done = self._batch.step(given[:, None])
        outcomes = done.outcomes[:, 0]
        info = {
            "outcome": outcomes,
            "is_success": np.isin(outcomes, SUCCESSES),
            "rejected": done.rejected,
        }
        ended = done.terminated[:, 0], done.truncated[:, 0]
        return done.observations[:, 0], done.rewards[:, 0], *ended, info

    def render(self) -> tuple[RgbImage, ...] | None:
        """Return the picture (480, 640, 3) of the first environment, or show it; see
        ``EnvironmentView.show``.
        """
        image = self._view.show(self._batch)
        return None if image is None else (image,)

    def close_extras(self, **kwargs: Any) -> None:
        """Close the window, if there is one."""
        self._view.close()
