# SPDX-License-Identifier: Apache-2.0
"""Predicts a chaser's own state to the time at which the next command takes effect."""

from __future__ import annotations

import itertools
from collections.abc import Iterable

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.rigid_body import RigidBody, propagate
from chaserdock_protocol.messages import Odometry


class CommandHistory:
    """Wrenches (6,), body axes, that were sent to a chaser, with the times at which they take
    effect.
    """

    def __init__(self) -> None:
        self._sent: list[tuple[int, Array]] = []

    def add(self, effective_ns: int, wrench: Array) -> None:
        """Add a command. Times must not decrease."""
        self._sent.append((effective_ns, np.array(wrench)))

    def replace(self, effective_ns: int, wrench: Array) -> None:
        """Replace what was sent for a time by what another controller has sent for it."""
        kept = [(t, w) for t, w in self._sent if t != effective_ns]
        at = sum(t < effective_ns for t, _ in kept)
        self._sent = [*kept[:at], (effective_ns, np.array(wrench)), *kept[at:]]

    def segments(self, from_ns: int, to_ns: int) -> list[tuple[int, int, Array]]:
        """Return the wrenches between two times as (from, to, wrench); zero before the first
        command.
        """
        edges = [from_ns, *sorted({t for t, _ in self._sent if from_ns < t < to_ns}), to_ns]
        out = []
        for begin, end in itertools.pairwise(edges):
            acting = [w for t, w in self._sent if t <= begin]
            out.append((begin, end, acting[-1] if acting else np.zeros(6)))
        return out

    def ahead(self, from_ns: int, to_ns: int) -> tuple[tuple[float, Array], ...]:
        """Return the wrenches between two times as durations (s) and wrenches (6,)."""
        return tuple(
            ((end - begin) / 1e9, wrench) for begin, end, wrench in self.segments(from_ns, to_ns)
        )

    def forget_before(self, time_ns: int) -> None:
        """Drop the commands that no longer act after ``time_ns``."""
        last = max((k for k, (t, _) in enumerate(self._sent) if t <= time_ns), default=0)
        self._sent = self._sent[last:]


def predict_state(
    odometry: Odometry, ahead: Iterable[tuple[float, Array]], disturbance: Array, body: RigidBody
) -> Array:
    """Return the state (13,) of a chaser after the wrenches of ``ahead``: durations (s) and
    wrenches (6,).

    ``disturbance`` (6,) acts in addition. Wrenches are force and torque in body axes, N and N m.
    """
    x = np.array(
        [*odometry.position_m, *odometry.velocity_m_s, *odometry.q_wxyz, *odometry.omega_rad_s]
    )
    for duration_s, wrench in ahead:
        x = propagate(x, wrench + disturbance, body, duration_s)
    return x
