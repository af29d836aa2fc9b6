# SPDX-License-Identifier: Apache-2.0
"""Finished logs: damage and repair, the viewer layer, schema migrations."""

from __future__ import annotations

import resource
import shutil
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from chaserdock_agents.recorder.rotation import Recording
from chaserdock_protocol import codec, topics
from chaserdock_protocol import messages as m
from chaserdock_protocol.process import Rotation
from chaserdock_protocol.recording import schema_migrations as upgrades
from chaserdock_protocol.recording.log import (
    LogError,
    LogWriter,
    count_messages,
    read_log,
    read_scenario,
)
from chaserdock_protocol.recording.scan import FileState, log_files, records, stored_messages
from chaserdock_protocol.scenario import flight_scenario_json, scenario_from_json
from chaserdock_protocol.transport import RawSample
from harness import finished
from mcap.opcode import Opcode
from mcap.reader import make_reader
from message_samples import BY_TYPE

from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.report import write_report
from chaserdock.logs.info import info_of
from chaserdock.logs.recover import Recovered, loss_lines, recover

GOLDEN = Path(__file__).parents[1] / "golden" / "two-chasers.mcap"
ONE_FILE = Rotation()


def raws(log: Path) -> list[tuple[RawSample, Any]]:
    out = []
    for channel, stored in stored_messages(log):
        if channel.topic.startswith("/viewer/"):
            continue
        found = topics.topic_of_key(channel.topic)
        assert found is not None
        raw = RawSample(
            channel.topic, channel.metadata["zenoh_encoding"], stored.data, stored.publish_time
        )
        out.append((raw, upgrades.decode_logged(found[0].kind, raw.payload, raw.encoding)))
    return out


def recorded(
    folder: Path, rotation: Rotation = ONE_FILE, viewer: bool = True, repeat: int = 1
) -> Path:
    """The golden flight, recorded again without a network; ``repeat`` times over."""
    text, run = read_scenario(GOLDEN)
    scenario = scenario_from_json(text, "golden")
    mission = m.JoinReply(
        accepted=True, reason="", run_id=run["run_id"], scenario_json=flight_scenario_json(scenario)
    )
    recording = Recording(folder, mission, text, "full", rotation, scenario if viewer else None)
    for raw, message in raws(GOLDEN) * repeat:
        recording.write(raw, message)
    recording.close()
    return folder


# -- viewer layer ----------------------------------------------------------------------------------


def test_viewer_layer_does_not_change_the_verbatim_layer(tmp_path: Path) -> None:
    with_layer, without = recorded(tmp_path / "a"), recorded(tmp_path / "b", viewer=False)
    assert [r.message for r in read_log(with_layer)] == [r.message for r in read_log(without)]
    assert count_messages(with_layer) == count_messages(without) == count_messages(GOLDEN)
    assert load_flight(with_layer).digest == load_flight(GOLDEN).digest
    # The images' second copy lies in the same compressed chunk as the first.
    images = sum(len(r.message.data) for r in read_log(GOLDEN) if r.topic is topics.IMAGE)
    grown = (with_layer / "mission.mcap").stat().st_size - (without / "mission.mcap").stat().st_size
    assert grown < 0.25 * images


