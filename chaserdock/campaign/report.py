# SPDX-License-Identifier: Apache-2.0
"""Report of a campaign: one HTML file with pass rate, causes, sensitivities and a link to every
failure.
"""

from __future__ import annotations

import html
import math
import os
from pathlib import Path
from typing import Any

from chaserdock.html_page import Markup, html_page, table

from .plan import Campaign, Run
from .table import RunRow, causes, metrics_of, numbers_of, rank_correlation, rerun_command, wilson

_SHOWN = (
    ("steady_position_mse_m2", "steady position RMS, mm", lambda v: math.sqrt(v) * 1e3),
    (
        "steady_orientation_mse_rad2",
        "steady orientation RMS, deg",
        lambda v: math.degrees(math.sqrt(v)),
    ),
    ("estimate_max_position_error_m", "largest estimate error, mm", lambda v: v * 1e3),
)


def page(campaign: Campaign, rows: list[RunRow], folder: Path) -> str:
    """Return the report as HTML; links to logs are relative to ``folder``. Raise ValueError without
    any run.
    """
    passed, finished = sum(bool(r["success"]) for r in rows), len(rows)
    low, high = wilson(passed, finished)
    missing = len(campaign.runs) - finished
    scenarios = ", ".join(sorted({str(run.scenario) for run in campaign.runs}))
    parts = [
        f"<h1>{html.escape(campaign.name)}</h1>",
        f"<p>Scenario <code>{html.escape(scenarios)}</code>, {finished} of {len(campaign.runs)} runs flown"
        + (f"; <b>{missing} are missing</b>; repeat the command to resume" if missing else "")
        + ".</p>",
        f'<p class="big">{passed} of {finished} passed: {100 * passed / finished:.1f} % '
        f"(95 % confidence: {100 * low:.1f} to {100 * high:.1f} %, Wilson)</p>",
        _causes(rows),
        _sensitivities(campaign, rows),
        _failures(campaign, rows, folder),
    ]
    return html_page(campaign.name, parts)


def _causes(rows: list[RunRow]) -> str:
    counted = causes(rows)
    if not counted:
        return ""
    rows_of_causes = [(str(n), cause) for cause, n in counted]
    return "<h2>Outcomes by cause</h2>" + table(
        ("runs", "first failure (# stands for a number)"), rows_of_causes, text=True
    )


def _sensitivities(campaign: Campaign, rows: list[RunRow]) -> str:
    numeric = [p for p in campaign.parameters if numbers_of(rows, f"vary.{p}") is not None]
    categorical = [p for p in campaign.parameters if p not in numeric]
    out = []
    if numeric and len(rows) > 1:
        caption = "<figcaption>Dots: passed; crosses: failed.</figcaption>"
        out.append(f'<figure class="wide">{caption}{_figure(numeric, rows)}</figure>')
        out.append(_correlations(numeric, rows))
    for p in categorical:
        out.append(_by_value(p, rows))
    return "<h2>Sensitivity</h2>" + "".join(out) if out else ""


def _figure(parameters: list[str], rows: list[RunRow]) -> str:
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


def _correlations(parameters: list[str], rows: list[RunRow]) -> str:
    body: list[list[str]] = []
    for metric in ["success", *metrics_of(rows)]:
        values = [float(r[metric]) for r in rows]
        cells = [rank_correlation(numbers_of(rows, f"vary.{p}") or [], values) for p in parameters]
        if not all(math.isnan(c) for c in cells):
            body.append([metric, *("" if math.isnan(c) else f"{c:+.2f}" for c in cells)])
    return "<h3>Rank correlation (Spearman)</h3>" + table(["", *parameters], body)


def _by_value(parameter: str, rows: list[RunRow]) -> str:
    groups: dict[str, list[RunRow]] = {}
    for r in rows:
        groups.setdefault(str(r[f"vary.{parameter}"]), []).append(r)
    body: list[tuple[str, str, str]] = []
    for value, group in sorted(groups.items()):
        passed = sum(bool(r["success"]) for r in group)
        low, high = wilson(passed, len(group))
        body.append((value, f"{passed} of {len(group)}", f"{100 * low:.0f} to {100 * high:.0f} %"))
    return f"<h3>{html.escape(parameter)}</h3>" + table(("value", "passed", "95 %"), body)


def _failures(campaign: Campaign, rows: list[RunRow], folder: Path) -> str:
    failed = [r for r in rows if not r["success"]]
    if not failed:
        return ""
    runs: dict[str, Run] = {run.name: run for run in campaign.runs}
    body: list[tuple[str, str]] = []
    for r in failed:
        log = str(r["log"])
        where = Path(log)
        if where.is_absolute():
            shown = html.escape(os.path.relpath(where, folder))
            link = f'<a href="{shown}">{shown}</a>'
        else:
            link = html.escape(log) or "not kept"
        command = html.escape(rerun_command(runs[str(r["run"])]))
        cell = f"{html.escape(str(r['cause']))}<br>{link}<br><code>{command}</code>"
        body.append((str(r["index"]), Markup(cell)))
    head = ("run", "cause, log and command that repeats the run")
    return "<h2>Failures</h2>" + table(head, body, text=True)
