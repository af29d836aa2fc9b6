# SPDX-License-Identifier: Apache-2.0
"""Cost of a mission beside that of another commit, on one machine: flown in pairs, in turn."""

from __future__ import annotations

import json
import resource
import statistics
import subprocess
import sys
import tempfile
from argparse import ArgumentParser
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from common import ROOT, Figures, Group, Options


def _beginning(duration_s: float) -> tuple[str, ...]:
    """Return the overrides that fly the beginning of a scenario, without commands and criteria."""
    steady_s = 0.5 * duration_s
    times = (f"duration_s={duration_s}", f"settling_s={steady_s}", f"steady_until_s={duration_s}")
    return *times, "timeline=[]", "success={}"


SCENARIOS = {"four-chaser-docking": (), "sixteen-chasers": _beginning(20.0)}
"""Scenarios, with the overrides that shorten them."""


@dataclass(frozen=True)
class FlightCost:
    """Cost of one flight, per tick, seconds.

    ``cpu_s``: processor time of the mission's processes; ``command_cpu_s``: of the whole command,
    with start and summary. ``position_rms_m``: error of the target's estimate.
    """

    cpu_s: float
    command_cpu_s: float
    wall_s: float
    position_rms_m: float


def build(commit: str, folder: Path) -> Path:
    """Clone a commit and install it with the packages of its own lock; return its Python. Raise
    SystemExit if that fails. What ``folder`` has already is used again.
    """
    python = folder / "venv" / "bin" / "python"
    if (folder / "built").is_file():
        return python
    source = folder / "source"
    pip = [str(python), "-m", "pip", "install", "--quiet", "--no-deps"]
    steps: list[Sequence[str | Path]] = [
        ["git", "clone", "--quiet", "--shared", ROOT, source],
        ["git", "-C", source, "checkout", "--quiet", "--detach", commit],
        [sys.executable, "-m", "venv", folder / "venv"],
        [*pip, "--requirement", source / "requirements.txt"],
        [*pip, "--editable", source],
    ]
    for step in steps:
        done = subprocess.run(step, capture_output=True, text=True, check=False)
        if done.returncode:
            raise SystemExit(f"{' '.join(map(str, step))}: {done.stderr or done.stdout}")
    (folder / "built").touch()
    return python


def fly(python: Path, scenario: str, overrides: Sequence[str]) -> FlightCost:
    """Fly a scenario by the installation of ``python``, in separate processes, with images and
    recording. Raise SystemExit if it does not succeed.
    """
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        sets = [part for override in overrides for part in ("--set", override)]
        command = [python, "-m", "chaserdock", "run", scenario, "--out", out, "--quiet", *sets]
        before = _children_cpu_s()
        done = subprocess.run(command, capture_output=True, text=True, cwd=folder, check=False)
        command_cpu_s = _children_cpu_s() - before
        if done.returncode:
            raise SystemExit(f"{python}: {scenario}: {done.stdout}{done.stderr}")
        summary: dict[str, Any] = json.loads((out / "summary.json").read_text())
    ticks = summary["ticks"]
    return FlightCost(
        sum(summary["cpu_s"].values()) / ticks,
        command_cpu_s / ticks,
        summary["wall_time_s"] / ticks,
        summary["target_estimate"]["position_rms_m"],
    )


def _children_cpu_s() -> float:
    """Return the processor time of all children that have ended."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def against(options: Options) -> Figures:
    """Fly missions by this commit and by ``--against``, in turn: cost of a tick, and ratios."""
    if options.against is None:
        raise SystemExit("against needs --against COMMIT")
    pairs = 1 if options.quick else options.flights or 5
    with tempfile.TemporaryDirectory() as folder:
        other = build(options.against, options.build or Path(folder))
        figures: Figures = {}
        for scenario, overrides in SCENARIOS.items():
            flown = [
                [fly(p, scenario, _beginning(5.0) if options.quick else overrides) for p in pair]
                for pair in [(Path(sys.executable), other)] * pairs
            ]
            figures |= figures_of(scenario, flown)
    return figures


def figures_of(scenario: str, pairs: Sequence[Sequence[FlightCost]]) -> Figures:
    """Return medians over the pairs (ours, theirs) of each cost, and of its ratio."""
    out: Figures = {}
    for name in ("cpu_s", "command_cpu_s", "wall_s", "position_rms_m"):
        values = [[float(getattr(cost, name)) for cost in pair] for pair in pairs]
        key = f"{scenario.replace('-', '_')}_{'' if name == 'position_rms_m' else 'tick_'}{name}"
        out[key] = statistics.median(ours for ours, _ in values)
        out[f"{key}_other"] = statistics.median(theirs for _, theirs in values)
        out[f"{key}_ratio"] = statistics.median(ours / theirs for ours, theirs in values)
    return out


def _add_options(parser: ArgumentParser) -> None:
    parser.add_argument("--against", metavar="COMMIT", help="the commit of against")
    parser.add_argument(
        "--build", type=Path, metavar="FOLDER", help="of against: keep the other commit's build"
    )


GROUP = Group({"against": against}, ("flights",), _add_options, ("against",))
