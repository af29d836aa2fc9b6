# SPDX-License-Identifier: Apache-2.0
"""Simulated missions: equal to separate processes over Zenoh, and to themselves, bit for bit."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chaserdock_protocol import codec
from chaserdock_protocol.messages import ActuatorCommand, WrenchCommand
from chaserdock_protocol.recording.log import read_log
from chaserdock_protocol.transport import RawSample
from harness import DRILL, ROOT, SHORT, simulated_digest, summary

from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.summary import summarize
from chaserdock.simulation import mission
from chaserdock.simulation.mission import simulate
from chaserdock.simulation.network import SimulatedNetwork

BRIEF = ("duration_s=2.0", "timeline=[]", "success.docked=[]", "settling_s=1.0")
OTHER_SIMD = {
    "OPENCV_CPU_DISABLE": "AVX512-SKX,AVX512-COMMON,AVX2,FMA3,AVX",
    "NPY_DISABLE_CPU_FEATURES": "AVX512F AVX2 FMA3",
    "OPENBLAS_CORETYPE": "Prescott",
}
"""Disables AVX and newer instructions in OpenCV, NumPy and OpenBLAS."""


def simulate_elsewhere(out: Path, *overrides: str, env: dict[str, str]) -> None:
    """Simulate ``fault-drill`` in an interpreter with other environment variables."""
    code = (
        "import sys, pathlib; from chaserdock.simulation.mission import simulate;"
        "simulate(pathlib.Path(sys.argv[1]), pathlib.Path(sys.argv[2]), tuple(sys.argv[3:]))"
    )
    arguments = [str(ROOT / "scenarios" / "fault-drill.toml"), str(out), *overrides]
    subprocess.run(
        [sys.executable, "-c", code, *arguments], env={**os.environ, **env}, cwd=ROOT, check=True
    )


@pytest.mark.slow
@pytest.mark.parametrize(
    ("flown", "overrides"),
    [("short_flight", ("two-chaser-tracking", *SHORT)), ("drill_flight", DRILL)],
)
def test_digest_equals_that_of_separate_processes_over_zenoh(
    flown: str, overrides: tuple[str, ...], request: pytest.FixtureRequest, tmp_path: Path
) -> None:
    """So do those with faults, a standby and thrusters, in the tests of those."""
    folder = request.getfixturevalue(flown)
    assert simulated_digest(overrides[0], tmp_path, *overrides[1:]) == summary(folder)["digest"]


@pytest.mark.slow
def test_innovations_in_flight_are_as_large_as_their_covariance_states(tmp_path: Path) -> None:
    """Ranging has white errors: the mean of 570 six-dimensional ones is 1 to four standard
    errors, on either side. One in 40 is beyond the band, at most twice as many.
    """
    changes = ("duration_s=60.0", "settling_s=3.0", "timeline=[]")
    simulate(ROOT / "scenarios" / "v-bar.toml", tmp_path, changes)
    (shown,) = (c["innovations"] for c in summarize(tmp_path)["chasers"].values())
    number = shown["used"] + shown["rejected"]
    assert number == 570
    assert abs(shown["mean_per_freedom"] - 1.0) < 4.0 * np.sqrt(2.0 / (6 * number))
    assert 0.005 < shown["above_share"] < 0.05


def test_latency_does_not_change_a_lockstep_flight(tmp_path: Path) -> None:
    late = ("simulation.latency_s=0.003", "simulation.jitter_s=0.02")
    cut = "simulation.partition=[{at_s=0.5,duration_s=1.0,processes=['controller','chaser/1']}]"
    digests = []
    for k, conditions in enumerate(((), (*late, cut))):
        path = ROOT / "scenarios" / "fault-drill.toml"
        flight = simulate(path, tmp_path / str(k), (*BRIEF, *conditions))
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


@pytest.mark.slow
def test_a_seed_repeats_every_byte_for_any_hash_seed(tmp_path: Path) -> None:
    contents = []
    for k in range(2):
        simulate_elsewhere(tmp_path / str(k), *BRIEF, *_HARSH, env={"PYTHONHASHSEED": str(k)})
        contents.append(
            [(r.key, r.message, r.sent_ns) for r in read_log(tmp_path / str(k) / "mission.mcap")]
        )
    assert len(contents[0]) > 500
    assert contents[0] == contents[1]


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_chasers_fly_both_controllers_in_the_tick_in_which_the_commander_dies(
    mode: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It dies after two of its four commands. Those of the standby are the same, so that no body
    moves otherwise.
    """
    networks: list[SimulatedNetwork] = []
    dies_at, sent = 8, 0

    def network(*arguments: Any) -> SimulatedNetwork:
        networks.append(SimulatedNetwork(*arguments))
        return networks[-1]

    def die(sender: str, raw: RawSample) -> None:
        nonlocal sent
        if sender != "controller" or not raw.key.endswith("wrench"):
            return
        sent += codec.decode(WrenchCommand, raw.payload, raw.encoding).tick == dies_at
        host = networks[-1].host_of("controller")
        if sent == 3 and host is not None:
            host.kill()  # before the third leaves

    monkeypatch.setattr(mission, "SimulatedNetwork", network)
    changes = (
        *BRIEF,
        "controller.standby=true",
        "perception.name='statistical'",
        f"simulation.mode='{mode}'",
    )
    path, flown = ROOT / "scenarios" / "fault-drill.toml", {}
    for name, tap in (("undisturbed", None), ("disturbed", die)):
        flight = simulate(path, tmp_path / name, changes, tap)
        assert (flight.crashes, flight.stalled) == ({}, ())
        flown[name] = load_flight(tmp_path / name / "mission.mcap")
    executed = [r.message for r in read_log(tmp_path / "disturbed" / "mission.mcap")]
    commands = [m for m in executed if isinstance(m, ActuatorCommand) and m.source == "command"]
    terms = {m.chaser: m.term for m in commands if m.tick == dies_at}
    # The news of the death may overtake its last command.
    assert (terms[0], terms[2], terms[3]) == (1, 2, 2)
    assert {m.term for m in commands if m.tick > dies_at} == {2}
    assert {m.term for m in commands if m.tick < dies_at} == {1}
    apart_m = max(
        np.linalg.norm(track.position_m - flown["disturbed"].motion[body].position_m, axis=1).max()
        for body, track in flown["undisturbed"].motion.items()
    )
    assert apart_m == 0.0


