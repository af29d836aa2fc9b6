"""A chaser's own state at the time when the next command takes effect: its odometry, and the commands under way."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
from chaserdock_models.rotations import Array
from chaserdock_protocol.messages import Odometry
from chaserdock_protocol.scenario.bodies import Body

_STEP_S = 0.02
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


def _slope(
    x: Sequence[float], wrench: Sequence[float], mass_kg: float, inertia: Sequence[float]
) -> list[float]:
    # Plain floats: a handful of numbers, several times a tick and chaser.
    _, _, _, vx, vy, vz, w, i, j, k, a, b, c = x
    fx, fy, fz, tx, ty, tz = wrench
    ia, ib, ic = inertia
    cx, cy, cz = 2.0 * (j * fz - k * fy), 2.0 * (k * fx - i * fz), 2.0 * (i * fy - j * fx)
    return [
        vx,
        vy,
        vz,
        (fx + w * cx + (j * cz - k * cy)) / mass_kg,
        (fy + w * cy + (k * cx - i * cz)) / mass_kg,
        (fz + w * cz + (i * cy - j * cx)) / mass_kg,
        0.5 * (-i * a - j * b - k * c),
        0.5 * (w * a + j * c - k * b),
        0.5 * (w * b + k * a - i * c),
        0.5 * (w * c + i * b - j * a),
        (tx - (b * ic * c - c * ib * b)) / ia,
        (ty - (c * ia * a - a * ic * c)) / ib,
        (tz - (a * ib * b - b * ia * a)) / ic,
    ]


def integrate(state: Array, wrench: Array, body: Body, duration_s: float) -> Array:
    """State (13,): p, v (WRF), q_wxyz, omega (body) after ``duration_s`` under a constant body-frame wrench (RK4)."""
    u, inertia, mass_kg = wrench.tolist(), body.inertia, body.mass_kg
    x = state.tolist()
    steps = max(1, math.ceil(duration_s / _STEP_S))
    h = duration_s / steps
    for _ in range(steps):
        k1 = _slope(x, u, mass_kg, inertia)
        k2 = _slope([a + h / 2 * b for a, b in zip(x, k1, strict=True)], u, mass_kg, inertia)
        k3 = _slope([a + h / 2 * b for a, b in zip(x, k2, strict=True)], u, mass_kg, inertia)
        k4 = _slope([a + h * b for a, b in zip(x, k3, strict=True)], u, mass_kg, inertia)
        slopes = zip(x, k1, k2, k3, k4, strict=True)
        x = [a + h / 6 * (b + 2 * c + 2 * d + e) for a, b, c, d, e in slopes]
        norm = math.hypot(*x[6:10])
        x[6:10] = [a / norm for a in x[6:10]]
    return np.array(x)


def _state_of(odometry: Odometry) -> Array:
    return np.array([*odometry.position_m, *odometry.velocity_m_s, *odometry.q_wxyz, *odometry.omega_rad_s])


def fault_of(odometry: Odometry) -> str:
    """What makes an odometry no state of a rigid body, in words; empty when nothing does."""
    for name in ("position_m", "velocity_m_s", "q_wxyz", "omega_rad_s"):
        if not all(map(math.isfinite, getattr(odometry, name))):
            return f"{name} holds a value that is not finite"
    length = math.hypot(*odometry.q_wxyz)
    return f"q_wxyz has length {length:.3g}, not 1" if abs(length - 1.0) > _UNIT_WITHIN else ""


def predict_state(odometry: Odometry, history: CommandHistory, until_ns: int, body: Body) -> Array:
    """State (13,) of a chaser at ``until_ns``, from its odometry and the commands already sent."""
    x = _state_of(odometry)
    for begin, end, wrench in history.segments(odometry.chaser, odometry.sim_time_ns, until_ns):
        x = integrate(x, wrench, body, (end - begin) / 1e9)
    return x


def predict_state_with_impulse(odometry: Odometry, impulse: Array, until_ns: int, body: Body) -> Array:
    """State (13,) of a chaser at ``until_ns``, from its odometry and an impulse (6,), N s and N m s, body axes, that
    it gets until then, taken as evenly spread."""
    duration_s = (until_ns - odometry.sim_time_ns) / 1e9
    x = _state_of(odometry)
    return integrate(x, impulse / duration_s, body, duration_s) if duration_s > 0.0 else x
