# SPDX-License-Identifier: Apache-2.0
"""Text of the page as Markdown: state of the mission and of each chaser, faults, events."""

from __future__ import annotations

import math
import re

from chaserdock_protocol.scenario import FlightScenario

from chaserdock.analysis.mass_properties import property_rows, true_values
from chaserdock.criterion import markdown_table
from chaserdock.verdict import Verdict

from .history import History, Line
from .snapshot import ChaserState, MissionState

_MARKS = {"info": "", "warning": "⚠ ", "error": "✗ "}
_VERDICT_MARKS = {"good": "✓ ", "partial": "⚠ ", "bad": "✗ "}
_FRESH_S = 2.0
"""Age (s) up to which a latency is shown: that of stopped images is out of date."""
_GOOD_SOLVES = frozenset({"solved", "iteration_limit"})


def head(
    scenario: FlightScenario,
    state: MissionState,
    mode: str,
    speed: float | None,
    verdict: Verdict | None = None,
    report: str | None = None,
) -> str:
    """Return time, speed, estimator status, how the mission ended and, for a log, the verdict and
    a link to the ``report``.
    """
    lines = [
        f"**{scenario.name}** · {mode}",
        f"**{state.time_s():.1f} s** of {scenario.duration_s:g} s",
    ]
    if speed is not None:
        lines[1] += f" · {speed:.2f} x real time"
    if state.target is not None:
        lines.append(
            f"target: {state.target.status}, used by the filter: {_numbers(state.target.accepted)}"
        )
        if state.target.rejected:
            lines[-1] += f", rejected: {_numbers(state.target.rejected)}"
    if verdict is not None:
        lines.append(f"{_VERDICT_MARKS[verdict.level]}**verdict: {verdict.headline}**")
        lines += verdict.lines_beside_table()
    elif report is not None:
        lines.append("the log is being judged")
    elif state.ended is not None:
        lines.append(
            f"{'ended' if state.ended.complete else '✗ ended early'}: {state.ended.reason}"
        )
        lines.append("the verdict needs the log: `chaserdock judge`")
    if report is not None:
        lines.append(f'<a href="{report}" target="_blank">report</a>')
    return "  \n".join(lines)


def criteria(verdict: Verdict | None) -> str:
    """Return the table of a verdict's criteria; empty without a verdict."""
    return "" if verdict is None else markdown_table(verdict.criteria)


def _numbers(chasers: tuple[int, ...]) -> str:
    return ", ".join(map(str, chasers)) or "none"


