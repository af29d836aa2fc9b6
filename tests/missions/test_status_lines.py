# SPDX-License-Identifier: Apache-2.0
"""What processes print, which is all that ``docker logs`` shows of them."""

from __future__ import annotations

from pathlib import Path

from harness import ROOT

from chaserdock.simulation.mission import simulate


def test_every_member_prints_start_takeover_and_end(tmp_path: Path) -> None:
    overrides = (
        "duration_s=1.6",
        'perception.name="statistical"',
        "controller.standby=true",
        'fault=[{kind="kill", at_s=0.8, process="controller"}]',
    )
    flight = simulate(ROOT / "scenarios" / "single.toml", tmp_path, overrides)
    assert (flight.crashes, flight.stalled) == ({}, ())
    lines = flight.output.splitlines()
    for member in ("controller", "standby", "chaser/0", "recorder"):
        assert any(line.startswith(f"{member}: joined mission ") for line in lines), flight.output
    assert any(line.startswith("world: single, lockstep: waiting for") for line in lines)
    (takeover,) = (
        line for line in lines if line.startswith("standby: ") and "commands in term" in line
    )
    assert takeover.endswith(" s: commands in term 2")
    for member in ("standby", "chaser/0", "recorder"):
        assert lines.count(f"{member}: ended with status 0") == 1
    assert "controller: ended with status 0" not in lines
    assert "world: completed at 1.60 s" in lines
