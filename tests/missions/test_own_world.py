# SPDX-License-Identifier: Apache-2.0
"""A world that is no part of chaserdock flies, and the check of worlds tells good from bad."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from harness import ROOT

from chaserdock.conformance.world import check_world

OWN = ROOT / "examples" / "own_world" / "own_world.py"
pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The flight scenario, as docs/howto-own-world.md makes it."""
    sets = ["--set", 'perception.name="statistical"', "--set", "duration_s=2.0"]
    command = [sys.executable, "-m", "chaserdock", "scenario", "single", *sets, "--flight"]
    made = subprocess.run(command, capture_output=True, text=True, check=True)
    path = tmp_path_factory.mktemp("flight") / "flight.json"
    path.write_text(made.stdout)
    return path


def checked(program: Path, flight: Path, ticks: int = 100) -> list[str]:
    command = [sys.executable, str(program), str(flight), "connect", "{endpoint}", "{namespace}"]
    result = check_world(command, ticks, start_s=60.0, patience_s=3.0)
    return [f"{f.where}: {f.what}" for f in result.findings]


def test_own_world_conforms_to_its_end(flight: Path) -> None:
    assert checked(OWN, flight) == []


def test_the_shipped_world_conforms(flight: Path) -> None:
    world = [sys.executable, "-m", "chaserdock", "world", "docking-contact", "-e", "{endpoint}"]
    command = [*world, "--namespace", "{namespace}", "--no-recorder", "--set", "duration_s=1.0"]
    result = check_world(command, 100, start_s=60.0, patience_s=3.0)
    assert result.findings == []
    assert result.ticks == 15


BREACHES = {
    "waits": (
        "while len(self.replies) < len(places)",
        "while False",
        "world/tick: does not wait for all replies in lock-step",
    ),
    "time": (
        'head = {"tick": tick, "sim_time_ns": tick * 1_000_000_000 // RATE}',
        'head = {"tick": tick, "sim_time_ns": tick * 66_000_000}',
        "world/tick: wrong sim_time_ns",
    ),
    "version": ('"Odometry", 2,', '"Odometry", 1,', "world/chaser/0/odometry: wrong encoding"),
    "images": (
        'self.publish(f"world/chaser/{i}/image", "Image"',
        'self.publish(f"world/chaser/{i + 1}/image", "Image"',
        "world/chaser/1/image: chaser differs from the key's",
    ),
    "instances": (
        "who = {n: self.joined[n] for n in CHASERS}",
        'who = {n: "another" for n in CHASERS}',
        "world/tick: another instance than joined",
    ),
    "farewell": (
        "counts = {key: n + 1 for key, n in self.seq.items()}",
        "counts = {key: n for key, n in self.seq.items()}",
        "world/farewell: wrong number of published messages",
    ),
}
"""What a world does wrong: text to replace, by what, and what the check says."""


@pytest.mark.parametrize("name", sorted(BREACHES))
def test_a_breach_of_a_duty_is_named(name: str, flight: Path, tmp_path: Path) -> None:
    old, new, said = BREACHES[name]
    source = OWN.read_text()
    assert old in source
    bad = tmp_path / "bad_world.py"
    bad.write_text(source.replace(old, new))
    assert any(said in finding for finding in checked(bad, flight)), name
