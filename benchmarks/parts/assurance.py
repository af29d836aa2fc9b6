# SPDX-License-Identifier: Apache-2.0
"""Assurance of commands: its cost, and flights under harmful commands."""

from __future__ import annotations

import math
import statistics
import time
from pathlib import Path
from tempfile import TemporaryDirectory

from chaserdock_protocol.scenario import Scenario, load_scenario
from common import BenchmarkFailed, Figures, Group, Options
from flights.assured import ATTACKS, AssuredFlight, worst

_FLIGHTS, _QUICK_FLIGHTS = 50, 3
_SCENARIOS = ("four-chaser-docking", "four-chaser-capture")
_DURATION_S = 40.0


def _assured(name: str) -> Scenario:
    with TemporaryDirectory() as folder:
        file = Path(folder) / "assured.toml"
        file.write_text(f'extends = "{name}"\nname = "assured"\n[assurance]\n')
        return load_scenario(file)


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
    """Time a call for one of four chasers, processor time: median and 99 % over commands that are
    kept, and over those that are changed.
    """
    scenario = _assured("four-chaser-docking")
    took: dict[str, list[float]] = {"unchanged": [], "changed": [], "backup": []}
    for attack in ("ram", "chase"):
        flight = AssuredFlight(scenario, attack, options.first)
        for assurance in flight.assurances:
            plain = assurance.assure

            def timed(*values, plain=plain, **named):
                begun = time.process_time_ns()
                out = plain(*values, **named)
                took.setdefault(out.status.state, []).append((time.process_time_ns() - begun) / 1e9)
                return out

            assurance.assure = timed  # type: ignore[method-assign]
        flight.fly(10.0 if options.quick else _DURATION_S)
    return {
        f"call_{state}_{name}_s": value
        for state, times in took.items()
        if len(times) > 100
        for name, value in (
            ("median", statistics.median(times)),
            ("p99", statistics.quantiles(times, n=100)[98]),
        )
    }


GROUP = Group({"assurance-attacks": attacks, "assurance-cost": cost}, uses=("flights", "first"))
