"""Flies a plan: several missions at a time, each once. What is finished in the folder is not flown again."""

from __future__ import annotations

import hashlib
import os
import shutil
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from threading import Event, Lock
from typing import Any

import msgspec
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.process import SINGLE_THREADED
from chaserdock_protocol.recording.scan import LOG_NAME
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_protocol.study import StudyCase, StudyResult, line_of, read_lines
from msgspec import Struct

from chaserdock.launch.scenario_files import find_scenario

from .plan import SCENARIO, Mission, Plan

_PACKAGES = ("chaserdock_protocol", "chaserdock_world", "chaserdock", "chaserdock_controller")


class ReproduceError(ChaserdockError):
    """The plan cannot be flown here; one clear line."""


class Flown(Struct, frozen=True, kw_only=True):
    """A finished mission: by which code and scenario (``key``), and its summary."""

    key: str
    summary: dict[str, Any]


@dataclass(frozen=True)
class Results:
    """Summaries of missions by name, results of studies by name."""

    missions: dict[str, dict[str, Any]]
    studies: dict[str, StudyResult]


def code_digest() -> str:
    """A digest of the code that flies: another version's results are not taken for this one's."""
    digest = hashlib.sha256()
    own = Path(__file__).resolve().parent
    for package in _PACKAGES:
        spec = find_spec(package)
        if spec is None or spec.origin is None:
            raise ReproduceError(
                f"{package} is not installed; everything must be on the machine that reproduces"
            )
        for path in sorted(Path(spec.origin).resolve().parent.rglob("*.py")):
            if path.parent != own:
                digest.update(path.read_bytes())
    digest.update(scenario_path(SCENARIO).read_bytes())  # what the studies fly
    return digest.hexdigest()[:16]


def scenario_path(name: str) -> Path:
    """The shipped scenario of that name; raises ReproduceError if there is none."""
    path = find_scenario(name)
    if path is None:
        raise ReproduceError(f"there is no scenario {name}")
    return path


def scenario_of(mission: Mission) -> tuple[Path, Scenario]:
    """A mission's scenario file and the scenario, resolved; raises ScenarioError or ReproduceError."""
    path = scenario_path(mission.scenario)
    return path, load_scenario(path, (*mission.overrides, f"seed={mission.seed}"))


def _key(code: str, content: str) -> str:
    return f"{code} {hashlib.sha256(content.encode()).hexdigest()[:16]}"


