# SPDX-License-Identifier: Apache-2.0
"""Dock by a proportional law in the training environment: ``python proportional.py [EPISODES]``.

What a policy has to beat. It needs no training, and shows what observations and actions mean.
"""

from __future__ import annotations

import sys
from collections import Counter
from pathlib import Path

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.scenario import Scenario
from numpy.typing import NDArray

import chaserdock.envs
from chaserdock.envs.batch import DockingBatch
from chaserdock.envs.task import OUTCOMES

SCENARIO = Path(__file__).with_name("docking.toml")
APPROACH_PER_S = 0.2  # speed towards the goal for each metre from it
FASTEST_M_S = 0.038  # in the corridor up to 0.04 m/s are allowed
CONTACT_M_S = 0.014  # in its last part up to 0.016 m/s
SIDEWAYS_M_S = 0.15  # from farther than the starts of docking.toml
ASIDE = 3.0  # first onto the port's axis, and then along it
VELOCITY_PER_S = 6.0  # acceleration for each m/s of velocity error
ATTITUDE_PER_S2, RATE_PER_S = 0.6, 1.55  # angular acceleration for attitude (rad) and rate (rad/s)


def actions_of(batch: DockingBatch, observations: NDArray[np.float32]) -> Array:
    """Return the actions (n, 1, 6) of the law for observations (n, 1, 16)."""
    return law(batch.task.scenario, 0, observations[:, 0])[:, None]


def law(
    scenario: Scenario, chaser: int, observations: NDArray[np.float32], drift_m_s: Array | float = 0
) -> Array:
    """Return the actions (n, 6) of a chaser for its observations (n, 16 + k).

    ``drift_m_s`` (n, 3): velocity (TRF) to fly in addition, as of who evades another one.
    """
    seen = observations.astype(float)
    off, velocity, error, rate = seen[:, :3], seen[:, 3:6], seen[:, 6:10], seen[:, 10:13]
    port = scenario.docking.port_of(chaser)
    assert port is not None
    axis = np.array(port.axis)
    along = off @ axis
    aside = off - along[:, None] * axis
    waiting = np.linalg.norm(aside, axis=1) * ASIDE
    inward = np.clip(APPROACH_PER_S * (along - waiting), -FASTEST_M_S, FASTEST_M_S)
    inward = np.where(along < waiting, inward, np.maximum(inward, CONTACT_M_S))
    sideways = ASIDE * APPROACH_PER_S * aside
    speed = np.linalg.norm(sideways, axis=1, keepdims=True)
    sideways *= np.minimum(1.0, SIDEWAYS_M_S / np.maximum(speed, SIDEWAYS_M_S))
    wanted = -inward[:, None] * axis - sideways
    q = rotations.multiply(np.array(scenario.chasers[chaser].q_wxyz), error)
    acceleration = rotations.rotate_inverse(q, VELOCITY_PER_S * (wanted + drift_m_s - velocity))
    turn = -ATTITUDE_PER_S2 * 2.0 * error[:, 1:] - RATE_PER_S * rate
    wrench = np.concatenate(
        [scenario.chaser.mass_kg * acceleration, np.array(scenario.chaser.inertia) * turn], axis=1
    )
    return wrench / scenario.chaser.wrench_max


def outcomes(episodes: int, seed: int = 0) -> Counter[str]:
    """Fly a number of episodes; return how many ended in which way."""
    batch = DockingBatch(chaserdock.envs.loaded(SCENARIO), episodes)
    observations = batch.start(seed)
    ended = np.zeros(episodes, dtype=int)
    while not ended.all():
        done = batch.step(actions_of(batch, observations))
        observations = done.observations
        ended = np.where(ended == 0, done.outcomes[:, 0], ended)
    return Counter(OUTCOMES[k] for k in ended)


if __name__ == "__main__":
    for word, count in outcomes(int(sys.argv[1]) if len(sys.argv) > 1 else 1000).most_common():
        print(f"{word:12} {count}")
