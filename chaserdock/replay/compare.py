# SPDX-License-Identifier: Apache-2.0
"""Compares two recorded flights: summaries, digests, first different message, deviations of the
bodies.
"""

from __future__ import annotations

from itertools import zip_longest
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from chaserdock_models import rotations
from chaserdock_protocol.recording.log import LogSource, read_log

from chaserdock.analysis.flight import NOT_IN_DIGEST, RecordedFlight, load_flight
from chaserdock.analysis.summary import summary_of

from .difference import Comparison, TopicDifference, difference_lines, first_difference

# Prefixes of values that depend on the machine. They are shown, but are no difference between
# flights.
_WALL = (
    "wall_time_s",
    "latency_s.",
    "solver.solve_s.",
    "peak_memory_bytes",
    "cpu_s",
    "messages.",
    "digest",
)


class Deviation(msgspec.Struct):
    """Largest deviation between two tracks of one body, and its time."""

    position_m: float
    position_time_s: float
    orientation_rad: float
    orientation_time_s: float


class RunComparison(msgspec.Struct):
    """Differences of two recorded flights.

    ``summary``: both values of each key that differs between the summaries. ``deviations``: of the
    motion of each body; ``target estimate`` is the fused one. ``blas``: both linear algebra
    libraries (recording.provenance.blas_in_use) of each process for which they are known and
    differ.
    """

    digests: tuple[str, str]
    blas: dict[str, tuple[str, str]]
    first_difference: str | None
    summary: dict[str, tuple[Any, Any]]
    deviations: dict[str, Deviation]
    topics: list[TopicDifference]

    @property
    def equal(self) -> bool:
        return self.digests[0] == self.digests[1]


def flat(value: Any, name: str = "") -> dict[str, Any]:
    """Flatten nested dictionaries; join keys with dots."""
    if not isinstance(value, dict):
        return {name: value}
    out: dict[str, Any] = {}
    for key, item in value.items():
        out |= flat(item, f"{name}.{key}" if name else str(key))
    return out


def compare(first: Path, second: Path, tolerance: float = 0.0) -> RunComparison:
    """Compare the flights in two logs or run folders. Raise LogError or ScenarioError."""
    flights = load_flight(first), load_flight(second)
    a, b = (flat(summary_of(f)) for f in flights)
    topics = _messages(first, second, tolerance)
    return RunComparison(
        digests=(flights[0].digest, flights[1].digest),
        blas=_different_blas(*(f.blas for f in flights)),
        first_difference=first_difference(topics),
        summary={k: (a.get(k), b.get(k)) for k in {**a, **b} if a.get(k) != b.get(k)},
        deviations=_deviations(*flights),
        topics=topics,
    )


def _different_blas(one: dict[str, str], other: dict[str, str]) -> dict[str, tuple[str, str]]:
    both = {name: (one[name], other[name]) for name in sorted(one.keys() & other.keys())}
    return {name: pair for name, pair in both.items() if all(pair) and pair[0] != pair[1]}


def _messages(first: LogSource, second: LogSource, tolerance: float) -> list[TopicDifference]:
    comparison = Comparison(tolerance)
    for pair in zip_longest(read_log(first), read_log(second)):
        for side, record in enumerate(pair):
            if record is not None and record.topic not in NOT_IN_DIGEST:
                comparison.add(side, record.key, record.message)
    return comparison.finish()


def _deviations(a: RecordedFlight, b: RecordedFlight) -> dict[str, Deviation]:
    out = {}
    for name in [*(n for n in a.motion if n in b.motion), "target estimate"]:
        estimate = name == "target estimate"
        one, other = (f.estimate if estimate else f.motion[name] for f in (a, b))
        one, other = one.with_other(other)
        if not len(one.time_s):
            continue
        position = np.linalg.norm(one.position_m - other.position_m, axis=1)
        angle = rotations.angle_between(one.q_wxyz, other.q_wxyz)
        p, q = int(np.argmax(position)), int(np.argmax(angle))
        out[name] = Deviation(
            float(position[p]), float(one.time_s[p]), float(angle[q]), float(one.time_s[q])
        )
    return out


def comparison_lines(result: RunComparison) -> list[str]:
    """Format the comparison as lines of text."""
    lines = [
        f"different BLAS of {name}, whose results differ in the last bits: {one}; {other}"
        for name, (one, other) in result.blas.items()
    ]
    if result.equal:
        return [*lines, f"equal flights, digest {result.digests[0]}"]
    lines += ["summary (first, second, second / first):"]
    for wall in (False, True):
        for key, (x, y) in sorted(result.summary.items()):
            if key.startswith(_WALL) != wall or not isinstance(x, int | float | None | bool | str):
                continue
            ratio = f"  {y / x:8.3f}" if _is_size(x) and _is_size(y) else ""
            lines.append(
                f"  {key}: {_format(x)}  "
                f"{_format(y)}{ratio}{'  (machine-dependent)' if wall else ''}"
            )
    lines.append("largest deviations between the flights:")
    for name, d in result.deviations.items():
        lines.append(
            f"  {name}: {d.position_m:.3g} m at {d.position_time_s:.2f} s, "
            f"{d.orientation_rad:.3g} rad at {d.orientation_time_s:.2f} s"
        )
    lines += difference_lines(result.topics, ("first", "second"))
    lines.append(f"first difference: {result.first_difference or 'none within the tolerance'}")
    return lines


def _is_size(x: Any) -> bool:
    return isinstance(x, int | float) and not isinstance(x, bool) and x != 0


def _format(x: Any) -> str:
    return f"{x:.6g}" if isinstance(x, float) else str(x)
