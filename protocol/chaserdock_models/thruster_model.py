"""What a body's thrusters give, from when their valves open and close: the world's thrusters, and a chaser's idea of its own.

Times are whole nanoseconds of simulated time. A valve is open where a pulse, or a failure, opens it and its shut-off
valve is not closed. Thrust rises linearly within ``rise_s`` of the opening and falls linearly within ``fall_s`` of the
closing; a gap no longer than the fall is none, and a pulse shorter than the minimum on-time does not open the valve.
What is given between two times is exact, so that no splitting of time into steps changes it.
"""

from __future__ import annotations

import math
from bisect import insort
from collections.abc import Sequence
from typing import Literal, Protocol

import numpy as np

from .arrays import Array

FailureKind = Literal["stuck_off", "stuck_on", "weak"]
"""How a thruster fails: never opens, never closes, or gives a fraction of its thrust."""


class Thruster(Protocol):
    """Thrust (N), specific impulse (s) and valve times (s) of a thruster."""

    @property
    def thrust_N(self) -> float: ...
    @property
    def isp_s(self) -> float: ...
    @property
    def min_on_s(self) -> float: ...
    @property
    def rise_s(self) -> float: ...
    @property
    def fall_s(self) -> float: ...


G0_M_S2 = 9.80665
"""Standard gravity, by which specific impulse is defined."""

Span = tuple[float, float]
"""From, to: nanoseconds; the end may be infinite."""


def _ns(time_s: float) -> int:
    return round(time_s * 1e9)


def joined(spans: Sequence[Span], gap_ns: int) -> list[Span]:
    """Sorted spans, those that overlap or lie at most ``gap_ns`` apart made one."""
    out: list[Span] = []
    for begin, end in sorted(spans):
        if out and begin - out[-1][1] <= gap_ns:
            out[-1] = (out[-1][0], max(out[-1][1], end))
        else:
            out.append((begin, end))
    return out


def without(spans: Sequence[Span], cut: Span) -> list[Span]:
    """Spans less what lies in ``cut``."""
    out = []
    for begin, end in spans:
        out += [(b, e) for b, e in ((begin, min(end, cut[0])), (max(begin, cut[1]), end)) if e > b]
    return out


class _Thruster:
    """One thruster: pulses asked for, how it has failed, when its shut-off valve was closed."""

    def __init__(self, thruster: Thruster) -> None:
        self.rise_ns, self.fall_ns = _ns(thruster.rise_s), _ns(thruster.fall_s)
        self.shortest_ns = _ns(thruster.min_on_s)
        self.pulses: list[Span] = []
        self.shut: list[Span] = []
        self.failure: tuple[FailureKind, int, float] | None = None

    def open_spans(self) -> list[Span]:
        """When the thruster's valves are open."""
        spans = joined(self.pulses, self.fall_ns)
        if self.failure is not None:
            kind, at_ns, _ = self.failure
            if kind == "stuck_off":
                spans = without(spans, (at_ns, math.inf))
            elif kind == "stuck_on":
                spans = joined([*spans, (at_ns, math.inf)], self.fall_ns)
        for cut in self.shut:
            spans = without(spans, cut)
        return spans

    def factor(self, begin_ns: float) -> float:
        """Of its thrust, when opened at that time."""
        weak = self.failure is not None and self.failure[0] == "weak" and begin_ns >= self.failure[1]
        return self.failure[2] if weak and self.failure is not None else 1.0

    def forget_before(self, time_ns: int) -> None:
        # What ended is over for good only after its fall; a pulse that is still open may be joined.
        old = time_ns - 10 * (self.fall_ns + self.rise_ns) - self.shortest_ns
        self.pulses = [s for s in self.pulses if s[1] >= old]
        if self.failure is None or self.failure[0] != "stuck_on":
            self.shut = [s for s in self.shut if s[1] >= old]


