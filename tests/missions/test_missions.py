# SPDX-License-Identifier: Apache-2.0
"""Complete missions with separate processes over Zenoh: success, determinism, contents of the
log.
"""

from __future__ import annotations

import signal
import time
from pathlib import Path
from typing import Any

import msgpack
import pytest
from chaserdock_protocol import topics
from chaserdock_protocol.recording.log import count_messages
from chaserdock_protocol.topics import TOPICS, topic_of_key
from harness import (
    SHORT,
    ByHand,
    chaserdock,
    find_child,
    run,
    sets,
    simulated_digest,
    summary,
    wait_for_log,
)
from mcap.reader import make_reader

from chaserdock.analysis.flight import load_flight
from chaserdock.exit_codes import STOPPED

TWO = "two-chaser-tracking"


@pytest.mark.slow
def test_other_seed_gives_another_digest(short_flight: Path, tmp_path: Path) -> None:
    other = simulated_digest(TWO, tmp_path, *SHORT, "seed=7")
    assert other != summary(short_flight)["digest"]


@pytest.mark.slow
def test_digest_is_independent_of_start_order(short_flight: Path, tmp_path: Path) -> None:
    """Recorder and chasers first, the world last, each started by its own command."""
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
            status, output = by_hand.output_of(name)
            assert status == 0, f"{name}: {output}"
    finally:
        by_hand.end()
    assert load_flight(tmp_path / "mission.mcap").digest == summary(short_flight)["digest"]


@pytest.mark.slow
def test_digest_is_independent_of_suspended_processes(short_flight: Path, tmp_path: Path) -> None:
    """Suspend controller, chaser 1 and recorder for two seconds each."""
    mission = chaserdock("run", TWO, "--out", str(tmp_path / "run"), "-q", *sets(*SHORT))
    try:
        for words in (("controller",), ("chaser", "1"), ("record",)):
            wait_for_log(tmp_path / "run" / "mission.mcap", 200_000)
            child = find_child(mission, *words)
            child.suspend()
            time.sleep(2.0)
            child.resume()
        assert mission.wait(timeout=120) == 0
    finally:
        mission.kill()
        mission.wait()
    assert summary(tmp_path / "run")["digest"] == summary(short_flight)["digest"]
    assert summary(tmp_path / "run")["wall_time_s"] > 4.0  # they were suspended during the flight


def test_log_contains_every_topic_at_its_rate(short_flight: Path) -> None:
    counts = count_messages(short_flight / "mission.mcap")
    ticks = 6 * 15
    for key, count in counts.items():
        found = topic_of_key(key)
        assert found is not None, key
        # Topics that are also published after the last tick have one message more.
        if found[0].rate in ("tick", "image"):
            assert ticks - 1 <= count <= ticks + 1, key
        elif found[0].rate == "second":
            assert 1 <= count <= 8, key
    recorded = {id(found[0]) for key in counts if (found := topic_of_key(key)) is not None}
    missing = {topic.key for topic in TOPICS if id(topic) not in recorded}
    # No operator commands, thrusters, docking ports, standby, plumes, passive safety or assurance
    # in this flight.
    ports = (topics.DOCKING, topics.TRUTH_LOAD, topics.STACK)
    absent = (
        topics.COMMAND,
        topics.OPERATED,
        topics.THRUSTERS,
        *ports,
        topics.STATE,
        topics.TRUTH_PLUME,
        topics.SAFETY,
        topics.ASSURANCE,
        *(topics.FEATURES, topics.MAP),  # of an unknown target
        *(topics.KILL, topics.BODY_REFERENCE),  # of a laboratory
    )
    assert missing == {t.key for t in absent}


def test_log_is_readable_with_mcap_and_msgpack(short_flight: Path) -> None:
    """Every channel has a schema and consecutive sequence numbers."""
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


@pytest.mark.slow
def test_waiting_world_names_missing_processes_and_can_be_interrupted() -> None:
    by_hand = ByHand.at_free_port("waiting")
    try:
        world = by_hand.start("world", "world", TWO, *sets(*SHORT))
        assert world.stdout is not None
        line = next(line for line in world.stdout if b"waiting for" in line)
        world.send_signal(signal.SIGINT)
        rest = world.stdout.read()
        assert world.wait(timeout=60) == STOPPED
    finally:
        by_hand.end()
    assert b"waiting for chaser/0, chaser/1, controller, recorder" in line
    assert b"stopped before the first tick" in rest


@pytest.mark.slow
def test_realtime_flight_completes(tmp_path: Path) -> None:
    options = ["--mode", "realtime", "--seed", "7"]
    _, output = run("single", tmp_path / "run", *SHORT, arguments=options)
    result = summary(tmp_path / "run")
    assert result["seed"] == 7
    assert result["mode"] == "realtime"
    assert result["ticks"] == 90, output
    assert result["latency_s"]["p50"] > 0
    assert result["collisions"] == 0
