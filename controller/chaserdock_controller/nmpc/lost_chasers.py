# SPDX-License-Identifier: Apache-2.0
"""Adds lost chasers to the NMPC problem as obstacles. Pure functions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.extrapolation import extrapolate
from chaserdock_protocol.messages import Odometry

from chaserdock_controller.ingest.lost_chasers import margin_m

from .problem import NmpcParameters, with_obstacles
from .types import NmpcInput


def coasting(last: Odometry, from_ns: int, times_s: Array) -> Array:
    """Return positions (K, 3), WRF, extrapolated from the last odometry to ``times_s`` (K,) after
    ``from_ns``.
    """
    ahead = extrapolate(last, last.tick, from_ns)
    return np.asarray(ahead.position_m) + times_s[:, None] * np.asarray(ahead.velocity_m_s)


def with_lost_chasers(
    problem: NmpcInput, params: NmpcParameters, lost: Sequence[Odometry], from_ns: int
) -> NmpcInput:
    """Return the problem with a row appended for each lost chaser, which coasts and is avoided by
    the others.

    ``from_ns``: time of stage 0. The margin is that at the end of the horizon.
    """
    if not lost:
        return problem
    nodes = params.stages + 1
    times_s = params.dt_s * np.arange(nodes, dtype=np.float64)
    states, references = [], []
    for last in lost:
        places, q = coasting(last, from_ns, times_s), np.asarray(last.q_wxyz)
        states.append(np.concatenate([places[0], last.velocity_m_s, q, np.zeros(3)]))
        references.append(np.concatenate([places, np.tile(q, (nodes, 1))], axis=1))
    lost_s = [(from_ns - last.sim_time_ns) / 1e9 + float(times_s[-1]) for last in lost]
    margins_m = [margin_m(s) for s in lost_s]
    return with_obstacles(problem, params, np.array(states), np.array(references), margins_m)
