# SPDX-License-Identifier: Apache-2.0
"""Dock three chasers at one time in a PettingZoo ``ParallelEnv``: ``python team.py [EPISODES]``.

Each agent flies by the law of proportional.py from its own observation, and passes others that are
near on one side.
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path
from typing import NamedTuple

import numpy as np
from chaserdock_models.arrays import Array
from proportional import law

import chaserdock.envs
from chaserdock.envs.parallel import DockingParallelEnv

SCENARIO = Path(__file__).with_name("team.toml")
ALONE = 16  # elements of an observation before the places of the others
APART_M = 0.72  # others that are nearer are evaded; at their ports they are 0.75 m apart
AWAY_PER_S = 0.6  # speed away from them, and around, for each metre below that
AROUND = np.array([0.0, 0.0, 1.0])  # axis (TRF) of the turn in which all pass each other


class Episode(NamedTuple):
    """How an episode went: outcome of each agent, the least distance of two chasers, and its
    duration, s.
    """

    outcomes: dict[str, str]
    nearest_m: float
    duration_s: float


def evasion_m_s(others_m: Array) -> Array:
    """Return the velocity (3,), TRF, that evades others at ``others_m`` (k, 3) relative to oneself:
    away from them, and around.
    """
    distance_m = np.linalg.norm(others_m, axis=1, keepdims=True)
    towards = others_m / distance_m
    push = AWAY_PER_S * np.maximum(APART_M - distance_m, 0.0)
    return (push * (np.cross(AROUND, towards) - towards)).sum(axis=0)


def fly(environment: DockingParallelEnv, seed: int | None) -> Episode:
    """Fly an episode; the next ones without a ``seed``."""
    scenario = chaserdock.envs.loaded(SCENARIO)
    numbers = {agent: k for k, agent in enumerate(environment.possible_agents)}
    seen, _ = environment.reset(seed)
    outcomes = dict[str, str]()
    nearest_m, ticks = np.inf, 0
    while environment.agents:
        actions = {}
        for agent in environment.agents:
            others_m = seen[agent][ALONE:].reshape(-1, 3).astype(float)
            nearest_m = min(nearest_m, float(np.linalg.norm(others_m, axis=1).min()))
            drift_m_s = evasion_m_s(others_m)
            wrench = law(scenario, numbers[agent], seen[agent][None], drift_m_s)[0]
            actions[agent] = np.clip(wrench, -1.0, 1.0).astype(np.float32)
        seen, _, _, _, infos = environment.step(actions)
        outcomes |= {agent: info["outcome"] for agent, info in infos.items()}
        ticks += 1
    return Episode(outcomes, nearest_m, ticks / scenario.time.rate_hz)


def main(episodes: int) -> None:
    """Fly a number of episodes and print how they went."""
    environment = chaserdock.envs.parallel_env(SCENARIO)
    flown = [fly(environment, 0 if k == 0 else None) for k in range(episodes)]
    docked = sum(set(episode.outcomes.values()) == {"docked"} for episode in flown)
    words = Counter(word for episode in flown for word in episode.outcomes.values())
    print(f"all docked {docked} of {episodes}; " + ", ".join(f"{n} {w}" for w, n in words.items()))
    print(f"nearest {min(e.nearest_m for e in flown):.3f} m apart")
    print(f"median {np.median([e.duration_s for e in flown]):.1f} s")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 20)
