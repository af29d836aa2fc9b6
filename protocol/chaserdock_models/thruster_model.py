# SPDX-License-Identifier: Apache-2.0
"""Compute the impulse of thrusters from the opening times of their valves.

Simulator and chaser use the same model. Times are integer nanoseconds of simulated time. A valve is
open where a pulse or a failure opens it and its shut-off valve is not closed. Thrust rises linearly
within ``rise_s`` of the opening and falls linearly within ``fall_s`` of the closing. A gap no
longer than the fall time does not close the valve, and a pulse shorter than the minimum on-time
does not open it. Impulses between two times are exact, so they do not depend on the step size.
"""

from __future__ import annotations

import math
from bisect import insort
from collections.abc import Sequence
from typing import Literal, Protocol

import numpy as np

from .arrays import Array, IntArray

FailureKind = Literal["stuck_off", "stuck_on", "weak"]
"""Failure modes of a thruster: never opens, never closes, or delivers a fraction of its thrust."""


class ThrusterDynamics(Protocol):
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
"""Standard gravity, which defines specific impulse."""

Span = tuple[float, float]
"""Start and end, nanoseconds; the end may be infinite."""


def _ns(time_s: float) -> int:
    return round(time_s * 1e9)


def merge_spans(spans: Sequence[Span], gap_ns: int) -> list[Span]:
    """Return the spans sorted, merging those that overlap or lie at most ``gap_ns`` apart."""
    out: list[Span] = []
    for begin, end in sorted(spans):
        if out and begin - out[-1][1] <= gap_ns:
            out[-1] = (out[-1][0], max(out[-1][1], end))
        else:
            out.append((begin, end))
    return out


def subtract_span(spans: Sequence[Span], cut: Span) -> list[Span]:
    """Return the spans without the parts inside ``cut``."""
    out = []
    for begin, end in spans:
        out += [(b, e) for b, e in ((begin, min(end, cut[0])), (max(begin, cut[1]), end)) if e > b]
    return out


class _Thruster:
    """One thruster: commanded pulses, failure, and the times its shut-off valve is closed."""

    def __init__(self, thruster: ThrusterDynamics) -> None:
        self.rise_ns, self.fall_ns = _ns(thruster.rise_s), _ns(thruster.fall_s)
        self.shortest_ns = _ns(thruster.min_on_s)
        self.pulses: list[Span] = []
        self.shut: list[Span] = []
        self.failure: tuple[FailureKind, int, float] | None = None

    def open_spans(self) -> list[Span]:
        """Return the spans in which thrust is commanded or forced: the valve is open and not shut
        off.
        """
        spans = merge_spans(self.pulses, self.fall_ns)
        if self.failure is not None:
            kind, at_ns, _ = self.failure
            if kind == "stuck_off":
                spans = subtract_span(spans, (at_ns, math.inf))
            elif kind == "stuck_on":
                spans = merge_spans([*spans, (at_ns, math.inf)], self.fall_ns)
        for cut in self.shut:
            spans = subtract_span(spans, cut)
        return spans

    def factor(self, begin_ns: float) -> float:
        """Return the fraction of the nominal thrust for an opening at ``begin_ns``."""
        weak = (
            self.failure is not None and self.failure[0] == "weak" and begin_ns >= self.failure[1]
        )
        return self.failure[2] if weak and self.failure is not None else 1.0

    def forget_before(self, time_ns: int) -> None:
        # A span that has ended still acts during its fall, and a later pulse may merge with it.
        old = time_ns - 10 * (self.fall_ns + self.rise_ns) - self.shortest_ns
        self.pulses = [s for s in self.pulses if s[1] >= old]
        if self.failure is None or self.failure[0] != "stuck_on":
            self.shut = [s for s in self.shut if s[1] >= old]


