# SPDX-License-Identifier: Apache-2.0
"""Report of a campaign: pass rate, causes, sensitivities, and a link to every failure."""

from __future__ import annotations

import html
import math
import os
from collections import Counter
from pathlib import Path
from typing import Any

from chaserdock.html_page import Markup

from .page import PageSection, Table
from .plan import ExperimentPlan, PlannedFlight
from .results import (
    ResultRow,
    cause_of,
    causes,
    metrics_of,
    numbers_of,
    rank_correlation,
    remarks,
    repeat_command,
    wilson,
)

_SHOWN = (
    ("steady_position_mse_m2", "steady position RMS, mm", lambda v: math.sqrt(v) * 1e3),
    (
        "steady_orientation_mse_rad2",
        "steady orientation RMS, deg",
        lambda v: math.degrees(math.sqrt(v)),
    ),
    ("estimate_max_position_error_m", "largest estimate error, mm", lambda v: v * 1e3),
)


def sections(plan: ExperimentPlan, rows: list[ResultRow], folder: Path) -> list[PageSection]:
    """Return the report; links to logs are relative to ``folder``. Raise ValueError without any
    row.
    """
    passed, ended = sum(bool(r["success"]) for r in rows), len(rows)
    low, high = wilson(passed, ended)
    missing = len(plan.flights) - ended
    scenarios = ", ".join(sorted({flight.scenario for flight in plan.flights}))
    flown = f"Scenario `{scenarios}`, {ended} of {len(plan.flights)} runs flown"
    resume = f"; {missing} are missing; repeat the command to resume" if missing else ""
    rate = Markup(
        f'<p class="big">{passed} of {ended} passed: {100 * passed / ended:.1f} % '
        f"(95 % confidence: {100 * low:.1f} to {100 * high:.1f} %, Wilson)</p>"
    )
    return [
        PageSection("", (f"{flown}{resume}.", rate, *qualification(rows))),
        *_causes(rows),
        *_sensitivities(plan, rows),
        *_failures(plan, rows, folder),
    ]


def _causes(rows: list[ResultRow]) -> list[PageSection]:
    counted = tuple((str(n), cause) for cause, n in causes(rows))
    head = ("runs", "first failure (# stands for a number)")
    found = (
        [PageSection("Outcomes by cause", (Table(head, counted, text=True),))] if counted else []
    )
    for title, kind in (("Criteria not judged", "not_judged"), ("Doubtful estimates", "doubts")):
        lines = tuple((str(n), text) for text, n in remarks(rows, kind))
        if lines:
            table = Table(("runs", "remark (# stands for a number)"), lines, text=True)
            found.append(PageSection(title, (table,)))
    ends = Counter(cause_of(r["ended"]) for r in rows if r["ended"])
    if ends:
        lines = tuple((str(n), reason) for reason, n in ends.most_common())
        head = ("runs", "end of the flight (# stands for a number)")
        found.append(PageSection("Ends", (Table(head, lines, text=True),)))
    return found


def qualification(rows: list[ResultRow]) -> list[str]:
    """Return a line about the passed runs whose verdict is qualified; none without any."""
    passed = [r for r in rows if r["success"]]
    counts = (
        (sum(r["not_judged"] != "[]" for r in passed), "with criteria not judged"),
        (sum(r["doubts"] != "[]" for r in passed), "with a NEES out of range"),
    )
    texts = [f"{n} {what}" for n, what in counts if n]
    return [f"Of the {len(passed)} that passed: {', '.join(texts)}."] if texts else []


def _sensitivities(plan: ExperimentPlan, rows: list[ResultRow]) -> list[PageSection]:
    numeric = [p for p in plan.parameters if numbers_of(rows, f"vary.{p}") is not None]
    parts: list[str | Table] = []
    if numeric and len(rows) > 1:
        caption = "<figcaption>Dots: passed; crosses: failed.</figcaption>"
        parts.append(Markup(f'<figure class="wide">{caption}{_figure(numeric, rows)}</figure>'))
        parts += ["Rank correlation (Spearman):", _correlations(numeric, rows)]
    for p in plan.parameters:
        if p not in numeric:
            parts += [f"Pass rate by `{p}`:", _by_value(p, rows)]
    return [PageSection("Sensitivity", tuple(parts))] if parts else []