def test_viewer_layer_has_schemas_images_and_frames(tmp_path: Path) -> None:
    path = recorded(tmp_path) / "mission.mcap"
    images = {
        (r.message.chaser, r.message.sim_time_ns): r.message.data
        for r in read_log(path)
        if r.topic is topics.IMAGE
    }
    seen: dict[str, list[Any]] = {}
    with path.open("rb") as file:
        reader = make_reader(file, validate_crcs=True)
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if channel.topic.startswith("/viewer/"):
                assert (schema.encoding, channel.message_encoding) == ("protobuf", "protobuf")
                seen.setdefault(f"{channel.topic} {schema.name}", []).append(message)
    for i in (0, 1):
        shown = seen[f"/viewer/chaser/{i}/image foxglove.CompressedImage"]
        assert len(shown) == 18
        assert all(images[i, message.log_time] in message.data for message in shown)
        assert len(seen[f"/viewer/chaser/{i}/calibration foxglove.CameraCalibration"]) == 18
        assert len(seen[f"/viewer/chaser/{i}/measurement foxglove.PoseInFrame"]) == 18
        assert len(seen[f"/viewer/chaser/{i}/detections foxglove.ImageAnnotations"]) == 18
        assert len(seen[f"/viewer/chaser/{i}/corners foxglove.PointCloud"]) == 18
        assert len(seen[f"/viewer/chaser/{i}/points foxglove.PointCloud"]) == 1
    frames = Counter(
        name
        for message in seen["/viewer/tf foxglove.FrameTransform"]
        for name in (b"target/estimate", b"chaser/0/camera", b"chaser/1", b"target")
        if b"\x1a" + bytes([len(name)]) + name in message.data  # field 3, the child frame
    )
    assert frames == {b"target": 19, b"chaser/1": 19, b"target/estimate": 18, b"chaser/0/camera": 1}
    assert len(seen["/viewer/scene foxglove.SceneUpdate"]) == 1
    assert len(seen["/viewer/target/points foxglove.PointCloud"]) == 1


# -- rotation --------------------------------------------------------------------------------------


@pytest.mark.slow
def test_rotation_by_size_keeps_every_message(tmp_path: Path) -> None:
    folder = recorded(tmp_path / "r", Rotation(size_bytes=400_000), repeat=4)
    parts = log_files(folder)
    assert len(parts) >= 3
    whole = recorded(tmp_path / "w", repeat=4)
    assert [r.message for r in read_log(folder)] == [r.message for r in read_log(whole)]
    assert [r.message for r in read_log(parts)] == [r.message for r in read_log(whole)]
    assert load_flight(folder).digest == load_flight(whole).digest
    page = write_report(folder)
    assert page == folder / "report.html"
    assert (
        page.read_text().count("data:image/jpeg")
        == write_report(whole).read_text().count("data:image/jpeg")
        > 0
    )
    parts[1].unlink()
    with pytest.raises(LogError, match=r"mission-0001.mcap is missing; mission-0002.mcap follows"):
        list(read_log(folder))


def test_folder_with_a_log_is_rejected(tmp_path: Path) -> None:
    recorded(tmp_path)
    with pytest.raises(LogError, match="contains a log already; a log is never overwritten"):
        recorded(tmp_path, Rotation(seconds=1.0))


# -- disks and damage ------------------------------------------------------------------------------


