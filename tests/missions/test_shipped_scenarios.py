# SPDX-License-Identifier: Apache-2.0
"""Shipped scenarios, shortened: `chaserdock simulate` flies each, and one of each kind as separate
processes over Zenoh do, bit for bit.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from chaserdock_protocol.scenario import Scenario, load_scenario
from harness import ROOT, run, simulated_digest, summary

FLOWN_ELSEWHERE = {
    "two-chaser-tracking": "test_simulation.py",
    "fault-drill": "test_simulation.py, test_standby_takeover.py, test_fault_injection.py",
    "thruster-failure": "test_thruster_missions.py",
}
"""Scenarios whose digests another test compares, on longer flights that it makes anyway."""
TICKS = 10
MOST_SEPARATE = 16
"""Largest number of chasers that fly as separate processes here: those of 64 take minutes to start
on two cores.
"""
SCENARIOS = {path.stem: load_scenario(path) for path in sorted((ROOT / "scenarios").glob("*.toml"))}


def kind_of(scenario: Scenario) -> tuple[object, ...]:
    """Return what decides which messages a scenario's processes exchange, and which code answers
    them.
    """
    return (
        scenario.perception.name,
        scenario.estimator.name,
        scenario.chaser.actuation,
        scenario.docking.kind,
        scenario.target.motion,
        bool(scenario.target_model().markers),
        scenario.ranging is not None,
        scenario.orbit is not None,
        scenario.controller.standby,
    )


def first_of_each_kind() -> list[str]:
    """Return a scenario of each kind: one of several chasers, and else of one."""
    found = {kind_of(SCENARIOS[name]) for name in FLOWN_ELSEWHERE}
    names = []
    chasers = {name: len(scenario.chasers) for name, scenario in SCENARIOS.items()}
    for name in sorted(chasers, key=lambda n: (chasers[n] == 1, chasers[n])):
        if chasers[name] <= MOST_SEPARATE and (kind := kind_of(SCENARIOS[name])) not in found:
            found.add(kind)
            names.append(name)
    return names


SEPARATE = first_of_each_kind()


def shortened(name: str) -> tuple[str, ...]:
    """Return what makes a scenario one of ten ticks with small images."""
    scenario = SCENARIOS[name]
    overrides = (f"duration_s={TICKS / scenario.time.rate_hz}", "settling_s=0.0", "timeline=[]")
    # A criterion of commands that are not given.
    overrides += ("success.reached=[]",) if scenario.success.reached else ()
    small = (
        ()
        if scenario.camera.intrinsics is not None
        else ("camera.width_px=320", "camera.height_px=240")
    )
    return (*overrides, *small)


def test_scenarios_flown_elsewhere_are_shipped_and_compared_there() -> None:
    assert FLOWN_ELSEWHERE.keys() <= SCENARIOS.keys()
    for files in FLOWN_ELSEWHERE.values():
        for name in files.split(", "):
            assert "simulated_digest(" in (ROOT / "tests" / "missions" / name).read_text(
                encoding="utf-8"
            )


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in SCENARIOS if n not in (*SEPARATE, *FLOWN_ELSEWHERE)])
def test_shipped_scenario_flies(name: str, tmp_path: Path) -> None:
    assert simulated_digest(name, tmp_path, *shortened(name))


@pytest.mark.slow
@pytest.mark.parametrize("name", SEPARATE)
def test_simulated_flight_equals_that_of_separate_processes(name: str, tmp_path: Path) -> None:
    """Criteria of success may fail in so short a flight, but it is complete."""
    overrides = shortened(name)
    status, output = run(name, tmp_path / "run", *overrides)
    flown = summary(tmp_path / "run")
    assert status in (0, 1), output
    assert flown["ticks"] == TICKS, output
    assert simulated_digest(name, tmp_path / "simulated", *overrides) == flown["digest"]
