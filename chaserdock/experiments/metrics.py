# SPDX-License-Identifier: Apache-2.0
"""Metrics of a campaign's runs: values with limits and outcomes, quantiles, expected NEES."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

from chaserdock.analysis.pose_errors import chi_square_band
from chaserdock.criterion import Criterion, Outcome, quantity
from chaserdock.verdict import verdict_of

from .worker import FlightOutcome

CONFIDENCE = 0.95
"""Confidence of all intervals of a campaign."""
QUANTILES = (0.5, 0.05, 0.95)
"""Shares of the runs whose quantiles are shown: the median, which a phone shows, low and high."""
POSE_FREEDOMS = 6
"""Degrees of freedom of a pose, which are the expectation of its NEES."""
_NEES = "mean NEES"


@dataclass(frozen=True)
class RunValue:
    """What one run, by its index in the plan, shows of a metric.

    ``value``: None if it is not known; infinite if the run never reached what has to be reached.
    ``outcome``: None without a criterion. ``note``: why it was not judged.
    """

    run: int
    value: float | None
    limit: float | None = None
    outcome: Outcome | None = None
    note: str = ""


@dataclass(frozen=True)
class Metric:
    """A metric of the runs, for the worst chaser of each. ``side``: see ``Criterion``.
    ``freedoms``: expectation of a NEES; None for all others.
    """

    name: str
    unit: str
    side: Literal["at most", "at least"]
    runs: tuple[RunValue, ...]
    freedoms: int | None = None

    @property
    def values(self) -> list[float]:
        """Return the known values in ascending order."""
        return sorted(r.value for r in self.runs if r.value is not None)

    @property
    def limits(self) -> list[float]:
        """Return the different limits of the runs."""
        return sorted({r.limit for r in self.runs if r.limit is not None})

    def count(self, outcome: Outcome) -> int:
        """Return the number of runs with an outcome."""
        return sum(r.outcome == outcome for r in self.runs)

    @property
    def is_judged(self) -> bool:
        """Return whether it is a criterion, judged or not, of any run."""
        return any(r.outcome is not None for r in self.runs)

    def worst(self, number: int) -> list[RunValue]:
        """Return the worst runs: not met before met, then by value; a NEES by its ratio to the
        expectation. None where all values are equal.
        """
        known = [r for r in self.runs if r.value is not None]
        if len({(r.value, r.outcome) for r in known}) < 2:
            return []
        return sorted(known, key=self._rank)[:number]

    def _rank(self, run: RunValue) -> tuple[bool, float]:
        value = run.value or 0.0
        if self.freedoms is not None:
            value = abs(math.log(max(value, 1e-12) / self.freedoms))
        return run.outcome != "not met", value if self.side == "at least" else -value

    def text(self, value: float) -> str:
        """Return a value with its unit; a count is whole."""
        return f"{self.number(value)} {self.unit if math.isfinite(value) else ''}".rstrip()

    def number(self, value: float) -> str:
        """Return a value without its unit."""
        if math.isinf(value):
            return "never" if self.unit == "s" else "not known"
        return f"{value:.0f}" if not self.unit and self.freedoms is None else quantity(value, "")


@dataclass(frozen=True)
class _Measure:
    """A column of the table of results that is a metric without a criterion of its name."""

    column: str
    name: str
    unit: str
    scaled: Callable[[float], float]
    side: Literal["at most", "at least"] = "at most"
    freedoms: int | None = None


def _mm(metres: float) -> float:
    return metres * 1e3


def _same(value: float) -> float:
    return value


_MEASURES = (
    _Measure(
        "steady_position_mse_m2", "steady position RMS", "mm", lambda mse: math.sqrt(mse) * 1e3
    ),
    _Measure(
        "steady_orientation_mse_rad2",
        "steady orientation RMS",
        "°",
        lambda mse: math.degrees(math.sqrt(mse)),
    ),
    _Measure("min_distance_target_m", "distance to target", "m", _same, "at least"),
    _Measure("min_distance_chasers_m", "between chasers", "m", _same, "at least"),
    _Measure("relative_estimate_position_rms_m", "estimated relative position RMS", "mm", _mm),
    _Measure("estimate_max_position_error_m", "largest error of target position", "mm", _mm),
    _Measure("impulse_N_s", "impulse, all chasers", "N s", _same),
    _Measure("estimate_nees_mean", f"{_NEES}, target", "", _same, freedoms=POSE_FREEDOMS),
    _Measure(
        "relative_estimate_nees", f"{_NEES}, relative pose", "", _same, freedoms=POSE_FREEDOMS
    ),
)
"""Metrics without a limit, from the columns of the results (SI units)."""


def metrics(
    rows: Sequence[Mapping[str, Any]], outcomes: Mapping[str, FlightOutcome]
) -> list[Metric]:
    """Return the metrics of the runs of a table: their criteria, then measures without a limit."""
    found: dict[tuple[str, str, Literal["at most", "at least"]], list[RunValue]] = {}
    for row in rows:
        groups: dict[tuple[str, str, Literal["at most", "at least"]], list[Criterion]] = {}
        for c in verdict_of(outcomes[row["run"]].summary or {}).criteria:
            groups.setdefault((c.name, c.unit, c.side), []).append(c)
        for key, group in groups.items():
            found.setdefault(key, []).append(_of_run(row["index"], group))
    judged = [Metric(*key, tuple(runs)) for key, runs in found.items()]
    names = {m.name for m in judged}
    return [*judged, *(m for m in _measured(rows) if m.name not in names)]


def _of_run(run: int, group: Sequence[Criterion]) -> RunValue:
    """Return a run's value: that of the chaser with the least margin. It is met only if it was
    judged for all chasers.
    """
    seen = {c.outcome for c in group}
    outcome = "not met" if "not met" in seen else "not judged" if "not judged" in seen else "met"
    judged = [c for c in group if c.outcome == "not met"] if outcome == "not met" else []
    judged = judged or [c for c in group if c.outcome == "met"] or list(group)
    worst = min(judged, key=lambda c: -math.inf if c.margin is None else c.margin)
    value = worst.measured
    if value is None and worst.outcome == "not met":
        value = -math.inf if worst.side == "at least" else math.inf
    note = next((c.note for c in group if c.outcome == "not judged"), "")
    return RunValue(run, value, worst.limit, outcome, note)


def _measured(rows: Sequence[Mapping[str, Any]]) -> list[Metric]:
    found: list[Metric] = []
    for m in _MEASURES:
        values = [(r["index"], r.get(m.column, math.nan)) for r in rows]
        runs = tuple(RunValue(i, m.scaled(v)) for i, v in values if math.isfinite(v))
        if runs:
            found.append(Metric(m.name, m.unit, m.side, runs, m.freedoms))
    return found


def quantile(values: Sequence[float], share: float) -> float:
    """Return the smallest value that at least ``share`` of the values do not exceed: an observed
    one, also among infinite ones. Raise ValueError without values.
    """
    if not values:
        raise ValueError("no values")
    # The slack keeps 0.95 * 20, which is more than 19 in binary, at rank 19.
    return sorted(values)[max(math.ceil(share * len(values) - 1e-9), 1) - 1]


def quantile_interval(values: Sequence[float], share: float) -> tuple[float | None, float | None]:
    """Return the confidence interval of a quantile: order statistics, by the binomial distribution
    of their ranks (W. J. Conover, Practical Nonparametric Statistics, 1999, section 3.2). None: so
    few values leave this side open.
    """
    from scipy.stats import quantile_test

    interval = quantile_test(sorted(values), q=0, p=share).confidence_interval(CONFIDENCE)
    low, high = float(interval.low), float(interval.high)
    return None if math.isnan(low) else low, None if math.isnan(high) else high


def nees_band(runs: int, freedoms: int = POSE_FREEDOMS) -> tuple[float, float]:
    """Return the 95 % band of the mean NEES over independent runs of a consistent filter.

    The sum over runs is chi-square distributed with ``freedoms`` each run, as if the errors of a
    run were one (Y. Bar-Shalom et al., Estimation with Applications, 2001, section 5.4.2); errors
    that vary within a run make the mean vary less.
    """
    low, high = chi_square_band(freedoms * runs)
    return float(low) / runs, float(high) / runs
