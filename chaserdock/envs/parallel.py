# SPDX-License-Identifier: Apache-2.0
"""One training environment of one to sixteen chasers, as a PettingZoo ``ParallelEnv``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from chaserdock_protocol.scenario import Scenario
from gymnasium.spaces import Space
from pettingzoo import ParallelEnv

from . import loaded
from .batch import DockingBatch, Floats, ObservationArray
from .scene import RENDER_MODES, EnvironmentView, RgbImage
from .spaces import action_space, observation_space, require_finite
from .task import OUTCOMES, SUCCESSES

_METADATA: dict[str, Any] = {
    "name": "chaserdock_docking_v0",
    "render_modes": list(RENDER_MODES),
}


class DockingParallelEnv(ParallelEnv[str, ObservationArray, Floats]):
    """See ``chaserdock.envs.parallel_env``. Agents are ``chaser_0``, ``chaser_1``, ...

    A docked chaser leaves the agents and moves with the target, whose motion it does not change. A
    collision, and what comes too near or is lost, ends the episode of all. ``infos``: as ``info``
    of ``DockingEnv``.
    """

    metadata = _METADATA

    def __init__(self, scenario: str | Path | Scenario, *, render_mode: str | None = None) -> None:
        given = loaded(scenario)
        self._batch = DockingBatch(given, 1)
        self._view = EnvironmentView(given, render_mode)
        self.metadata = _METADATA | {"render_fps": given.time.rate_hz}
        self.render_mode = render_mode
        self.possible_agents = [f"chaser_{i}" for i in range(self._batch.chasers)]
        self.agents: list[str] = []
        task = self._batch.task
        self.observation_spaces = {a: observation_space(task) for a in self.possible_agents}
        self.action_spaces = {a: action_space(task) for a in self.possible_agents}
        self._started = False

    def observation_space(self, agent: str) -> Space[ObservationArray]:
        """Return the space of an agent's observations."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Space[Floats]:
        """Return the space of an agent's actions."""
        return self.action_spaces[agent]

    def reset(
        self, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, ObservationArray], dict[str, dict[str, Any]]]:
        """Start an episode; ``seed``: see ``DockingBatch.start``. There are no ``options``."""
        if not self._started and seed is None:
            seed = int(np.random.SeedSequence().generate_state(1)[0])
        self._started = True
        self.agents = list(self.possible_agents)
        observations = self._batch.start(seed)[0]
        infos = {a: {"outcome": OUTCOMES[0], "is_success": False} for a in self.agents}
        return dict(zip(self.agents, observations, strict=True)), infos

    def step(
        self, actions: dict[str, Floats]
    ) -> tuple[
        dict[str, ObservationArray],
        dict[str, float],
        dict[str, bool],
        dict[str, bool],
        dict[str, dict[str, Any]],
    ]:
        """Fly for a tick. Raises ValueError unless each agent, and no other, has an action of its
        space's shape with finite numbers.
        """
        if set(actions) != set(self.agents):
            raise ValueError(
                f"actions: of {', '.join(sorted(actions)) or 'no agent'}, not of "
                f"{', '.join(self.agents) or 'no agent: the episode is over'}"
            )
        if not self.agents:
            return {}, {}, {}, {}, {}
        given = np.zeros((1, self._batch.chasers, self._batch.task.actuators), np.float32)
        for agent, action in actions.items():
            require_finite(action, f"actions: {agent}")
            if np.shape(action) != given.shape[2:]:
                raise ValueError(
                    f"actions: {agent}: the shape is {np.shape(action)}, not {given.shape[2:]}"
                )
            given[0, self.possible_agents.index(agent)] = action
        done = self._batch.step(given)
        rows = {a: self.possible_agents.index(a) for a in self.agents}
        outcomes = {a: int(done.outcomes[0, i]) for a, i in rows.items()}
        terminated = {a: bool(done.terminated[0, i]) for a, i in rows.items()}
        truncated = {a: bool(done.truncated[0, i]) for a, i in rows.items()}
        self.agents = [a for a in self.agents if not (terminated[a] or truncated[a])]
        return (
            {a: done.observations[0, i] for a, i in rows.items()},
            {a: float(done.rewards[0, i]) for a, i in rows.items()},
            terminated,
            truncated,
            {a: {"outcome": OUTCOMES[k], "is_success": k in SUCCESSES}
             for a, k in outcomes.items()},
        )  # fmt: skip

    def render(self) -> RgbImage | None:
        """Return the picture (480, 640, 3), or show it; see ``EnvironmentView.show``."""
        return self._view.show(self._batch)

    def close(self) -> None:
        """Close the window, if there is one."""
        self._view.close()
