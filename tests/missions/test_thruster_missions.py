# SPDX-License-Identifier: Apache-2.0
"""Thruster failures in complete missions with separate processes and images."""

from __future__ import annotations

from pathlib import Path

import pytest
from chaserdock_protocol.messages import ActuatorCommand, BodyTruth, ThrusterReport
from chaserdock_protocol.recording.log import read_log
from harness import SHORT, run, simulated_digest, summary

STUCK = (
    *SHORT,
    "thruster_failure=[{chaser=0,thruster=5,at_s=3.02,kind='stuck_on'}]",
    "timeline=[{at_s=5.0,command='isolate',chasers=[0],thruster=7}]",
)


@pytest.fixture(scope="module")
def stuck_flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Fly a chaser of which one thruster sticks on without a report, and of which an operator
    isolates another.
    """
    out = tmp_path_factory.mktemp("thrusters") / "run"
    status, output = run("thruster-failure", out, *STUCK)
    assert status == 0, output
    return out


@pytest.mark.slow
def test_stuck_thruster_is_detected_isolated_and_reported(stuck_flight: Path) -> None:
    result = summary(stuck_flight)
    reported = [e for e in result["events"] if "thruster 5 stuck on" in e["what"]]
    assert len(reported) == 1
    assert 3.02 < reported[0]["time_s"] <= 3.02 + 0.3
    assert result["collisions"] == 0
    chaser = result["chasers"]["0"]
    assert chaser["propellant_kg"] == pytest.approx(
        chaser["thruster_impulse_N_s"] / (70.0 * 9.80665), rel=1e-6
    )
    assert chaser["thruster_impulse_N_s"] > 0.3


@pytest.mark.slow
def test_log_contains_valve_commands_and_force_limits(stuck_flight: Path) -> None:
    commands, reports, truths = [], [], []
    for record in read_log(stuck_flight / "mission.mcap"):
        match record.message:
            case ActuatorCommand() as m:
                commands.append(m)
            case ThrusterReport() as m:
                reports.append(m)
            case BodyTruth(body="chaser/0") as m:
                truths.append(m)
    isolated = {m.isolated: m.tick for m in reversed(commands)}
    assert list(reversed(isolated)) == [(), (5,), (5, 7)]
    assert [r.tick for r in reports] == list(range(len(reports)))
    assert reports[-1].thrusters[5] == "stuck_on"
    assert max(reports[-1].force_max_N) < max(reports[0].force_max_N)
    # Thruster 5 fires at full thrust from its failure until its valve is closed, and not
    # afterwards.
    impulse_N_s = sum(m.thruster_impulse_N_s[5] for m in truths if m.sim_time_ns > 3.0e9)
    first = next(m.effective_time_ns for m in commands if m.isolated) / 1e9
    assert impulse_N_s == pytest.approx(1.5 * (first - 3.02), abs=1.5 * 0.012)
    after = [m.thruster_impulse_N_s for m in truths if m.sim_time_ns > 5.5e9]
    assert all(thrusters[5] == 0.0 and thrusters[7] == 0.0 for thrusters in after)


@pytest.mark.slow
def test_simulated_thruster_flight_has_equal_digest(stuck_flight: Path, tmp_path: Path) -> None:
    assert simulated_digest("thruster-failure", tmp_path, *STUCK) == summary(stuck_flight)["digest"]
