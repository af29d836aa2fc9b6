"""A chaser's own state at the time when the next command takes effect: its odometry, and the commands under way."""

from __future__ import annotations

import numpy as np
from chaserdock_protocol import rotations
from chaserdock_protocol.messages import Odometry
from chaserdock_protocol.rotations import Array
from chaserdock_protocol.scenario import Body

_STEP_S = 0.02


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
        for begin, end in zip(edges[:-1], edges[1:], strict=True):
            acting = [w for t, w in sent if t <= begin]
            out.append((begin, end, acting[-1] if acting else np.zeros(6)))
        return out

    def forget_before(self, time_ns: int) -> None:
        """Drops what cannot act any more after ``time_ns``."""
        for chaser, sent in self._sent.items():
            last = max((k for k, (t, _) in enumerate(sent) if t <= time_ns), default=0)
            self._sent[chaser] = sent[last:]


def _slope(x: Array, wrench: Array, mass_kg: float, inertia: Array) -> Array:
    q, omega = x[6:10], x[10:]
    return np.concatenate(
        [
            x[3:6],
            rotations.rotate(q, wrench[:3]) / mass_kg,
            0.5 * rotations.multiply(q, np.concatenate([[0.0], omega])),
            (wrench[3:] - np.cross(omega, inertia * omega)) / inertia,
        ]
    )


def integrate(x: Array, wrench: Array, body: Body, duration_s: float) -> Array:
    """State (13,): p, v (WRF), q_wxyz, omega (body) after ``duration_s`` under a constant body-frame wrench (RK4)."""
    inertia = np.asarray(body.inertia)
    steps = max(1, int(np.ceil(duration_s / _STEP_S)))
    h = duration_s / steps
    for _ in range(steps):
        k1 = _slope(x, wrench, body.mass_kg, inertia)
        k2 = _slope(x + h / 2 * k1, wrench, body.mass_kg, inertia)
        k3 = _slope(x + h / 2 * k2, wrench, body.mass_kg, inertia)
        k4 = _slope(x + h * k3, wrench, body.mass_kg, inertia)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        x[6:10] = rotations.normalize(x[6:10])
    return x


def predict_state(odometry: Odometry, history: CommandHistory, until_ns: int, body: Body) -> Array:
    """State (13,) of a chaser at ``until_ns``, from its odometry and the commands already sent."""
    x = np.array([*odometry.position_m, *odometry.velocity_m_s, *odometry.q_wxyz, *odometry.omega_rad_s])
    for begin, end, wrench in history.segments(odometry.chaser, odometry.sim_time_ns, until_ns):
        x = integrate(x, wrench, body, (end - begin) / 1e9)
    return x
