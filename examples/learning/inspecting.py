# SPDX-License-Identifier: Apache-2.0
"""Inspect by a proportional law in the training environment: ``python inspecting.py [EPISODES]``.

Each chaser flies on a sphere about the target to the nearest face with unseen points, facing the
target. What a policy has to beat; it needs no training.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from evaluate import flown, line_of

import chaserdock.envs
from chaserdock.envs.batch import DockingBatch, Floats

SCENARIO = Path(__file__).with_name("inspecting.toml")
DISTANCE_M = 1.4  # from the target's centre: in view, and beyond limits.min_distance_target_m
NORMAL_M = 1.0  # a place so far before a face is in the direction from which it is seen
AHEAD_RAD = 0.5  # farthest point ahead on the sphere that is flown to
APART_M, AWAY_PER_S = 1.5, 0.3  # from which distance chasers avoid each other, and how fast
APPROACH_PER_S, VELOCITY_PER_S = 0.3, 3.0  # speed for each metre, acceleration for each m/s
ATTITUDE_PER_S2, RATE_PER_S = 0.6, 1.55  # angular acceleration for attitude (rad) and rate (rad/s)


def actions_of(batch: DockingBatch, observations: Floats) -> Array:
    """Return the actions (n, m, 6) of the law for observations (n, m, 26 + 3 (m - 1))."""
    body, seen = batch.task.scenario.chaser, observations.astype(float)
    place, velocity, q, rate = seen[..., :3], seen[..., 3:6], seen[..., 6:10], seen[..., 10:13]
    away = _unit(place)
    # Without unseen points the face is at the chaser, with no normal: it stays.
    view = _unit(place + seen[..., 16:19] + NORMAL_M * seen[..., 19:22])
    turn = _cross(away, view)
    angle = np.arctan2(_norm(turn), np.sum(away * view, axis=-1, keepdims=True))
    step = rotations.exp(np.minimum(angle, AHEAD_RAD) * _unit(turn))
    wanted = APPROACH_PER_S * (DISTANCE_M * rotations.rotate(step, away) - place)
    for k in range(26, seen.shape[-1], 3):
        other = seen[..., k : k + 3]
        wanted -= AWAY_PER_S * np.maximum(APART_M - _norm(other), 0.0) * _unit(other)
    acceleration = rotations.rotate_inverse(q, VELOCITY_PER_S * (wanted - velocity))
    # The camera looks along +X of CRF: turn it to the target.
    error = _cross(np.array([1.0, 0.0, 0.0]), rotations.rotate_inverse(q, -away))
    torque = np.array(body.inertia) * (ATTITUDE_PER_S2 * error - RATE_PER_S * rate)
    wrench = np.concatenate([body.mass_kg * acceleration, torque], axis=-1)
    return wrench / body.wrench_max


def _norm(v: Array) -> Array:
    return np.linalg.norm(v, axis=-1, keepdims=True)


def _unit(v: Array) -> Array:
    return v / np.maximum(_norm(v), 1e-9)


def _cross(a: Array, b: Array) -> Array:
    return np.cross(np.broadcast_to(a, b.shape), b)


if __name__ == "__main__":
    episodes = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    scenario = chaserdock.envs.loaded(SCENARIO)
    print(line_of("proportional", *flown(scenario, actions_of, episodes, 0)))
