# SPDX-License-Identifier: Apache-2.0
"""Each shipped scenario, shortened: `chaserdock simulate` flies it as separate processes over Zenoh
do, bit for bit.
"""

from __future__ import annotations

from pathlib import Path

import pytest
from chaserdock_protocol.scenario import load_scenario
from harness import ROOT, run, simulated_digest, summary

FLOWN_ELSEWHERE = {
    "two-chaser-tracking": "test_simulation.py",
    "fault-drill": "test_simulation.py, test_standby_takeover.py, test_fault_injection.py",
    "thruster-failure": "test_thruster_missions.py",
}
"""Scenarios whose digests another test compares, on longer flights that it makes anyway."""
TICKS = 10
NAMES = sorted(path.stem for path in (ROOT / "scenarios").glob("*.toml"))


def shortened(name: str) -> tuple[str, ...]:
    """Return what makes a scenario one of ten ticks with small images."""
    scenario = load_scenario(ROOT / "scenarios" / f"{name}.toml")
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
    assert FLOWN_ELSEWHERE.keys() <= set(NAMES)
    for files in FLOWN_ELSEWHERE.values():
        for name in files.split(", "):
            assert "simulated_digest(" in (ROOT / "tests" / "missions" / name).read_text(
                encoding="utf-8"
            )


@pytest.mark.slow
@pytest.mark.parametrize("name", [n for n in NAMES if n not in FLOWN_ELSEWHERE])
def test_simulated_flight_equals_that_of_separate_processes(name: str, tmp_path: Path) -> None:
    """Criteria of success may fail in so short a flight, but it is complete."""
    overrides = shortened(name)
    status, output = run(name, tmp_path / "run", *overrides)
    flown = summary(tmp_path / "run")
    assert status in (0, 1), output
    assert flown["ticks"] == TICKS, output
    assert simulated_digest(name, tmp_path / "simulated", *overrides) == flown["digest"]
