# SPDX-License-Identifier: Apache-2.0
"""What the benchmarks share: options, parts, results that a file keeps, and output.

A benchmark is a command of one subject with parts: functions of the options that return figures.
``main`` parses the options, runs the parts that ``--only`` chooses and writes their figures.
"""

from __future__ import annotations

import argparse
import inspect
import json
import math
import platform
import subprocess
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import cv2
import msgspec
import numpy as np
from threadpoolctl import threadpool_limits

if TYPE_CHECKING:
    from chaserdock.launch.launcher import Fleet

ROOT = Path(__file__).resolve().parents[1]

Figures = dict[str, float]
"""Flat: name with SI unit -> number. Truth values are 0 and 1."""

Options = argparse.Namespace
Measure = Callable[[Options], Figures]


class BenchmarkFailed(Exception):
    """What a part measured misses its bar. Other parts still run; the command's status is 1."""

    def __init__(self, text: str, figures: Figures) -> None:
        super().__init__(text)
        self.figures = figures


# -- Options and parts -----------------------------------------------------------------------------


@dataclass(frozen=True)
class Group:
    """Parts of a benchmark by name, with the options that only they have.

    ``uses``: those of ``SHARED`` that they read. ``on_request``: parts that run only by name.
    """

    parts: Mapping[str, Measure]
    uses: Sequence[str] = ()
    add_options: Callable[[argparse.ArgumentParser], object] | None = None
    on_request: Sequence[str] = ()


def described(run: Measure, text: str) -> Measure:
    """Return a part that is made by a function, with the sentence for ``--help``."""
    run.__doc__ = text
    return run


SHARED: dict[str, dict[str, Any]] = {
    "flights": {"type": int, "metavar": "N", "help": "number of seeds of each part"},
    "first": {"type": int, "default": 0, "metavar": "SEED", "help": "first seed (default: 0)"},
    "jobs": {"type": int, "default": 1, "metavar": "N", "help": "flights at a time (default: 1)"},
    "set": {
        "action": "append",
        "default": [],
        "metavar": "KEY=VALUE",
        "help": "override a scenario key (repeatable)",
    },
    "results": {
        "type": Path,
        "metavar": "FILE",
        "help": "append what is flown; what FILE contains is not flown again",
    },
}
"""Options that several benchmarks have, with the same meaning everywhere."""


def make_parser(description: str | None) -> argparse.ArgumentParser:
    """Return a parser with the options of all benchmarks."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--quick", action="store_true", help="fewer or shorter runs")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures to FILE")
    return parser


def add_shared(parser: argparse.ArgumentParser, names: Iterable[str]) -> None:
    """Add options that several benchmarks have."""
    for name in dict.fromkeys(names):
        parser.add_argument(f"--{name}", **SHARED[name])


def parser_of(description: str | None, groups: Sequence[Group]) -> argparse.ArgumentParser:
    """Return the parser of a benchmark with these groups of parts."""
    parts = parts_of(groups)
    parser = make_parser(description)
    width = max(map(len, parts))
    lines = [f"  {name:{width}}  {_purpose(part)}" for name, part in parts.items()]
    parser.epilog = "parts:\n" + "\n".join(lines)
    parser.add_argument(
        "--only",
        nargs="+",
        metavar="PART",
        default=[name for g in groups for name in g.parts if name not in g.on_request],
        help="parts by name, or by the begin of several names (before a hyphen)",
    )
    add_shared(parser, (name for group in groups for name in group.uses))
    for group in groups:
        if group.add_options is not None:
            group.add_options(parser)
    return parser


def parts_of(groups: Sequence[Group]) -> dict[str, Measure]:
    """Return the parts of all groups by name."""
    return {name: part for group in groups for name, part in group.parts.items()}


def matching(wanted: str, names: Iterable[str]) -> list[str]:
    """Return the part of this name, or those whose names begin so."""
    every = list(names)
    return [wanted] if wanted in every else [n for n in every if n.startswith(f"{wanted}-")]


def main(description: str | None, groups: Sequence[Group]) -> None:
    """Run the parts of a benchmark as the command line says, print and write their figures.

    Raises SystemExit with status 1 if a part misses its bar.
    """
    parts, parser = parts_of(groups), parser_of(description, groups)
    options = parser.parse_args()
    chosen = []
    for wanted in options.only:
        chosen += matching(wanted, parts)
        if not matching(wanted, parts):
            parser.error(f"no part {wanted}; there are: {', '.join(parts)}")
    use_one_thread()
    figures, failures = Figures(), []
    for name in chosen:
        print(f"{name}:", flush=True)
        try:
            found = parts[name](options)
        except BenchmarkFailed as failure:
            found = failure.figures
            failures.append(f"{name}: {failure}")
        except ModuleNotFoundError as error:
            if (error.name or "").startswith("chaserdock"):
                raise
            found = Figures()
            failures.append(f"{name} needs the package {error.name}: see requirements-dev.txt")
        print_figures(found)
        figures |= found
    write_json(options.json, figures)
    if failures:
        raise SystemExit("\n".join(failures))


def _purpose(part: Measure) -> str:
    """Return the first sentence of a part's docstring."""
    text = inspect.getdoc(part) or ""
    return " ".join(text.split("\n\n")[0].split()).partition(". ")[0].rstrip(".")


