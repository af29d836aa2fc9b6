# SPDX-License-Identifier: Apache-2.0
"""Whether anything notices when a number named at the top of a module is doubled or halved.

A number that nothing notices has no effect, and can be deleted, or no test. A flight notices it if
any message differs, a test if it fails. Only flights and tests that run a line with the number's
name are tried; which these are is told by coverage.
"""

from __future__ import annotations

import ast
import importlib
import os
import re
import resource
import sys
import tempfile
import traceback
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from importlib.machinery import SourceFileLoader
from multiprocessing import Pipe
from pathlib import Path
from typing import TYPE_CHECKING

from common import ROOT, Figures
from coverage import Coverage, CoverageData

sys.path.insert(0, str(ROOT / "tests"))

from source_changes import SOURCES, Change, changed
from source_tree import MODULES, is_numeric, tree_of

if TYPE_CHECKING:
    from chaserdock_protocol.transport import RawSample

MOST_TESTS = 12
"""Tests that are run for a number, those that run the fewest lines first: they say the most about
it, and a second of each is affordable for all numbers."""

MOST_FLIGHTS = 2
"""Flights that are flown with a number doubled and halved: the cheapest of those that run it."""

PROCESSOR_TIME_S = 300
"""Processor time after which a flight counts as different: a number may make it endless."""

DRAWN = 'perception.name="statistical"'
FLIGHTS: Mapping[str, Sequence[str]] = {
    "single": ["duration_s=2"],
    "fault-drill": [],
    "single-thrusters": [DRAWN, "duration_s=20"],
    "planar-docking": [DRAWN, "duration_s=40"],
    "low-orbit": [DRAWN, "duration_s=15"],
    "docking-contact": [DRAWN],
    "thruster-failure": [DRAWN],
    "abort": [DRAWN, "duration_s=60"],
    "camera-calibration": [DRAWN],
    "markerless-docking": ["duration_s=1"],
    "detumble-pair": [DRAWN, "duration_s=55"],
}
"""Overrides of the scenarios that are flown, the cheapest first. Images are rendered where a few
seconds suffice; for the rest, measurements are drawn."""

PRELOADED = ("numpy", "scipy.optimize", "casadi", "cv2", "pybullet", "zenoh", "mcap", "pydantic")
"""Packages that are imported once, before a process for each flight is forked."""

FindFailing = Callable[[Path, Sequence[str]], str]
"""Runs tests in a folder until one fails. Returns its name, "" if all pass."""

Lines = Mapping[Path, set[int]]
"""Line numbers by module."""


@dataclass(frozen=True)
class NamedNumber:
    """A number, or a tuple or list of numbers, that a module names.

    Attributes:
        path: Module that defines it.
        names: Names that are assigned.
        text: Source text of the statement.
        value: Its expression.
    """

    path: Path
    names: tuple[str, ...]
    text: str
    value: ast.expr

    @property
    def place(self) -> str:
        """Return the module and the statement on one line."""
        return f"{self.path.relative_to(ROOT)}: {' '.join(self.text.split())}"

    @property
    def changes(self) -> list[Change]:
        """Return the number twice and halved."""
        head = self.text.split("=")[0]
        file = str(self.path.relative_to(ROOT))
        values = (scaled(self.value, double) for double in (True, False))
        return [Change(file, self.text, f"{head}= {value}") for value in values]


def named_numbers() -> Iterator[NamedNumber]:
    """Yield the numbers at the top of all modules whose statement occurs once in its file."""
    for _, path in MODULES:
        source = path.read_text(encoding="utf-8")
        for statement in tree_of(path).body:
            if not isinstance(statement, ast.Assign | ast.AnnAssign) or not statement.value:
                continue
            text = ast.get_source_segment(source, statement)
            if text and is_numeric(statement.value) and source.count(text) == 1:
                targets = ast.walk(statement)
                names = {n.id for n in targets if isinstance(n, ast.Name) and is_stored(n)}
                yield NamedNumber(path, tuple(sorted(names)), text, statement.value)


def is_stored(name: ast.Name) -> bool:
    """Return whether a name is assigned to."""
    return isinstance(name.ctx, ast.Store)


def scaled(value: ast.expr, double: bool) -> str:
    """Return the source text of twice or half a number, or numbers. Integers remain integers."""
    if isinstance(value, ast.Tuple | ast.List):
        items = "".join(f"{scaled(item, double)}, " for item in value.elts)
        return f"({items})" if isinstance(value, ast.Tuple) else f"[{items}]"
    number = ast.unparse(value)
    is_whole = "." not in number and "e" not in number and "/" not in number
    return f"({number}) * 2" if double else f"({number}) // 2" if is_whole else f"({number}) / 2"


