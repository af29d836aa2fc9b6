# SPDX-License-Identifier: Apache-2.0
"""Report of a campaign: outcomes by cause, metrics, sensitivities, and how to see more of failures
and of the worst runs.
"""

from __future__ import annotations

import html
import json
import math
import os
import shlex
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import quote

from chaserdock.html_page import Markup

from .metric_sections import WORST, metric_sections
from .metrics import Metric, metrics
from .page import PageSection, Table
from .plan import ExperimentPlan
from .results import (
    ResultRow,
    cause_of,
    causes,
    in_part,
    metrics_of,
    numbers_of,
    qualification,
    rank_correlation,
    rate,
    remarks,
    repeat_command,
    share_text,
    wilson,
)
from .worker import FlightOutcome

TABLE, PAGE, SINGLE_RUNS = "results.parquet", "report.html", "single-runs"
"""Files and folders of a campaign's folder: table, report, runs that were flown again."""

_SHOWN = (
    ("steady_position_mse_m2", "steady position RMS, mm", lambda v: math.sqrt(v) * 1e3),
    (
        "steady_orientation_mse_rad2",
        "steady orientation RMS, deg",
        lambda v: math.degrees(math.sqrt(v)),
    ),
    ("estimate_max_position_error_m", "largest estimate error, mm", lambda v: v * 1e3),
)


def sections(
    plan: ExperimentPlan,
    rows: list[ResultRow],
    outcomes: Mapping[str, FlightOutcome],
    folder: Path,
    command: str,
) -> list[PageSection]:
    """Return the report; links are relative to ``folder``, where it is written. ``command``: see
    ``campaign_command``. Raise ValueError without any row.
    """
    missing = len(plan.flights) - len(rows)
    scenarios = ", ".join(sorted({flight.scenario for flight in plan.flights}))
    flown = f"Scenario `{scenarios}`, {len(rows)} of {len(plan.flights)} runs flown"
    resume = f"; {missing} are missing; repeat the command to resume" if missing else ""
    big = Markup(f'<p class="big">{html.escape(rate(rows))}</p>')
    again = f"Run N again{with_log(plan)}: `{command} --only N`."
    notes = qualification(rows)
    qualified = [f"{', '.join(notes)}."] if notes else []
    found = metrics(rows, outcomes)
    head = (f"{flown}{resume}.", big, *qualified, again, *_table_link(folder))
    return [
        PageSection("", head),
        *_outcomes(rows),
        *metric_sections(found),
        *_remarks(rows),
        *_sensitivities(plan, rows),
        *_runs(rows, found, folder, command),
    ]


def with_log(plan: ExperimentPlan) -> str:
    """Return what a run that is flown again leaves: nothing if the controller flies alone."""
    return "" if any(flight.module for flight in plan.flights) else ", with its log and report"


def _table_link(folder: Path) -> Iterator[str]:
    if (folder / TABLE).exists():
        yield Markup(f'<p>All results as a table: <a href="{TABLE}">{TABLE}</a>.</p>')


def _outcomes(rows: list[ResultRow]) -> list[PageSection]:
    """Return the outcomes by cause: a bar, and a table with the share of each."""
    part = sum(in_part(r) for r in rows)
    counts = [
        ("good", "passed", sum(bool(r["success"]) for r in rows) - part),
        ("partial", "not judged in full: met what was judged", part),
        *(("bad", f"failed: {cause}", n) for cause, n in causes(rows)),
    ]
    shown = [c for c in counts if c[2]]
    parts = (
        f'<i class="{k}" style="flex:{n}" title="{html.escape(t)}"><b>{n}</b></i>'
        for k, t, n in shown
    )
    bar = Markup(f'<div class="outcomes">{"".join(parts)}</div>')
    lines: list[tuple[str, ...]] = []
    for level, text, n in shown:
        share = share_text(n, len(rows))
        lines.append((str(n), share, Markup(f'<span class="{level}">{html.escape(text)}</span>')))
    head = ("runs", "share (95 %, Wilson)", "outcome (# stands for a number)")
    return [PageSection("Outcomes by cause", (bar, Table(head, tuple(lines), text=True)))]


def _remarks(rows: list[ResultRow]) -> list[PageSection]:
    found: list[PageSection] = []
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


def _runs(
    rows: list[ResultRow], found: list[Metric], folder: Path, command: str
) -> list[PageSection]:
    """Return the runs that failed or are among the worst of a metric, each with what is known of
    it and how to see more.
    """
    worst: dict[int, list[str]] = {}
    for m in found:
        for run in m.worst(WORST):
            worst.setdefault(run.run, []).append(f"{m.name} {m.text(run.value or 0.0)}")
    body: list[tuple[str, str]] = []
    for r in rows:
        index, failures = int(r["index"]), json.loads(r["failures"])
        if r["success"] and index not in worst:
            continue
        varied = [f"{k.removeprefix('vary.')}={r[k]}" for k in r if k.startswith("vary.")]
        texts = [", ".join([*varied, f"seed {r['seed']}"])]
        texts += [f"failed: {text}" for text in failures]
        texts += [f"among the worst: {', '.join(worst[index])}"] if index in worst else []
        lines = [*map(html.escape, texts), *_ways(r, folder, repeat_command(command, index))]
        body.append((Markup(f'<span id="run-{index}">{index}</span>'), Markup("<br>".join(lines))))
    head = ("run", "what is known of it, and how to see more")
    return (
        [PageSection("Failures and worst runs", (Table(head, tuple(body), text=True),))]
        if body
        else []
    )


def _ways(row: ResultRow, folder: Path, again: str) -> Iterator[str]:
    """Yield links to what is there of a run, and the commands that make what is not."""
    log = Path(str(row["log"]))
    single = folder / SINGLE_RUNS / str(row["run"])
    kept = [log.parent] if log.is_absolute() else []
    pages = (where / PAGE for where in (*kept, single))
    page = next((page for page in pages if page.is_file()), None)
    links = [] if page is None else [_link(page, folder, "report")]
    if log.is_absolute():
        links.append(_link(log, folder, "log"))
    elif row["log"]:  # on another machine
        links.append(html.escape(str(row["log"])))
    if links:
        yield ", ".join(links)
    if page is None and log.is_absolute():
        yield f"report: <code>{html.escape(shlex.join(['chaserdock', 'report', str(log)]))}</code>"
    yield f"again: <code>{html.escape(again)}</code>"


def _link(path: Path, folder: Path, name: str) -> str:
    target = quote(os.path.relpath(path, folder))
    return f'<a href="{target}">{name}</a>'