class Valves:
    """All thrusters of one body, by their number."""

    def __init__(self, thrusters: Sequence[Thruster]) -> None:
        self._thrusters = [_Thruster(t) for t in thrusters]
        self._thrust_N = np.array([t.thrust_N for t in thrusters])
        self._exhaust_m_s = np.array([t.isp_s * G0_M_S2 for t in thrusters])
        self._table: tuple[Array, ...] | None = None

    def pulse(self, thruster: int, open_ns: int, close_ns: int) -> bool:
        """Opens a thruster's valve for a while; False where that cannot be: no such thruster, or too short a time."""
        if (
            not 0 <= thruster < len(self._thrusters)
            or close_ns - open_ns < self._thrusters[thruster].shortest_ns
        ):
            return False
        insort(self._thrusters[thruster].pulses, (open_ns, close_ns))
        self._table = None
        return True

    def stop(self, at_ns: int) -> None:
        """No pulse lasts longer than until ``at_ns``."""
        for thruster in self._thrusters:
            thruster.pulses = without(thruster.pulses, (at_ns, math.inf))
        self._table = None

    def set_shut(self, thrusters: Sequence[int], at_ns: int) -> None:
        """From ``at_ns`` on the shut-off valves of these thrusters are closed, all others open."""
        for k, thruster in enumerate(self._thrusters):
            is_shut = bool(thruster.shut) and thruster.shut[-1][1] == math.inf
            if is_shut == (k in thrusters):
                continue
            if is_shut:
                thruster.shut[-1] = (thruster.shut[-1][0], max(float(at_ns), thruster.shut[-1][0]))
            else:
                thruster.shut.append((float(at_ns), math.inf))
            self._table = None

    def shut_at(self, time_ns: int) -> tuple[int, ...]:
        """The thrusters whose shut-off valve is closed then."""
        return tuple(k for k, j in enumerate(self._thrusters) if any(b <= time_ns < e for b, e in j.shut))

    def fail(self, thruster: int, kind: FailureKind | None, at_ns: int, factor: float | None = None) -> None:
        """From ``at_ns`` on a thruster fails in a way; None: it never did. ``factor`` goes with ``weak``."""
        self._thrusters[thruster].failure = (
            None if kind is None else (kind, at_ns, 1.0 if factor is None else factor)
        )
        self._table = None

    def forget_before(self, time_ns: int) -> None:
        """Drops what has no effect after ``time_ns``: nobody will ask for what was before."""
        for thruster in self._thrusters:
            thruster.forget_before(time_ns)
        self._table = None

    def _spans(self) -> tuple[Array, ...]:
        """Columns of all openings: thruster, begin, end, rise, fall (ns), factor."""
        if self._table is None:
            rows = [
                (k, begin, end, thruster.rise_ns, thruster.fall_ns, thruster.factor(begin))
                for k, thruster in enumerate(self._thrusters)
                for begin, end in thruster.open_spans()
            ]
            self._table = tuple(np.array(rows, dtype=float).reshape(-1, 6).T)
        return self._table

    def impulses(self, edges_ns: Array) -> Array:
        """N s given by every thruster between successive times: (K + 1,) whole nanoseconds -> (K, n)."""
        thruster, begin, end, rise, fall, factor = self._spans()
        out = np.zeros((len(edges_ns) - 1, len(self._thrusters)))
        if len(thruster):
            t = np.asarray(edges_ns, dtype=float)[:, None]
            full_ns = factor * np.diff(_ramp(t - begin, rise) - _ramp(t - end, fall), axis=0)
            number = thruster.astype(int)
            np.add.at(out.T, number, full_ns.T * (1e-9 * self._thrust_N[number, None]))
        return out

    def open_s(self, from_ns: int, to_ns: int) -> Array:
        """How long every thruster's valves are open between two times, (n,) s."""
        out = np.zeros(len(self._thrusters))
        thruster, begin, end = self._spans()[:3]
        np.add.at(
            out, thruster.astype(int), np.clip(np.minimum(end, to_ns) - np.maximum(begin, from_ns), 0.0, None)
        )
        return out * 1e-9

    def propellant_kg(self, impulses_N_s: Array) -> float:
        """What impulses (n,) cost: mass flow = thrust / (Isp g0)."""
        return float(np.sum(impulses_N_s / self._exhaust_m_s))


def _ramp(after_ns: Array, length_ns: Array) -> Array:
    """The integral of a linear rise from 0 to 1 within ``length_ns``, nanoseconds; length zero: a step."""
    x = np.maximum(after_ns, 0.0)
    length = np.maximum(length_ns, 1e-3)
    # What never ends is infinitely far from its fall, and ``x`` is zero.
    return np.where(x < length, x * x / (2.0 * length), x - length_ns / 2.0)