def lines_with(number: NamedNumber) -> Lines:
    """Return the lines of functions that mention a number. Where only statements outside of
    functions do, all functions of these modules use it.
    """
    word = re.compile(rf"\b(?:{'|'.join(map(re.escape, number.names))})\b")
    inside: dict[Path, set[int]] = {}
    around: dict[Path, set[int]] = {}
    for _, path in MODULES:
        source = path.read_text(encoding="utf-8")
        if path != number.path and number.path.stem not in source:
            continue  # another number of the same name
        mentions = {k for k, line in enumerate(source.splitlines(), 1) if word.search(line)}
        if mentions:
            around[path] = {k for node in functions(path) for k in lines_of(node)}
            inside[path] = mentions & around[path]
    return inside if any(inside.values()) else around


def functions(path: Path) -> Iterator[ast.FunctionDef]:
    """Yield all functions and methods of a module."""
    return (node for node in ast.walk(tree_of(path)) if isinstance(node, ast.FunctionDef))


def lines_of(function: ast.FunctionDef) -> range:
    """Return the lines of a function's body."""
    return range(function.body[0].lineno, (function.end_lineno or 0) + 1)


class TestsByLine:
    """Which tests ran which lines, by a file of coverage data with contexts."""

    def __init__(self, data: Path) -> None:
        """Read the data. Raises ValueError if it has no contexts."""
        coverage = CoverageData(str(data))
        coverage.read()
        self._tests: dict[str, dict[int, list[str]]] = {}
        self._size: dict[str, int] = defaultdict(int)
        for path in coverage.measured_files():
            self._tests[path] = {
                line: [test.split("|")[0] for test in tests if "::" in test]
                for line, tests in coverage.contexts_by_lineno(path).items()
            }
            for tests in self._tests[path].values():
                for test in tests:
                    self._size[test] += 1
        if not self._size:
            raise ValueError(f"{data} has no contexts: use pytest -n 2 --cov --cov-context=test")

    def using(self, lines: Lines) -> list[str]:
        """Return the tests that ran one of the lines, those that run the fewest lines first."""
        found: set[str] = set()
        for path, numbers in lines.items():
            end = f"/{path.relative_to(ROOT)}"
            for measured, tests in self._tests.items():
                if measured.endswith(end):
                    found.update(test for line in numbers for test in tests.get(line, ()))
        return sorted(found, key=self._size.__getitem__)[:MOST_TESTS]


def tests_that_name(number: NamedNumber) -> list[str]:
    """Return the tests that mention a number, in files that mention its module."""
    word = re.compile(rf"\b(?:{'|'.join(map(re.escape, number.names))})\b")
    found = []
    for path in sorted((ROOT / "tests").rglob("test_*.py")):
        source = path.read_text(encoding="utf-8")
        if number.path.stem in source and word.search(source):
            place = path.relative_to(ROOT)
            found += [
                f"{place}::{function.name}"
                for function in functions(path)
                if function.name.startswith("test_")
                and word.search(ast.get_source_segment(source, function) or "")
            ]
    return found


class Difference(Exception):
    """A message of a flight differs."""


@dataclass(frozen=True)
class Flight:
    """A flight as it is without a change.

    Attributes:
        scenario: Name of a shipped scenario.
        checksums: Checksum of all messages up to each.
        lines: Lines that it ran.
    """

    scenario: str
    checksums: list[int]
    lines: Lines


def fly(scenario: str, expected: Sequence[int] | None = None) -> list[int]:
    """Fly a scenario in this process and return the checksums of its messages. Raises Difference at
    the first that differs from the expected ones.
    """
    from chaserdock.simulation.flight import fingerprint_after
    from chaserdock.simulation.mission import simulate

    checksums: list[int] = []
    differs = False

    def observe(sender: str, raw: RawSample) -> None:
        nonlocal differs
        checksums.append(fingerprint_after((checksums or [0])[-1], sender, raw))
        k = len(checksums)
        differs |= expected is not None and checksums[-1:] != expected[k - 1 : k]

    path = ROOT / "scenarios" / f"{scenario}.toml"
    with tempfile.TemporaryDirectory() as folder:
        simulate(path, Path(folder) / "run", tuple(FLIGHTS[scenario]), observe, lambda: differs)
    if differs or (expected is not None and len(checksums) != len(expected)):
        raise Difference
    return checksums


