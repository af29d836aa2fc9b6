# SPDX-License-Identifier: Apache-2.0
"""Whole missions: separate processes over real Zenoh, in lock-step, and that nothing about the machine matters."""

from __future__ import annotations

import math
import signal
import time
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from chaserdock_protocol import topics
from chaserdock_protocol.recording.log import count_messages
from chaserdock_protocol.topics import TOPICS, topic_of_key
from harness import SHORT, ByHand, chaserdock, find_child, run, sets, summary, wait_for_log
from mcap.reader import make_reader

from chaserdock.analysis.flight import load_flight

TWO = "two-chaser-tracking"
OTHER_SIMD = {
    "OPENCV_CPU_DISABLE": "AVX512-SKX,AVX512-COMMON,AVX2,FMA3,AVX",
    "NPY_DISABLE_CPU_FEATURES": "AVX512F AVX2 FMA3",
    "OPENBLAS_CORETYPE": "Prescott",
}
"""OpenCV, NumPy and the BLAS one or two levels below what this machine has."""


def test_same_flight_twice(short_flight: Path, tmp_path: Path) -> None:
    status, said = run(TWO, tmp_path / "again", *SHORT, arguments=["--quiet"])
    assert status == 0, said
    assert summary(tmp_path / "again")["digest"] == summary(short_flight)["digest"]


def test_other_seed_is_another_flight(short_flight: Path, tmp_path: Path) -> None:
    status, said = run(TWO, tmp_path / "other", *SHORT, arguments=["--seed", "7"])
    assert status == 0, said
    assert summary(tmp_path / "other")["seed"] == 7
    assert summary(tmp_path / "other")["digest"] != summary(short_flight)["digest"]


def test_started_by_hand_in_another_order(short_flight: Path, tmp_path: Path) -> None:
    """Recorder and chasers first, the world last, as in separate terminals."""
    by_hand = ByHand.at_free_port("by-hand")
    try:
        by_hand.start("recorder", "record", "--out", str(tmp_path))
        by_hand.start("chaser/1", "chaser", "1")
        time.sleep(1.0)
        by_hand.start("controller", "controller")
        by_hand.start("chaser/0", "chaser", "0")
        time.sleep(1.0)
        by_hand.start("world", "world", TWO, *sets(*SHORT))
        for name in ("world", "chaser/0", "chaser/1", "controller", "recorder"):
            status, said = by_hand.said(name)
            assert status == 0, f"{name}: {said}"
    finally:
        by_hand.end()
    assert load_flight(tmp_path / "mission.mcap").digest == summary(short_flight)["digest"]


@pytest.mark.slow
def test_stopped_processes_change_nothing(short_flight: Path, tmp_path: Path) -> None:
    """Controller, a chaser and the recorder are each stopped for ten seconds and continued."""
    mission = chaserdock("run", TWO, "--out", str(tmp_path / "run"), "-q", *sets(*SHORT))
    try:
        for words in (("controller",), ("chaser", "1"), ("record",)):
            wait_for_log(tmp_path / "run" / "mission.mcap", 200_000)
            child = find_child(mission, *words)
            child.suspend()
            time.sleep(10.0)
            child.resume()
        assert mission.wait(timeout=120) == 0
    finally:
        mission.kill()
        mission.wait()
    assert summary(tmp_path / "run")["digest"] == summary(short_flight)["digest"]
    assert summary(tmp_path / "run")["wall_time_s"] > 20.0  # they were stopped while it flew


def farthest_apart_m(one: Path, other: Path) -> dict[str, float]:
    """By body, how far apart two flights ever were; they must not be equal to the last bit."""
    a, b = load_flight(one / "mission.mcap"), load_flight(other / "mission.mcap")
    assert a.digest != b.digest
    return {
        name: float(np.linalg.norm(track.position_m - b.truth[name].position_m, axis=1).max())
        for name, track in a.truth.items()
    }


@pytest.mark.slow
def test_other_simd_level_short(short_flight: Path, tmp_path: Path) -> None:
    status, said = run(TWO, tmp_path / "simd", *SHORT, env=OTHER_SIMD)
    assert status == 0, said
    assert max(farthest_apart_m(short_flight, tmp_path / "simd").values()) < 1e-3


def test_log_holds_every_topic_in_its_numbers(short_flight: Path) -> None:
    counts = count_messages(short_flight / "mission.mcap")
    ticks = 6 * 15
    for key, count in counts.items():
        found = topic_of_key(key)
        assert found is not None, key
        # What is also told after the last tick comes once more.
        if found[0].rate in ("tick", "image"):
            assert ticks - 1 <= count <= ticks + 1, key
        elif found[0].rate == "second":
            assert 1 <= count <= 8, key
    held = {id(found[0]) for key in counts if (found := topic_of_key(key)) is not None}
    missing = {topic.key for topic in TOPICS if id(topic) not in held}
    # Nobody commanded anything, there are no thrusters and no ports, and no controller stands by.
    absent = (topics.COMMAND, topics.OPERATED, topics.THRUSTERS, topics.DOCKING, topics.STATE)
    assert missing == {t.key for t in absent}


