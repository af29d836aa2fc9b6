# SPDX-License-Identifier: Apache-2.0
"""Parts of a campaign's report about metrics: criteria, quantiles, histograms, worst runs."""

from __future__ import annotations

import math
from html import escape

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from scipy.stats import chi2

from chaserdock.analysis.plots import FAINT, INK, LIMIT, SERIES, styled, to_inline_svg
from chaserdock.html_page import Markup

from .metrics import (
    CONFIDENCE,
    QUANTILES,
    Metric,
    RunValue,
    nees_band,
    quantile,
    quantile_interval,
)
from .page import PageSection, Table
from .results import share_text

WORST = 3
"""Number of worst runs that are listed of each metric: enough to see whether they share a cause."""
_MOST_BINS = 30
"""Largest number of bins of a histogram: three millimetres each on the page. Larger: outliers make
bins too thin to see.
"""
_FAR_SPANS = 1.5
"""Distance of a limit from the values, in their span, beyond which an arrow points to it instead.
Larger: the values shrink to one bar.
"""
_DASH = "–"  # noqa: RUF001


def metric_sections(found: list[Metric]) -> list[PageSection]:
    """Return criteria, quantiles and histograms of the metrics."""
    return [*_criteria(found), *_quantiles(found), *_histograms(found)]


def _criteria(found: list[Metric]) -> list[PageSection]:
    """Return how many runs met each criterion, of those in which it was judged."""
    body: list[tuple[str, ...]] = []
    for m in found:
        if not m.is_judged:
            continue
        met, missed = m.count("met"), m.count("not met")
        share = share_text(met, met + missed) if met + missed else _DASH
        body.append((m.name, _limits(m), str(met), str(missed), str(m.count("not judged")), share))
    if not body:
        return []
    head = ("criterion", "limit", "met", "not met", "not judged", "met of judged (95 %, Wilson)")
    return [PageSection("Criteria", (Table(head, tuple(body)),))]


def _limits(m: Metric) -> str:
    limits = m.limits
    if not limits:
        return _DASH
    sign = "≥" if m.side == "at least" else "≤"
    most = f" to {limits[-1]:.4g}" if len(limits) > 1 else ""
    return f"{sign} {limits[0]:.4g}{most} {m.unit}".rstrip()


def _quantiles(found: list[Metric]) -> list[PageSection]:
    body: list[tuple[str, ...]] = []
    for m in found:
        if len(set(values := m.values)) > 1:
            cells = (_cell(m, values, share) for share in QUANTILES)
            body.append((m.name, *cells, str(len(values))))
    if not body:
        return []
    names = ("median" if share == 0.5 else f"{100 * share:.0f} %" for share in QUANTILES)
    method = (
        f"Worst chaser of each run. Quantiles are values of runs; in brackets their "
        f"{100 * CONFIDENCE:.0f} % confidence interval by order statistics (binomial "
        "distribution of ranks), open on a side on which there are too few runs."
    )
    return [PageSection("Quantiles", (Table(("metric", *names, "runs"), tuple(body)), method))]


def _cell(m: Metric, values: list[float], share: float) -> str:
    low, high = quantile_interval(values, share)
    if low is None:
        between = "open" if high is None else f"≤ {m.number(high)}"
    else:
        between = f"≥ {m.number(low)}" if high is None else f"{m.number(low)} to {m.number(high)}"
    return f"{m.text(quantile(values, share))} ({between})"


def _histograms(found: list[Metric]) -> list[PageSection]:
    """Return a histogram of each metric whose values differ, with its worst runs."""
    cards: list[str] = []
    equal: list[str] = []
    for k, m in enumerate(found):
        finite = [v for v in m.values if math.isfinite(v)]
        if len(set(finite)) > 1:
            cards.append(_card(m, finite, k))
        elif finite and len(finite) == len(m.values):
            equal.append(f"{m.name} {m.text(finite[0])}")
    parts: list[str | Table] = []
    if cards:
        parts.append(Markup(f'<div class="pair">{"".join(cards)}</div>'))
    if equal:
        parts.append(f"Equal in all runs: {', '.join(equal)}.")
    return [PageSection("Distributions", tuple(parts))] if parts else []


