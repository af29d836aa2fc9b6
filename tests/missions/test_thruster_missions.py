"""Jets in whole missions: separate processes, real Zenoh, pictures and all."""

from __future__ import annotations

from pathlib import Path

import pytest
from chaserdock_protocol.messages import ActuatorCommand, BodyTruth, JetReport
from chaserdock_protocol.recording.log import read_log
from harness import SHORT, run, summary

from chaserdock.analysis.flight import load_flight

STUCK = (
    *SHORT,
    "jet_failure=[{chaser=0,jet=5,at_s=3.02,kind='stuck_on'}]",
    "timeline=[{at_s=5.0,command='isolate',chasers=[0],jet=7}]",
)


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A chaser with jets, one of which sticks open untold, and an operator who shuts another off."""
    out = tmp_path_factory.mktemp("jets") / "run"
    status, said = run("jet-failure", out, *STUCK)
    assert status == 0, said
    return out


def test_a_stuck_jet_is_found_isolated_and_told(flown: Path) -> None:
    result = summary(flown)
    told = [e for e in result["events"] if "jet 5 stuck on" in e["what"]]
    assert len(told) == 1
    assert 3.02 < told[0]["time_s"] <= 3.02 + 0.3
    assert result["collisions"] == 0
    chaser = result["chasers"]["0"]
    assert chaser["propellant_kg"] == pytest.approx(chaser["jet_impulse_N_s"] / (70.0 * 9.80665), rel=1e-6)
    assert chaser["jet_impulse_N_s"] > 0.3


def test_valves_and_limits_are_in_the_log(flown: Path) -> None:
    commands, reports, truths = [], [], []
    for record in read_log(flown / "mission.mcap"):
        match record.message:
            case ActuatorCommand() as m:
                commands.append(m)
            case JetReport() as m:
                reports.append(m)
            case BodyTruth(body="chaser/0") as m:
                truths.append(m)
    shut = {m.isolated: m.tick for m in reversed(commands)}
    assert list(reversed(shut)) == [(), (5,), (5, 7)]
    assert [r.tick for r in reports] == list(range(len(reports)))
    assert reports[-1].jets[5] == "stuck_on"
    assert max(reports[-1].force_max_N) < max(reports[0].force_max_N)
    # The world's jet 5 gave full thrust from its failure until its valve was shut, and nothing afterwards.
    given = sum(m.jet_impulse_N_s[5] for m in truths if m.sim_time_ns > 3.0e9)
    first = next(m.effective_time_ns for m in commands if m.isolated) / 1e9
    assert given == pytest.approx(1.5 * (first - 3.02), abs=1.5 * 0.012)
    after = [m.jet_impulse_N_s for m in truths if m.sim_time_ns > 5.5e9]
    assert all(jets[5] == 0.0 and jets[7] == 0.0 for jets in after)


def test_the_same_flight_again_is_the_same(flown: Path, tmp_path: Path) -> None:
    status, said = run("jet-failure", tmp_path / "run", *STUCK)
    assert status == 0, said
    assert load_flight(tmp_path / "run" / "mission.mcap").digest == summary(flown)["digest"]
