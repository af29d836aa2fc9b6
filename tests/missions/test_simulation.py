# SPDX-License-Identifier: Apache-2.0
"""Simulated missions: equal to separate processes over Zenoh, and to themselves, bit for bit."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from chaserdock_protocol.recording.log import read_log
from harness import ROOT, run, summary

from chaserdock.analysis.flight import load_flight
from chaserdock.simulation.mission import SimulatedFlight, simulate

SMALL = (
    "camera.width_px=480",
    "camera.height_px=270",
    "settling_s=1.0",
    "success.steady_position_rms_m=9.0",
    "success.steady_orientation_rms_deg=180.0",
)
DRILL = ("timeline=[]", "success.docked=[]", "settling_s=1.0")
CASES = {
    "single": ("single", ("duration_s=2.0", *SMALL)),
    "two-chaser-tracking": ("two-chaser-tracking", ("duration_s=2.0", *SMALL)),
    "fault-drill": ("fault-drill", ("duration_s=2.0", *DRILL)),
    "fault-drill with faults and a standby": (
        "fault-drill",
        (
            "duration_s=3.0",
            *DRILL,
            "controller.standby=true",
            "fault=[{kind='kill',at_s=2.0,process='controller'},"
            "{kind='drop',at_s=1.0,duration_s=1.0,process='chaser/0',topic='wrench',share=0.5}]",
        ),
    ),
}


def simulated(name: str, folder: Path, *overrides: str) -> SimulatedFlight:
    return simulate(ROOT / "scenarios" / f"{name}.toml", folder, overrides)


@pytest.mark.parametrize("case", CASES)
def test_digest_equals_that_of_separate_processes_over_zenoh(case: str, tmp_path: Path) -> None:
    name, overrides = CASES[case]
    _, text = run(name, tmp_path / "run", *overrides)
    flight = simulated(name, tmp_path / "simulated", *overrides)
    assert (flight.crashes, flight.stalled) == ({}, ())
    digest = load_flight(tmp_path / "simulated" / "mission.mcap").digest
    assert digest == summary(tmp_path / "run")["digest"], text


def test_latency_does_not_change_a_lockstep_flight(tmp_path: Path) -> None:
    name, overrides = CASES["fault-drill"]
    late = ("simulation.latency_s=0.003", "simulation.jitter_s=0.02")
    cut = "simulation.partition=[{at_s=0.5,duration_s=1.0,processes=['controller','chaser/1']}]"
    digests = []
    for k, conditions in enumerate(((), (*late, cut))):
        flight = simulated(name, tmp_path / str(k), *overrides, *conditions)
        assert set(flight.statuses.values()) == {0}
        digests.append(load_flight(tmp_path / str(k) / "mission.mcap").digest)
    assert digests[0] == digests[1]


_HARSH = (
    "simulation.mode='realtime'",
    "simulation.latency_s=0.002",
    "simulation.jitter_s=0.004",
    "simulation.loss=0.05",
    "simulation.duplicate=0.05",
    "simulation.reorder=0.05",
    "simulation.clock=[{process='controller',drift=0.01}]",
)


def test_a_seed_repeats_every_byte_whatever_the_hash_seed(tmp_path: Path) -> None:
    overrides = ("duration_s=2.0", *DRILL, *_HARSH)
    contents = []
    for k in range(2):
        code = (
            "import sys, pathlib; from chaserdock.simulation.mission import simulate;"
            "simulate(pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]), tuple(sys.argv[3:]))"
        )
        arguments = [str(ROOT / "scenarios" / "fault-drill.toml"), str(tmp_path / str(k)), *overrides]
        environment = {**os.environ, "PYTHONHASHSEED": str(k)}
        subprocess.run([sys.executable, "-c", code, *arguments], env=environment, cwd=ROOT, check=True)
        contents.append([(r.key, r.message, r.sent_ns) for r in read_log(tmp_path / str(k) / "mission.mcap")])
    assert len(contents[0]) > 500
    assert contents[0] == contents[1]
