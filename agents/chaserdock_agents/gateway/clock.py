# SPDX-License-Identifier: Apache-2.0
"""Estimate a device's clock, offset and drift, from its stamps and the times of their arrival.

A message arrives its delay after its stamp, and no delay is negative: all points (stamp, arrival -
stamp) lie above the line offset + drift x stamp + least delay, and the fastest messages lie on it.
The line is the lower convex hull's edge at the middle of the stamps, which among all lines below
the points has the smallest sum of distances (Moon, Skelly, Towsley: Estimation and removal of clock
skew from network delay measurements, INFOCOM 1999). The least delay cannot be told from an offset:
the scenario states it. No I/O.
"""

from __future__ import annotations

import itertools
from collections import deque
from dataclasses import dataclass

_NS = 1_000_000_000
"""Nanoseconds of a second."""


@dataclass(frozen=True)
class ClockParameters:
    """Constants of the estimate. Durations in s."""

    window_s: float = 60.0
    """Age of the stamps that count: drift of a crystal changes by 1 ppm with 10 K, in minutes."""
    bin_s: float = 0.25
    """The fastest message of each bin counts: bounds the work to 240 points."""
    drift_after_s: float = 10.0
    """Time span of stamps below which no drift is estimated: at 1 ms of jitter a shorter one
    would give more than the 100 ppm that crystals have."""
    most_drift: float = 2e-4
    """Largest drift, twice that of common crystals."""
    step_s: float = 0.02
    """Deviation that counts as a step of the device's clock: more than jitter of a quiet link."""
    step_after_s: float = 0.5
    """Time for which all messages must deviate: longer than a burst of traffic."""


class DeviceClock:
    """Map the stamps of one device to the host's clock. ``least_delay_s``: from a stamp to the
    fastest arrival.
    """

    def __init__(self, least_delay_s: float = 0.0, p: ClockParameters | None = None) -> None:
        self._p = p or ClockParameters()
        self._least_delay_ns = round(least_delay_s * _NS)
        self._bins: deque[tuple[int, int]] = deque()
        self._base_ns = self._offset_ns = 0
        self._drift = 0.0
        self._late_since_ns: int | None = None
        # Least deviations in the first and the second half of the time for which messages are late.
        self._late_ns = [0, 0]
        self.steps = 0

    @property
    def is_known(self) -> bool:
        """Return whether a stamp has arrived."""
        return bool(self._bins)

    @property
    def offset_s(self) -> float:
        """Return host clock minus device clock at the newest stamp, s."""
        return (self._line_ns(self._bins[-1][0]) - self._least_delay_ns) / _NS

    @property
    def drift(self) -> float:
        """Return how much faster the host's clock runs, as a share."""
        return self._drift

    def add(self, stamp_ns: int, arrived_ns: int) -> bool:
        """Take a stamp and its arrival by the host's clock. Returns whether the device's clock has
        stepped, which starts the estimate again.
        """
        delay_ns = arrived_ns - stamp_ns
        if self._bins and self._has_stepped(stamp_ns, arrived_ns, delay_ns):
            self._bins.clear()
            self._late_since_ns, self._drift = None, 0.0
            self.steps += 1
            self._insert(stamp_ns, delay_ns)
            return True
        self._insert(stamp_ns, delay_ns)
        return False

    def host_ns(self, stamp_ns: int) -> int:
        """Return the time of a stamp by the host's clock."""
        return stamp_ns + self._line_ns(stamp_ns) - self._least_delay_ns

    def stamp_ns(self, host_ns: int) -> int:
        """Return what the device's clock shows at a time of the host's clock."""
        near_ns = host_ns + self._least_delay_ns - self._line_ns(self._bins[-1][0])
        return host_ns + self._least_delay_ns - self._line_ns(near_ns)

    def _line_ns(self, stamp_ns: int) -> int:
        return self._offset_ns + round(self._drift * (stamp_ns - self._base_ns))

    def _has_stepped(self, stamp_ns: int, arrived_ns: int, delay_ns: int) -> bool:
        step_ns = self._p.step_s * _NS
        excess_ns = delay_ns - self._line_ns(stamp_ns)
        if excess_ns <= step_ns:
            self._late_since_ns = None
            # Early: the clock went ahead, unless the estimate is still young.
            span_ns = self._bins[-1][0] - self._bins[0][0]
            return excess_ns < -step_ns and span_ns > self._p.step_after_s * _NS
        # A clock that stepped deviates evenly. A device or link that falls behind does not.
        late_ns = 0 if self._late_since_ns is None else arrived_ns - self._late_since_ns
        if self._late_since_ns is None or late_ns > self._p.step_after_s * _NS:
            first, second = self._late_ns
            if self._late_since_ns is not None and abs(second - first) < step_ns / 2:
                return True
            self._late_since_ns, self._late_ns = arrived_ns, [excess_ns, excess_ns + step_ns]
            return False
        half = int(late_ns > self._p.step_after_s * _NS / 2)
        self._late_ns[half] = min(self._late_ns[half], excess_ns)
        return False

    def _insert(self, stamp_ns: int, delay_ns: int) -> None:
        bins, bin_ns = self._bins, self._p.bin_s * _NS
        if bins and stamp_ns // bin_ns <= bins[-1][0] // bin_ns:
            if delay_ns >= bins[-1][1]:
                return
            bins[-1] = (max(stamp_ns, bins[-1][0]), delay_ns)
        else:
            bins.append((stamp_ns, delay_ns))
        while bins[-1][0] - bins[0][0] > self._p.window_s * _NS:
            bins.popleft()
        self._fit()

    def _fit(self) -> None:
        bins, p = self._bins, self._p
        middle_ns = sum(stamp for stamp, _ in bins) // len(bins)
        if bins[-1][0] - bins[0][0] < p.drift_after_s * _NS:
            self._base_ns, self._drift = middle_ns, 0.0
        else:
            (x0, y0), (x1, y1) = _edge_below(tuple(bins), middle_ns)
            slope = (y1 - y0) / (x1 - x0)
            self._base_ns, self._drift = x0, max(-p.most_drift, min(p.most_drift, slope))
        self._offset_ns = round(
            min(delay - self._drift * (stamp - self._base_ns) for stamp, delay in bins)
        )


def _edge_below(
    points: tuple[tuple[int, int], ...], x: int
) -> tuple[tuple[int, int], tuple[int, int]]:
    """Return the edge of the points' lower convex hull over ``x``. The points are in order of their
    abscissas, the first before and the last after ``x``.
    """
    hull: list[tuple[int, int]] = []
    for point in points:
        while len(hull) > 1 and _turns_right(hull[-2], hull[-1], point):
            hull.pop()
        hull.append(point)
    for a, b in itertools.pairwise(hull):
        if b[0] >= x:
            return a, b
    return hull[-2], hull[-1]


def _turns_right(a: tuple[int, int], b: tuple[int, int], c: tuple[int, int]) -> bool:
    return (b[0] - a[0]) * (c[1] - a[1]) <= (b[1] - a[1]) * (c[0] - a[0])