class Runner:
    """Flies missions and studies into ``folder``; ``jobs`` at a time. ``say`` gets a line for people."""

    def __init__(self, folder: Path, jobs: int, keep_logs: bool, say) -> None:
        self.folder, self.jobs, self.keep_logs, self.say = folder, jobs, keep_logs, say
        self._code = code_digest()
        self._stop = Event()
        self._lock = Lock()
        self._done, self._number = 0, 0

    def fly(self, plan: Plan) -> Results:
        """Everything of ``plan`` that is not finished yet, and all results. Raises ReproduceError if something failed."""
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ReproduceError(f"{self.folder}: cannot be made: {error.strerror or error}") from None
        self._mend()
        todo = [m for m in plan.missions if self.finished(m) is None]
        cases = self._open_cases(plan)
        self._done, self._number = 0, len(todo) + bool(cases)
        flown = len(plan.missions) - len(todo)
        self.say(
            f"{len(todo)} missions and {len(cases)} studies to fly; {flown} missions are finished already"
        )
        begun_s = time.monotonic()
        with ThreadPoolExecutor(self.jobs) as pool:
            # The longest first, so that no core waits for it at the end.
            work = [pool.submit(self._study, cases, begun_s)] if cases else []
            by_length = sorted(todo, key=lambda m: -self._effort(m))
            work += [pool.submit(self._mission, m, begun_s) for m in by_length]
            try:
                faults = [fault for future in work if (fault := future.result())]
            except BaseException:
                self._stop.set()
                raise
        if faults:
            raise ReproduceError("\n".join(faults))
        return self.results(plan)

    def results(self, plan: Plan) -> Results:
        """What of ``plan`` is finished, in the plan's order. Nothing may be flying."""
        self._mend()
        summaries = {m.name: s for m in plan.missions if (s := self.finished(m)) is not None}
        found = self._studies()
        cases = [c for c in plan.studies if c.name in found and found[c.name].case == c]
        return Results(summaries, {c.name: found[c.name] for c in cases})

    def finished(self, mission: Mission) -> dict[str, Any] | None:
        """The summary of a mission that this code has flown here, or None."""
        try:
            flown = msgspec.json.decode((self._place(mission) / "flown.json").read_bytes(), type=Flown)
        except (OSError, msgspec.DecodeError):
            return None
        return flown.summary if flown.key == self._mission_key(mission) else None

    def _place(self, mission: Mission) -> Path:
        return self.folder / "runs" / mission.name

    def _mission_key(self, mission: Mission) -> str:
        return _key(self._code, scenario_of(mission)[1].model_dump_json())

    @staticmethod
    def _effort(mission: Mission) -> float:
        scenario = scenario_of(mission)[1]
        return scenario.duration_s * scenario.time.image_hz * len(scenario.chasers)

    def _told(self, name: str, begun_s: float, what: str) -> None:
        with self._lock:
            self._done += 1
            so_far_s = time.monotonic() - begun_s
            left_s = so_far_s / self._done * (self._number - self._done)
            ahead = f"about {left_s / 60:.0f} min left"
            self.say(f"[{self._done} of {self._number}, {so_far_s / 60:.1f} min, {ahead}] {name}: {what}")

    def _mission(self, mission: Mission, begun_s: float) -> str | None:
        """Flies one; what went wrong, if it left no summary (a flight that failed leaves one)."""
        if self._stop.is_set():
            return None
        place, path = self._place(mission), scenario_of(mission)[0]
        if place.exists():
            shutil.rmtree(place)  # begun and not finished, or by other code
        sets = [item for o in mission.overrides for item in ("--set", o)]
        said = self._call("run", str(path), "--out", str(place), "--seed", str(mission.seed), "-q", *sets)
        try:
            summary = msgspec.json.decode((place / "summary.json").read_bytes(), type=dict[str, Any])
        except (OSError, msgspec.DecodeError):
            return f"{mission.name}: {said}"
        flown = Flown(key=self._mission_key(mission), summary=summary)
        (place / "flown.json").write_bytes(msgspec.json.encode(flown))
        if not self.keep_logs:
            (place / LOG_NAME).unlink(missing_ok=True)
        self._told(mission.name, begun_s, "flown" if summary["success"] else "; ".join(summary["failures"]))
        return None

    def _call(self, *arguments: str) -> str:
        """Runs the program; the last line that it said."""
        command = [sys.executable, "-m", "chaserdock", *arguments]
        env = {**os.environ, **SINGLE_THREADED}
        done = subprocess.run(command, capture_output=True, text=True, env=env, check=False)
        lines = (done.stdout + done.stderr).strip().splitlines()
        return lines[-1] if lines else f"ended with status {done.returncode} without a word"

    def _studies(self) -> dict[str, StudyResult]:
        """Finished studies by name; the last of equal names counts."""
        path = self._results()
        return {r.case.name: r for r in read_lines(path, StudyResult)} if path.exists() else {}

    def _mend(self) -> None:
        """Drops a line that was cut off when a study was interrupted: that case counts as not flown."""
        path = self._results()
        text = path.read_text(encoding="utf-8") if path.exists() else ""
        if text and not text.endswith("\n"):
            path.write_text(text[: text.rfind("\n") + 1], encoding="utf-8")

    def _results(self) -> Path:
        return self.folder / "studies" / f"{self._code}.jsonl"

    def _open_cases(self, plan: Plan) -> list[StudyCase]:
        flown = self._studies()
        return [c for c in plan.studies if c.name not in flown or flown[c.name].case != c]

    def _study(self, cases: list[StudyCase], begun_s: float) -> str | None:
        place = self._results().parent
        place.mkdir(parents=True, exist_ok=True)
        (place / "cases.jsonl").write_text("".join(map(line_of, cases)), encoding="utf-8")
        said = self._call("study", str(place / "cases.jsonl"), "--out", str(self._results()))
        self._told("studies", begun_s, said)
        flown = self._studies()
        missing = [c.name for c in cases if c.name not in flown or flown[c.name].case != c]
        return f"studies: {missing[0]} was not flown: {said}" if missing else None
