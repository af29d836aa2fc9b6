# SPDX-License-Identifier: Apache-2.0
"""The mission log: what goes in comes out, for us and for tools that know nothing of us."""

from __future__ import annotations

import gzip
import io
import json
import os
import platform
import re
import subprocess
import sys
import time
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgpack
import pytest
from chaserdock_protocol import codec, topics
from chaserdock_protocol import messages as m
from chaserdock_protocol.recording import chunk_index, log, provenance
from chaserdock_protocol.recording.log import (
    LOCK_ATTACHMENT,
    SCENARIO_ATTACHMENT,
    VERSIONS_ATTACHMENT,
    LogError,
    LogWriter,
    count_messages,
    read_log,
    read_scenario,
)
from harness import ROOT
from log_samples import SCENARIO, Clock, flight, record
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer

PRESENCE = m.Presence(process="world", instance="i", heard={})


def written(path: Path, ticks: int = 20) -> list[tuple[str, m.Message, int]]:
    """Writes a whole log; what is in it: key, message, wall clock."""
    writer, out = LogWriter(path), []
    writer.describe(SCENARIO, {"run_id": "r1", "mode": "lockstep"})
    for n, (topic, place, message) in enumerate(flight(ticks)):
        record(writer, topic, place, message, 1_000_000 + n)
        out.append((topic.key_of(place), message, 1_000_000 + n))
    writer.close()
    return out


# -- round trip ------------------------------------------------------------------------------------