def test_a_chaser_falls_back_while_its_controller_is_frozen_in_real_time(tmp_path: Path) -> None:
    """It plans on by itself without commands, refuses stale ones, and follows new ones again."""
    changes = (
        "duration_s=5.0",
        "settling_s=1.0",
        "perception.name='statistical'",
        "simulation.mode='realtime'",
        # Longer than a command is valid.
        "fault=[{kind='freeze', at_s=2.0, duration_s=1.1, process='controller'}]",
    )
    flight = simulate(ROOT / "scenarios" / "single.toml", tmp_path, changes)
    assert (flight.crashes, flight.stalled) == ({}, ())
    log = tmp_path / "mission.mcap"
    records = list(read_log(log, ["chaser/0/actuators"]))
    executed = [r.message for r in records]
    fallback = [m.tick for m in executed if m.source != "command"]
    assert 8 < len(fallback) < 20
    assert max(m.tick for m in executed if m.source == "command") > max(fallback) + 15
    events = [e.what for e in load_flight(log).events if e.process == "chaser/0"]
    assert events == [
        "no command",
        "fallback: plan",
        "command refused",
        "commands accepted again",
        "fallback ends",
    ]
    # No stale command is executed: a command is valid for 0.5 s after its odometry.
    known = [(r.sent_ns, r.message.sim_time_ns) for r in read_log(log, ["world/chaser/0/odometry"])]
    for record in records:
        if record.message.source == "command":
            newest_ns = max(sim_ns for sent_ns, sim_ns in known if sent_ns <= record.sent_ns)
            assert newest_ns - record.message.sim_time_ns < 0.6e9


@pytest.mark.slow
def test_four_chasers_dock_along_the_same_paths_on_another_simd_level(tmp_path: Path) -> None:
    """The complete drill: 5 s at a distance, then an approach to the docking distance."""
    for name, env in (("native", {}), ("other", OTHER_SIMD)):
        simulate_elsewhere(tmp_path / name, env=env)
    native, other = (
        load_flight(tmp_path / name / "mission.mcap").motion for name in ("native", "other")
    )
    separations_m = [
        np.linalg.norm(native[body].position_m - track.position_m, axis=1).max()
        for body, track in other.items()
    ]
    assert len(separations_m) == 5
    # Not zero, or the variables that disable instructions had no effect.
    assert 0.0 < max(separations_m) < 3e-3
