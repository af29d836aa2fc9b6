# SPDX-License-Identifier: Apache-2.0
"""Motion of the bodies of a flight, from the best source in its log: ground truth, else what
another system (motion capture) measured, else none. Everything that is judged or shown takes times
and poses of bodies from here.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import BodyReference, BodyTruth
from numpy.typing import NDArray

from .columns import Columns, nanoseconds, rows_at_equal_times

TARGET = "target"
MotionSource = Literal["truth", "reference", "none"]

_MOST_GAP_S = 0.1
"""Longest time, s, between two reference measurements over which a pose is interpolated. At the
0.05 m/s^2 of a robot on air bearings the error in the middle is 0.06 mm. Longer: errors of
interpolation count as errors of the flight; shorter: fewer dropouts are bridged.
"""


@dataclass(frozen=True)
class JumpBounds:
    """What two reference measurements of a body may differ by, beside their noise, before one of
    them is of something else: a swapped body, a wrong fit.
    """

    jump_m: float = 0.05  # as lab.safety.jump_m: vibration and lost markers move a body by less
    speed_m_s: float = 1.0  # three times the speed that robots on a floor are allowed
    jump_rad: float = np.radians(20.0)  # the next symmetric fit of markers is 60 degrees and more
    rate_rad_s: float = np.radians(120.0)  # twice the largest rate of lab.safety
    sigmas: float = 5.0  # of both measurements: four of their difference


_JUMP_BOUNDS = JumpBounds()
_NO_RATES = (np.nan,) * 3
_WIDTH = 16
"""Columns of a stored motion: time, position, velocity, attitude, rate, sigma of position and of
attitude."""


@dataclass
class Track:
    """Motion of one body: times (K,) s, positions and velocities (K, 3) WRF, attitudes (K, 4),
    rates (K, 3); velocities and rates are NaN where the source has none.

    ``sigma_m``, ``sigma_rad`` (K,): standard deviations of position and attitude about each axis, 0
    for ground truth.
    """

    time_s: Array
    position_m: Array
    velocity_m_s: Array
    q_wxyz: Array
    omega_rad_s: Array
    sigma_m: Array
    sigma_rad: Array

    @classmethod
    def of(cls, columns: Columns) -> Track:
        """Return the motion in a table of ``motion_columns``."""
        t = columns.table()
        # A copy of the times: a reference to them must not keep the whole table in memory.
        return cls(
            t[:, 0].copy(), t[:, 1:4], t[:, 4:7], t[:, 7:11], t[:, 11:14], t[:, 14], t[:, 15]
        )

    def rows(self, rows: slice | NDArray[np.intp]) -> Track:
        """Return a part of the motion."""
        return Track(*(getattr(self, name)[rows] for name in _FIELDS))

    def with_other(self, other: Track) -> tuple[Track, Track]:
        """Return both motions at the times at which both are known."""
        n = min(len(self.time_s), len(other.time_s))
        if np.array_equal(self.time_s[:n], other.time_s[:n]):
            return self.rows(slice(n)), other.rows(slice(n))
        a, b = rows_at_equal_times(self.time_s, other.time_s)
        return self.rows(a), other.rows(b)

    def distance_to(self, other: Track) -> tuple[Array, Array]:
        """Return times (K,) s and distances (K,) m of another body while both are known."""
        own, its = self.with_other(other)
        return own.time_s, np.linalg.norm(own.position_m - its.position_m, axis=1)

    def interpolated(self, time_s: Array) -> tuple[NDArray[np.intp], Track]:
        """Return which of the times (K,) s are between two measurements at most ``_MOST_GAP_S``
        apart, and the motion at those.

        Position, velocity and rate linearly, attitude at a constant rate. Independent errors of the
        two measurements average.
        """
        if len(self.time_s) < 2:
            return np.zeros(0, dtype=np.intp), self.rows(slice(0))
        after = np.clip(np.searchsorted(self.time_s, time_s), 1, len(self.time_s) - 1)
        gap_s = self.time_s[after] - self.time_s[after - 1]
        share = (time_s - self.time_s[after - 1]) / gap_s
        inside = np.flatnonzero((share >= 0.0) & (share <= 1.0) & (gap_s <= _MOST_GAP_S))
        one, two = self.rows(after[inside] - 1), self.rows(after[inside])
        w = share[inside]
        v = w[:, None]
        turn = rotations.log(rotations.multiply(rotations.conjugate(one.q_wxyz), two.q_wxyz))
        return inside, Track(
            time_s[inside],
            one.position_m + v * (two.position_m - one.position_m),
            one.velocity_m_s + v * (two.velocity_m_s - one.velocity_m_s),
            rotations.multiply(one.q_wxyz, rotations.exp(v * turn)),
            one.omega_rad_s + v * (two.omega_rad_s - one.omega_rad_s),
            np.hypot((1.0 - w) * one.sigma_m, w * two.sigma_m),
            np.hypot((1.0 - w) * one.sigma_rad, w * two.sigma_rad),
        )

    def is_reached_from(self, before: Track) -> NDArray[np.bool_]:
        """Return whether a body can have got from each pose of ``before`` to the one here."""
        b, gap_s = _JUMP_BOUNDS, self.time_s - before.time_s
        moved_m, turned_rad = self.differences(before)
        noise_m, noise_rad = self.sigma_m + before.sigma_m, self.sigma_rad + before.sigma_rad
        near = moved_m <= b.jump_m + b.speed_m_s * gap_s + b.sigmas * noise_m
        return near & (turned_rad <= b.jump_rad + b.rate_rad_s * gap_s + b.sigmas * noise_rad)

    def differences(self, other: Track) -> tuple[Array, Array]:
        """Return distances (K,) m and angles (K,) rad from the poses of another motion."""
        moved_m = np.linalg.norm(self.position_m - other.position_m, axis=1)
        return moved_m, rotations.angle_between(self.q_wxyz, other.q_wxyz)

    def jumps(self) -> list[range]:
        """Return the rows, in order of time, that no motion from those before explains: from a
        jump until the body is back where it can have got meanwhile.
        """
        n, found = len(self.time_s), list[range]()
        if n < 2:
            return found
        reached = self.rows(slice(1, n)).is_reached_from(self.rows(slice(n - 1)))
        begins = [int(k) + 1 for k in np.flatnonzero(~reached)]
        known = begins[0] - 1 if begins else 0
        for begin, end in itertools.pairwise([*begins, n]):
            first, last = self.rows(slice(begin, begin + 1)), self.rows(slice(known, known + 1))
            if first.is_reached_from(last)[0]:
                known = end - 1
            elif found and found[-1].stop == begin:
                found[-1] = range(found[-1].start, end)
            else:
                found.append(range(begin, end))
        return found

    def in_order(self) -> Track:
        """Return the motion in order of time, each time once: measurements may come late or
        twice.
        """
        if np.all(np.diff(self.time_s) > 0.0):
            return self
        _, first = np.unique(nanoseconds(self.time_s), return_index=True)
        return self.rows(first)


_FIELDS = tuple(Track.__dataclass_fields__)


def motion_columns() -> Columns:
    """Return an empty table of a motion."""
    return Columns(_WIDTH)


@dataclass(frozen=True)
class ReferenceJump:
    """Reference measurements of a body that no motion explains, from ``from_s`` to ``until_s``
    (None: to the last one), and by how much they jumped.
    """

    body: str
    from_s: float
    until_s: float | None
    distance_m: float
    angle_rad: float

    def __str__(self) -> str:
        until = "to the end" if self.until_s is None else f"until {self.until_s:.2f} s"
        return (
            f"reference jumped: {self.body} by {self.distance_m:.2f} m, "
            f"{np.degrees(self.angle_rad):.0f} deg at {self.from_s:.2f} s; left out {until}"
        )


@dataclass
class MotionCollector:
    """Collects the motion of all bodies while a log is read."""

    truth: dict[str, Columns] = field(default_factory=dict)
    references: dict[str, Columns] = field(default_factory=dict)
    systems: dict[str, None] = field(default_factory=dict)

    def add(self, message: BodyTruth | BodyReference) -> None:
        """Add a true or measured state."""
        m, sigmas = message, (0.0, 0.0)
        kept = self.truth
        if isinstance(message, BodyReference):
            kept, sigmas = self.references, (message.sigma_m, message.sigma_rad)
            self.systems[message.source] = None
        velocity, omega = m.velocity_m_s or _NO_RATES, m.omega_rad_s or _NO_RATES
        table = kept.setdefault(m.body, motion_columns())
        table.add((m.sim_time_ns / 1e9,), m.position_m, velocity, m.q_wxyz, omega, sigmas)

    def finish(self, tick_s: Array) -> KnownMotion:
        """Return the motion. ``tick_s`` (K,): times of the ticks."""
        return KnownMotion(self.truth, self.references, tuple(self.systems), tick_s)


class KnownMotion(Mapping[str, Track]):
    """Motion of the bodies (``target``, ``chaser/0`` …) at the ticks of a flight, from one source
    for all.

    Reference measurements have times of their own and are interpolated. A long motion is read from
    its file and occupies memory only while referenced.
    """

    def __init__(
        self,
        truth: dict[str, Columns],
        references: dict[str, Columns],
        systems: tuple[str, ...],
        tick_s: Array,
    ) -> None:
        self._motions, self._tick_s, self._systems = truth or references, tick_s, systems
        self.source: MotionSource = "truth" if truth else "reference" if references else "none"
        self._names = tuple(name for name in self._motions if truth or len(self[name].time_s))

    def __getitem__(self, name: str) -> Track:
        if self.source != "reference":
            return Track.of(self._motions[name])
        return self._measured(name).interpolated(self._tick_s)[1]

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __contains__(self, name: object) -> bool:
        return name in self._names

    def __len__(self) -> int:
        return len(self._names)

    def _measured(self, name: str) -> Track:
        """Return the reference measurements of a body without those of a jump."""
        track = Track.of(self._motions[name]).in_order()
        jumps = track.jumps()
        if not jumps:
            return track
        return track.rows(np.delete(np.arange(len(track.time_s)), np.concatenate(jumps)))

    def reference_jumps(self) -> list[ReferenceJump]:
        """Return the jumps of all references, none with ground truth."""
        found: list[ReferenceJump] = []
        for name in self._motions if self.source == "reference" else ():
            track = Track.of(self._motions[name]).in_order()
            for jump in track.jumps():
                before, first = (track.rows(slice(k, k + 1)) for k in (jump[0] - 1, jump[0]))
                moved_m, turned_rad = first.differences(before)
                is_last = jump.stop == len(track.time_s)
                until_s = None if is_last else float(track.time_s[jump.stop])
                size = float(moved_m[0]), float(turned_rad[0])
                found.append(ReferenceJump(name, float(first.time_s[0]), until_s, *size))
        return sorted(found, key=lambda jump: jump.from_s)

    @property
    def chasers(self) -> list[int]:
        """Chasers whose motion is known."""
        return sorted(int(n.partition("/")[2]) for n in self if n.startswith("chaser/"))

    def at(self, name: str, time_s: Array) -> tuple[NDArray[np.intp], Track]:
        """Return which of the ascending times (K,) s the motion of a body covers, and the motion at
        those: ground truth at equal times, reference measurements interpolated.
        """
        if self.source == "reference":
            return self._measured(name).interpolated(time_s)
        true = self[name]
        rows, true_rows = rows_at_equal_times(time_s, true.time_s)
        return rows, true.rows(true_rows)

    def pair(self, chaser: int) -> tuple[Track, Track]:
        """Return the motions of a chaser and of the target at the times at which both are known."""
        return self[f"chaser/{chaser}"].with_other(self[TARGET])

    def has_pair(self, chaser: int) -> bool:
        """Return whether the motions of a chaser and of the target are known."""
        return TARGET in self and f"chaser/{chaser}" in self

    def has_rates(self) -> bool:
        """Return whether the source measures velocities and rates of all bodies."""
        columns = (self._motions[name].table() for name in self)
        return not any(np.isnan(table[:, [4, 11]]).any() for table in columns)

    def sigmas(self) -> tuple[float, float]:
        """Return the stated standard deviations, m and rad, of a measurement: RMS over all
        bodies.
        """
        tables = [self._motions[name].table()[:, 14:] for name in self]
        m, rad = np.sqrt(np.mean(np.concatenate(tables) ** 2, axis=0)).tolist()
        return m, rad

    def describe(self) -> str:
        """Return what the flight is judged against, in words."""
        match self.source:
            case "truth":
                return "ground truth"
            case "reference":
                m, rad = self.sigmas()
                names = " and ".join(f"'{name}'" for name in self._systems)
                return (
                    f"motion capture {names}, 1 sigma {m * 1e3:.2g} mm, {np.degrees(rad):.2g} deg"
                )
            case "none":
                return "nothing: the log has neither ground truth nor a reference"
