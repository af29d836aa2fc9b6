# SPDX-License-Identifier: Apache-2.0
"""Report of a campaign: one HTML file with pass rate, causes, sensitivities and a link to every failure."""

from __future__ import annotations

import html
import io
import math
import os
from pathlib import Path

from .plan import Campaign, Run
from .table import RunRow, causes, metrics_of, numbers_of, rank_correlation, rerun_command, wilson

_SHOWN = (
    ("steady_position_mse_m2", "steady position RMS, mm", lambda v: math.sqrt(v) * 1e3),
    ("steady_orientation_mse_rad2", "steady orientation RMS, deg", lambda v: math.degrees(math.sqrt(v))),
    ("estimate_max_position_error_m", "largest estimate error, mm", lambda v: v * 1e3),
)
_GOOD, _BAD = "#1b6ca8", "#c8401f"
_STYLE = """
:root { color-scheme: light dark; --ink: light-dark(#1c2430, #e6e9ee); --paper: light-dark(#fff, #15191f);
  --line: light-dark(#d5dae1, #343b45); }
body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper); max-width: 70rem;
  margin: 2rem auto; padding: 0 1rem; }
table { border-collapse: collapse; } td, th { border-bottom: 1px solid var(--line); padding: .3rem .8rem .3rem 0;
  text-align: left; vertical-align: top; } td.n { text-align: right; font-variant-numeric: tabular-nums; }
.figure { background: #fff; border-radius: 6px; padding: .5rem; overflow-x: auto; } svg { max-width: 100%; height: auto; }
code { font-size: .85em; overflow-wrap: anywhere; } .big { font-size: 1.6rem; }
"""


def page(campaign: Campaign, rows: list[RunRow], folder: Path) -> str:
    """Return the report as HTML; links to logs are relative to ``folder``. Raise ValueError without any run."""
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
    title = html.escape(campaign.name)
    head = (
        f'<!doctype html><html lang="en"><meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style>'
    )
    return head + "".join(parts) + "</html>\n"


def _causes(rows: list[RunRow]) -> str:
    counted = causes(rows)
    if not counted:
        return ""
    body = "".join(f'<tr><td class="n">{n}</td><td>{html.escape(cause)}</td></tr>' for cause, n in counted)
    return f"<h2>Outcomes by cause</h2><table><tr><th>runs</th><th>first failure (# stands for a number)</th></tr>{body}</table>"


def _sensitivities(campaign: Campaign, rows: list[RunRow]) -> str:
    numeric = [p for p in campaign.parameters if numbers_of(rows, f"vary.{p}") is not None]
    categorical = [p for p in campaign.parameters if p not in numeric]
    out = []
    if numeric and len(rows) > 1:
        out.append(f'<div class="figure">{_figure(numeric, rows)}</div>')
        out.append(_correlations(numeric, rows))
    for p in categorical:
        out.append(_by_value(p, rows))
    return "<h2>Sensitivity</h2>" + "".join(out) if out else ""


def _figure(parameters: list[str], rows: list[RunRow]) -> str:
    from matplotlib.figure import Figure

    shown = [m for m in _SHOWN if m[0] in metrics_of(rows)]
    figure = Figure(figsize=(3.2 * len(parameters) + 0.6, 2.5 * len(shown) + 0.4), layout="constrained")
    axes = figure.subplots(len(shown), len(parameters), squeeze=False, sharex="col", sharey="row")
    for row, (metric, label, scale) in enumerate(shown):
        for column, parameter in enumerate(parameters):
            ax = axes[row][column]
            for good, colour, marker in ((True, _GOOD, "o"), (False, _BAD, "x")):
                points = [
                    (float(r[f"vary.{parameter}"]), scale(r[metric]))
                    for r in rows
                    if r["success"] is good and math.isfinite(r[metric])
                ]
                if points:
                    ax.scatter(*zip(*points, strict=True), s=14, c=colour, marker=marker, linewidths=1)
            ax.grid(alpha=0.3)
            if column == 0:
                ax.set_ylabel(label, fontsize=8)
                ax.set_yscale("log")
            if row == len(shown) - 1:
                ax.set_xlabel(parameter, fontsize=8)
            ax.tick_params(labelsize=7)
    figure.suptitle("blue dots: passed; red crosses: failed", fontsize=9)
    text = io.StringIO()
    figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()[text.getvalue().index("<svg") :]


def _correlations(parameters: list[str], rows: list[RunRow]) -> str:
    head = "".join(f"<th>{html.escape(p)}</th>" for p in parameters)
    body = []
    for metric in ["success", *metrics_of(rows)]:
        values = [float(r[metric]) for r in rows]
        cells = [rank_correlation(numbers_of(rows, f"vary.{p}") or [], values) for p in parameters]
        if all(math.isnan(c) for c in cells):
            continue
        shown = "".join(f'<td class="n">{"" if math.isnan(c) else f"{c:+.2f}"}</td>' for c in cells)
        body.append(f"<tr><td>{metric}</td>{shown}</tr>")
    return f"<h3>Rank correlation (Spearman)</h3><table><tr><th></th>{head}</tr>{''.join(body)}</table>"


def _by_value(parameter: str, rows: list[RunRow]) -> str:
    groups: dict[str, list[RunRow]] = {}
    for r in rows:
        groups.setdefault(str(r[f"vary.{parameter}"]), []).append(r)
    body = ""
    for value, group in sorted(groups.items()):
        passed = sum(bool(r["success"]) for r in group)
        low, high = wilson(passed, len(group))
        body += (
            f'<tr><td><code>{html.escape(value)}</code></td><td class="n">{passed} of {len(group)}</td>'
            f'<td class="n">{100 * low:.0f} to {100 * high:.0f} %</td></tr>'
        )
    return f"<h3>{html.escape(parameter)}</h3><table><tr><th>value</th><th>passed</th><th>95 %</th></tr>{body}</table>"


def _failures(campaign: Campaign, rows: list[RunRow], folder: Path) -> str:
    failed = [r for r in rows if not r["success"]]
    if not failed:
        return ""
    runs: dict[str, Run] = {run.name: run for run in campaign.runs}
    body = ""
    for r in failed:
        log = str(r["log"])
        where = Path(log)
        if where.is_absolute():
            shown = os.path.relpath(where, folder)
            link = f'<a href="{html.escape(shown)}">{html.escape(shown)}</a>'
        else:
            link = html.escape(log) or "not kept"
        command = html.escape(rerun_command(runs[str(r["run"])]))
        cell = f"{html.escape(str(r['cause']))}<br>{link}<br><code>{command}</code>"
        body += f'<tr><td class="n">{r["index"]}</td><td>{cell}</td></tr>'
    head = "<tr><th>run</th><th>cause, log and command that repeats the run</th></tr>"
    return f"<h2>Failures</h2><table>{head}{body}</table>"
