# SPDX-License-Identifier: Apache-2.0
"""``chaserdock simulate``: missions in one process, in virtual time, with random faults."""

from __future__ import annotations

import os
import re
import shlex
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from chaserdock.exit_codes import DONE, FAILED, STOPPED
from chaserdock.terminal import labelled, wrapped

from .options import ClusterOpt, ModeOption, ScenarioArg, fail

if TYPE_CHECKING:
    from chaserdock.simulation.flight import SimulationResult
    from chaserdock.simulation.seeds import SeedOptions, UnflownSeed
    from chaserdock.spread import Places


def _seed_range(text: str) -> range:
    found = re.fullmatch(r"(\d+)(?::(\d+))?", text)
    first, last = (int(found[1]), int(found[2] or found[1])) if found else (1, 0)
    if last < first or last >= 2**32:
        raise typer.BadParameter("must be FIRST:LAST or one number, below 2^32")
    return range(first, last + 1)


def simulate(
    scenario: ScenarioArg,
    seeds: Annotated[
        str | None,
        typer.Option(
            metavar="FIRST:LAST",
            help="fly random faults drawn from these seeds; without: as the scenario states",
        ),
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, max=256, help="processes to fly seeds on")] = 1,
    cluster: ClusterOpt = None,
    results: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="append results of seeds as they come; what FILE contains is not flown again",
        ),
    ] = None,
    mode: Annotated[
        ModeOption | None, typer.Option(help="fly all seeds in this mode; drawn by default")
    ] = None,
    images: Annotated[
        bool,
        typer.Option("--images", help="render images instead of drawing measurements (slower)"),
    ] = False,
    shrinking: Annotated[
        bool,
        typer.Option(
            "--shrink/--no-shrink",
            help="reduce seeds that fail to the simplest scenario that fails",
        ),
    ] = True,
    stop: Annotated[
        bool, typer.Option("--stop", help="end at the first violation of the first seed that fails")
    ] = False,
    out: Annotated[
        Path,
        typer.Option(
            help="folder for scenarios that fail, and for the log of a flight without --seeds"
        ),
    ] = Path("simulations"),
) -> None:
    """Simulate missions in this process, in virtual time, and check invariants. Status 0 only if
    all of them hold.
    """
    from chaserdock_protocol.process import SINGLE_THREADED

    os.environ |= SINGLE_THREADED  # as the processes of `run`; must precede the import of NumPy
    from chaserdock.simulation.seeds import SeedOptions, UnflownSeed
    from chaserdock.spread import Places

    _check_writable(out)
    if seeds is None:
        given = {
            "--jobs": jobs > 1,
            "--cluster": cluster is not None,
            "--results": results is not None,
            "--images": images,
            "--no-shrink": not shrinking,
            "--stop": stop,
        }
        if unused := [option for option, is_given in given.items() if is_given]:
            raise fail(f"{', '.join(unused)}: only with --seeds")
        raise typer.Exit(_fly_one(scenario, out, mode))
    if jobs > 1 and cluster is not None:
        raise fail("--jobs is for this machine; it excludes --cluster")

    begin_s = time.monotonic()
    options = SeedOptions(scenario, images, None if mode is None else mode.value, to_violation=stop)
    flown: list[SimulationResult] = []
    outcomes: Counter[str] = Counter()
    written: list[Path] = []
    chosen, stopped = _seed_range(seeds), False

    try:
        for result in _fly(options, chosen, Places(jobs, cluster), results):
            flew = not isinstance(result, UnflownSeed)
            outcomes[result.outcome if flew else "not flown"] += 1
            _print_seed(result, f"{outcomes.total()}/{len(chosen)}")
            if flew:
                flown.append(result)
                if stop and result.violations:
                    break
        # Only now, as processes elsewhere would wait.
        for result in flown:
            if shrinking and result.violations:
                _shrink(result, out, written)
    except KeyboardInterrupt:
        stopped = True
        if results is not None:
            print("chaserdock: stopped; repeat the command to resume", file=sys.stderr)

    failed = _print_end(options, outcomes, flown, written, time.monotonic() - begin_s)
    raise typer.Exit(STOPPED if stopped else FAILED if failed else DONE)


def _fly(
    options: SeedOptions, seeds: range, places: Places, file: Path | None
) -> Iterator[SimulationResult | UnflownSeed]:
    """Yield what a file of results has of the seeds, then the others as they end, added to it."""
    from chaserdock.simulation.seed_table import opened_table
    from chaserdock.simulation.seeds import UnflownSeed, fly_seeds

    if file is None:
        yield from fly_seeds(options, seeds, places)
        return
    with opened_table(file, options) as table:
        known = [table.results[seed] for seed in sorted(table.results) if seed in seeds]
        if known:
            print(f"{len(known)} of {len(seeds)} seeds are in {file} already", flush=True)
        yield from known
        if len(known) == len(seeds):
            return
        left = (seed for seed in seeds if seed not in table.results)
        for result in fly_seeds(options, left, places):
            if not isinstance(result, UnflownSeed):
                table.add(result)
            yield result


