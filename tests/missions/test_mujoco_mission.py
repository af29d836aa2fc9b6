# SPDX-License-Identifier: Apache-2.0
"""A capture by contact with the world on MuJoCo, every process included."""

from __future__ import annotations

from pathlib import Path

import pytest
from harness import ROOT

from chaserdock.analysis.summary import summarize
from chaserdock.simulation.mission import simulate

MUJOCO = ("world.engine=mujoco", "perception.name=statistical", "duration_s=46.0")


@pytest.mark.slow
def test_docking_by_contact_succeeds_on_mujoco(tmp_path: Path) -> None:
    flight = simulate(ROOT / "scenarios" / "docking-contact.toml", tmp_path, MUJOCO)
    assert (flight.crashes, flight.stalled) == ({}, ())
    summary = summarize(tmp_path / "mission.mcap")
    assert summary["failures"] == []
    capture = summary["chasers"]["0"]["capture"]
    assert capture["latched"]
    assert capture["verified"]
    assert capture["probe_touches"] == 1
    # 17.8 kg meet 40 kg at 1 cm/s.
    assert capture["port_load"]["closing_impulse_N_s"] == pytest.approx(0.12, abs=0.03)