class Valves:
    """All thrusters of one body, by number."""

    def __init__(self, thrusters: Sequence[ThrusterDynamics]) -> None:
        self._thrusters = [_Thruster(t) for t in thrusters]
        self._thrust_N = np.array([t.thrust_N for t in thrusters])
        self._exhaust_m_s = np.array([t.isp_s * G0_M_S2 for t in thrusters])
        self._table: tuple[Array, ...] | None = None

    def pulse(self, thruster: int, open_ns: int, close_ns: int) -> bool:
        """Open a thruster's valve for a span. Return False for an unknown thruster or a span below
        the minimum on-time."""
        if (
            not 0 <= thruster < len(self._thrusters)
            or close_ns - open_ns < self._thrusters[thruster].shortest_ns
        ):
            return False
        insort(self._thrusters[thruster].pulses, (open_ns, close_ns))
        self._table = None
        return True

    def stop(self, at_ns: int) -> None:
        """Cut all pulses at ``at_ns``."""
        for thruster in self._thrusters:
            thruster.pulses = subtract_span(thruster.pulses, (at_ns, math.inf))
        self._table = None

    def set_shut(self, thrusters: Sequence[int], at_ns: int) -> None:
        """Close the shut-off valves of these thrusters at ``at_ns`` and open all others."""
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
        """Return the thrusters whose shut-off valve is closed at ``time_ns``."""
        return tuple(
            k for k, j in enumerate(self._thrusters) if any(b <= time_ns < e for b, e in j.shut)
        )

    def fail(
        self, thruster: int, kind: FailureKind | None, at_ns: int, factor: float | None = None
    ) -> None:
        """Set the failure of a thruster from ``at_ns`` on, or clear it (None). ``factor``: thrust
        fraction for ``weak``."""
        self._thrusters[thruster].failure = (
            None if kind is None else (kind, at_ns, 1.0 if factor is None else factor)
        )
        self._table = None

    def forget_before(self, time_ns: int) -> None:
        """Discard spans that have no effect after ``time_ns``; earlier times can no longer be
        queried.
        """
        for thruster in self._thrusters:
            thruster.forget_before(time_ns)
        self._table = None

    def _spans(self) -> tuple[Array, ...]:
        """Return columns of all openings: thruster, begin, end, rise, fall (ns), factor."""
        if self._table is None:
            rows = [
                (k, begin, end, thruster.rise_ns, thruster.fall_ns, thruster.factor(begin))
                for k, thruster in enumerate(self._thrusters)
                for begin, end in thruster.open_spans()
            ]
            self._table = tuple(np.array(rows, dtype=float).reshape(-1, 6).T)
        return self._table

    def impulses(self, edges_ns: Array) -> Array:
        """Return the impulse (K, n), N s, of each thruster between successive times (K + 1,),
        integer nanoseconds.
        """
        thruster, begin, end, rise, fall, factor = self._spans()
        out = np.zeros((len(edges_ns) - 1, len(self._thrusters)))
        if len(thruster):
            t = np.asarray(edges_ns, dtype=float)[:, None]
            full_thrust_ns = factor * np.diff(_ramp(t - begin, rise) - _ramp(t - end, fall), axis=0)
            number = thruster.astype(int)
            np.add.at(out.T, number, full_thrust_ns.T * (1e-9 * self._thrust_N[number, None]))
        return out

    def first_moments(self, from_ns: int, to_ns: int) -> Array:
        """Return the first moment (n,) of each thruster's thrust F about the middle of an interval,
        N s²: the integral of (middle - t) F dt.

        It is positive for a thruster that fires early, and zero for a constant thrust. With the
        impulse it gives the exact displacement of a free mass: m dx = impulse T / 2 + moment.
        """
        thruster, begin, end, rise, fall, factor = self._spans()
        out = np.zeros(len(self._thrusters))
        if len(thruster):
            moment = _moments(begin, rise, from_ns, to_ns) - _moments(end, fall, from_ns, to_ns)
            number = thruster.astype(int)
            np.add.at(out, number, factor * moment * (1e-18 * self._thrust_N[number]))
        return out

    def impulses_and_moments(self, edges_ns: Array | IntArray) -> tuple[Array, Array]:
        """Return impulses and first moments (see ``first_moments``), each (K, n), between
        successive times (K + 1,), integer nanoseconds, in time proportional to K and to the number
        of openings.
        """
        impulses, moments = np.zeros((2, len(edges_ns) - 1, len(self._thrusters)))
        t = np.asarray(edges_ns, dtype=float)
        spans = self._spans()
        _, begin, end, rise, fall, _ = spans
        # Pairs of an opening and an interval in which it gives thrust.
        first = np.maximum(np.searchsorted(t, begin, side="right") - 1, 0)
        last = np.minimum(np.searchsorted(t, np.maximum(begin + rise, end + fall)), len(impulses))
        count = np.maximum(last - first, 0)
        row = np.arange(count.sum()) + np.repeat(first - np.cumsum(count) + count, count)
        thruster, begin, end, rise, fall, factor = (np.repeat(x, count) for x in spans)
        a, b = t[row], t[row + 1]
        given = [_ramp(x - begin, rise) - _ramp(x - end, fall) for x in (a, b)]
        moment = _moments(begin, rise, a, b) - _moments(end, fall, a, b)
        number = thruster.astype(int)
        full_N = factor * self._thrust_N[number]
        np.add.at(impulses, (row, number), full_N * 1e-9 * (given[1] - given[0]))
        np.add.at(moments, (row, number), full_N * 1e-18 * moment)
        return impulses, moments

    def open_s(self, from_ns: int, to_ns: int) -> Array:
        """Return how long each thruster's valve is open between two times, (n,) s."""
        out = np.zeros(len(self._thrusters))
        thruster, begin, end = self._spans()[:3]
        np.add.at(
            out,
            thruster.astype(int),
            np.clip(np.minimum(end, to_ns) - np.maximum(begin, from_ns), 0.0, None),
        )
        return out * 1e-9

    def propellant_kg(self, impulses_N_s: Array) -> float:
        """Return the propellant mass for impulses (n,): mass flow = thrust / (Isp g0)."""
        return float(np.sum(impulses_N_s / self._exhaust_m_s))


def _ramp(after_ns: Array, length_ns: Array) -> Array:
    """Return the integral of a linear rise from 0 to 1 within ``length_ns``, nanoseconds; length
    zero is a step.
    """
    x = np.maximum(after_ns, 0.0)
    length = np.maximum(length_ns, 1e-3)
    # A span that never ends has an infinitely late fall, where ``x`` is zero.
    return np.where(x < length, x * x / (2.0 * length), x - length_ns / 2.0)


def _ramp_integral(after_ns: Array, length_ns: Array) -> Array:
    """Return the integral of ``_ramp`` from 0 to ``after_ns``, nanoseconds²."""
    x = np.maximum(after_ns, 0.0)
    length = np.maximum(length_ns, 1e-3)
    late = x * (x - length_ns) / 2.0 + length_ns * length_ns / 6.0
    return np.where(x < length, x * x * x / (6.0 * length), late)


def _moments(edge_ns: Array, length_ns: Array, from_ns: Array | int, to_ns: Array | int) -> Array:
    """Return the first moment, nanoseconds², about the middle of an interval of a linear rise from
    0 to 1 at ``edge_ns``: the integral of its impulse J(t) since ``from_ns``, less J(to) T / 2.
    """
    since, until = from_ns - edge_ns, to_ns - edge_ns
    area = _ramp_integral(until, length_ns) - _ramp_integral(since, length_ns)
    return area - (to_ns - from_ns) / 2.0 * (_ramp(since, length_ns) + _ramp(until, length_ns))
