# SPDX-License-Identifier: Apache-2.0
"""Faults in whole missions over real processes: deterministic in lock-step, told in the log, survived."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from harness import run, summary

from chaserdock.analysis.flight import RecordedFlight, load_flight

DRILL = "fault-drill"
SHORT = ("duration_s=6.0", "timeline=[]", "success.docked=[]", "settling_s=1.0")

pytestmark = pytest.mark.slow


def flown(
    out: Path, *faults: str, arguments: list[str] | None = None
) -> tuple[int, RecordedFlight, dict[str, Any]]:
    listed = ", ".join("{" + fault + "}" for fault in faults)
    status, said = run(DRILL, out, *SHORT, f"fault=[{listed}]", arguments=arguments or [])
    assert (out / "summary.json").exists(), said
    return status, load_flight(out / "mission.mcap"), summary(out)


def truth_of(flight: RecordedFlight) -> list[bytes]:
    return [flight.truth[name].position_m.tobytes() for name in sorted(flight.truth)]


MANY = (
    'kind = "drop", at_s = 1.0, duration_s = 2.0, process = "chaser/0", topic = "wrench", share = 0.5',
    'kind = "corrupt", at_s = 1.5, duration_s = 2.0, process = "controller", topic = "sighting", share = 0.5',
    'kind = "delay", at_s = 2.0, duration_s = 1.0, process = "world", topic = "actuators", delay_s = 0.2',
    'kind = "reorder", at_s = 2.0, duration_s = 1.0, process = "controller", topic = "odometry", share = 0.5',
    'kind = "flood", at_s = 2.0, duration_s = 1.0, process = "chaser/1", topic = "sighting", copies = 20',
    'kind = "cut", at_s = 3.0, duration_s = 1.0, process = "chaser/2"',
    'kind = "camera_off", at_s = 3.0, duration_s = 1.0, process = "chaser/3"',
    'kind = "kill", at_s = 4.5, process = "chaser/1"',
)


def test_equal_faults_make_equal_flights(tmp_path: Path) -> None:
    (_, one, first), (_, other, second) = (flown(tmp_path / name, *MANY) for name in ("one", "other"))
    assert first["digest"] == second["digest"]
    begun = [e.detail.split(",")[0] for e in one.events if e.what == "fault begins"]
    assert len(begun) == len(MANY)
    assert any(e.what == "process lost" and e.detail == "chaser/1" for e in other.events)
    assert first["collisions"] == 0
    assert all(m["lost"] == 0 for m in first["messages"].values())


def test_a_frozen_process_changes_nothing_in_lockstep(tmp_path: Path) -> None:
    status, plain, _ = flown(tmp_path / "plain")
    assert status == 0
    status, frozen, told = flown(
        tmp_path / "frozen",
        'kind = "freeze", at_s = 2.0, duration_s = 3.0, process = "controller"',
        'kind = "freeze", at_s = 3.0, duration_s = 1.0, process = "world"',
    )
    assert status == 0
    assert truth_of(frozen) == truth_of(plain)
    assert told["wall_time_s"] > 4.0


def test_killed_recorder_ends_the_log_and_not_the_flight(tmp_path: Path) -> None:
    status, _, told = flown(tmp_path / "run", 'kind = "kill", at_s = 4.0, process = "recorder"')
    assert status == 1
    assert 3.0 < told["sim_time_s"] <= 4.1
    assert "completed" in (tmp_path / "run" / "processes" / "world.txt").read_text()


def test_in_real_time(tmp_path: Path) -> None:
    """Nobody waits, nothing stands in for what is lost; the flight goes on."""
    _, flight, told = flown(
        tmp_path / "run",
        'kind = "drop", at_s = 2.0, duration_s = 1.5, process = "chaser/0", topic = "wrench"',
        'kind = "freeze", at_s = 4.0, duration_s = 0.5, process = "chaser/1"',
        arguments=["--mode", "realtime"],
    )
    assert told["sim_time_s"] == 6.0
    assert told["collisions"] == 0
    what = [e.what for e in flight.events]
    assert what.count("fault begins") == 2
