# SPDX-License-Identifier: Apache-2.0
"""Options, output and helpers that the benchmarks share."""

from __future__ import annotations

import argparse
import json
import math
import platform
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from threadpoolctl import threadpool_limits

if TYPE_CHECKING:
    from chaserdock.launch.launcher import Fleet

ROOT = Path(__file__).resolve().parents[1]

Figures = dict[str, float]
"""Flat: name with SI unit -> number. Truth values are 0 and 1."""


def use_one_thread() -> None:
    """Compute in one thread, as the processes of a flight do: others of BLAS and OpenCV wait for
    work, which is CPU time as well.
    """
    cv2.setNumThreads(1)
    threadpool_limits(1)


def make_parser(description: str | None, parts: Iterable[str] = ()) -> argparse.ArgumentParser:
    """Return a parser with the options of all benchmarks, and ``--only`` if there are parts to
    choose from.
    """
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="fewer or shorter runs")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE")
    if names := tuple(parts):
        parser.add_argument(
            "--only",
            nargs="+",
            choices=names,
            default=names,
            metavar="PART",
            help=f"parts: {', '.join(names)}",
        )
    return parser


def run_parts(options: argparse.Namespace, parts: Mapping[str, Callable[[], Figures]]) -> None:
    """Run the parts that ``--only`` chooses, print the figures of each, and write all of them to
    ``--json``.
    """
    figures: Figures = {}
    for name in options.only:
        print(f"{name}:", flush=True)
        figures |= (part := parts[name]())
        print_figures(part)
    write_json(options.json, figures)


def print_figures(figures: Mapping[str, float]) -> None:
    """Print one figure per line, aligned."""
    width = max(map(len, figures), default=0)
    for name, value in figures.items():
        print(f"  {name:{width}}  {value:.5g}", flush=True)


def write_json(path: Path | None, figures: Mapping[str, float]) -> None:
    """Write figures, command, commit, machine and date as one flat object; figures that are not
    finite as null.
    """
    if path is None:
        return
    values = {
        name: float(value) if math.isfinite(value) else None for name, value in figures.items()
    }
    about = {
        "command": " ".join(["python", *sys.argv]),
        "commit": commit(),
        "machine": f"{platform.machine()} {platform.platform()}",
        "date": f"{datetime.now():%Y-%m-%d}",
    }
    path.write_text(json.dumps({**values, **about}, indent=2) + "\n")


def commit() -> str:
    """Return the commit of the working copy; it ends with ``-dirty`` if files are changed."""
    command = ["git", "describe", "--always", "--dirty", "--abbrev=40", "--exclude=*"]
    return subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, check=False
    ).stdout.strip()


def percentiles(
    values: Sequence[float] | np.ndarray, name: str, unit: str, *labels: str
) -> Figures:
    """Return figures ``NAME_LABEL_UNIT``; labels: median, p95, p99, max. NaN without values."""
    shares = {"median": 50.0, "p95": 95.0, "p99": 99.0, "max": 100.0}
    return {
        f"{name}_{label}_{unit}": float(np.percentile(values, shares[label]))
        if len(values)
        else math.nan
        for label in labels
    }


def read_lines(path: Path | None) -> Iterator[dict[str, Any]]:
    """Yield the objects of a file of JSON lines; none if there is no file. Lines of an interrupted
    write are skipped.
    """
    for line in (
        path.read_text(encoding="utf-8").splitlines() if path is not None and path.exists() else []
    ):
        with suppress(json.JSONDecodeError):
            yield json.loads(line)


def append_line(path: Path | None, value: Mapping[str, Any]) -> None:
    """Append an object to a file of JSON lines; nothing without a path."""
    if path is not None:
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(value) + "\n")


def chaserdock_command(*arguments: str | Path) -> list[str]:
    """Return the command line of ``chaserdock`` in this Python."""
    return [sys.executable, "-m", "chaserdock", *map(str, arguments)]


def run_chaserdock(*arguments: str | Path, expected: Sequence[int] = (0,)) -> None:
    """Run ``chaserdock`` from the clone. Raise SystemExit with its output for another status than
    expected.
    """
    done = subprocess.run(
        chaserdock_command(*arguments), cwd=ROOT, capture_output=True, text=True, check=False
    )
    if done.returncode not in expected:
        raise SystemExit(
            f"chaserdock {arguments[0]}: status {done.returncode}\n{done.stdout}{done.stderr}"
        )


def start_mission(
    fleet: Fleet,
    folder: Path,
    scenario: Path,
    chasers: int,
    network: Sequence[str],
    world: Sequence[str],
    recorder: Sequence[str] = (),
    controllers: Mapping[str, Sequence[str]] | None = None,
) -> Path:
    """Start world, chasers, recorder and controllers; return the folder of their output.

    ``controllers``: arguments by process name; by default one controller on ``network``.
    """
    output = folder / "processes"
    output.mkdir()
    patient = [*network, "--timeout", "120"]
    fleet.start("world", ["world", str(scenario), *world, *network], output)
    for i in range(chasers):
        fleet.start(f"chaser/{i}", ["chaser", str(i), *patient], output)
    fleet.start("recorder", ["record", "--out", str(folder), *recorder, *patient], output)
    for name, arguments in (controllers or {"controller": patient}).items():
        fleet.start(name, ["controller", *arguments], output)
    return output
