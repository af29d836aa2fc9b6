# SPDX-License-Identifier: Apache-2.0
"""Execution of a plan: missions as runs of a campaign, studies by ``chaserdock study``. Finished work is kept."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import threading
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from chaserdock_protocol.process import SINGLE_THREADED
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.shipped_scenarios import ScenarioNotFound, find_scenario

from chaserdock.campaign.plan import Campaign, Run, make_run
from chaserdock.campaign.scheduler import CampaignProgress
from chaserdock.campaign.table import rows_of, write_table
from chaserdock.campaign.worker import CampaignError, FinishedRun, fly_campaign, read_result, result_path
from chaserdock.evaluation.study_cases import StudyCase, StudyResult, line_of, read_lines

from .plan import SCENARIO, Mission, ReproductionPlan

_PACKAGES = (
    "chaserdock",
    "chaserdock_agents",
    "chaserdock_controller",
    "chaserdock_models",
    "chaserdock_protocol",
    "chaserdock_world",
)
_POLL_S = 0.5


@dataclass(frozen=True)
class ReproductionResults:
    """Summaries of missions by name, results of studies by name."""

    missions: dict[str, dict[str, Any]]
    studies: dict[str, StudyResult]


@cache
def code_digest() -> str:
    """Return a digest of the code that flies, so that results of another version are not reused."""
    digest = hashlib.sha256()
    own = Path(__file__).resolve().parent
    for package in _PACKAGES:
        spec = find_spec(package)
        if spec is None or spec.origin is None:
            raise CampaignError(
                f"{package} is not installed; a reproduction needs all packages on this machine"
            )
        folder = Path(spec.origin).resolve().parent
        for path in sorted(p for p in folder.rglob("*") if p.suffix in (".py", ".c", ".h")):
            if path.parent != own:
                digest.update(path.read_bytes())
    digest.update(scenario_path(SCENARIO).read_bytes())  # the scenario of the studies
    return digest.hexdigest()[:16]


def scenario_path(name: str) -> Path:
    """Return the path of a shipped scenario. Raise CampaignError if there is none of that name."""
    try:
        return find_scenario(name)
    except ScenarioNotFound as error:
        raise CampaignError(str(error)) from None


def mission_run(mission: Mission, index: int = 0) -> tuple[Run, Scenario]:
    """Return a mission as a campaign run, named after code and scenario, with the resolved scenario."""
    varied = {"group": mission.group}
    return make_run(
        index, scenario_path(mission.scenario), mission.seed, varied, mission.overrides, code_digest()
    )


def fly_missions(
    missions: tuple[Mission, ...], folder: Path, jobs: int, keep_logs: bool, stop: threading.Event
) -> None:
    """Fly the missions without a result; write all finished ones to ``results.parquet``.

    Raise CampaignError when a mission ended without a summary; it is flown again by the next call.
    """
    runs = [mission_run(m, index) for index, m in enumerate(missions)]
    # Longest first, so that no core idles at the end.
    runs.sort(key=lambda run: -_effort(run[1]))
    campaign = Campaign("reproduction", ("group",), tuple(run for run, _ in runs))
    keep = "all" if keep_logs else "none"
    finished = fly_campaign(campaign, folder, keep, jobs, None, CampaignProgress(), stop)
    crashed = [(run, result) for run, result in finished if result.summary is None]
    for run, _ in crashed:
        result_path(folder, run).unlink()
    if crashed:
        raise CampaignError("\n".join(f"{run.varied['group']}: {r.last_words}" for run, r in crashed))
    if finished:
        write_table(rows_of(sorted(finished, key=_plan_order)), folder / "results.parquet")


def _plan_order(item: tuple[Run, FinishedRun]) -> int:
    return item[0].index


def _effort(scenario: Scenario) -> float:
    return scenario.duration_s * scenario.time.image_hz * len(scenario.chasers)


def results_of(plan: ReproductionPlan, folder: Path) -> ReproductionResults:
    """Return what is finished of ``plan``, in the plan's order."""
    missions = {}
    for mission in plan.missions:
        result = read_result(folder, mission_run(mission)[0])
        if result is not None and result.summary is not None:
            missions[mission.name] = result.summary
    finished = _finished_studies(folder)
    studies = {case.name: finished[case] for case in plan.studies if case in finished}
    return ReproductionResults(missions, studies)


# -- studies ----------------------------------------------------------------------------------------------


def fly_studies(
    cases: tuple[StudyCase, ...],
    folder: Path,
    jobs: int,
    stop: threading.Event,
    report: Callable[[str], None],
) -> None:
    """Fly the cases without a result in ``jobs`` processes. Raise CampaignError when one of them fails."""
    remaining = open_cases(cases, folder)
    if not remaining:
        return
    report(f"{len(remaining)} studies to fly, {len(cases) - len(remaining)} are finished")
    place = _studies_folder(folder)
    place.mkdir(parents=True, exist_ok=True)
    processes = []
    for k in range(min(jobs, len(remaining))):
        path = place / f"cases-{k}.jsonl"
        path.write_text("".join(map(line_of, remaining[k::jobs])), encoding="utf-8")
        command = [sys.executable, "-m", "chaserdock", "study", str(path), "--out"]
        processes.append(
            subprocess.Popen(
                [*command, str(place / f"{code_digest()}-{k}.jsonl")],
                stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
                text=True,
                env={**os.environ, **SINGLE_THREADED},
                start_new_session=True,
            )
        )
    errors = [_output_of(process, stop) for process in processes]
    missing = open_cases(cases, folder)
    if missing and not stop.is_set():
        raise CampaignError(f"studies: {missing[0].name} has no result: {'; '.join(filter(None, errors))}")


def _output_of(process: subprocess.Popen[str], stop: threading.Event) -> str:
    """Wait for a process, or terminate it after ``stop``; return its last line on standard error."""
    while True:
        try:
            _, errors = process.communicate(timeout=_POLL_S)
        except subprocess.TimeoutExpired:
            if stop.is_set():
                process.terminate()
            continue
        return (errors.strip().splitlines() or [""])[-1]


def open_cases(cases: tuple[StudyCase, ...], folder: Path) -> list[StudyCase]:
    """Return the cases without a result of this code; a result of the same name with other overrides does not count."""
    finished = _finished_studies(folder)
    return [case for case in cases if case not in finished]


def _studies_folder(folder: Path) -> Path:
    return folder / "studies"


def _finished_studies(folder: Path) -> dict[StudyCase, StudyResult]:
    """Return the results of this code. No study may be running."""
    results: dict[StudyCase, StudyResult] = {}
    for path in sorted(_studies_folder(folder).glob(f"{code_digest()}-*.jsonl")):
        _drop_incomplete_line(path)
        results |= {r.case: r for r in read_lines(path, StudyResult)}
    return results


def _drop_incomplete_line(path: Path) -> None:
    """Remove the last line of an interrupted study, so that the file can be read and appended to."""
    text = path.read_text(encoding="utf-8")
    if text and not text.endswith("\n"):
        path.write_text(text[: text.rfind("\n") + 1], encoding="utf-8")