def test_messages_are_read_in_the_order_written(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    expected = written(path)
    records = list(read_log(path))
    assert [(r.key, r.message, r.sent_ns) for r in records] == expected
    assert {r.place for r in records} == {None, "0", "1", "chaser/0", "chaser/1"}
    for r in records:
        assert r.topic.key_of(r.place) == r.key
        assert type(r.message) is r.topic.kind


def test_a_log_states_the_blas_in_use(tmp_path: Path) -> None:
    written(tmp_path / "a.mcap")
    assert read_scenario(tmp_path / "a.mcap")[1]["blas"] == provenance.blas_in_use()
    if not provenance.blas_in_use().startswith("openblas") or platform.machine() != "x86_64":
        pytest.skip("only OpenBLAS on x86-64 has this processor type")
    code = "from chaserdock_protocol.recording.provenance import blas_in_use; print(blas_in_use())"
    environment = os.environ | {"OPENBLAS_CORETYPE": "Nehalem"}
    command = [sys.executable, "-c", code]
    stated = subprocess.run(
        command, env=environment, check=True, capture_output=True, text=True
    ).stdout
    assert re.fullmatch(r"openblas \d+\.\d+\.\S+ Nehalem\n", stated)


def librarys_writer(stream: Any, compressed: bool = True) -> Writer:
    compression = CompressionType.ZSTD if compressed else CompressionType.NONE
    return Writer(
        stream, chunk_size=chunk_index.CHUNK_BYTES, compression=compression, enable_data_crcs=True
    )


@pytest.mark.parametrize("compressed", [True, False])
def test_the_file_is_the_librarys_own_to_the_byte(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, compressed: bool
) -> None:
    """Full chunks and flushed ones, times that go back, both layers, channels that come late or
    stay empty.
    """
    # If the library renames this attribute, replacing it has no effect.
    private = {
        name: type(value).__name__ for name, value in vars(librarys_writer(io.BytesIO())).items()
    }
    assert private["_Writer__chunk_indices"] == "list"

    def made(path: Path) -> bytes:
        monkeypatch.setattr(time, "time_ns", lambda: 17)
        writer, schema = LogWriter(path, Clock(), compressed), ("Seen", "protobuf", b"of it")
        writer.describe(SCENARIO, {"run_id": "r1"})
        for n, (topic, place, message) in enumerate(flight(30)):
            record(writer, topic, place, message, 5)
            writer.write_view(f"/viewer/{n % 3}", schema, bytes(n), 10**9 - n)
            if n % 50 == 20:
                writer.flush()
            if n % 9 == 4:
                writer.write(f"foreign/{n}", "text/plain", bytes(250_000), 2**64 - 1)
        writer.note("in between", {"a": "b"})
        writer._register("late/and/empty", "text/plain")
        writer.write("foreign/4", "text/plain", bytes(chunk_index.CHUNK_BYTES), 6)
        writer.write("foreign/4", "text/plain", b"the last", 7)
        writer.close()
        return path.read_bytes()

    ours = made(tmp_path / "ours.mcap")
    monkeypatch.setattr(log, "create_writer", librarys_writer)
    assert made(tmp_path / "theirs.mcap") == ours
    assert (len(ours) < 500_000) == compressed
    with (tmp_path / "ours.mcap").open("rb") as file:
        summary = make_reader(file, validate_crcs=True).get_summary()
    assert summary is not None
    assert len(summary.chunk_indexes) > 6


def test_an_empty_file_is_the_librarys_own_to_the_byte(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    LogWriter(tmp_path / "ours.mcap").close()
    monkeypatch.setattr(log, "create_writer", librarys_writer)
    LogWriter(tmp_path / "theirs.mcap").close()
    assert (tmp_path / "ours.mcap").read_bytes() == (tmp_path / "theirs.mcap").read_bytes()


def test_chunk_indexes_are_kept_small(tmp_path: Path) -> None:
    writer = LogWriter(tmp_path / "a.mcap")
    for topic, place, message in flight(30):
        record(writer, topic, place, message, 5)
        writer.flush()
    indexes = vars(writer._writer)["_Writer__chunk_indices"]
    assert len(indexes) == len(list(flight(30)))
    assert sys.getsizeof(indexes._records) < 200 * len(indexes)
    writer.close()


def test_time_given_by_the_caller_gives_the_same_file(tmp_path: Path) -> None:
    """The recorder passes the time of messages that it has decoded anyway."""
    for name in ("decoded", "passed"):
        writer = LogWriter(tmp_path / name)
        for topic, place, message in [*flight(5), (topics.PRESENCE, "world", PRESENCE), *flight(2)]:
            time_ns = message.sim_time_ns if name == "passed" else None
            key, encoding = topic.key_of(place), m.encoding_of(topic.kind)
            writer.write(key, encoding, codec.encode(message), 5, time_ns)
        writer.close()
    assert (tmp_path / "decoded").read_bytes() == (tmp_path / "passed").read_bytes()


def test_keys_select_and_counts_count(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    expected = written(path, 7)
    wanted = [topics.TICK.key_of(), topics.ODOMETRY.key_of(1)]
    assert [r.message for r in read_log(path, wanted)] == [
        x for key, x, _ in expected if key in wanted
    ]
    assert list(read_log(path, [])) == []
    assert count_messages(path) == {
        "truth/body/chaser/0": 7,
        "truth/body/chaser/1": 7,
        "world/chaser/0/odometry": 7,
        "world/chaser/1/image": 7,
        "world/chaser/1/odometry": 7,
        "world/tick": 7,
    }


def test_scenario_and_versions_lie_in_the_log(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    written(path, 1)
    scenario, data = read_scenario(path)
    assert scenario == SCENARIO
    assert data["run_id"] == "r1"
    assert data["mode"] == "lockstep"
    assert data["version.chaserdock"] == version("chaserdock")
    assert data.get("commit") == provenance.commit_of()
    assert data["version.numpy"].count(".") >= 1


def test_commit_of_a_checkout_tells_changed_files(tmp_path: Path) -> None:
    assert provenance.commit_of.__wrapped__(tmp_path) is None
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)
    (tmp_path / "a").write_text("1")
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b"]
    for command in (["add", "a"], ["commit", "-qm", "a"]):
        subprocess.run([*git, *command], check=True)
    clean = provenance.commit_of.__wrapped__(tmp_path)
    assert re.fullmatch("[0-9a-f]{12}", clean or "")
    (tmp_path / "a").write_text("2")
    assert provenance.commit_of.__wrapped__(tmp_path) == f"{clean}-dirty"


# -- other people's readers ------------------------------------------------------------------------


def test_mcaps_own_reader_and_plain_msgpack_read_it_all(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    expected = written(path)
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        header = reader.get_header()
        assert header.profile == "chaserdock"
        assert header.library.startswith("chaserdock ")
        seen = list(reader.iter_messages(log_time_order=False))
        attachments = list(reader.iter_attachments())
        summary = reader.get_summary()
    assert len(seen) == len(expected)
    sequence: dict[str, int] = {}
    for (schema, channel, message), (key, original, sent_ns) in zip(seen, expected, strict=True):
        assert channel.topic == key
        assert channel.message_encoding == "msgpack"
        assert message.data == codec.encode(original)  # verbatim
        values = msgpack.unpackb(message.data)
        assert values["tick"] == original.tick
        assert list(values) == list(original.__struct_fields__)
        assert message.log_time == original.sim_time_ns
        assert message.publish_time == sent_ns
        assert message.sequence == sequence.get(key, 0)
        sequence[key] = message.sequence + 1
        assert schema is not None
        assert schema.encoding == "jsonschema"
        assert schema.name == m.encoding_of(type(original)).rpartition(";")[2]
        assert channel.metadata["zenoh_encoding"] == m.encoding_of(type(original))
        properties = json.loads(schema.data)["$defs"][type(original).__name__]["properties"]
        assert set(properties) == set(values)
    assert (attachments[0].name, attachments[0].data) == (SCENARIO_ATTACHMENT, SCENARIO.encode())
    assert {a.name: a.media_type for a in attachments} == {
        SCENARIO_ATTACHMENT: "application/json",
        VERSIONS_ATTACHMENT: "application/json",
        LOCK_ATTACHMENT: "application/gzip",
    }
    held = {a.name: a.data for a in attachments}
    assert json.loads(held[VERSIONS_ATTACHMENT])["numpy"] == version("numpy")
    assert gzip.decompress(held[LOCK_ATTACHMENT]) == (ROOT / "uv.lock").read_bytes()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == len(expected)
    assert {c.topic for c in summary.channels.values()} == {key for key, _, _ in expected}


def test_every_topic_gets_its_schema(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = LogWriter(path)
    keys = {}
    for topic in topics.TOPICS:
        place = 3 if "{chaser}" in topic.key else "chaser/3" if "{process}" in topic.key else None
        keys[topic.key_of(place)] = topic
        writer.write(topic.key_of(place), m.encoding_of(topic.kind), b"\x80", 5)
    writer.close()
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None
    assert {c.topic for c in summary.channels.values()} == set(keys)
    for channel in summary.channels.values():
        assert summary.schemas[channel.schema_id].data == m.schema_of(keys[channel.topic].kind)


def test_log_digest_does_not_depend_on_the_wall_clock(tmp_path: Path) -> None:
    a, b = tmp_path / "a.mcap", tmp_path / "b.mcap"
    written(a)
    written(b)
    assert [r.message for r in read_log(a)] == [r.message for r in read_log(b)]


# -- not everything is a good message --------------------------------------------------------------

GARBAGE = [
    b"",
    b"\xc1garbage",
    b"\xff" * 50,
    msgpack.packb("just text"),
    msgpack.packb({"sim_time_ns": "noon"}),
    msgpack.packb({"sim_time_ns": -5}),
    msgpack.packb({"sim_time_ns": 2**64 - 1}),
    msgpack.packb({"sim_time_ns": None}),
    b"\x81\xa1\xff\x00",
    b"\x81\xab\xff\xfe_time_n\xff\x00",
    b"\x81\xa1x" + b"\x91" * 200_000,
]


def test_garbage_is_recorded_verbatim_counted_and_not_handed_out(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = LogWriter(path)
    key, encoding = topics.ODOMETRY.key_of(0), m.encoding_of(m.Odometry)
    good = next(x for t, p, x in flight(3) if t is topics.ODOMETRY and x.tick == 2 and p == 0)
    record(writer, topics.ODOMETRY, 0, good, 5)
    for payload in GARBAGE:
        writer.write(key, encoding, payload, 6)
    record(writer, topics.ODOMETRY, 0, good, 7)
    # Those whose header cannot be read are counted as unreadable; a time below zero is read, and
    # taken as zero.
    assert writer.messages == len(GARBAGE) + 2
    assert 7 <= writer.unreadable <= 9
    writer.close()
    assert [(r.message, r.sent_ns) for r in read_log(path)] == [(good, 5), (good, 7)]
    assert count_messages(path) == {key: len(GARBAGE) + 2}
    with path.open("rb") as file:
        stored = [x.data for _, _, x in make_reader(file).iter_messages(log_time_order=False)]
    assert stored == [codec.encode(good), *GARBAGE, codec.encode(good)]


def test_unreadable_messages_take_the_time_of_the_one_before(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = LogWriter(path)
    record(writer, topics.TICK, None, m.Tick(sim_time_ns=77, images=False, chasers=()), 5)
    writer.write("world/tick", m.encoding_of(m.Tick), b"\xc1", 0)
    assert writer.unreadable == 1
    writer.close()
    with path.open("rb") as file:
        stored = [(x.log_time, x.publish_time) for _, _, x in make_reader(file).iter_messages()]
    assert stored == [(77, 5), (77, 77)]


def test_foreign_keys_and_versions_are_kept_and_not_handed_out(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = LogWriter(path)
    payload = codec.encode(m.RecorderAck(tick=3))
    writer.write("somebody/else", "text/plain", b"hello", 5)
    writer.write(topics.ACK.key_of(), m.encoding_of(m.RecorderAck).replace("v1", "v2"), payload, 6)
    writer.write(topics.ACK.key_of(), m.encoding_of(m.RecorderAck), payload, 7)
    writer.close()
    assert [r.sent_ns for r in read_log(path)] == [7]
    assert count_messages(path) == {"recorder/ack": 2, "somebody/else": 1}
    with path.open("rb") as file:
        kinds = [
            (channel.message_encoding, schema.name if schema else None, x.data)
            for schema, channel, x in make_reader(file).iter_messages(log_time_order=False)
        ]
    assert kinds == [
        ("unknown", "unknown", b"hello"),
        ("msgpack", "unknown", payload),
        ("msgpack", "chaserdock.RecorderAck.v1", payload),
    ]


# -- files -----------------------------------------------------------------------------------------


def test_a_log_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    written(path)
    before = path.read_bytes()
    with pytest.raises(LogError, match="already exists; a log is never overwritten"):
        LogWriter(path)
    assert path.read_bytes() == before
    with pytest.raises(LogError, match="cannot be created: No such file or directory"):
        LogWriter(tmp_path / "nowhere" / "a.mcap")


def test_files_that_are_no_log_are_one_clear_line(tmp_path: Path) -> None:
    for reader in (read_scenario, count_messages, lambda p: list(read_log(p))):
        with pytest.raises(LogError, match="cannot be read: No such file or directory"):
            reader(tmp_path / "none.mcap")
        with pytest.raises(LogError, match=r"holds no log \(mission.mcap"):
            reader(tmp_path)
    other = tmp_path / "other.mcap"
    for content in (b"", b"text, and not a log at all " * 20, bytes(1000)):
        other.write_bytes(content)
        with pytest.raises(LogError, match="no MCAP log"):
            read_scenario(other)
        with pytest.raises(LogError, match="no MCAP log"):
            list(read_log(other))
        with pytest.raises(LogError, match="no MCAP log"):
            count_messages(other)


def test_log_without_scenario_is_rejected(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = LogWriter(path)
    record(writer, topics.ACK, None, m.RecorderAck(tick=1), 1)
    writer.close()
    with pytest.raises(LogError, match="holds no scenario; was it recorded by chaserdock"):
        read_scenario(path)