def seeds_of(options: Options, number: int, quick: int) -> range:
    """Return the seeds to fly: those of ``--first`` and ``--flights``, or ``number`` of them, or
    ``quick`` with ``--quick``.
    """
    count = options.flights or (quick if options.quick else number)
    return range(options.first, options.first + count)


def use_one_thread() -> None:
    """Compute in one thread, as the processes of a flight do: others of BLAS and OpenCV wait for
    work, which is CPU time as well.
    """
    cv2.setNumThreads(1)
    threadpool_limits(1)


# -- Results ---------------------------------------------------------------------------------------

T = TypeVar("T")


@dataclass(frozen=True)
class KeptResults(Generic[T]):
    """Outcomes of type ``kind`` by seed, which a file of JSON lines keeps.

    ``key``: what was flown, beside the seed. Rows with another key are left alone.
    """

    path: Path | None
    key: Mapping[str, Any]
    kind: type[T]

    def of(
        self,
        seeds: Iterable[int],
        fly: Callable[[int], T],
        line: Callable[[T], str] | None = None,
        jobs: int = 1,
    ) -> list[T]:
        """Return the outcome of each seed, from the file or flown now; print the ``line`` of each
        that is flown.
        """
        wanted, key = list(seeds), dict(self.key)
        done = {
            row["seed"]: msgspec.convert(row["outcome"], self.kind)
            for row in read_lines(self.path)
            if row["key"] == key
        }
        todo = [seed for seed in wanted if seed not in done]
        for seed, outcome in zip(todo, map_jobs(fly, todo, jobs), strict=True):
            done[seed] = outcome
            row = {"key": key, "seed": seed, "commit": commit()}
            append_line(self.path, row | {"outcome": msgspec.to_builtins(outcome)})
            if line is not None:
                print(f"  {seed}: {line(outcome)}", file=sys.stderr, flush=True)
        return [done[seed] for seed in wanted]


U = TypeVar("U")


def map_jobs(call: Callable[[U], T], values: Sequence[U], jobs: int) -> Iterator[T]:
    """Yield the results in order, of so many processes; in this process if it is one."""
    if jobs == 1:
        yield from map(call, values)
        return
    with ProcessPoolExecutor(jobs) as pool:
        yield from pool.map(call, values)


def read_lines(path: Path | None) -> Iterator[dict[str, Any]]:
    """Yield the objects of a file of JSON lines; none if there is no file. Lines of an interrupted
    write are skipped.
    """
    if path is None or not path.exists():
        return
    for line in path.read_text(encoding="utf-8").splitlines():
        with suppress(json.JSONDecodeError):
            yield json.loads(line)


def append_line(path: Path | None, value: Mapping[str, Any]) -> None:
    """Append an object to a file of JSON lines; nothing without a path."""
    if path is not None:
        with path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(value) + "\n")


# -- Figures ---------------------------------------------------------------------------------------


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
    path.write_text(json.dumps({**values, **about}, indent=2) + "\n", encoding="utf-8")


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


def summaries(name: str, columns: Iterable[tuple[str, str, Sequence[float | None]]]) -> Figures:
    """Return median and maximum of each column (quantity, unit, values), without those that are
    None; nothing of an empty column.
    """
    out: Figures = {}
    for quantity, unit, values in columns:
        if known := [value for value in values if value is not None]:
            out |= percentiles(known, f"{name}_{quantity}", unit, "median", "max")
    return out


# -- Processes -------------------------------------------------------------------------------------


def chaserdock_command(*arguments: str | Path) -> list[str]:
    """Return the command line of ``chaserdock`` in this Python."""
    return [sys.executable, "-m", "chaserdock", *map(str, arguments)]


def run_chaserdock(*arguments: str | Path) -> None:
    """Run ``chaserdock`` from the clone. Raise SystemExit with its output if it fails."""
    done = subprocess.run(
        chaserdock_command(*arguments), cwd=ROOT, capture_output=True, text=True, check=False
    )
    if done.returncode:
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
