# SPDX-License-Identifier: Apache-2.0
"""Execution of a plan: every flight in this process, one after the other. Each result is kept at
once as a line of JSON.
"""

from __future__ import annotations

import hashlib
import math
import tempfile
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import TypeVar

import numpy as np
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.recording.scan import LOG_NAME
from chaserdock_protocol.shipped_scenarios import find_scenario
from msgspec import Struct

from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.summary import estimate_errors, summary_of
from chaserdock.evaluation.study import fly_case
from chaserdock.evaluation.study_cases import StudyResult, line_of, read_lines
from chaserdock.simulation.mission import simulate

from .plan import Mission, ReproductionPlan

_PACKAGES = (
    "chaserdock",
    "chaserdock_agents",
    "chaserdock_controller",
    "chaserdock_models",
    "chaserdock_protocol",
    "chaserdock_world",
)


class ReproductionError(ChaserdockError):
    """A flight of the reproduction did not end."""


class MissionResult(Struct, frozen=True, kw_only=True):
    """Results of a mission, on ground truth. Steady RMS: of the worst chaser, None without a steady
    interval.

    ``dock_time_s``, ``reached_time_s``: by chaser. ``estimate_rms_rad``, ``estimate_max_rad``,
    ``estimate_max_at_s``: attitude error of the target estimate after settling, and the time of its
    maximum; None without an estimate.
    """

    mission: Mission
    steady_position_rms_m: float | None
    steady_orientation_rms_rad: float | None
    min_distance_target_m: float
    min_distance_chasers_m: float | None
    dock_time_s: dict[str, float]
    reached_time_s: dict[str, float]
    estimate_rms_rad: float | None
    estimate_max_rad: float | None
    estimate_max_at_s: float | None


@dataclass(frozen=True)
class ReproductionResults:
    """Results by name of the case or mission."""

    cases: dict[str, StudyResult]
    missions: dict[str, MissionResult]


@cache
def code_digest() -> str:
    """Return a digest of the code that flies and of its scenarios, so that results of another
    version are not reused.
    """
    digest = hashlib.sha256()
    own = Path(__file__).resolve().parent
    for package in _PACKAGES:
        spec = find_spec(package)
        if spec is None or spec.origin is None:
            raise ReproductionError(
                f"{package} is not installed; a reproduction needs all packages on this machine"
            )
        folder = Path(spec.origin).resolve().parent
        for path in sorted(p for p in folder.rglob("*") if p.suffix in (".py", ".c", ".h")):
            if path.parent != own:
                digest.update(path.read_bytes())
    for path in sorted(find_scenario("paper-single").parent.glob("*.toml")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def fly(
    plan: ReproductionPlan, folder: Path, stop: threading.Event, report: Callable[[str], None]
) -> None:
    """Fly what has no result in ``folder`` yet, until ``stop``. Raise ReproductionError, StudyError
    or ScenarioError.
    """
    results = results_of(plan, folder)
    cases = [c for c in plan.cases if c.name not in results.cases]
    missions = [m for m in plan.missions if m.name not in results.missions]
    total = len(plan.cases) + len(plan.missions)
    done = total - len(cases) - len(missions)
    for item in (*cases, *missions):
        if stop.is_set():
            return
        done += 1
        report(f"{done} of {total}: {item.name}")
        if isinstance(item, Mission):
            _append(_missions_file(folder), fly_mission(item))
        else:
            _append(_cases_file(folder), fly_case(item))


def fly_mission(mission: Mission) -> MissionResult:
    """Simulate a mission and evaluate its log. Raise ReproductionError if a process of it crashed."""
    with tempfile.TemporaryDirectory(prefix="chaserdock-reproduce-") as place:
        folder = Path(place) / "run"
        flight = simulate(find_scenario(mission.scenario), folder, mission.overrides)
        for name, error in flight.crashes.items():
            raise ReproductionError(
                f"{mission.name}: {name} crashed: {error.strip().splitlines()[-1]}"
            )
        recorded = load_flight(folder / LOG_NAME)
    summary, errors = summary_of(recorded), estimate_errors(recorded)
    chasers = summary["chasers"]
    late = errors["time_s"] >= recorded.scenario.settling_s
    angle, time_s = errors["orientation_rad"][late], errors["time_s"][late]
    return MissionResult(
        mission=mission,
        steady_position_rms_m=_worst(c["steady"]["position_mse_m2"] for c in chasers.values()),
        steady_orientation_rms_rad=_worst(
            c["steady"]["orientation_mse_rad2"] for c in chasers.values()
        ),
        min_distance_target_m=min(c["min_distance_target_m"] for c in chasers.values()),
        min_distance_chasers_m=summary["min_distance_chasers_m"],
        dock_time_s={i: c["dock_time_s"] for i, c in chasers.items() if c["docked"]},
        reached_time_s={
            i: c["reached_time_s"] for i, c in chasers.items() if c["reached_time_s"] is not None
        },
        estimate_rms_rad=float(np.sqrt(np.mean(angle**2))) if len(angle) else None,
        estimate_max_rad=float(angle.max()) if len(angle) else None,
        estimate_max_at_s=float(time_s[angle.argmax()]) if len(angle) else None,
    )


def _worst(mean_squares: Iterator[float | None]) -> float | None:
    """Return the largest root of mean squares; None if one is missing."""
    known = [math.sqrt(math.inf if x is None else x) for x in mean_squares]
    return None if math.inf in known else max(known)


def results_of(plan: ReproductionPlan, folder: Path) -> ReproductionResults:
    """Return what is finished of ``plan`` with this code; a result of the same name with other
    settings does not count.
    """
    cases = {r.case: r for r in _read(_cases_file(folder), StudyResult)}
    missions = {r.mission: r for r in _read(_missions_file(folder), MissionResult)}
    return ReproductionResults(
        {c.name: cases[c] for c in plan.cases if c in cases},
        {m.name: missions[m] for m in plan.missions if m in missions},
    )


def _cases_file(folder: Path) -> Path:
    return folder / f"flights-{code_digest()}.jsonl"


def _missions_file(folder: Path) -> Path:
    return folder / f"missions-{code_digest()}.jsonl"


def _append(path: Path, result: StudyResult | MissionResult) -> None:
    with path.open("a", encoding="utf-8") as file:
        file.write(line_of(result))


_Kind = TypeVar("_Kind", bound=Struct)


def _read(path: Path, kind: type[_Kind]) -> list[_Kind]:
    """Return the lines of a file, none if it does not exist. Drop the last line of an interrupted
    flight.
    """
    if not path.exists():
        return []
    text = path.read_text(encoding="utf-8")
    if text and not text.endswith("\n"):
        path.write_text(text[: text.rfind("\n") + 1], encoding="utf-8")
    return read_lines(path, kind)