def _figure(parameters: list[str], rows: list[ResultRow]) -> str:
    from matplotlib.figure import Figure

    from chaserdock.analysis.plots import LIMIT, SERIES, styled, to_inline_svg

    shown = [m for m in _SHOWN if m[0] in metrics_of(rows)]
    with styled():
        figure = Figure(figsize=(3.2 * len(parameters) + 0.6, 2.5 * len(shown) + 0.4))
        axes: Any = figure.subplots(
            len(shown), len(parameters), squeeze=False, sharex="col", sharey="row"
        )
        for row, (metric, label, scale) in enumerate(shown):
            axes[row][0].set_ylabel(label)
            axes[row][0].set_yscale("log")
            for ax, parameter in zip(axes[row], parameters, strict=True):
                for good, colour, marker in ((True, SERIES[0], "o"), (False, LIMIT, "x")):
                    points = [
                        (float(r[f"vary.{parameter}"]), scale(r[metric]))
                        for r in rows
                        if r["success"] is good and math.isfinite(r[metric])
                    ]
                    if points:
                        ax.scatter(
                            *zip(*points, strict=True), s=14, c=colour, marker=marker, linewidths=1
                        )
        for ax, parameter in zip(axes[-1], parameters, strict=True):
            ax.set_xlabel(parameter)
    return to_inline_svg(figure, "sensitivity", "results by parameter")


def _correlations(parameters: list[str], rows: list[ResultRow]) -> Table:
    body: list[tuple[str, ...]] = []
    for metric in ["success", *metrics_of(rows)]:
        values = [float(r[metric]) for r in rows]
        cells = [rank_correlation(numbers_of(rows, f"vary.{p}") or [], values) for p in parameters]
        if not all(math.isnan(c) for c in cells):
            body.append((metric, *("" if math.isnan(c) else f"{c:+.2f}" for c in cells)))
    return Table(("", *parameters), tuple(body))


def _by_value(parameter: str, rows: list[ResultRow]) -> Table:
    groups: dict[str, list[ResultRow]] = {}
    for r in rows:
        groups.setdefault(str(r[f"vary.{parameter}"]), []).append(r)
    body: list[tuple[str, ...]] = []
    for value, group in sorted(groups.items()):
        passed = sum(bool(r["success"]) for r in group)
        low, high = wilson(passed, len(group))
        body.append((value, f"{passed} of {len(group)}", f"{100 * low:.0f} to {100 * high:.0f} %"))
    return Table(("value", "passed", "95 %"), tuple(body))


def _failures(plan: ExperimentPlan, rows: list[ResultRow], folder: Path) -> list[PageSection]:
    """Return the runs that failed, each with its cause, a link to its log, and the command that
    repeats it.
    """
    flights: dict[str, PlannedFlight] = {flight.name: flight for flight in plan.flights}
    body: list[tuple[str, str]] = []
    for r in rows:
        if r["success"]:
            continue
        log = Path(str(r["log"]))
        if log.is_absolute():
            shown = html.escape(os.path.relpath(log, folder))
            link = f'<a href="{shown}">{shown}</a>'
        else:
            link = html.escape(str(r["log"])) or "not kept"
        command = html.escape(repeat_command(flights[str(r["run"])]))
        cause = html.escape(str(r["cause"]))
        body.append((str(r["index"]), Markup(f"{cause}<br>{link}<br><code>{command}</code>")))
    head = ("run", "cause, log and command that repeats the run")
    return [PageSection("Failures", (Table(head, tuple(body), text=True),))] if body else []
