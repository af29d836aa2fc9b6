# SPDX-License-Identifier: Apache-2.0
"""Prediction of a chaser's own state to the time when the next command takes effect."""

from __future__ import annotations

import itertools

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.rigid_body import RigidBody, propagate
from chaserdock_protocol.messages import Odometry


class CommandHistory:
    """Wrenches (6,), body axes, sent to each chaser, with the times at which they take effect."""

    def __init__(self) -> None:
        self._sent: dict[int, list[tuple[int, Array]]] = {}

    def add(self, chaser: int, effective_ns: int, wrench: Array) -> None:
        """Add a command. Times must not decrease."""
        self._sent.setdefault(chaser, []).append((effective_ns, np.array(wrench)))

    def segments(self, chaser: int, from_ns: int, to_ns: int) -> list[tuple[int, int, Array]]:
        """Return what acts between two times as (from, to, wrench); zero before the first command."""
        sent = self._sent.get(chaser, [])
        edges = [from_ns, *sorted({t for t, _ in sent if from_ns < t < to_ns}), to_ns]
        out = []
        for begin, end in itertools.pairwise(edges):
            acting = [w for t, w in sent if t <= begin]
            out.append((begin, end, acting[-1] if acting else np.zeros(6)))
        return out

    def forget_before(self, time_ns: int) -> None:
        """Remove commands that do not act after ``time_ns``."""
        for chaser, sent in self._sent.items():
            last = max((k for k, (t, _) in enumerate(sent) if t <= time_ns), default=0)
            self._sent[chaser] = sent[last:]


def _state_of(odometry: Odometry) -> Array:
    return np.array([*odometry.position_m, *odometry.velocity_m_s, *odometry.q_wxyz, *odometry.omega_rad_s])


def predict_state(odometry: Odometry, history: CommandHistory, until_ns: int, body: RigidBody) -> Array:
    """Return the state (13,) of a chaser at ``until_ns`` from its odometry and the commands already sent."""
    x = _state_of(odometry)
    for begin, end, wrench in history.segments(odometry.chaser, odometry.sim_time_ns, until_ns):
        x = propagate(x, wrench, body, (end - begin) / 1e9)
    return x


def predict_state_with_impulse(odometry: Odometry, impulse: Array, until_ns: int, body: RigidBody) -> Array:
    """Return the state (13,) of a chaser at ``until_ns`` from its odometry and an impulse (6,), N s and N m s, body axes,
    that is spread evenly over the time until then."""
    duration_s = (until_ns - odometry.sim_time_ns) / 1e9
    x = _state_of(odometry)
    return propagate(x, impulse / duration_s, body, duration_s) if duration_s > 0.0 else x