def recorded(scenario: str) -> Flight:
    """Return a flight of a scenario without a change."""
    receiver, sender = Pipe(duplex=False)
    if not (child := os.fork()):
        try:
            sender.send(_recorded(scenario))
        except BaseException:
            traceback.print_exc()
            os._exit(1)
        os._exit(0)
    sender.close()
    try:
        checksums, ran = receiver.recv()
    except EOFError:
        raise SystemExit(f"{scenario}: not flown") from None
    os.waitpid(child, 0)
    return Flight(scenario, checksums, {Path(path): set(lines) for path, lines in ran.items()})


def _recorded(scenario: str) -> tuple[list[int], dict[str, list[int]]]:
    """Fly in this process. Return the checksums and the lines that ran, by file."""
    sources = [str(ROOT / source) for source in SOURCES]
    coverage = Coverage(data_file=None, source=sources, concurrency=["greenlet"])
    with coverage.collect():
        checksums = fly(scenario)
    data = coverage.get_data()
    return checksums, {path: data.lines(path) or [] for path in data.measured_files()}


def notices(flight: Flight, change: Change) -> bool:
    """Return whether a flight with a changed source differs, ends by an error or does not end."""
    if child := os.fork():
        return os.waitpid(child, 0)[1] != 0
    try:
        resource.setrlimit(resource.RLIMIT_CPU, (PROCESSOR_TIME_S, PROCESSOR_TIME_S))
        load_changed(change)
        silence()
        fly(flight.scenario, flight.checksums)
    except BaseException:
        os._exit(1)
    os._exit(0)


def silence() -> None:
    """Discard what this process prints."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.dup2(nowhere, 2)


def load_changed(change: Change) -> None:
    """Import a module of the sources with a change from now on."""
    path, original = ROOT / change.file, SourceFileLoader.get_code

    def get_code(loader: SourceFileLoader, name: str) -> object:
        if Path(loader.path) != path:
            return original(loader, name)
        source = path.read_text(encoding="utf-8").replace(change.old, change.new)
        return compile(source, str(path), "exec")

    SourceFileLoader.get_code = get_code  # type: ignore[method-assign]


def runs(flight: Flight, lines: Lines) -> bool:
    """Return whether a flight runs one of the lines."""
    return any(numbers & flight.lines.get(path, set()) for path, numbers in lines.items())


class FailingTests:
    """Finds tests that a change makes fail, in a copy of the checkout."""

    def __init__(self, folder: Path, find_failing: FindFailing) -> None:
        self._folder, self._find_failing = folder, find_failing
        self._passing, self._failing = set[str](), set[str]()

    def of(self, change: Change, tests: Sequence[str]) -> str:
        """Return a test that passes without the change and fails with it, "" for none."""
        tests = [test for test in tests if test not in self._failing]
        if not tests:
            return ""
        with changed(change, self._folder):
            test = self._find_failing(self._folder, tests)
        if test and test not in self._passing:
            if self._find_failing(self._folder, [test]):
                self._failing.add(test)
                return self.of(change, tests)
            self._passing.add(test)
        return test


def survey(
    data: Path, folder: Path, only: Sequence[str], find_failing: FindFailing, quick: bool
) -> Figures:
    """Double and halve each number until a flight or a test notices, and print what did.

    Args:
        data: File of ``pytest -n 2 --cov --cov-context=test``, of a checkout with these sources.
        folder: Copy of the checkout.
        only: Texts of which the place of a number contains one.
        find_failing: Runs tests.
        quick: Take every tenth number.
    """
    for name in PRELOADED:
        importlib.import_module(name)
    numbers = [n for n in named_numbers() if any(text in n.place for text in only)]
    numbers = numbers[::10] if quick else numbers
    flights = [recorded(scenario) for scenario in FLIGHTS]
    left = []
    for number in numbers:
        lines = lines_with(number)
        using = [flight for flight in flights if runs(flight, lines)][:MOST_FLIGHTS]
        if flight := next((f for f in using if any(notices(f, c) for c in number.changes)), None):
            print(f"{number.place}: {flight.scenario}", flush=True)
        else:
            left.append(number)
    tests_by_line, failing = TestsByLine(data), FailingTests(folder, find_failing)
    unnoticed = 0
    for number in left:
        tests = [*tests_that_name(number), *tests_by_line.using(lines_with(number))]
        test = next(filter(None, (failing.of(change, tests) for change in number.changes)), "")
        unnoticed += not test
        print(f"{number.place}: {test or f'NOTHING, {len(tests)} tests'}", flush=True)
    by_tests = len(left) - unnoticed
    return {
        "numbers": len(numbers),
        "noticed_by_flights": len(numbers) - len(left),
        "noticed_by_tests": by_tests,
        "noticed_by_nothing": unnoticed,
    }
