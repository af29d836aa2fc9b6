"""The page's tables of whole missions, and of other estimators and targets."""

from __future__ import annotations

import math
from typing import Any

from .cells import NONE, cell, orientation_text, position_text
from .page import Section, Table
from .plan import INFERRED, Plan, table_group
from .runner import Results
from .tables import flown


def other_runs(plan: Plan, results: Results) -> Section:
    """The baseline row with the paper's estimator, and our default on either target."""
    rows = []
    for label, group in (
        ("paper's settings, mekf", table_group(INFERRED, "paper", "baseline")),
        ("paper's settings, the paper's estimator", "estimator/paper"),
        ("our default", table_group(INFERRED, "default", "baseline")),
        ("our default, target servicer", "target/servicer"),
    ):
        e = flown(plan, results, group)
        rows.append(
            (
                label,
                cell(e, lambda e: position_text(e.position)),
                cell(e, lambda e: orientation_text(e.orientation)),
                cell(e, lambda e: f"{e.steady_position:.2e}"),
                cell(e, lambda e: f"{math.sqrt(e.steady_position) * 1e3:.2f}"),
                cell(e, lambda e: f"{math.degrees(math.sqrt(e.steady_orientation)):.3f}"),
                cell(e, lambda e: f"{e.failed} of {e.runs}"),
            )
        )
    header = (
        "baseline row, inferred start",
        "position, 1e-2 m^2",
        "orientation, 1e-3 rad^2",
        "steady position, m^2",
        "steady RMS, mm",
        "steady RMS, deg",
        "failed",
    )
    return Section("Estimators and targets", (Table(header, tuple(rows)),))


def whole_missions(plan: Plan, results: Results) -> Section:
    """The paper's missions of several chasers."""
    rows = []
    for m in plan.missions:
        if not m.group.startswith("mission/"):
            continue
        summary = results.missions.get(m.name)
        _, column, name = m.group.split("/")
        rows.append((name, column, *(_mission(summary) if summary is not None else (NONE,) * 6)))
    header = (
        "mission",
        "settings",
        "flown, s",
        "result",
        "worst steady RMS, mm; deg",
        "nearest to the target, m",
        "nearest chasers, m",
        "docked or reached",
    )
    text = (
        "The paper shows these as plots, without figures. Its claims: two chasers keep their poses on shared sightings; "
        "chasers 0 and 3 of four dock after a command at 60 s; chaser 0 passes the target no nearer than 0.35 m on what "
        "chaser 1 sees. Settings as above, but in the default ones the camera is the scenario's own."
    )
    return Section("The missions", (text, Table(header, tuple(rows))))


def _mission(summary: dict[str, Any]) -> tuple[str, ...]:
    chasers = summary["chasers"].values()
    steady = [c["steady"] for c in chasers if c["steady"]["position_mse_m2"] is not None]
    worst = NONE
    if steady:
        position = math.sqrt(max(s["position_mse_m2"] for s in steady)) * 1e3
        worst = (
            f"{position:.2f}; {math.degrees(math.sqrt(max(s['orientation_mse_rad2'] for s in steady))):.3f}"
        )
    told = [f"{i} docked at {c['dock_time_s']:.1f} s" for i, c in summary["chasers"].items() if c["docked"]]
    told += [
        f"{i} there at {c['reached_time_s']:.1f} s"
        for i, c in summary["chasers"].items()
        if c["reached_time_s"] is not None
    ]
    between = summary["min_distance_chasers_m"]
    return (
        f"{summary['sim_time_s']:.0f}",
        "success" if summary["success"] else "FAILED: " + "; ".join(summary["failures"]),
        worst,
        f"{min(c['min_distance_target_m'] for c in chasers):.3f}",
        NONE if between is None else f"{between:.3f}",
        ", ".join(told) or NONE,
    )
