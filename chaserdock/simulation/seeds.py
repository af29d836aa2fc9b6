# SPDX-License-Identifier: Apache-2.0
"""Flies many seeds, optionally on several processes. Shrinks cases that fail, and checks
consistency over all seeds.
"""

from __future__ import annotations

import contextlib
import itertools
import multiprocessing.connection
import os
import re
import signal
import sys
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import cast

from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.output_files import write_atomically
from chaserdock_protocol.process import SINGLE_THREADED
from chaserdock_protocol.scenario import Scenario, ScenarioError, load_scenario
from chaserdock_protocol.shipped_scenarios import find_scenario

from chaserdock.exit_codes import STOPPED
from chaserdock.toml_text import toml_document

from .checks.check import Violation
from .checks.expectations import Expectation
from .flight import SimulationResult, fly_case
from .shrinking import shrink
from .swarm import Case, draw_case

_NOT_DOCKED = "ends in phase "
"""Start of the text about a chaser that should have docked or be safe."""
_END_S = 5.0
"""Wall time, s, in which a process ends its flight and removes its folder."""


@dataclass(frozen=True)
class SeedOptions:
    """Options of flights with random faults.

    ``scenario``: name or path. ``images``: render instead of drawing measurements. ``mode``: fly
    all seeds in this mode; drawn by default. ``to_violation``: end at the first violation.
    """

    scenario: str
    images: bool = False
    mode: str | None = None
    to_violation: bool = False


@dataclass(frozen=True)
class UnflownSeed:
    """A seed that could not be flown, and the reason."""

    seed: int
    reason: str


def _load(options: SeedOptions) -> tuple[str, Scenario]:
    """Return what cases extend, and the scenario. Raises ScenarioError if it can fly no seed."""
    path = find_scenario(options.scenario)
    scenario = load_scenario(path)
    if not (options.images or scenario.target_model().markers):
        raise ScenarioError(
            f"{path}: the target has no markers to draw measurements of; use --images"
        )
    return (str(path.resolve()) if path == Path(options.scenario) else path.stem), scenario


def fly_seed(options: SeedOptions, seed: int) -> SimulationResult:
    """Draw and fly the case of a seed. Raises ScenarioError."""
    name, scenario = _load(options)
    case = draw_case(name, seed, scenario, images=options.images, mode=options.mode)
    return fly_case(case, seed, to_violation=options.to_violation)


def _fly(options: SeedOptions, seed: int) -> SimulationResult | UnflownSeed:
    try:
        return fly_seed(options, seed)
    except ScenarioError as error:
        return UnflownSeed(seed, str(error))


def fly_seeds(
    options: SeedOptions, seeds: Iterable[int], jobs: int = 1
) -> Iterator[SimulationResult | UnflownSeed]:
    """Yield the results of the seeds in order. Raises ScenarioError at once if none can be flown.

    The processes (``jobs``) end at once when the generator does.
    """
    _load(options)
    if jobs == 1:
        yield from (_fly(options, seed) for seed in seeds)
        return
    os.environ.update(
        SINGLE_THREADED
    )  # read by the numerical libraries of the new processes when they start
    workers: list[_Worker] = []
    try:
        for _ in range(jobs):
            workers.append(_Worker(options))
        yield from _fly_on(workers, iter(seeds))
    finally:
        for worker in workers:
            worker.end()


class _Worker:
    """A process that flies one seed after the other. ``turn``: position of its ``seed`` in the
    order of all.
    """

    def __init__(self, options: SeedOptions) -> None:
        self.options, self.seed, self.turn = options, 0, 0
        self._start()

    def _start(self) -> None:
        context = multiprocessing.get_context("spawn")
        self.connection, theirs = context.Pipe()
        self._process = context.Process(target=_work, args=(self.options, theirs), daemon=True)
        self._process.start()
        theirs.close()

    def answer(self) -> SimulationResult | UnflownSeed | ChaserdockError:
        """Return what the process has sent. If it has died, start another one."""
        try:
            return self.connection.recv()
        except (EOFError, OSError):
            self._process.join(1.0)
            self.end()
            status = self._process.exitcode
            self._start()
            why = " (killed, as when memory is short)" if status == -signal.SIGKILL else ""
            return UnflownSeed(self.seed, f"its process ended with status {status}{why}")

    def end(self) -> None:
        """End the process; kill it if it does not end."""
        self._process.terminate()
        self._process.join(_END_S)
        self._process.kill()
        self._process.join()
        self.connection.close()


