# SPDX-License-Identifier: Apache-2.0
"""Thrusters in whole missions: separate processes, real Zenoh, images and all."""

from __future__ import annotations

from pathlib import Path

import pytest
from chaserdock_protocol.messages import ActuatorCommand, BodyTruth, ThrusterReport
from chaserdock_protocol.recording.log import read_log
from harness import SHORT, run, summary

from chaserdock.analysis.flight import load_flight

STUCK = (
    *SHORT,
    "thruster_failure=[{chaser=0,thruster=5,at_s=3.02,kind='stuck_on'}]",
    "timeline=[{at_s=5.0,command='isolate',chasers=[0],thruster=7}]",
)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A chaser with thrusters, one of which sticks open untold, and an operator who shuts another off."""
    out = tmp_path_factory.mktemp("thrusters") / "run"
    status, said = run("thruster-failure", out, *STUCK)
    assert status == 0, said
    return out


def test_a_stuck_thruster_is_found_isolated_and_told(flown: Path) -> None:
    result = summary(flown)
    told = [e for e in result["events"] if "thruster 5 stuck on" in e["what"]]
    assert len(told) == 1
    assert 3.02 < told[0]["time_s"] <= 3.02 + 0.3
    assert result["collisions"] == 0
    chaser = result["chasers"]["0"]
    assert chaser["propellant_kg"] == pytest.approx(
        chaser["thruster_impulse_N_s"] / (70.0 * 9.80665), rel=1e-6
    )
    assert chaser["thruster_impulse_N_s"] > 0.3


def test_valves_and_limits_are_in_the_log(flown: Path) -> None:
    commands, reports, truths = [], [], []
    for record in read_log(flown / "mission.mcap"):
        match record.message:
            case ActuatorCommand() as m:
                commands.append(m)
            case ThrusterReport() as m:
                reports.append(m)
            case BodyTruth(body="chaser/0") as m:
                truths.append(m)
    shut = {m.isolated: m.tick for m in reversed(commands)}
    assert list(reversed(shut)) == [(), (5,), (5, 7)]
    assert [r.tick for r in reports] == list(range(len(reports)))
    assert reports[-1].thrusters[5] == "stuck_on"
    assert max(reports[-1].force_max_N) < max(reports[0].force_max_N)
    # The world's thruster 5 gave full thrust from its failure until its valve was shut, and nothing afterwards.
    given = sum(m.thruster_impulse_N_s[5] for m in truths if m.sim_time_ns > 3.0e9)
    first = next(m.effective_time_ns for m in commands if m.isolated) / 1e9
    assert given == pytest.approx(1.5 * (first - 3.02), abs=1.5 * 0.012)
    after = [m.thruster_impulse_N_s for m in truths if m.sim_time_ns > 5.5e9]
    assert all(thrusters[5] == 0.0 and thrusters[7] == 0.0 for thrusters in after)


def test_the_same_flight_again_is_the_same(flown: Path, tmp_path: Path) -> None:
    status, said = run("thruster-failure", tmp_path / "run", *STUCK)
    assert status == 0, said
    assert load_flight(tmp_path / "run" / "mission.mcap").digest == summary(flown)["digest"]
