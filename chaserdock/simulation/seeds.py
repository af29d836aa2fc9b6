# SPDX-License-Identifier: Apache-2.0
"""Flies many seeds, optionally on several processes or machines. Shrinks cases that fail, and
checks consistency over all seeds.
"""

from __future__ import annotations

import hashlib
import re
import socket
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.output_files import write_atomically
from chaserdock_protocol.scenario import Scenario, ScenarioError, load_scenario
from chaserdock_protocol.shipped_scenarios import find_scenario

from chaserdock.spread import HERE, Lost, Places, ServedCall, serve, spread
from chaserdock.toml_text import toml_document

from .checks.check import Violation
from .checks.expectations import Expectation
from .flight import EXPECTATIONS, SimulationResult, fly_case
from .shrinking import shrink
from .swarm import Case, draw_case

_NOT_DOCKED = "ends in phase "
"""Start of the text about a chaser that should have docked or be safe."""


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


def flown_digest(options: SeedOptions) -> str:
    """Return a digest of what flies the seeds: scenario and options. Raises ScenarioError."""
    name, scenario = _load(options)
    flown = (name, scenario.model_dump_json(), options.images, options.mode, options.to_violation)
    return hashlib.sha256(repr(flown).encode()).hexdigest()[:12]


@dataclass(frozen=True)
class _Call:
    """A seed to fly, perhaps on another machine; ``digest``: of what is to fly it."""

    options: SeedOptions
    digest: str
    seed: int


def _fly(call: _Call) -> SimulationResult | Lost:
    """Raises ChaserdockError if this machine has another scenario."""
    if flown_digest(call.options) != call.digest:
        host = socket.gethostname()
        raise ChaserdockError(f"{call.options.scenario}: host {host} has another file of that name")
    try:
        return fly_seed(call.options, call.seed)
    except ScenarioError as error:
        return Lost(str(error))


_FLY = ServedCall("chaserdock.simulation.seeds", _fly, _Call, SimulationResult)


def fly_seeds(
    options: SeedOptions, seeds: Iterable[int], places: Places = HERE
) -> Iterator[SimulationResult | UnflownSeed]:
    """Yield the results of the seeds as they end, which is in order with one job. Raises
    ChaserdockError at once if none can be flown.

    Processes of this machine end at once when the generator does.
    """
    name, _ = _load(options)
    options = replace(options, scenario=name)  # a path is absolute: others work elsewhere
    digest = flown_digest(options)
    calls = (_Call(options, digest, seed) for seed in seeds)
    for call, result in spread(_FLY, calls, places):
        yield UnflownSeed(call.seed, result.reason) if isinstance(result, Lost) else result


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
        for name, subject, mean in result.means:
            found.setdefault((EXPECTATIONS[name], subject), []).append(mean)
    return dict(sorted(found.items(), key=lambda item: (item[0][0].name, item[0][1])))


def inaccuracies(results: Iterable[SimulationResult]) -> list[str]:
    """Return which quantities are not as expected over an ensemble; none if it is small."""
    found = []
    for (expected, subject), means in means_over(results).items():
        if defect := expected.defect_over(means):
            found.append(f"{expected.invariant}: {subject}: {defect}")
    return found


if __name__ == "__main__":
    serve(_FLY)
