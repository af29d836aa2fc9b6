# SPDX-License-Identifier: Apache-2.0
"""Injected faults in complete missions with separate processes: deterministic in lock-step, logged,
survived.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from harness import DRILL, run, simulated_digest, summary

from chaserdock.analysis.flight import RecordedFlight, load_flight

pytestmark = pytest.mark.slow


def listed(*faults: str) -> str:
    """Return the override that injects the faults."""
    return f"fault=[{', '.join('{' + fault + '}' for fault in faults)}]"


def fly(
    out: Path, *faults: str, arguments: list[str] | None = None
) -> tuple[int, RecordedFlight, dict[str, Any]]:
    status, output = run(DRILL[0], out, *DRILL[1:], listed(*faults), arguments=arguments or [])
    assert (out / "summary.json").exists(), output
    return status, load_flight(out / "mission.mcap"), summary(out)


def truth_of(flight: RecordedFlight) -> list[bytes]:
    return [flight.motion[name].position_m.tobytes() for name in sorted(flight.motion)]


MANY = (
    (
        'kind = "drop", at_s = 1.0, duration_s = 2.0, '
        'process = "chaser/0", topic = "wrench", share = 0.5'
    ),
    (
        'kind = "corrupt", at_s = 1.5, duration_s = 2.0, '
        'process = "controller", topic = "sighting", share = 0.5'
    ),
    (
        'kind = "delay", at_s = 2.0, duration_s = 1.0, '
        'process = "world", topic = "actuators", delay_s = 0.2'
    ),
    (
        'kind = "reorder", at_s = 2.0, duration_s = 1.0, '
        'process = "controller", topic = "odometry", share = 0.5'
    ),
    (
        'kind = "flood", at_s = 2.0, duration_s = 1.0, '
        'process = "chaser/1", topic = "sighting", copies = 20'
    ),
    'kind = "cut", at_s = 3.0, duration_s = 1.0, process = "chaser/2"',
    'kind = "camera_off", at_s = 3.0, duration_s = 1.0, process = "chaser/3"',
    'kind = "kill", at_s = 4.5, process = "chaser/1"',
)


def test_equal_faults_give_equal_digests_in_processes_and_simulated(tmp_path: Path) -> None:
    _, flight, result = fly(tmp_path / "run", *MANY)
    begun = [e.detail.split(",")[0] for e in flight.events if e.what == "fault begins"]
    assert len(begun) == len(MANY)
    assert any(e.what == "process lost" and e.detail == "chaser/1" for e in flight.events)
    assert result["collisions"] == 0
    assert all(m["lost"] == 0 for m in result["messages"].values())
    assert (
        simulated_digest(DRILL[0], tmp_path / "simulated", *DRILL[1:], listed(*MANY))
        == result["digest"]
    )


def test_lockstep_trajectories_are_independent_of_frozen_processes(
    drill_flight: Path, tmp_path: Path
) -> None:
    status, frozen, result = fly(
        tmp_path / "frozen",
        'kind = "freeze", at_s = 2.0, duration_s = 3.0, process = "controller"',
        'kind = "freeze", at_s = 3.0, duration_s = 1.0, process = "world"',
    )
    assert status == 0
    assert truth_of(frozen) == truth_of(load_flight(drill_flight / "mission.mcap"))
    assert result["wall_time_s"] > 4.0


def test_flight_completes_without_recorder(tmp_path: Path) -> None:
    status, _, result = fly(tmp_path / "run", 'kind = "kill", at_s = 4.0, process = "recorder"')
    assert status == 1
    assert 3.0 < result["sim_time_s"] <= 4.1
    assert "completed" in (tmp_path / "run" / "processes" / "world.txt").read_text()


def test_realtime_flight_continues_with_dropped_commands_and_frozen_chaser(tmp_path: Path) -> None:
    """Realtime mode neither waits for a process nor substitutes lost messages."""
    _, flight, result = fly(
        tmp_path / "run",
        'kind = "drop", at_s = 2.0, duration_s = 1.5, process = "chaser/0", topic = "wrench"',
        'kind = "freeze", at_s = 4.0, duration_s = 0.5, process = "chaser/1"',
        arguments=["--mode", "realtime"],
    )
    assert result["sim_time_s"] == 6.0
    assert result["collisions"] == 0
    assert [e.what for e in flight.events].count("fault begins") == 2
