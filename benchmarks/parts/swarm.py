# SPDX-License-Identifier: Apache-2.0
"""Processor time of a simulated second by part, for 4 to 64 chasers: the first N of ``swarm-64``
in `chaserdock simulate`, with its checks.

A timer interrupts the flight every 2 ms of processor time; a sample counts for the part in whose
source file, or in what it called, the interruption came. Starting and ending the mission counts,
too. ``solve`` is the processor time of the NMPC per tick: median and largest.
"""

from __future__ import annotations

import signal
import tempfile
import time
from argparse import ArgumentParser
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np
from chaserdock_controller.nmpc.rti import RtiSolver
from chaserdock_protocol.scenario import load_scenario
from chaserdock_protocol.transport import RawSample
from common import ROOT, BenchmarkFailed, Figures, Group, KeptResults, Options, seeds_of

from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.summary import summary_of
from chaserdock.simulation.checks.flight_checks import FlightChecks
from chaserdock.simulation.mission import simulate
from chaserdock.summary import Summary

SCENARIO = ROOT / "scenarios" / "swarm-64.toml"
SAMPLE_S = 0.002
PARTS = {
    "/simulation/checks/": "checks",
    "/chaserdock_controller/estimation/": "estimation",
    "/chaserdock_controller/nmpc/": "nmpc",
    "/chaserdock_controller/guidance/": "guidance",
    "/chaserdock_controller/": "controller",
    "/chaserdock_world/physics/": "physics",
    "/chaserdock_world/": "world",
    "/recorder/": "recorder",
    "/chaserdock_agents/": "chasers",
    "/chaserdock/simulation/": "network",
}
"""Parts by folder; the first that fits counts."""
NAMES = tuple(dict.fromkeys(PARTS.values()))


def first(n: int) -> str:
    """Return the scenario's text with its first ``n`` chasers and their commands."""
    head, *sections = SCENARIO.read_text(encoding="utf-8").split("\n[[")
    kept, number = [], 0
    for section in sections:
        if section.startswith("chasers"):
            number += 1
            if number > n:
                continue
        elif int(section.partition("chasers = [")[2].partition("]")[0]) >= n:
            continue
        kept.append(section)
    return "\n[[".join([head, *kept])


class Sampler:
    """Counts the parts that use processor time while it is active."""

    def __init__(self) -> None:
        self.samples: Counter[str] = Counter()

    def __enter__(self) -> Sampler:
        self._before = signal.signal(signal.SIGPROF, self._sample)
        signal.setitimer(signal.ITIMER_PROF, SAMPLE_S, SAMPLE_S)
        return self

    def __exit__(self, *_: object) -> None:
        signal.setitimer(signal.ITIMER_PROF, 0.0)
        signal.signal(signal.SIGPROF, self._before)

    def _sample(self, _: int, frame: FrameType | None) -> None:
        while frame is not None:
            path = frame.f_code.co_filename
            for folder, part in PARTS.items():
                if folder in path:
                    self.samples[part] += 1
                    return
            frame = frame.f_back


def fly(n: int, overrides: tuple[str, ...], duration_s: float) -> dict[str, float]:
    """Return seconds of processor time per simulated second by part and in all, and those of a
    solve.

    Raise SystemExit if an invariant is violated.
    """
    solves: list[float] = []
    solve = RtiSolver.solve

    def timed(self: RtiSolver, *args: Any, **more: Any) -> Any:
        begin_s = time.thread_time()
        result = solve(self, *args, **more)
        solves.append(time.thread_time() - begin_s)
        return result

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scenario.toml"
        path.write_text(first(n), encoding="utf-8")
        checks = FlightChecks(load_scenario(path, overrides))

        def tap(sender: str, raw: RawSample) -> None:
            checks.observe(sender, raw)

        RtiSolver.solve = timed  # type: ignore[method-assign]
        try:
            with Sampler() as sampler:
                begin_s = time.process_time()
                checks.end(simulate(path, Path(folder) / "run", overrides, tap))
                total_s = time.process_time() - begin_s
        finally:
            RtiSolver.solve = solve  # type: ignore[method-assign]
    if checks.violations:
        raise SystemExit(f"{n} chasers: {checks.violations[0]}")
    per_sample = total_s / sum(sampler.samples.values()) / duration_s
    figures = {name: sampler.samples[name] * per_sample for name in NAMES}
    return figures | {
        "total": total_s / duration_s,
        "solve": float(np.median(solves)),
        "worst_solve": max(solves),
    }


