# SPDX-License-Identifier: Apache-2.0
"""Distances between the shapes of bodies on ground truth."""

from __future__ import annotations

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.shape_distance import box_table, moved
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.physics.simulation import TARGET, BodyState
from chaserdock_world.rendering.cameras import States


def shape_gap_m(scenario: Scenario, states: States) -> float:
    """Return the least gap between the shapes of two bodies, negative exactly if two overlap, at
    most their distance, m.
    """
    shape = box_table(scenario.chaser.boxes())
    names = [f"chaser/{i}" for i in range(len(scenario.chasers))]
    tables = [_placed(box_table(scenario.target_model().boxes), states[TARGET])]
    tables += [_placed(shape, states[name]) for name in names]
    cuboids = np.concatenate(tables)
    owner = np.repeat(np.arange(len(tables)), [len(t) for t in tables])
    one, other = np.nonzero(owner[:, None] < owner)
    return float(separations(cuboids[one], cuboids[other]).min())


def _placed(table: Array, body: BodyState) -> Array:
    return moved(table, body.position_m[None], body.q_wxyz[None])[0]


def separations(one: Array, other: Array) -> Array:
    """Return the largest gap (M,), m, of cuboids (M, 15) from others (M, 15), in one frame, along
    the directions of the separating-axis test: positive exactly if they are disjoint, at most the
    distance.

    S. Gottschalk, M. Lin, D. Manocha, OBBTree, SIGGRAPH 1996.
    """
    axes, others = (t[:, 3:12].reshape(-1, 3, 3).transpose(0, 2, 1) for t in (one, other))
    edges = np.cross(axes[:, :, None], others[:, None]).reshape(-1, 9, 3)
    length = np.linalg.norm(edges, axis=2, keepdims=True)
    edges = np.where(length > 1e-6, edges / np.maximum(length, 1e-6), axes[:, :1])
    directions = np.concatenate([axes, others, edges], axis=1)
    gaps = np.abs(np.einsum("mdk,mk->md", directions, other[:, :3] - one[:, :3]))
    for table, own in ((one, axes), (other, others)):
        gaps -= np.einsum("mdi,mi->md", np.abs(directions @ own.transpose(0, 2, 1)), table[:, 12:])
    return gaps.max(axis=1)
