# SPDX-License-Identifier: Apache-2.0
"""Logs that end uncleanly: what a flush keeps, a file cut off anywhere, a file that is damaged."""

from __future__ import annotations

from pathlib import Path

import pytest
from chaserdock_protocol import messages as m
from chaserdock_protocol import topics
from chaserdock_protocol.recording.log import (
    LogError,
    LogWriter,
    count_messages,
    read_log,
    read_scenario,
)
from chaserdock_protocol.recording.scan import FileState, records
from log_samples import SCENARIO, Clock, flight, record


def test_flush_period_makes_earlier_messages_readable(tmp_path: Path) -> None:
    path, clock = tmp_path / "a.mcap", Clock()
    writer = LogWriter(path, clock)
    acks = [m.RecorderAck(tick=k, sim_time_ns=k) for k in range(40)]
    on_disk = []
    for ack in acks:
        clock.now_s += 0.05
        record(writer, topics.ACK, None, ack, 1)
        on_disk.append(len(list(read_log(path))) if path.stat().st_size > 8 else 0)
    # A second of wall time without being flushed never passes, and not every message is a flush.
    for k, held in enumerate(on_disk):
        assert k + 1 - held <= 20
    assert 2 <= len(set(on_disk)) <= 6
    clock.now_s += 10.0
    record(writer, topics.ACK, None, m.RecorderAck(tick=99), 1)
    assert [r.message.tick for r in read_log(path)] == [*range(40), 99]
    writer.close()


def test_a_flight_faster_than_the_clock_is_flushed_by_its_own_time(tmp_path: Path) -> None:
    path, on_disk = tmp_path / "a.mcap", []
    writer = LogWriter(path, Clock())
    for k in range(120):
        record(writer, topics.ACK, None, m.RecorderAck(tick=k, sim_time_ns=k * 33_333_333), 1)
        on_disk.append(len(list(read_log(path))) if path.stat().st_size > 8 else 0)
    for k, held in enumerate(on_disk):
        assert (k + 1 - held) * 33_333_333 <= 0.55e9
    assert 6 <= len(set(on_disk)) <= 10
    # A time that cannot be is one flush, not one a message.
    for k in range(120, 134):
        wrong = k == 120
        record(
            writer, topics.ACK, None, m.RecorderAck(tick=k, sim_time_ns=(10**18 if wrong else k)), 1
        )
    assert sum(count_messages(path).values()) == 121
    writer.close()


def test_without_time_passing_nothing_is_flushed_and_flush_does(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = LogWriter(path, Clock())
    for k in range(50):
        record(writer, topics.ACK, None, m.RecorderAck(tick=k), 1)
    assert b"recorder/ack" not in path.read_bytes()
    writer.flush()
    assert len(list(read_log(path))) == 50
    writer.close()


@pytest.mark.slow
def test_a_log_cut_off_anywhere_yields_the_messages_before(tmp_path: Path) -> None:
    """Cut at many places, inside and between records: never an error, never a wrong or repeated
    message.
    """
    path, clock = tmp_path / "a.mcap", Clock()
    writer = LogWriter(path, clock)
    writer.describe(SCENARIO, {"run_id": "r1"})
    expected, flushed = [], []
    for n, (topic, place, message) in enumerate(flight(12)):
        record(writer, topic, place, message, n + 1)
        expected.append((topic.key_of(place), message))
        if n % 10 == 9:
            writer.flush()
            flushed.append((path.stat().st_size, n + 1))
    writer.close()
    data, cut = path.read_bytes(), tmp_path / "cut.mcap"
    assert len(flushed) == 7
    sizes = [size for size, _ in flushed]
    ends = {
        *range(sizes[0], len(data), 23),
        *sizes,
        *(s + 1 for s in sizes),
        *(s - 1 for s in sizes[1:]),
    }
    for end in sorted(ends | set(range(len(data) - 120, len(data)))):
        cut.write_bytes(data[:end])
        records = [(r.key, r.message) for r in read_log(cut)]
        held = max(n for size, n in flushed if size <= end)
        assert len(records) >= held, end
        assert records == expected[: len(records)], end
        assert sum(count_messages(cut).values()) == len(records)
        assert read_scenario(cut)[0] == SCENARIO


def test_damage_is_reported_or_harmless_and_never_invents_messages(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = LogWriter(path, Clock())
    expected = []
    for n, (topic, place, message) in enumerate(flight(12)):
        record(writer, topic, place, message, n + 1)
        expected.append((topic.key_of(place), message))
        if n % 10 == 9:
            writer.flush()
    writer.close()
    data, reported = path.read_bytes(), 0
    for place in range(0, len(data), 97):
        damaged = bytearray(data)
        damaged[place] ^= 0x55
        path.write_bytes(bytes(damaged))
        records = []
        try:
            for r in read_log(path):
                records.append((r.key, r.message))
        except LogError:
            reported += 1
        rest = iter(expected)
        assert all(found in rest for found in records), place  # in order, as they were, none twice
    assert reported > 10


def test_a_log_cut_off_at_the_end_of_a_record_has_this_record(tmp_path: Path) -> None:
    path, cut = tmp_path / "a.mcap", tmp_path / "cut.mcap"
    writer = LogWriter(path, Clock())
    for k in range(3):
        record(writer, topics.ACK, None, m.RecorderAck(tick=k), 1)
        writer.flush()
    writer.close()
    found, end = list(records(path)), 8
    assert len(found) >= 3
    for number, (_, content) in enumerate(found, start=1):
        end += 9 + len(content)  # opcode and length
        cut.write_bytes(path.read_bytes()[:end])
        state = FileState()
        assert list(records(cut, state)) == found[:number]
        assert state.cut_bytes == 0


@pytest.mark.parametrize(
    ("kept", "follows"), [((0, 1, 3), "3 follows where 2"), ((0, 1, 1), "1 follows where 2")]
)
def test_a_single_lost_or_repeated_message_is_damage(
    tmp_path: Path, kept: tuple[int, ...], follows: str
) -> None:
    path, ends = tmp_path / "a.mcap", [8]
    writer = LogWriter(path, Clock())
    for k in range(4):
        record(writer, topics.ACK, None, m.RecorderAck(tick=k), 1)
        writer.flush()
        ends.append(path.stat().st_size)
    data = path.read_bytes()
    path.write_bytes(data[:8] + b"".join(data[ends[k] : ends[k + 1]] for k in kept))
    with pytest.raises(LogError, match=f"recorder/ack: message {follows} belongs"):
        list(read_log(path))


def test_a_changed_attachment_is_damage(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    writer = LogWriter(path, Clock())
    writer.describe(SCENARIO, {"run_id": "r1"})
    writer.flush()  # not closed: without a checksum over all data
    data = path.read_bytes()
    assert data.count(b"a scenario") == 1
    path.write_bytes(data.replace(b"a scenario", b"A scenario"))
    with pytest.raises(LogError, match="the checksum of scenario"):
        read_scenario(path)