def _card(m: Metric, finite: list[float], number: int) -> str:
    svg = to_inline_svg(_figure(m, finite), f"metric-{number}", escape(m.name))
    worst = ", ".join(_link(m, run) for run in m.worst(WORST))
    return (
        f"<figure><h3>{escape(m.name)}</h3><figcaption>{escape(_caption(m))}</figcaption>{svg}"
        f"<figcaption>Worst: {worst}</figcaption></figure>"
    )


def _link(m: Metric, run: RunValue) -> str:
    return f'<a href="#run-{run.run}">run {run.run}</a> ({escape(m.text(run.value or 0.0))})'


def _caption(m: Metric) -> str:
    values = m.values
    parts = [f"{len(values)} runs"]
    if never := sum(math.isinf(v) for v in values):
        parts.append(f"{never} {m.text(math.inf)}")
    if m.is_judged:
        outcomes = ("met", "not met", "not judged")
        parts += [f"{n} {outcome}" for outcome in outcomes if (n := m.count(outcome))]
    if m.freedoms is not None:
        low, high = nees_band(len(values), m.freedoms)
        mean = math.fsum(values) / len(values)
        verdict = "within" if low <= mean <= high else "outside"
        parts.append(
            f"mean {mean:.2f}, {verdict} the 95 % band {low:.2f} to {high:.2f} (chi-square, "
            f"{m.freedoms} degrees of freedom each run)"
        )
    return "; ".join(parts)


def _figure(m: Metric, finite: list[float]) -> Figure:
    """Draw a histogram with limits, median and outer quantiles; of a NEES with chi-square."""
    with styled():
        figure = Figure(figsize=(5.0, 2.3))
        axes = figure.add_subplot()
        number = min(len(np.histogram_bin_edges(finite, "auto")) - 1, _MOST_BINS)
        counts, edges = np.histogram(finite, number)
        axes.bar(edges[:-1], counts, np.diff(edges), align="edge", color=SERIES[0], alpha=0.55)
        highest = float(counts.max())
        if m.freedoms is not None:
            x = np.linspace(0.0, max(edges[-1], 3.0 * m.freedoms), 200)
            expected = len(finite) * (edges[1] - edges[0]) * chi2.pdf(x, m.freedoms)
            axes.plot(x, expected, color=SERIES[1], label="chi-square")
            axes.legend(loc="upper right", bbox_to_anchor=(1.0, 0.8))
            highest = max(highest, float(expected.max()))
        axes.set_ylim(0.0, 1.4 * highest)  # above the bars: names of quantiles, then of limits
        for share in QUANTILES:
            if math.isfinite(value := quantile(m.values, share)):
                _mark(axes, value, share)
        for limit in m.limits:
            _draw_limit(axes, limit, f"limit {limit:.4g}", (finite[0], finite[-1]))
        axes.set(xlabel=f"{m.name} / {m.unit}" if m.unit else m.name, ylabel="runs")
        axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    return figure


def _mark(axes: Axes, value: float, share: float) -> None:
    """Mark a quantile; the name of the median is lower, as outer ones may be near it."""
    median = share == 0.5
    colour = INK if median else FAINT
    axes.axvline(
        value, 0.0, 0.68 if median else 0.78, color=colour, linestyle="-" if median else ":"
    )
    axes.annotate(
        "median" if median else f"{100 * share:.0f} %",
        (value, 0.70 if median else 0.80),
        xycoords=("data", "axes fraction"),
        ha="center",
        fontsize=8,
        color=colour,
    )


def _draw_limit(axes: Axes, limit: float, label: str, span: tuple[float, float]) -> None:
    """Draw a limit; an arrow to it where it is far from the values."""
    low, high = span
    far, right = _FAR_SPANS * (high - low), limit > (low + high) / 2.0
    near = low - far <= limit <= high + far
    if near:
        axes.axvline(limit, color=LIMIT, linestyle=(0, (5, 3)), linewidth=1.1)
    else:
        label = f"{label} →" if right else f"← {label}"
    axes.annotate(
        label,
        (limit if near else float(right), 1.0),
        xycoords=("data" if near else "axes fraction", "axes fraction"),
        xytext=(-3 if right else 3, -2),
        textcoords="offset points",
        ha="right" if right else "left",
        va="top",
        fontsize=8,
        color=LIMIT,
    )
