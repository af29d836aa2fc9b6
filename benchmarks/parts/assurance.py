# SPDX-License-Identifier: Apache-2.0
"""Assurance of commands: its cost, and flights under harmful commands."""

from __future__ import annotations

import math
import statistics
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from chaserdock_agents.chaser.assurance.assurance import Assurance, AssuredCommand
from chaserdock_protocol.scenario import Scenario, load_scenario
from common import BenchmarkFailed, Figures, Group, KeptResults, Options, seeds_of
from flights.assured import ATTACKS, AssuredFlight, worst

from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.summary import summary_of
from chaserdock.simulation.mission import simulate
from chaserdock.summary import Summary

from .rates import STATISTICAL

_FLIGHTS, _QUICK_FLIGHTS = 50, 3
_SCENARIOS = ("four-chaser-docking", "four-chaser-capture")
_DURATION_S = 40.0


@dataclass(frozen=True)
class AssuredMission:
    """How a mission under the NMPC ended: ``missed`` criteria; commands changed, and all."""

    missed: tuple[str, ...]
    changed: int
    commands: int
    hazards: dict[str, int]

    def line(self) -> str:
        """Return the flight as a line of text."""
        named = "".join(f"; {count} for {hazard}" for hazard, count in self.hazards.items())
        return f"{self.changed} of {self.commands} changed{named}; {'; '.join(self.missed) or 'ok'}"


def _assured_file(name: str, folder: str) -> Path:
    file = Path(folder) / "assured.toml"
    file.write_text(f'extends = "{name}"\nname = "{name}-assured"\n[assurance]\n')
    return file


def _assured(name: str) -> Scenario:
    with TemporaryDirectory() as folder:
        return load_scenario(_assured_file(name, folder))


def _fly_mission(name: str, overrides: tuple[str, ...], seed: int) -> AssuredMission:
    with TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        flight = simulate(_assured_file(name, folder), out, (*overrides, f"seed={seed}"))
        if flight.crashes or flight.stalled:
            reason = flight.crashes or flight.stalled
            raise BenchmarkFailed(f"{name}, seed {seed}: {reason}", {})
        recorded = load_flight(out / "mission.mcap")
        summary = Summary.from_dict(summary_of(recorded))
    chasers = summary.chasers.values()
    hazards: Counter[str] = Counter()
    for chaser in chasers:
        hazards.update({} if chaser.assurance is None else chaser.assurance.hazards)
    return AssuredMission(
        tuple(summary.failures),
        sum(c.assurance.changed for c in chasers if c.assurance is not None),
        sum(len(history.time_s) for history in recorded.assurance.values()),
        dict(hazards),
    )


def missions(options: Options) -> Figures:
    """Fly missions of ``--scenarios`` under the NMPC with assurance, other errors by seed (1;
    statistical perception): how many succeed, and the share of commands that were changed.
    """
    figures: Figures = {}
    for name in options.scenarios:
        overrides = (STATISTICAL, *options.set)
        if options.quick:
            overrides = (*overrides, "duration_s=14.0", "settling_s=5.0", "timeline=[]")
            overrides = (*overrides, "steady_until_s=5.0", "success={}")
        results = KeptResults(
            options.results, {"assured": name, "set": list(overrides)}, AssuredMission
        )
        seeds = seeds_of(options, 1, 1)
        fly = partial(_fly_mission, name, overrides)
        flights = results.of(seeds, fly, AssuredMission.line, jobs=options.jobs)
        successes = sum(not flight.missed for flight in flights)
        commands = sum(flight.commands for flight in flights)
        share = sum(flight.changed for flight in flights) / commands
        print(f"{name}: {successes} of {len(flights)}, {share:.2%} changed", flush=True)
        key = name.replace("-", "_")
        figures |= {f"{key}_successes": successes, f"{key}_changed_share": share}
    return figures


def attacks(options: Options) -> Figures:
    """Fly chasers under each harmful command, 40 s, over seeds (50; ``--quick``: 3): least room to
    what must not be crossed, greatest speeds, shares of commands that were changed.
    """
    flights = options.flights or (_QUICK_FLIGHTS if options.quick else _FLIGHTS)
    seeds = range(options.first, options.first + flights)
    figures: Figures = {}
    for name in _SCENARIOS:
        scenario = _assured(name)
        for attack in ATTACKS:
            out = worst(scenario, attack, seeds, _DURATION_S)
            at, commands = f"{name}_{attack}_", sum(out.states.values())
            found = {
                "target_room_m": out.target_room_m,
                "chaser_room_m": out.chaser_room_m,
                "corridor_room_m": out.corridor_room_m,
                "corridor_closing_m_s": out.closing_m_s,
                "touch_closing_m_s": out.touch_m_s,
                "rate_deg_s": math.degrees(out.rate_rad_s),
                "changed_share": out.states.get("changed", 0) / commands,
                "backup_share": out.states.get("backup", 0) / commands,
            }
            figures |= {at + k: v for k, v in found.items() if math.isfinite(v)}
    crossed = [k for k, v in figures.items() if k.endswith("room_m") and v < 0.0]
    if crossed:
        raise BenchmarkFailed(f"crossed: {', '.join(crossed)}", figures)
    return figures


def cost(options: Options) -> Figures:
    """Time what one of four chasers does in a tick, processor time: median and 99 % over commands
    that are kept, over those that are changed, and over backups.
    """
    scenario = _assured("four-chaser-docking")
    took: dict[str, list[float]] = {"unchanged": [], "changed": [], "backup": []}
    for attack in ("ram", "chase"):
        flight = AssuredFlight(scenario, attack, options.first)
        for assurance in flight.assurances:
            _time(assurance, took)
        flight.fly(10.0 if options.quick else _DURATION_S)
    return {
        f"tick_{state}_{name}_s": value
        for state, times in took.items()
        if len(times) > 100
        for name, value in (
            ("median", statistics.median(times)),
            ("p99", statistics.quantiles(times, n=100)[98]),
        )
    }


def _time(assurance: Assurance, took: dict[str, list[float]]) -> None:
    """Add the processor time (s) of each tick to ``took``, by the state that it ends with."""
    since_command_ns = 0

    def timed(call: Callable[..., Any]) -> Callable[..., Any]:
        def wrapper(*values: Any, **named: Any) -> Any:
            nonlocal since_command_ns
            begun_ns = time.process_time_ns()
            out = call(*values, **named)
            since_command_ns += time.process_time_ns() - begun_ns
            if isinstance(out, AssuredCommand):
                took.setdefault(out.status.state, []).append(since_command_ns / 1e9)
                since_command_ns = 0
            return out

        return wrapper

    for name in ("add_estimate", "add_odometry", "assure"):
        setattr(assurance, name, timed(getattr(assurance, name)))


GROUP = Group(
    {"assurance-attacks": attacks, "assurance-cost": cost, "assurance-missions": missions},
    uses=("flights", "first", "set", "results", "jobs"),
    on_request=("assurance-missions",),
)