def chasers(state: MissionState, history: History) -> str:
    """Return a table with one row per chaser."""
    rows = [
        "| # | phase | error | distance | seen | latency |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for i, chaser in enumerate(state.chasers):
        error, distance = chaser.error(), state.distance_m(i)
        latency = history.series["latency_ms", i].last(state.time_s() + _FRESH_S, 2.0 * _FRESH_S)
        cells = (
            f"**{i}**",
            chaser.reference.phase if chaser.reference is not None else "-",
            f"{error[0] * 1e3:.1f} mm {math.degrees(error[1]):.2f}°" if error is not None else "-",
            f"{distance:.3f} m" if distance is not None else "-",
            visibility(chaser),
            f"{latency:.0f} ms" if latency is not None else "-",
        )
        rows.append("| " + " | ".join(cells) + " |")
    return "\n".join(rows)


def mass_properties(scenario: FlightScenario, state: MissionState) -> str:
    """Return a table of the identified mass properties of target and stack, beside the stated and,
    if known, the true ones.
    """
    if state.stack is None:
        return "not yet identified"
    true = None if state.true_body is None else true_values(state.true_body)
    head = ("", "target", "stated", *(("true",) if true is not None else ()), "stack")
    lines = ["| " + " | ".join(head) + " |", "| " + " | ".join("---" for _ in head) + " |"]
    for row in property_rows(state.stack, scenario, true, "-"):
        cells = (
            row.name,
            row.target,
            row.stated,
            *((row.true,) if true is not None else ()),
            row.stack,
        )
        lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def visibility(chaser: ChaserState) -> str:
    """Return the number of markers in view, or the status of the sighting."""
    if chaser.sighting is None:
        return "-"
    if chaser.sighting.status != "seen":
        return chaser.sighting.status.replace("_", " ")
    return str(len(chaser.sighting.marker_ids))


def faults(state: MissionState, history: History, lost: set[str]) -> str:
    """Return the present faults. ``lost``: processes that have disappeared."""
    out = [f"**{name}** has disappeared" for name in sorted(lost)]
    if state.target is not None and state.target.status == "lost":
        out.append("the target is lost")
    expected = set(state.tick.chasers) if state.tick is not None else set(range(len(state.chasers)))
    for i, chaser in enumerate(state.chasers):
        if i not in expected:
            out.append(f"chaser {i} does not participate")
        out += _chaser_faults(i, chaser)
    if state.tick is not None and not state.tick.controllers:
        out.append("the controller does not participate")
    if state.solver is not None:
        statuses = zip(state.solver.chasers, state.solver.status, strict=False)
        out += [f"chaser {i}: solver status {s}" for i, s in statuses if s not in _GOOD_SOLVES]
    counted = ", ".join(f"{process} {n}" for process, n in sorted(history.rejected.items()) if n)
    if counted:
        out.append(f"messages rejected or lost: {counted}")
    return "\n".join(f"- ⚠ {fault}" for fault in out) or "none"


def _chaser_faults(i: int, chaser: ChaserState) -> list[str]:
    out = []
    modes = {"track", "brake", "coast"}
    if chaser.docking is not None and chaser.docking.latched:
        modes.remove("coast")  # at its port it is meant to
    if chaser.wrench is not None and chaser.wrench.mode in modes:
        out.append(f"chaser {i}: the controller commands {chaser.wrench.mode}")
    if (safety := chaser.safety) is not None and not safety.safe:
        out.append(
            f"chaser {i}: not passively safe: {safety.margin_sigmas:.1f} sigmas, "
            f"{safety.distance_m:.2f} m "
            f"after {safety.closest_s:.0f} s"
        )
    if (assured := chaser.assurance) is not None and assured.state in ("changed", "backup"):
        how = "changed" if assured.state == "changed" else "replaced by the backup"
        out.append(f"chaser {i}: command {how}: {', '.join(assured.hazards)}")
    if chaser.actuators is not None and chaser.actuators.source != "command":
        out.append(f"chaser {i}: fallback ({chaser.actuators.source}), no valid command")
    if chaser.thrusters is not None:
        statuses = enumerate(chaser.thrusters.thrusters)
        bad = [f"{k} {s.replace('_', ' ')}" for k, s in statuses if s != "healthy"]
        if bad:
            out.append(f"chaser {i}: thruster {', '.join(bad)}")
    return out


def events(lines: list[Line], most: int = 99, begins_s: float = 0.0) -> str:
    """Return at most ``most`` event lines, newest first. Lines that differ in numbers only are
    merged and counted. ``begins_s``: time from which events are known.
    """
    groups: dict[tuple[str, str], list[Line]] = {}
    for line in lines:
        # Chasers and thrusters are told apart by their numbers; measured values are not.
        pattern = re.sub(r"(?<!chaser )(?<!chaser/)(?<!thruster )\b\d+(\.\d+)?", "#", line.text)
        groups.setdefault((line.level, pattern), []).append(line)
    out = []
    for group in list(groups.values())[:most]:
        newest = group[0]
        times = f" ({len(group)} times since {group[-1].time_s:.2f} s)" if len(group) > 1 else ""
        out.append(f"- `{newest.time_s:7.2f} s` {_MARKS[newest.level]}{newest.text}{times}")
    if begins_s > 0.0:
        out.append(f"- those before {begins_s:.1f} s, when this page joined, are in the log")
    return "\n".join(out) or "none"
