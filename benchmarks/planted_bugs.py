# SPDX-License-Identifier: Apache-2.0
"""Evidence that ``chaserdock simulate`` finds bugs: ``python benchmarks/planted_bugs.py [--only
NAME ...] [--seeds 500]``.

Each patch in tests/planted_bugs/ plants one bug in a copy of this checkout, in which random seeds
are flown until one fails; the checkout itself must pass that seed. Prints a table: bug, scenario,
seed, invariant. ``--check`` only applies all patches. The lines of a patch before its first ``---``
state the bug and, as ``Scenario: NAME``, what is flown (default: fault-drill), and as ``Seed:
NUMBER`` one that finds it (default: 1), the only one flown with ``--known``.
"""

from __future__ import annotations

import re
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from common import ROOT, Figures, make_parser, write_json

sys.path.insert(0, str(ROOT / "tests"))

from source_changes import SOURCES, Change, apply, copy_checkout, run_python

PATCHES = sorted((ROOT / "tests" / "planted_bugs").glob("*.patch"))
COPIED = (
    *SOURCES,
    "scenarios",
    "tests/planted_bugs",
    "pyproject.toml",
    "build_hook.py",
    "release",
    "CITATION.cff",
)
_BUILD = "protocol/chaserdock_models/native/build.py"
_FAILED = re.compile(
    r"(?:seed (\d+)|chaserdock): (covariance consistency|[a-z ,-]+?)(?: at [\d.]+ s)?: (.*)"
)


@dataclass(frozen=True)
class PlantedBug:
    """A planted bug: its number and name, what is wrong, the scenario to fly, a seed that finds it,
    and the hunks."""

    name: str
    text: str
    scenario: str
    known_seed: int
    hunks: tuple[Change, ...]


@dataclass(frozen=True)
class FailedSeed:
    """The first seed that fails, the invariant that it violates, and what was found."""

    seed: int
    invariant: str
    text: str


def read_bug(path: Path) -> PlantedBug:
    """Read a patch: a unified diff below a description. Raises ValueError for a line that is
    neither.
    """
    head, file, stated = [], "", {"Scenario": "fault-drill", "Seed": "1"}
    hunks: list[tuple[str, list[str], list[str]]] = []
    for line in path.read_text(encoding="utf-8").splitlines():
        if line.startswith("+++ b/"):
            file = line.removeprefix("+++ b/")
        elif line.startswith("@@"):
            hunks.append((file, [], []))
        elif line.startswith("--- a/"):
            file = ""
        elif file and line[:1] in ("", " ", "-", "+"):
            for mark, lines in (("-", hunks[-1][1]), ("+", hunks[-1][2])):
                if line[:1] in ("", " ", mark):
                    lines.append(line[1:])
        elif found := re.fullmatch(r"(Scenario|Seed): (\S+)", line):
            stated[found[1]] = found[2]
        elif not file and not hunks:
            head.append(line)
        else:
            raise ValueError(f"{path.name}: not a line of a unified diff: {line!r}")
    texts = tuple(Change(f, "\n".join(old) + "\n", "\n".join(new) + "\n") for f, old, new in hunks)
    return PlantedBug(path.stem, " ".join(head), stated["Scenario"], int(stated["Seed"]), texts)


def simulate(folder: Path, scenario: str, first: int, last: int) -> FailedSeed | None:
    """Fly seeds with the sources in ``folder`` until one fails. Raises RuntimeError if the program
    fails otherwise.
    """
    seeds = f"{first}:{last}"
    done = run_python(
        folder, "-m", "chaserdock", "simulate", scenario, "--seeds", seeds, "--no-shrink", "--stop"
    )
    found = _FAILED.search(done.stdout) or _FAILED.search(done.stderr)
    if done.returncode == 0:
        return None
    if found is None:
        raise RuntimeError(f"simulate failed:\n{done.stdout}{done.stderr}")
    return FailedSeed(int(found[1] or last), found[2], found[3])


def hunt(bug: PlantedBug, first: int, last: int) -> FailedSeed | None:
    """Return the first of the seeds that finds a bug. Raises RuntimeError if the patched sources
    cannot be flown.
    """
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        copy_checkout(folder, COPIED)
        apply(bug.hunks, folder)
        if any(change.file.endswith((".c", ".h")) for change in bug.hunks):
            built = run_python(folder, _BUILD)
            if built.returncode:
                raise RuntimeError(f"{bug.name} does not compile:\n{built.stdout}{built.stderr}")
        return simulate(folder, bug.scenario, first, last)


def main() -> int:
    parser = make_parser(__doc__)
    parser.add_argument(
        "--only", nargs="+", metavar="NAME", help="bugs whose name contains one of these"
    )
    parser.add_argument(
        "--seeds", type=int, default=500, metavar="N", help="most seeds to fly for a bug"
    )
    parser.add_argument(
        "--known", action="store_true", help="fly only the seed that each patch states"
    )
    parser.add_argument("--check", action="store_true", help="only check that the patches apply")
    options = parser.parse_args()
    bugs = [
        bug
        for path in PATCHES
        if any(n in path.stem for n in options.only or [""])
        for bug in [read_bug(path)]
    ]
    if not bugs:
        parser.error(
            f"no bug is named {' or '.join(options.only)}; there are: "
            f"{', '.join(p.stem for p in PATCHES)}"
        )
    for bug in bugs:
        try:
            apply(bug.hunks, ROOT, write=False)
        except ValueError as error:
            raise SystemExit(f"{bug.name}: {error}") from None
    if options.check:
        print(f"{len(bugs)} patches apply")
        return 0
    figures: Figures = {}
    flown: set[tuple[str, int]] = set()
    broken: list[str] = []
    print("| bug | scenario | seed | invariant |\n| --- | --- | --- | --- |", flush=True)
    for bug in bugs:
        try:
            seeds = (1, min(options.seeds, 5) if options.quick else options.seeds)
            found = hunt(bug, *((bug.known_seed,) * 2 if options.known else seeds))
        except RuntimeError as error:  # the other bugs are hunted nevertheless
            print(error, file=sys.stderr, flush=True)
            print(f"| {bug.name}: {bug.text} | {bug.scenario} | not flown | |", flush=True)
            broken.append(bug.name)
            continue
        figures[bug.name] = 0 if found is None else found.seed
        seed, invariant = ("not found", "") if found is None else (found.seed, found.invariant)
        print(f"| {bug.name}: {bug.text} | {bug.scenario} | {seed} | {invariant} |", flush=True)
        write_json(options.json, figures)
        if found is not None:
            flown.add((bug.scenario, found.seed))
            print(f"{bug.name}: {found.text}", file=sys.stderr, flush=True)
    missed = [name for name, seed in figures.items() if not seed]
    print(
        f"{len(figures) - len(missed)} of {len(figures)} found"
        + (f"; not: {', '.join(missed)}" if missed else "")
        + (f"; not flown, see above: {', '.join(broken)}" if broken else "")
    )
    wrong = [
        (*case, found)
        for case in sorted(flown)
        if (found := simulate(ROOT, case[0], case[1], case[1]))
    ]
    for scenario, seed, found in wrong:
        print(
            f"seed {seed} of {scenario} fails without a planted bug: {found.invariant}: "
            f"{found.text}"
        )
    if flown and not wrong:
        print(f"all {len(flown)} seeds that found a bug pass without it")
    return 1 if missed or broken or wrong else 0


if __name__ == "__main__":
    sys.exit(main())
