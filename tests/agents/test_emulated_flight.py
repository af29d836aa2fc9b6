# SPDX-License-Identifier: Apache-2.0
"""Flights on the emulated laboratory in real time, with the processes that a user starts: images,
motion capture, PX4 and probes over ROS 2 and MAVLink.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from virtual_lab import FOLDER

import chaserdock


def flown(flight: str, out: Path, *options: str) -> tuple[str, dict[str, Any]]:
    """Fly; return the gateway's output, and what the laboratory saw."""
    command = [sys.executable, str(FOLDER / "fly.py"), flight, "--out", str(out), *options]
    done = subprocess.run(command, capture_output=True, text=True, timeout=900, check=False)
    seen = out / "laboratory.json"
    assert seen.exists(), done.stderr
    return (out / "gateway.txt").read_text(), json.loads(seen.read_text())


def assert_safe(said: str, seen: dict[str, Any]) -> None:
    """Assert what holds on any machine, however slow."""
    assert "arm accepted" in said
    assert "Traceback" not in said
    assert "world: completed at" in said
    assert seen["clearance_m"] > 0.02
    assert seen["misses"] == {}


@pytest.mark.slow(minutes=3)
def test_a_free_flyer_docks_over_real_topics_or_stops_with_a_reason(tmp_path: Path) -> None:
    said, seen = flown("free-flyer-docking", tmp_path / "out")
    assert_safe(said, seen)
    assert seen["latched"] == [0] or "disarmed: " in said or seen["speeds_m_s"][0] < 0.1


@pytest.mark.slow(minutes=2)
def test_a_gateway_that_is_killed_and_restarted_goes_on_measuring_the_target(
    tmp_path: Path,
) -> None:
    out = tmp_path / "out"
    options = ("--set", "duration_s=45.0", "--kill-gateway", "8")
    said, seen = flown("tracking", out, *options)
    assert_safe(said, seen)
    assert "gateway restarted: the mission goes on" in said
    assert said.count("arm accepted") == 2
    for process in ("controller", "chaser-0", "chaser-1", "recorder"):
        told = (out / f"{process}.txt").read_text()
        assert "the world is back, and the mission goes on" in told
        # A recorder that follows late lacks messages, and says so.
        assert "ended with status 0" in told or process == "recorder"
    log = chaserdock.open_log(out / "run")
    poses = {m.sim_time_ns: m for m in log.messages("reference/body/target")}
    times = np.array(sorted(poses))
    errors = []
    for estimate in log.messages("controller/target"):
        nearest = times[np.abs(times - estimate.sim_time_ns).argmin()]
        if abs(nearest - estimate.sim_time_ns) < 20_000_000:
            known = np.array(poses[nearest].position_m)
            errors.append(np.linalg.norm(estimate.position_m - known))
    assert errors
    assert np.median(errors) < 0.01