def swarm(options: Options) -> Figures:
    """Measure a simulated second with 4 to 64 chasers by part."""
    sizes = options.swarm or ([4, 16] if options.quick else [4, 8, 16, 32, 64])
    seconds, rate_hz = options.swarm_seconds, options.swarm_rate_hz
    overrides = (
        f"duration_s={seconds}",
        f"settling_s={0.9 * seconds}",
        f"time.rate_hz={rate_hz}",
        f"time.image_hz={rate_hz}",
    )
    columns = (*NAMES, "total", "solve", "worst_solve")
    print(f"ms of processor time per simulated second at {rate_hz} Hz; solve: ms per tick")
    print(f"{'N':>3}" + "".join(f"{name:>12}" for name in columns))
    figures: Figures = {}
    for n in sizes:
        row = fly(n, overrides, seconds)
        print(f"{n:3d}" + "".join(f"{1e3 * row[name]:12.1f}" for name in columns), flush=True)
        figures |= {f"n{n}_{name}_s": row[name] for name in columns}
    return figures


@dataclass(frozen=True)
class SwarmFlight:
    """How a flight of the whole scenario ended: violated invariants, criteria that it missed, and
    processor time.
    """

    violations: tuple[str, ...]
    missed: tuple[str, ...]
    cpu_s: float

    def line(self) -> str:
        """Return the flight as a line of text."""
        return f"{'; '.join((*self.violations, *self.missed)) or 'ok'}; {self.cpu_s:.0f} s"


def fly_whole(seed: int) -> SwarmFlight:
    """Fly ``swarm-64`` with other errors of its sensors, as ``seed`` draws them."""
    overrides = (f"seed={seed}",)
    checks = FlightChecks(load_scenario(SCENARIO, overrides))
    begin_s = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        checks.end(simulate(SCENARIO, out, overrides, checks.observe))
        missed = Summary.from_dict(summary_of(load_flight(out / "mission.mcap"))).failures
    violations = tuple(str(v) for v in checks.violations)
    return SwarmFlight(violations, tuple(missed), time.process_time() - begin_s)


def exchange(options: Options) -> Figures:
    """Fly the whole ``swarm-64`` with other errors of sensors by seed (20; ``--quick``: 1), and
    judge all invariants of `simulate` and the scenario's criteria.
    """
    results = KeptResults(options.results, {"scenario": "swarm-64"}, SwarmFlight)
    flights = results.of(seeds_of(options, 20, 1), fly_whole, SwarmFlight.line, jobs=options.jobs)
    figures: Figures = {
        "flights": len(flights),
        "without_violation": sum(not f.violations for f in flights),
        "successes": sum(not f.missed for f in flights),
        "cpu_s": float(np.median([f.cpu_s for f in flights])),
    }
    if figures["without_violation"] < len(flights):
        raise BenchmarkFailed("an invariant is violated", figures)
    return figures


def add_options(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--swarm",
        type=int,
        nargs="+",
        choices=range(2, 65, 2),
        metavar="N",
        help="numbers of chasers of swarm",
    )
    parser.add_argument(
        "--swarm-seconds", type=float, default=40.0, help="simulated time of swarm's flights"
    )
    parser.add_argument("--swarm-rate-hz", type=int, default=5, help="ticks per second of swarm")


GROUP = Group(
    {"swarm": swarm, "exchange": exchange},
    ("flights", "first", "results", "jobs"),
    add_options,
    ("exchange",),
)
