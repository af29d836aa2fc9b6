# SPDX-License-Identifier: Apache-2.0
"""Assurance in the full stack: nobody who commands can do harm, and the NMPC is not disturbed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from chaserdock_agents.chaser.core import ChaserCore
from chaserdock_models import rotations
from chaserdock_protocol.codec import vector

from chaserdock.analysis.summary import summarize
from chaserdock.simulation.mission import simulate

SHORT = (
    'perception.name="statistical"',
    "duration_s=25.0",
    "settling_s=5.0",
    "steady_until_s=25.0",
    "timeline=[]",
    "success={}",
)


def fly(folder: Path, section: str) -> dict[str, Any]:
    file = folder / "assured.toml"
    file.write_text(f'extends = "four-chaser-docking"\nname = "assured"\n{section}\n')
    out = folder / "run"
    simulate(file, out, SHORT)
    return summarize(out / "mission.mcap")


def rams(core: ChaserCore, command: Any, thrusts_N: Any = None) -> None:
    """Give full force towards the target's estimated centre in place of every command."""
    known, own = core.fallback.last.target, core.inbox.odometry
    if known is not None and known.status == "tracking" and own is not None:
        towards = rotations.rotate_inverse(
            own.q_wxyz, np.subtract(known.position_m, own.position_m)
        )
        force = core.scenario.chaser.force_max_N * towards / np.abs(towards).max()
        command = msgspec.structs.replace(command, force_N=vector(force))
    core.gate.executed_tick = command.tick
    core._actuate(command, None)


@pytest.mark.slow
def test_chasers_whose_commands_ram_the_target_keep_their_distances(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ChaserCore, "_reply", rams)
    found = fly(tmp_path, "[assurance]")
    assert found["collisions"] == 0
    assert found["min_distance_chasers_m"] >= 0.35
    for chaser in found["chasers"].values():
        assert chaser["min_distance_target_m"] >= 0.35
        assert chaser["assurance"]["changed"] > 50
        assert chaser["assurance"]["hazards"]["target"] > 50
    assert any("assurance: command changed" in e["what"] for e in found["events"])


@pytest.mark.slow
def test_they_collide_without_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ChaserCore, "_reply", rams)
    found = fly(tmp_path, "")
    assert found["collisions"] > 0
    assert "assurance" not in found["chasers"]["0"]


@pytest.mark.slow
def test_the_nmpc_flies_as_it_does_without_assurance(tmp_path: Path) -> None:
    free = fly(tmp_path, "")
    (tmp_path / "second").mkdir()
    guarded = fly(tmp_path / "second", "[assurance]")
    for i, chaser in guarded["chasers"].items():
        assert chaser["assurance"]["changed"] == 0
        assert chaser["steady"] == free["chasers"][i]["steady"]