def _work(options: SeedOptions, connection: Connection) -> None:
    """Fly the seeds that arrive until the connection closes. Sends back results, or errors that
    concern all seeds.
    """
    signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # Ctrl-C reaches all processes; the parent ends this one
    # As an exception: the flight's folder in memory is removed.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(STOPPED))
    with contextlib.suppress(EOFError):
        while True:
            seed = connection.recv()
            try:
                connection.send(_fly(options, seed))
            except ChaserdockError as error:
                connection.send(error)


def _fly_on(
    workers: Sequence[_Worker], seeds: Iterator[int]
) -> Iterator[SimulationResult | UnflownSeed]:
    """Yield the results of the seeds in order; a free worker flies the next seed."""
    flying: dict[Connection, _Worker] = {}
    flown: dict[int, SimulationResult | UnflownSeed] = {}
    turns, turn = itertools.count(), 0

    def assign(worker: _Worker) -> None:
        for seed in itertools.islice(seeds, 1):
            worker.seed, worker.turn = seed, next(turns)
            with contextlib.suppress(OSError):  # of a process that has died, which its answer shows
                worker.connection.send(seed)
            flying[worker.connection] = worker

    for worker in workers:
        assign(worker)
    while flying:
        for connection in multiprocessing.connection.wait(list(flying)):
            worker = flying.pop(cast(Connection, connection))
            answer = worker.answer()
            if isinstance(answer, ChaserdockError):
                raise answer
            flown[worker.turn] = answer
            assign(worker)
        while turn in flown:
            yield flown.pop(turn)
            turn += 1


def shrink_result(result: SimulationResult, attempts: int = 200) -> Iterator[SimulationResult]:
    """Reduce the case of a result: yield flights of ever simpler cases that have its first
    violation, numbers aside.
    """
    first, flown = result.violations[0], result
    judges_docking = _NOT_DOCKED in first.text

    def violation_s(case: Case) -> float | None:
        nonlocal flown
        # Without a command to approach no chaser docks.
        if judges_docking and _approaches(case) != _approaches(result.case):
            return None
        try:
            flown = fly_case(case, result.seed)
        except ScenarioError:  # a simplification that leaves the scenario inconsistent
            return None
        same = (
            v.time_s for v in flown.violations if _without_numbers(v) == _without_numbers(first)
        )
        return next(same, None)

    duration_s = load_scenario(find_scenario(result.case["extends"])).duration_s
    for _ in shrink(result.case, violation_s, first.time_s, duration_s, attempts):
        yield flown


def _approaches(case: Case) -> int:
    """Return the number of approach commands."""
    return sum(entry["command"] == "approach" for entry in case.get("timeline", ()))


def _without_numbers(violation: Violation) -> tuple[str, str, str]:
    """Return what violations of one defect share: invariant, subject, and text without numbers.

    For a chaser that has not docked, phase and reason may differ.
    """
    subject, _, text = violation.text.partition(": ")
    if text.startswith(_NOT_DOCKED):
        text = _NOT_DOCKED
    return violation.invariant, subject, re.sub(r"[-+]?\d[\d.]*(e[-+]?\d+)?", "", text)


def write_case(result: SimulationResult, folder: Path) -> Path:
    """Write a failing case as a scenario file whose first lines state what it violates. Returns its
    path.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{Path(result.case['extends']).stem}-seed-{result.seed}.toml"
    lines = [f"# {violation}" for violation in result.violations]
    write_atomically(path, "\n".join([*lines, toml_document(result.case)]))
    return path


def means_over(
    results: Iterable[SimulationResult],
) -> dict[tuple[Expectation, str], list[float]]:
    """Return the means of flights by quantity and subject, in order."""
    found: dict[tuple[Expectation, str], list[float]] = {}
    for result in results:
        for key, mean in result.means.items():
            found.setdefault(key, []).append(mean)
    return dict(sorted(found.items(), key=lambda item: (item[0][0].name, item[0][1])))


def inaccuracies(results: Iterable[SimulationResult]) -> list[str]:
    """Return which quantities are not as expected over an ensemble; none if it is small."""
    found = []
    for (expected, subject), means in means_over(results).items():
        if defect := expected.defect_over(means):
            found.append(f"{expected.invariant}: {subject}: {defect}")
    return found
