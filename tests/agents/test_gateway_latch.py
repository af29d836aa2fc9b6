# SPDX-License-Identifier: Apache-2.0
"""Latches of a laboratory get commands, and none in a dry run."""

from __future__ import annotations

from pathlib import Path

import pytest
import virtual_lab
from chaserdock_agents.gateway.devices import DeviceHost, LatchReading
from chaserdock_agents.gateway.lab import Laboratory
from chaserdock_protocol.messages import Latch
from chaserdock_protocol.scenario import load_scenario

SCENARIO = """
extends = "docking-contact"
[lab.safety]
volume = { lower_m = [-2.0, -2.0, -2.0], upper_m = [2.0, 2.0, 2.0] }
max_speed_m_s = 0.3
[[lab.odometry]]
body = "chaser/0"
address = "virtual:"
[[lab.robot]]
chaser = 0
address = "virtual:0"
[[lab.latch]]
chaser = 0
address = "virtual:0"
"""


class Recorder:
    """A latch that records its commands."""

    def __init__(self) -> None:
        self.commands: list[Latch] = []

    def poll(self) -> LatchReading | None:
        return None

    def command(self, latch: Latch) -> None:
        self.commands.append(latch)

    def close(self) -> None: ...


@pytest.mark.parametrize("dry_run", [False, True])
def test_a_latch_is_commanded_unless_in_a_dry_run(
    dry_run: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "lab.toml"
    path.write_text(SCENARIO)
    virtual_lab.install(monkeypatch, virtual_lab.two_free_flyers(1), latch=Recorder)
    lab = Laboratory(load_scenario(path), DeviceHost(lambda: 0), dry_run)
    latch = lab.latches[0]
    assert isinstance(latch, Recorder)
    lab.command_latch(0, "arm")
    lab.command_latch(1, "arm")  # has none
    assert latch.commands == ([] if dry_run else ["arm"])
    lab.close()
