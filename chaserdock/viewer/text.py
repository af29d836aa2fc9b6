"""What the page says in words, as Markdown: the state of the mission, of each chaser, what happened. No browser here."""

from __future__ import annotations

import math

from chaserdock_protocol.scenario import Scenario

from .history import History, Line
from .snapshot import ChaserNow, Now

_MARKS = {"info": "", "warning": "⚠ ", "error": "⛔ "}
_FRESH_S = 2.0
_GOOD_SOLVES = frozenset({"solved", "iteration_limit"})


def head(scenario: Scenario, now: Now, mode: str, speed: float | None) -> str:
    """Where the mission is: time, speed, the target's estimate, how it ended."""
    lines = [f"**{scenario.name}** · {mode}", f"**{now.time_s():.1f} s** of {scenario.duration_s:g} s"]
    if speed is not None:
        lines[1] += f" · {speed:.2f} x real time"
    if now.target is not None:
        lines.append(f"target: {now.target.status}, used by the filter: {_numbers(now.target.accepted)}")
        if now.target.rejected:
            lines[-1] += f", refused: {_numbers(now.target.rejected)}"
    if now.ended is not None:
        lines.append(f"{'ended' if now.ended.complete else '⛔ ended early'}: {now.ended.reason}")
    return "  \n".join(lines)


def _numbers(chasers: tuple[int, ...]) -> str:
    return ", ".join(map(str, chasers)) or "none"


def chasers(now: Now, history: History) -> str:
    """A table, one row a chaser."""
    rows = [
        "| # | phase | error | to target | sees | latency |",
        "| --- | --- | --- | --- | --- | --- |",
    ]
    for i, chaser in enumerate(now.chasers):
        error, distance = chaser.error(), now.distance_m(i)
        latency = history.series["latency_ms", i].last(now.time_s() + _FRESH_S, 2.0 * _FRESH_S)
        cells = (
            f"**{i}**",
            chaser.reference.phase if chaser.reference is not None else "-",
            f"{error[0] * 1e3:.2f} mm, {math.degrees(error[1]):.3f}°" if error is not None else "-",
            f"{distance:.3f} m" if distance is not None else "-",
            sees(chaser),
            f"{latency:.0f} ms" if latency is not None else "-",
        )
        rows.append("| " + " | ".join(cells) + " |")
    return "\n".join(rows)


def sees(chaser: ChaserNow) -> str:
    """What its camera has of the target."""
    if chaser.sighting is None:
        return "-"
    if chaser.sighting.status != "seen":
        return chaser.sighting.status.replace("_", " ")
    markers = len(chaser.sighting.marker_ids)
    return f"{markers} marker{'s' if markers != 1 else ''}"


def faults(now: Now, history: History, lost: set[str]) -> str:
    """What is not as it should be just now; ``lost``: processes that were there and are gone."""
    out = [f"**{name}** is gone" for name in sorted(lost)]
    if now.target is not None and now.target.status == "lost":
        out.append("the target is lost")
    expected = set(now.tick.chasers) if now.tick is not None else set(range(len(now.chasers)))
    for i, chaser in enumerate(now.chasers):
        if i not in expected:
            out.append(f"chaser {i} takes no part")
        if chaser.wrench is not None and chaser.wrench.mode in ("brake", "coast"):
            out.append(f"chaser {i}: the controller lets it {chaser.wrench.mode}")
        if chaser.actuators is not None and chaser.actuators.source != "command":
            out.append(
                f"chaser {i} flies by itself ({chaser.actuators.source}): it has no command it can trust"
            )
        if chaser.thrusters is not None:
            bad = [
                f"{k} {s.replace('_', ' ')}"
                for k, s in enumerate(chaser.thrusters.thrusters)
                if s != "healthy"
            ]
            if bad:
                out.append(f"chaser {i}: thruster {', '.join(bad)}")
    if now.tick is not None and not now.tick.controller:
        out.append("the controller takes no part")
    if now.solver is not None:
        for i, status in zip(now.solver.chasers, now.solver.status, strict=False):
            if status not in _GOOD_SOLVES:
                out.append(f"chaser {i}: solver says {status}")
    counted = ", ".join(f"{process} {n}" for process, n in sorted(history.refused.items()) if n)
    if counted:
        out.append(f"messages refused or lost: {counted}")
    return "\n".join(f"- ⚠ {text}" for text in out) or "none"


def happened(lines: list[Line]) -> str:
    """What happened, the newest first."""
    return "\n".join(f"- `{x.time_s:7.2f} s` {_MARKS[x.level]}{x.text}" for x in lines) or "nothing yet"