@contextmanager
def files_at_most(size: int) -> Iterator[None]:
    """As a full disk: the operating system refuses to let any file grow beyond ``size``."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("size", [1000, 60_000, 333_333, 3_000_000])
def test_full_disk_is_an_error_and_written_chunks_stay_readable(tmp_path: Path, size: int) -> None:
    with (
        files_at_most(size),
        pytest.raises(LogError, match=r"mission.mcap: cannot be written: File too large"),
    ):
        recorded(tmp_path, repeat=20)
    path = tmp_path / "mission.mcap"
    assert path.stat().st_size <= size
    state = FileState()
    kept = [
        s.data
        for channel, s in stored_messages(path, state)
        if not channel.topic.startswith("/viewer/")
    ]
    assert kept == ([raw.payload for raw, _ in raws(GOLDEN)] * 20)[: len(kept)]
    assert (state.closed, state.cut_bytes) == (False, 0)
    assert size < 2_000_000 or kept  # a chunk is 1 MB at most


def test_closing_on_a_full_disk_is_an_error(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = LogWriter(path, lambda: 0.0)
    writer.write(
        "recorder/ack", m.encoding_of(m.RecorderAck), codec.encode(m.RecorderAck(tick=1)), 1
    )
    with (
        files_at_most(path.stat().st_size + 10),
        pytest.raises(LogError, match="cannot be written"),
    ):
        writer.close()
    assert list(read_log(path)) == []


@pytest.mark.slow
def test_flipped_bytes_are_detected_or_harmless_and_the_rest_is_recovered(tmp_path: Path) -> None:
    path, out = recorded(tmp_path / "r", repeat=4) / "mission.mcap", tmp_path / "out.mcap"
    data, expected = path.read_bytes(), [r.message for r in read_log(path)]
    scenario = read_scenario(path)
    rng, detected = np.random.default_rng(5), 0
    for place in [
        0,
        8,
        9,
        17,
        *rng.integers(0, len(data), 20).tolist(),
        *range(len(data) - 60, len(data), 7),
    ]:
        damaged = bytearray(data)
        damaged[place] ^= 1 << int(rng.integers(8))
        path.write_bytes(bytes(damaged))
        try:
            assert [r.message for r in read_log(path)] == expected, place
            assert read_scenario(path) == scenario
        except LogError:
            detected += 1
            if place < 8:
                continue  # no log at all, by its first bytes
            found = recover(path, out)
            rest = iter(expected)
            saved = [r.message for r in read_log(out)]
            assert all(message in rest for message in saved), place  # as they were, in order
            assert len(saved) >= 0.5 * len(expected), place
            lost = found.broken_records + found.messages_without_channel + found.skipped_bytes
            assert lost > 0 or saved == expected
            out.unlink()
    assert detected > 20


@pytest.mark.slow
def test_cut_anywhere_and_recovered(tmp_path: Path) -> None:
    path, cut, out = (
        recorded(tmp_path / "r", repeat=4) / "mission.mcap",
        tmp_path / "cut.mcap",
        tmp_path / "out.mcap",
    )
    data, expected, refused = path.read_bytes(), [r.message for r in read_log(path)], []
    for end in np.random.default_rng(6).integers(1, len(data), 15).tolist():
        cut.write_bytes(data[:end])
        try:
            recover(cut, out)
        except LogError as error:
            refused.append(str(error).partition(": ")[2])
            assert end < 0.4 * len(data)
            continue
        state = FileState()
        list(stored_messages(out, state))
        assert state.closed
        saved = [r.message for r in read_log(out)]
        assert saved == expected[: len(saved)]
        assert saved == [r.message for r in read_log(cut)]
        out.unlink()
    assert set(refused) <= {"holds no whole message", "no MCAP log"}


def test_lost_chunk_is_detected_without_a_checksum(tmp_path: Path) -> None:
    """A chunk that is cut out of a log whose writer was killed leaves a gap in the channels'
    numbering.
    """
    path, ends = tmp_path / "a.mcap", []
    writer = LogWriter(path, lambda: 0.0)
    for k in range(30):
        writer.write(
            "recorder/ack", m.encoding_of(m.RecorderAck), codec.encode(m.RecorderAck(tick=k)), 1
        )
        if k % 10 == 9:
            writer.flush()
            ends.append(path.stat().st_size)
    data = path.read_bytes()
    path.write_bytes(data[: ends[0]] + data[ends[1] : ends[2]])
    with pytest.raises(LogError, match="recorder/ack: message 20 follows where 10 belongs"):
        list(read_log(path))


def thirty_messages(path: Path) -> tuple[bytes, int]:
    """Write a log of 30 messages. Returns its bytes, and where the record begins that ends the
    data.
    """
    writer = LogWriter(path, lambda: 0.0)
    for k in range(30):
        writer.write(
            "recorder/ack", m.encoding_of(m.RecorderAck), codec.encode(m.RecorderAck(tick=k)), 1
        )
    writer.close()
    return path.read_bytes(), 8 + sum(9 + len(content) for _, content in records(path))


def recovered(path: Path, data: bytes) -> Recovered:
    """Recover damaged bytes of ``thirty_messages``, all of whose messages must be in the copy."""
    path.write_bytes(data)
    out = path.with_name("out.mcap")
    found = recover(path, out)
    assert [r.message.tick for r in read_log(out)] == list(range(30))
    return found


DATA_END_BYTES = 9 + 4
FOOTER_BYTES = 9 + 20


def test_recovery_skips_nothing_where_only_the_summary_is_damaged(tmp_path: Path) -> None:
    data, end = thirty_messages(tmp_path / "a.mcap")
    damaged = bytearray(data)
    damaged[end + DATA_END_BYTES] = 0  # no opcode
    found = recovered(tmp_path / "a.mcap", bytes(damaged))
    assert (found.messages, found.broken_records, found.skipped_bytes) == (30, 0, 0)


@pytest.mark.parametrize("opcode", [0, int(Opcode.MESSAGE)])
def test_recovery_ends_with_the_data_where_nothing_of_the_summary_is_left(
    tmp_path: Path, opcode: int
) -> None:
    """Neither the footer nor the summary's first record states where the data end: the record that
    ends them does.
    """
    data, end = thirty_messages(tmp_path / "a.mcap")
    damaged = bytearray(data[:-FOOTER_BYTES])
    damaged[end + DATA_END_BYTES] = opcode
    found = recovered(tmp_path / "a.mcap", bytes(damaged))
    assert found.ended
    assert found.complete
    assert (found.broken_records, found.skipped_bytes, found.cut_bytes) == (0, 0, 0)
    assert loss_lines(found) == []


@pytest.mark.parametrize("place", [0, 3, 10])  # its opcode, its length, the checksum over all data
def test_recovery_loses_nothing_where_the_end_of_the_data_is_damaged(
    tmp_path: Path, place: int
) -> None:
    data, end = thirty_messages(tmp_path / "a.mcap")
    damaged = bytearray(data)
    damaged[end + place] ^= 0x55
    found = recovered(tmp_path / "a.mcap", bytes(damaged))
    assert (found.ended, found.complete, found.lost_messages) == (True, True, 0)


def test_recovery_says_that_a_log_without_an_end_of_its_data_was_not_closed(tmp_path: Path) -> None:
    data, end = thirty_messages(tmp_path / "a.mcap")
    found = recovered(tmp_path / "a.mcap", data[:end] + data[end + DATA_END_BYTES :])
    assert (found.ended, found.lost_messages) == (False, 0)
    assert loss_lines(found)[-1].startswith("the log was not closed")


@pytest.mark.slow
def test_log_commands(tmp_path: Path) -> None:
    log, cut = tmp_path / "a.mcap", tmp_path / "cut.mcap"
    shutil.copy(GOLDEN, log)
    status, said = finished("log", str(log))
    assert status == 0, said
    assert "two-chaser-tracking, seed 0" in said
    cut.write_bytes(log.read_bytes()[:600_000])  # within the last of three chunks
    status, said = finished("log", str(cut))
    assert status == 1, said
    assert "cut off" in said
    assert "chaserdock log --recover" in said
    status, said = finished("log", str(cut), "--recover", str(tmp_path / "whole.mcap"))
    assert status == 1, said
    assert "lost: messages of the last record, which is cut off; nothing states how many" in said
    status, said = finished("log", str(cut), "--recover", str(log))
    assert (status, "already exists; a log is never overwritten" in said) == (2, True)
    status, said = finished("log", str(tmp_path / "none.mcap"), "--export", str(tmp_path / "x"))
    assert (status, "Traceback" in said) == (2, False)


# -- versions --------------------------------------------------------------------------------------


def test_messages_of_older_versions_are_migrated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As if two versions ago odometry had had its attitude scalar last and its rate in degrees: it
    reads as today's.
    """
    path = tmp_path / "old.mcap"
    now: Any = BY_TYPE[m.Odometry]
    old = msgspec.to_builtins(now)
    w, x, y, z = old.pop("q_wxyz")
    old["q_xyzw"] = (x, y, z, w)
    old["omega_deg_s"] = [180.0 / np.pi * v for v in old.pop("omega_rad_s")]
    writer = LogWriter(path)
    key = topics.ODOMETRY.key_of(255)
    writer.write(key, m.encoding_of(m.Odometry), msgspec.msgpack.encode(old), 1)
    monkeypatch.setitem(m.VERSION, m.Odometry, 4)
    writer.write(key, m.encoding_of(m.Odometry), codec.encode(now), 2)
    writer.close()

    def scalar_first(fields: dict[str, Any]) -> dict[str, Any]:
        x, y, z, w = fields.pop("q_xyzw")
        return {**fields, "q_wxyz": (w, x, y, z)}

    def radians(fields: dict[str, Any]) -> dict[str, Any]:
        return {
            **fields,
            "omega_rad_s": tuple(np.pi / 180.0 * v for v in fields.pop("omega_deg_s")),
        }

    rejected: Counter[str] = Counter()
    assert [r.sent_ns for r in read_log(path, rejected=rejected)] == [2]
    assert rejected == {f"{key}: encoding": 1}
    monkeypatch.setitem(upgrades.UPGRADES, ("Odometry", 2), scalar_first)
    assert [r.sent_ns for r in read_log(path)] == [2]  # no way from 3 to 4 yet
    monkeypatch.setitem(upgrades.UPGRADES, ("Odometry", 3), radians)
    first, second = (r.message for r in read_log(path))
    assert second == now
    assert first.q_wxyz == now.q_wxyz
    assert first.omega_rad_s == pytest.approx(now.omega_rad_s)
    assert msgspec.structs.replace(first, omega_rad_s=now.omega_rad_s) == now
    with pytest.raises(codec.Rejected):  # on the wire only the present version is taken
        codec.decode(
            m.Odometry, msgspec.msgpack.encode(old), "application/msgpack;chaserdock.Odometry.v2"
        )


