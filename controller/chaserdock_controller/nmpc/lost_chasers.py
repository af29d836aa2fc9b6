# SPDX-License-Identifier: Apache-2.0
"""Obstacle rows of lost chasers in the NMPC problem. Pure functions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.extrapolation import extrapolate
from chaserdock_protocol.messages import Odometry

from chaserdock_controller.ingest.lost_chasers import margin_m

from .types import NmpcInput

_LIMIT = 1e-3
"""Input limit (N, N m) of a lost chaser's row: the solver needs some, and this much moves it by a
millimetre.
"""


def coasting(last: Odometry, from_ns: int, times_s: Array) -> Array:
    """Return positions (K, 3), WRF, extrapolated from a last odometry to ``times_s`` (K,) after
    ``from_ns``.
    """
    ahead = extrapolate(last, last.tick, from_ns)
    return np.asarray(ahead.position_m) + times_s[:, None] * np.asarray(ahead.velocity_m_s)


def with_lost_chasers(
    problem: NmpcInput, lost: Sequence[Odometry], from_ns: int, step_s: float
) -> NmpcInput:
    """Return the problem with a row for each lost chaser after the others: it coasts, and only the
    others avoid it.

    ``from_ns``: the time of stage 0. The margin is that of the end of the horizon.
    """
    if not lost:
        return problem
    n, nodes = problem.references.shape[:2]
    times_s = step_s * np.arange(nodes)
    states, references = [], []
    for last in lost:
        places, q = coasting(last, from_ns, times_s), np.asarray(last.q_wxyz)
        states.append(np.concatenate([places[0], last.velocity_m_s, q, np.zeros(3)]))
        references.append(np.concatenate([places, np.tile(q, (nodes, 1))], axis=1))
    lost_s = [(from_ns - last.sim_time_ns) / 1e9 + float(times_s[-1]) for last in lost]
    margins_m = [margin_m(s) for s in lost_s]
    between = _with_margins(problem.min_distance_chasers_m, n, margins_m)
    apart = problem.min_distance_shapes_m
    to_target = problem.min_distance_target_m
    corridors = problem.corridors
    if corridors is not None:
        corridors = np.concatenate([corridors, np.zeros((len(lost), *corridors.shape[1:]))])
    clearance = problem.box_clearance_m
    if clearance is not None:
        clearance = np.concatenate([clearance, np.zeros(len(lost))])
    return replace(
        problem,
        states=np.concatenate([problem.states, states]),
        references=np.concatenate([problem.references, references]),
        u_ref=np.concatenate([problem.u_ref, np.zeros((len(lost), *problem.u_ref.shape[1:]))]),
        min_distance_target_m=np.concatenate(
            [to_target, np.zeros((len(lost), *to_target.shape[1:]))]
        ),
        min_distance_chasers_m=between,
        min_distance_shapes_m=None if apart is None else _with_margins(apart, n, margins_m),
        input_max=np.concatenate([problem.input_max, np.full((len(lost), 6), _LIMIT)]),
        corridors=corridors,
        box_clearance_m=clearance,
    )


def _with_margins(distances_m: Array | float, n: int, margins_m: Sequence[float]) -> Array:
    """Return distances (N, N) with a row for each lost chaser: the largest of them and its margin;
    lost ones ignore each other.
    """
    total = n + len(margins_m)
    out = np.zeros((total, total))
    out[:n, :n] = distances_m
    for row, margin in enumerate(margins_m, start=n):
        out[row, :n] = out[:n, row] = float(np.max(distances_m)) + margin
    return out
