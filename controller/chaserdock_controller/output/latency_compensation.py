"""A chaser's own state at the time when the next command takes effect: its odometry, and the commands under way."""

from __future__ import annotations

import itertools
import math

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.rigid_body import RigidBody, propagate
from chaserdock_protocol.messages import Odometry

_UNIT_WITHIN = 0.1


class CommandHistory:
    """Wrenches (6,), body axes, that were sent to each chaser, by the time they take effect."""

    def __init__(self) -> None:
        self._sent: dict[int, list[tuple[int, Array]]] = {}

    def add(self, chaser: int, effective_ns: int, wrench: Array) -> None:
        """Notes a command; times never decrease."""
        self._sent.setdefault(chaser, []).append((effective_ns, np.array(wrench)))

    def segments(self, chaser: int, from_ns: int, to_ns: int) -> list[tuple[int, int, Array]]:
        """What acts between two times: (from, to, wrench), nothing before the first command."""
        sent = self._sent.get(chaser, [])
        edges = [from_ns, *sorted({t for t, _ in sent if from_ns < t < to_ns}), to_ns]
        out = []
        for begin, end in itertools.pairwise(edges):
            acting = [w for t, w in sent if t <= begin]
            out.append((begin, end, acting[-1] if acting else np.zeros(6)))
        return out

    def forget_before(self, time_ns: int) -> None:
        """Drops what cannot act any more after ``time_ns``."""
        for chaser, sent in self._sent.items():
            last = max((k for k, (t, _) in enumerate(sent) if t <= time_ns), default=0)
            self._sent[chaser] = sent[last:]


def _state_of(odometry: Odometry) -> Array:
    return np.array([*odometry.position_m, *odometry.velocity_m_s, *odometry.q_wxyz, *odometry.omega_rad_s])


def fault_of(odometry: Odometry) -> str:
    """What makes an odometry no state of a rigid body, in words; empty when nothing does."""
    for name in ("position_m", "velocity_m_s", "q_wxyz", "omega_rad_s"):
        if not all(map(math.isfinite, getattr(odometry, name))):
            return f"{name} holds a value that is not finite"
    length = math.hypot(*odometry.q_wxyz)
    return f"q_wxyz has length {length:.3g}, not 1" if abs(length - 1.0) > _UNIT_WITHIN else ""


def predict_state(odometry: Odometry, history: CommandHistory, until_ns: int, body: RigidBody) -> Array:
    """State (13,) of a chaser at ``until_ns``, from its odometry and the commands already sent."""
    x = _state_of(odometry)
    for begin, end, wrench in history.segments(odometry.chaser, odometry.sim_time_ns, until_ns):
        x = propagate(x, wrench, body, (end - begin) / 1e9)
    return x


def predict_state_with_impulse(odometry: Odometry, impulse: Array, until_ns: int, body: RigidBody) -> Array:
    """State (13,) of a chaser at ``until_ns``, from its odometry and an impulse (6,), N s and N m s, body axes, that
    it gets until then, taken as evenly spread."""
    duration_s = (until_ns - odometry.sim_time_ns) / 1e9
    x = _state_of(odometry)
    return propagate(x, impulse / duration_s, body, duration_s) if duration_s > 0.0 else x