def _print_seed(result: SimulationResult | UnflownSeed, done: str) -> None:
    """Print why a seed failed, and on a terminal how many are ``done``."""
    from chaserdock.simulation.seeds import UnflownSeed

    if sys.stderr.isatty():
        print(f"\033[K{done}\r", end="", file=sys.stderr, flush=True)
    unflown = isinstance(result, UnflownSeed)
    for text in [f"not flown: {result.reason}"] if unflown else result.violations:
        print(f"seed {result.seed}: {text}", flush=True)


def _print_end(
    options: SeedOptions,
    outcomes: Counter[str],
    results: list[SimulationResult],
    written: list[Path],
    elapsed_s: float,
) -> bool:
    """Print means, verdict, what was written, and a command to go on. Returns whether a seed, or a
    mean over seeds, is not as it should be.
    """
    from chaserdock.simulation.seeds import inaccuracies, means_over

    for (expected, subject), means in means_over(results).items():
        mean = sum(means) / len(means)
        print(f"{subject}: mean {expected.name} {mean:.2f} over {len(means)} flights")
    wrong = inaccuracies(results)
    for reason in wrong:
        print(f"chaserdock: {reason}", file=sys.stderr)
    failed = sum(bool(r.violations) for r in results) + outcomes["not flown"]
    counts = ", ".join(f"{n} {name}" for name, n in outcomes.most_common() if n) or "none flown"
    holds = [f"{failed} failed"] if failed else ["no invariant is violated"] if results else []
    holds += ["means are not as expected"] if wrong else []
    verdict = "; ".join([f"{outcomes.total()} seeds in {elapsed_s:.0f} s: {counts}", *holds])
    print("\n".join(wrapped([verdict])))
    if written:
        print("\n".join(labelled("written", str(path)) for path in written))
    else:
        print("written: nothing" if failed else "written: nothing, as no seed failed")
    print(_again(options, results, written))
    return bool(failed or wrong)


def _again(options: SeedOptions, results: list[SimulationResult], written: list[Path]) -> str:
    """Return a line with the command that flies the first failure again, else the last seed."""
    if written:
        command = ["chaserdock", "simulate", str(written[0])]
        return labelled("again, with its log", shlex.join(command))
    if not results:
        return "again: no seed was flown"
    seed = next((r for r in results if r.violations), results[-1]).seed
    command = ["chaserdock", "simulate", options.scenario, "--seeds", str(seed)]
    command += [] if options.mode is None else ["--mode", options.mode]
    command += ["--images"] if options.images else []
    return labelled(f"seed {seed} again", shlex.join(command))


def _check_writable(out: Path) -> None:
    """Exit with status 2 unless ``out`` is a folder that can be written, or can be made."""
    nearest = next(path for path in (out, *out.absolute().parents) if os.access(path, os.F_OK))
    if not (nearest.is_dir() and os.access(nearest, os.W_OK | os.X_OK)):
        raise fail(f"--out {out}: {nearest} is not a folder that can be written")


def _shrink(result: SimulationResult, out: Path, written: list[Path]) -> None:
    """Reduce a case that fails; write and print the simplest one, on Ctrl-C that so far. Adds its
    file to ``written``.
    """
    from chaserdock.simulation.seeds import shrink_result, write_case

    simplest = result
    try:
        print(f"seed {result.seed}: shrinking; Ctrl-C ends it", flush=True)
        for simpler in shrink_result(result):
            simplest = simpler
    finally:
        path = write_case(simplest, out)
        written.append(path)
        print(f"seed {result.seed}: shrunk to {path}:\n\n{path.read_text()}", flush=True)


def _fly_one(scenario: str, out: Path, mode: Any) -> int:
    """Fly a scenario with its own faults and conditions; print what it violates."""
    from chaserdock_protocol.shipped_scenarios import find_scenario

    from chaserdock.simulation.flight import fly_case

    path = find_scenario(scenario)
    case: dict[str, Any] = {"extends": str(path.resolve())}
    if mode is not None:
        case["simulation"] = {"mode": mode.value}
    folder = out / path.stem
    if (folder / "run").exists():
        raise fail(
            f"{folder / 'run'} exists already; a log is never overwritten, choose another --out"
        )
    result = fly_case(case, 0, folder)
    for violation in result.violations:
        print(violation)
    verdict = f"{path.stem}: {result.outcome}, fingerprint {result.fingerprint}"
    print("\n".join(wrapped([verdict])))
    print(labelled("log", str(folder / "run")))
    command = ["chaserdock", "report", str(folder / "run")]
    print(labelled("its report", shlex.join(command)))
    return FAILED if result.violations else DONE