def test_migrated_messages_are_validated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(m.VERSION, m.RecorderAck, 2)
    payload = codec.encode(m.RecorderAck(tick=3))
    for made in ({"tick": "three"}, {"tick": -2}, {}, {"tick": 1}):
        monkeypatch.setitem(upgrades.UPGRADES, ("RecorderAck", 1), lambda _, made=made: made)
        encoding = "application/msgpack;chaserdock.RecorderAck.v1"
        if made.get("tick") in (None, 1):
            assert upgrades.decode_logged(m.RecorderAck, payload, encoding).tick == made.get(
                "tick", -1
            )
        else:
            with pytest.raises(codec.Rejected, match="format"):
                upgrades.decode_logged(m.RecorderAck, payload, encoding)
    for encoding in (
        "application/msgpack;chaserdock.RecorderAck.v3",
        "application/msgpack;chaserdock.Tick.v1",
        "text",
    ):
        with pytest.raises(codec.Rejected, match="encoding"):
            upgrades.decode_logged(m.RecorderAck, payload, encoding)


def test_info_counts_lost_and_rejected_messages(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    scenario, run = read_scenario(GOLDEN)
    writer = LogWriter(path)
    writer.describe(scenario, {"run_id": run["run_id"]})
    for seq in (0, 1, 4, 5, 0, 1):  # two lost; then started again
        writer.write(
            "recorder/ack",
            m.encoding_of(m.RecorderAck),
            codec.encode(m.RecorderAck(seq=seq, tick=seq)),
            1,
        )
    for seq in (5, 6, 9):  # five sent before the recorder had subscribed; two lost
        presence = m.Presence(seq=seq, process="world", instance="a", heard={})
        writer.write("world/presence", m.encoding_of(m.Presence), codec.encode(presence), 1)
    writer.write("recorder/ack", m.encoding_of(m.RecorderAck), b"\xc1", 1)
    writer.write("somebody/else", "text/plain", b"hello", 1)
    writer.close()
    info = info_of(path)
    assert {k.key: (k.messages, k.lost) for k in info.keys} == {
        "recorder/ack": (7, 2),
        "somebody/else": (1, 0),
        "world/presence": (3, 2),
    }
    assert info.rejected == {"recorder/ack: format": 1, "somebody/else: key": 1}
    assert not info.whole
    assert info_of(GOLDEN).whole
