# SPDX-License-Identifier: Apache-2.0
"""A shipped detumbling mission, from free flight through capture to rest, with statistical
perception, in one process.
"""

from __future__ import annotations

from typing import Any

import pytest
from chaserdock_protocol.scenario import load_scenario
from harness import ROOT

from chaserdock.analysis.flight import RecordedFlight, load_flight
from chaserdock.analysis.summary import summary_of
from chaserdock.simulation.mission import simulate

MISSIONS = {"detumble-pair": (0, 1), "detumble": (0, 1, 2, 3)}
FLOWN = ("detumble-pair",)
"""``detumble`` takes a minute of processor time more and flies in ``benchmarks/shipped.py``."""


@pytest.fixture(scope="module", params=FLOWN)
def flown(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> RecordedFlight:
    """Return a mission flown to its end, without failures of its processes."""
    out = tmp_path_factory.mktemp(request.param)
    changes = ("perception.name=statistical", "camera.width_px=320", "camera.height_px=180")
    flight = simulate(ROOT / "scenarios" / f"{request.param}.toml", out, changes)
    assert (flight.crashes, flight.stalled) == ({}, ())
    return load_flight(out / "mission.mcap")


@pytest.mark.slow
def test_the_client_is_captured_and_stopped(flown: RecordedFlight) -> None:
    result: dict[str, Any] = summary_of(flown)
    assert result["success"], result["failures"]
    chasers = MISSIONS[flown.scenario.name]
    assert flown.world.latched == chasers
    commanded_s = next(
        entry.at_s for entry in flown.scenario.timeline if entry.command == "detumble"
    )
    stack = result["stack"]
    assert commanded_s < stack["since_s"] < commanded_s + 8.0
    for i in chasers:
        names = [name for _, name in flown.references[i].phases]
        assert names[-2:] == ["detumble", "stack_hold"]
        assert names.index("verified") < names.index("detumble")


@pytest.mark.slow
def test_ports_carry_what_thrusters_and_rotation_exert(flown: RecordedFlight) -> None:
    """At most six thrusters of a chaser fire, of 1.5 N each; at rest nothing loads a port."""
    for i in MISSIONS[flown.scenario.name]:
        force_N = flown.loads[i].of("peak_force_N")
        assert 1.0 < force_N.max() < 9.0
        assert force_N[-15:].max() < 0.05


def test_missions_are_shipped_with_criteria_of_rest() -> None:
    for name, chasers in MISSIONS.items():
        scenario = load_scenario(ROOT / "scenarios" / f"{name}.toml")
        assert scenario.success.detumbled is not None
        assert scenario.success.latched == chasers
        assert any(
            entry.command == "detumble" and entry.chasers == chasers for entry in scenario.timeline
        )