def test_log_is_read_by_others(short_flight: Path) -> None:
    """mcap's own reader, the plain msgpack package, a schema for every channel, no gap in any numbering."""
    with (short_flight / "mission.mcap").open("rb") as file:
        reader = make_reader(file)
        last: dict[str, int] = {}
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            assert schema is not None
            if channel.topic.startswith("/viewer/"):
                assert schema.encoding == channel.message_encoding == "protobuf"
                continue
            assert schema.encoding == "jsonschema"
            assert channel.message_encoding == "msgpack"
            values = msgpack.unpackb(message.data)
            if values["sim_time_ns"]:
                assert message.log_time == values["sim_time_ns"]
            if not channel.topic.endswith("presence"):
                assert values["seq"] == last.get(channel.topic, -1) + 1, channel.topic
                last[channel.topic] = values["seq"]
        names = {a.name for a in reader.iter_attachments()}
        metadata: dict[str, Any] = {m.name: m.metadata for m in reader.iter_metadata()}
    assert "scenario.json" in names
    assert "version.numpy" in metadata["chaserdock"]


def test_late_processes_are_named(tmp_path: Path) -> None:
    """Ctrl-C while the world still waits for others ends it at once."""
    by_hand = ByHand.at_free_port("waiting")
    try:
        world = by_hand.start("world", "world", TWO, *sets(*SHORT))
        time.sleep(3.0)
        world.send_signal(signal.SIGINT)
        status, said = by_hand.said("world", timeout_s=20)
    finally:
        by_hand.end()
    assert status == 1
    assert "waiting for chaser/0, chaser/1, controller, recorder" in said


@pytest.mark.slow
def test_realtime_flies(tmp_path: Path) -> None:
    _, said = run("single", tmp_path / "run", *SHORT, arguments=["--mode", "realtime"])
    result = summary(tmp_path / "run")
    assert result["mode"] == "realtime"
    assert result["ticks"] == 90, said
    assert result["latency_s"]["p50"] > 0
    assert result["collisions"] == 0


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["single", TWO])
def test_tracking_missions(scenario: str, tmp_path: Path) -> None:
    """The scenarios' own criteria: steady 8 mm and 0.3 degrees, estimate never off by 1 cm or 1 degree."""
    status, said = run(scenario, tmp_path / "run", timeout_s=1200)
    assert status == 0, said
    estimate = summary(tmp_path / "run")["target_estimate"]
    assert estimate["max_position_error_m"] < 0.01
    assert estimate["max_orientation_error_rad"] < math.radians(1.0)


@pytest.mark.slow
def test_collision_avoidance(tmp_path: Path) -> None:
    """Past the target to its other side on what the other chaser sees, never below 0.35 m, there within 60 s."""
    status, said = run("collision-avoidance", tmp_path / "run")
    assert status == 0, said
    result = summary(tmp_path / "run")
    assert result["chasers"]["0"]["min_distance_target_m"] >= 0.35
    assert result["chasers"]["0"]["reached_time_s"] <= 70.0
    flight = load_flight(tmp_path / "run" / "mission.mcap")
    # At the end chaser 0 looks away from the target: it has seen nothing for a while.
    assert not flight.sightings[0].seen[-150:].any()
    assert result["target_estimate"]["max_position_error_m"] < 0.01


@pytest.mark.slow
def test_main_job_on_another_simd_level(main_job: Path, tmp_path: Path) -> None:
    status, said = run("four-chaser-docking", tmp_path / "run", timeout_s=1800, env=OTHER_SIMD)
    assert status == 0, said
    assert max(farthest_apart_m(main_job, tmp_path / "run").values()) < 1e-3


@pytest.mark.slow
def test_four_chaser_docking(main_job: Path) -> None:
    result = summary(main_job)
    assert result["success"]
    assert result["collisions"] == 0
    assert result["min_distance_chasers_m"] >= 0.35
    for i, c in result["chasers"].items():
        assert c["docked"] == (i in ("0", "3"))
        assert c["min_distance_target_m"] >= 0.35
        assert math.sqrt(c["steady"]["position_mse_m2"]) < 0.008
        assert math.sqrt(c["steady"]["orientation_mse_rad2"]) < math.radians(0.3)
    assert result["peak_memory_bytes"] < 1.5e9
    assert result["messages"]["controller/command"]["count"] == 2
    assert all(m["lost"] == 0 for m in result["messages"].values())
