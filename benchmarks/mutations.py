# SPDX-License-Identifier: Apache-2.0
"""Strength of the tests: ``python benchmarks/mutations.py [--only TEXT ...] [--quick] [--json
FILE]``.

Each mutant in tests/mutants.toml changes one place of the sources in a copy of this checkout, in
which its tests must then fail. Without a change they must pass. ``--quick`` takes every fifth
mutant. Status 1 if a mutant survives. Tests that do not end within ``--timeout`` count as failed
and are reported apart.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

from common import ROOT, Figures, make_parser, write_json

sys.path.insert(0, str(ROOT / "tests"))

from parts.tuned_numbers import survey
from source_changes import SOURCES, Mutant, apply, changed, copy_checkout, read_mutants, run_python

COPIED = (
    *SOURCES,
    "benchmarks",
    "docs",
    "examples",
    "release",
    "scenarios",
    "tests",
    "pyproject.toml",
    "CITATION.cff",
    "README.md",
    "uv.lock",
)


def failed(folder: Path, tests: Sequence[str], timeout_s: float) -> str:
    """Run test files until one test fails. Return its name, "timeout", or "" if all pass.

    Raises RuntimeError if tests cannot be run, for example because their modules cannot be
    imported.
    """
    try:
        arguments = (
            "-m",
            "pytest",
            "-x",
            "-q",
            "-rf",
            "--tb=no",
            "--hypothesis-seed=0",
            "-p",
            "no:cacheprovider",
            "-m",
            "",  # also those marked slow
        )
        done = run_python(folder, *arguments, *tests, timeout_s=timeout_s)
    except subprocess.TimeoutExpired:
        return "timeout"
    if done.returncode not in (0, 1):
        raise RuntimeError(
            f"pytest {' '.join(tests)}: status {done.returncode}\n{done.stdout}{done.stderr}"
        )
    lines = [line for line in done.stdout.splitlines() if line.startswith(("FAILED ", "ERROR "))]
    return (
        lines[0].split(" ", 1)[1].split(" - ")[0]
        if done.returncode and lines
        else "failed"
        if done.returncode
        else ""
    )


def failing(folder: Path, tests: Sequence[str], timeout_s: float) -> str:
    """Run single tests, but for slow ones, until one fails. Return its name, "" if all pass or do
    not end in time.

    Raises RuntimeError if pytest cannot run them.
    """
    fast = ("-m", "not slow", "-x", "-q", "-rfE", "--tb=no", "-p", "no:cacheprovider")
    try:
        done = run_python(folder, "-m", "pytest", *fast, *tests, timeout_s=timeout_s)
    except subprocess.TimeoutExpired:
        return ""
    if done.returncode in (0, 5):  # 5: all are slow
        return ""
    names = re.findall(r"^(?:FAILED|ERROR) (\S+::.*?)(?: - |$)", done.stdout, re.MULTILINE)
    if names:
        return names[0]
    said = done.stdout + done.stderr
    lost = re.findall(r"(?:no collectors for|not found:) .*?/(tests/\S+)", said)
    if lost or done.returncode == 2:
        return [*lost, *tests][0]  # its modules cannot be imported
    raise RuntimeError(f"pytest: status {done.returncode}\n{done.stdout}{done.stderr}")


def survey_numbers(options: argparse.Namespace) -> Figures:
    """Return how many numbers a test notices when they are doubled or halved."""

    def find_failing(folder: Path, tests: Sequence[str]) -> str:
        return failing(folder, tests, options.timeout)

    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        copy_checkout(folder, COPIED)
        only = options.only or [""]
        return survey(options.numbers, folder, only, find_failing, options.quick)


def killer(folder: Path, mutant: Mutant, timeout_s: float) -> str:
    """Return the test that kills a mutant, "" if it survives. The sources in ``folder`` are then as
    before.
    """
    with changed(mutant.change, folder):
        return failed(folder, mutant.tests, timeout_s)


def main() -> int:
    parser = make_parser(__doc__)
    parser.add_argument(
        "--only", nargs="+", metavar="TEXT", help="mutants whose file or text contains one"
    )
    parser.add_argument(
        "--timeout",
        type=float,
        default=600.0,
        metavar="SECONDS",
        help="for the tests of one mutant",
    )
    parser.add_argument(
        "--numbers",
        type=Path,
        metavar="DATA",
        help="instead, double and halve each number that a module names, and run the tests that "
        "use it by this data of pytest --cov --cov-context=test",
    )
    options = parser.parse_args()
    if options.numbers:
        figures = survey_numbers(options)
        print(", ".join(f"{name} {count}" for name, count in figures.items()))
        write_json(options.json, figures)
        return 0
    mutants = [m for m in read_mutants() if any(text in m.name for text in options.only or [""])]
    mutants = mutants[::5] if options.quick else mutants
    if not mutants:
        parser.error(f"no mutant contains {' or '.join(options.only)}")
    try:
        apply([m.change for m in mutants], ROOT, write=False)
    except ValueError as error:
        parser.error(str(error))
    survivors: list[str] = []
    timeouts = 0
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        copy_checkout(folder, COPIED)
        sound: set[tuple[str, ...]] = set()
        for k, mutant in enumerate(mutants, 1):
            begin_s = time.monotonic()
            if mutant.tests not in sound and (
                test := failed(folder, mutant.tests, options.timeout)
            ):
                raise SystemExit(f"fails without a mutant: {test}")
            sound.add(mutant.tests)
            test = killer(folder, mutant, options.timeout)
            timeouts += test == "timeout"
            survivors += [] if test else [mutant.name]
            verdict = f"killed by {test}" if test else "SURVIVED"
            print(
                f"{k}/{len(mutants)} {verdict} ({time.monotonic() - begin_s:.0f} s): {mutant.name}",
                flush=True,
            )
    killed = len(mutants) - len(survivors)
    print(f"{killed} of {len(mutants)} mutants killed, {timeouts} of them by timeout")
    figures: Figures = {"mutants": len(mutants), "killed": killed, "killed_by_timeout": timeouts}
    write_json(options.json, figures)
    return 1 if survivors else 0


if __name__ == "__main__":
    sys.exit(main())
