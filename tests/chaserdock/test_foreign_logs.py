# SPDX-License-Identifier: Apache-2.0
"""Logs that another tool has written: every way of the official library, cut, damaged."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from chaserdock_protocol.recording.log import LogError, read_log, read_scenario
from chaserdock_protocol.recording.scan import RECORD_HEAD, stored_messages
from mcap.opcode import Opcode
from mcap_writers import LAYOUTS, OPTIONS, copy_log, places

from chaserdock.cli.main import app
from chaserdock.logs.info import info_of
from chaserdock.logs.recover import Recovered, loss_lines, recover
from chaserdock.replay.run import replay
from chaserdock.viewer.logged import LoggedMission

GOLDEN = Path(__file__).parents[1] / "golden" / "two-chasers.mcap"
WRITERS = {
    f"{layout}, {option}": {**LAYOUTS[layout], **OPTIONS[option]}
    for layout in LAYOUTS
    for option in OPTIONS
}
Content = list[tuple[str, int, bytes]]


def content_of(log: Path) -> Content:
    return [(channel.topic, m.log_time, m.data) for channel, m in stored_messages(log)]


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The golden flight without images and viewer layer."""
    path = tmp_path_factory.mktemp("logs") / "source.mcap"

    def small(key: str, time_ns: int) -> bool:
        return not key.startswith("/viewer/") and not key.endswith("/image")

    return copy_log(GOLDEN, path, keep=small)


@pytest.fixture(scope="module")
def expected(source: Path) -> Content:
    return content_of(source)


def is_part(found: Content, expected: Content) -> bool:
    """Whether messages are there as they were, in order, none twice."""
    rest: Iterator[tuple[str, int, bytes]] = iter(expected)
    return all(message in rest for message in found)


@pytest.mark.parametrize("writer", WRITERS)
def test_every_way_of_writing_is_read_and_copied(
    writer: str, source: Path, expected: Content, tmp_path: Path
) -> None:
    for attachments in ("first", "last"):
        log = copy_log(source, tmp_path / attachments, attachments=attachments, **WRITERS[writer])
        assert content_of(log) == expected
        assert read_scenario(log) == read_scenario(source)
        info = info_of(log)
        assert info.whole, info
        out = tmp_path / f"{attachments}.mcap"
        found = recover(log, out)
        assert (found.messages, found.complete) == (len(expected), True)
        assert loss_lines(found) == []
        assert content_of(out) == expected
        assert read_scenario(out) == read_scenario(source)


@pytest.mark.parametrize("writer", WRITERS)
@pytest.mark.parametrize("where", [0, 3, -1])
def test_damage_costs_one_record_and_is_stated(
    writer: str, where: int, source: Path, expected: Content, tmp_path: Path
) -> None:
    """A wrong bit in the content, or in the length, of the first, the fourth, or the last one."""
    log = copy_log(source, tmp_path / "log", **WRITERS[writer])
    whole, unchunked = log.read_bytes(), "without" in writer
    hits = places(whole, Opcode.MESSAGE if unchunked else Opcode.CHUNK)
    begin, end = hits[where]
    held = _messages_of(whole, begin, unchunked)
    for place in (begin + 2, begin + 7, (begin + end) // 2):
        if place > begin + 8 and (unchunked or "no checksums" in writer):
            continue  # nothing can tell
        data = bytearray(whole)
        data[place] ^= 0x10
        log.write_bytes(data)
        out = tmp_path / f"{place}.mcap"
        found = recover(log, out)
        saved = content_of(out)
        assert is_part(saved, expected)
        assert not found.complete
        # Channels that only the damaged chunk declares are lost with it.
        declared = "no declarations" not in writer and "no summary" not in writer
        assert len(saved) == len(expected) - held or (where != -1 and not declared)
        if "no statistics" not in writer and "no summary" not in writer:
            assert found.lost_messages == len(expected) - len(saved)
            assert f"lost: {found.lost_messages} of {len(expected)} messages" in loss_lines(found)
        else:
            assert found.lost_messages in (None, len(expected) - len(saved))
            assert any(line.startswith("lost: ") for line in loss_lines(found))


def _messages_of(data: bytes, place: int, unchunked: bool) -> int:
    """Number of messages of a record, by the official library."""
    from io import BytesIO

    from mcap.data_stream import ReadDataStream
    from mcap.records import Chunk, Message
    from mcap.stream_reader import breakup_chunk

    if unchunked:
        return 1
    content = data[place + RECORD_HEAD.size :]
    inside = breakup_chunk(Chunk.read(ReadDataStream(BytesIO(content))))
    return sum(isinstance(record, Message) for record in inside)


def test_an_index_behind_a_damaged_chunk_counts_its_messages(
    source: Path, expected: Content, tmp_path: Path
) -> None:
    """In a log without end, which has no statistics."""
    log = copy_log(source, tmp_path / "log")
    data = bytearray(log.read_bytes())
    begin, end = places(data, Opcode.CHUNK)[1]
    held = _messages_of(data, begin, unchunked=False)
    data[(begin + end) // 2] ^= 1
    last = places(data, Opcode.CHUNK)[-1][0]
    log.write_bytes(data[:last])
    found = recover(log, tmp_path / "out")
    assert (found.lost_messages, found.stated_messages) == (held, None)
    assert f"lost: {held} messages" in loss_lines(found)
    # Within the last chunk: how much more is lost is not known.
    log.write_bytes(data[: last + 200])
    found = recover(log, tmp_path / "again")
    assert (found.lost_messages, found.cut_bytes) == (None, 200)
    (_, line) = loss_lines(found)
    assert line == (
        "lost: what 1 damaged records and the last record, which is cut off held; nothing states "
        "how many messages"
    )


@pytest.mark.parametrize("writer", [w for w in WRITERS if "no" not in w.partition(", ")[2]])
def test_a_file_without_its_first_bytes_is_recovered(
    writer: str, source: Path, expected: Content, tmp_path: Path
) -> None:
    log = copy_log(source, tmp_path / "log", **WRITERS[writer])
    data, unchunked = log.read_bytes(), "without" in writer
    hits = places(data, Opcode.MESSAGE if unchunked else Opcode.CHUNK)
    log.write_bytes(data[hits[2][0] + 5 :])
    with pytest.raises(LogError, match="no MCAP log"):
        content_of(log)
    found = recover(log, tmp_path / "out")
    saved = content_of(tmp_path / "out")
    held = sum(_messages_of(data, hits[k][0], unchunked) for k in range(3))
    assert saved == expected[held:]
    assert found.lost_messages == held
    assert found.lost_attachments == 4  # three attachments and a metadata record


def test_a_message_without_checksum_may_be_wrong_and_that_is_said(
    source: Path, tmp_path: Path
) -> None:
    log = copy_log(source, tmp_path / "log", use_chunking=False, enable_data_crcs=True)
    data = bytearray(log.read_bytes())
    data[places(data, Opcode.MESSAGE)[9][1] - 1] ^= 1
    log.write_bytes(data)
    found = recover(log, tmp_path / "out")
    assert (found.lost_messages, found.complete) == (0, False)
    assert found.unchecked == found.messages
    assert "one of them may be wrong" in loss_lines(found)[0]


def test_a_channel_without_schema_is_kept(tmp_path: Path) -> None:
    from mcap.writer import Writer

    with (tmp_path / "log").open("wb") as file:
        writer = Writer(file)
        writer.start(library="other tool")
        number = writer.register_channel("sensor", "json", 0)
        writer.add_message(number, 5, b"{}", 5)
        writer.finish()
    found = recover(tmp_path / "log", tmp_path / "out")
    assert (found.messages, found.complete) == (1, True)
    assert content_of(tmp_path / "out") == [("sensor", 5, b"{}")]


def test_an_unknown_compression_is_named(source: Path, tmp_path: Path) -> None:
    log = copy_log(source, tmp_path / "log")
    log.write_bytes(log.read_bytes().replace(b"\x04\x00\x00\x00zstd", b"\x04\x00\x00\x00lzma"))
    with pytest.raises(LogError, match=r"compression 'lzma' of a chunk; known: none, lz4, zstd"):
        content_of(log)


# -- cut by time -----------------------------------------------------------------------------------


@pytest.mark.parametrize("numbered", [True, False])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_log_cut_at_its_beginning_is_read_from_there(
    layout: str, numbered: bool, source: Path, expected: Content, tmp_path: Path
) -> None:
    begin_ns = 1_000_000_000
    log = copy_log(
        source,
        tmp_path / "log",
        keep=lambda key, time_ns: time_ns >= begin_ns,
        numbered=numbered,
        **LAYOUTS[layout],
    )
    assert content_of(log) == [m for m in expected if m[1] >= begin_ns]
    info = info_of(log)
    assert not info.whole
    assert info.missing == ["begins at 1.0 s; earlier messages are missing"]
    notes = replay(log, "fusion").notes
    assert any(note.startswith("begins at 1.0 s; earlier messages are missing") for note in notes)


def test_a_log_cut_at_its_end_says_so(source: Path, tmp_path: Path) -> None:
    log = copy_log(source, tmp_path / "log", keep=lambda key, time_ns: time_ns < 800_000_000)
    info = info_of(log)
    assert not info.whole
    assert info.missing == [
        "ends at 0.77 s without the end of the mission; later messages may be missing"
    ]


def test_a_copy_without_attachments_says_what_that_costs(
    source: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = copy_log(source, tmp_path / "log", attachments="none")
    with pytest.raises(SystemExit if False else BaseException) as caught:
        app(["log", str(log), "--json"], standalone_mode=False)
    assert getattr(caught.value, "exit_code", None) == 1
    info = json.loads(capsys.readouterr().out)
    assert (info["scenario"], info["seed"]) == (None, None)
    assert info["missing"][0].startswith("holds no scenario")
    assert sum(key["messages"] for key in info["keys"]) == len(content_of(log))


def test_numbers_of_another_tool_need_not_be_gapless(source: Path, tmp_path: Path) -> None:
    """Every second message left out: read, and the gaps are counted by the messages' own numbers.
    A log of our recorder with such gaps is damaged.
    """
    kept = iter(range(10**6))
    log = copy_log(source, tmp_path / "log", keep=lambda key, time_ns: next(kept) % 2 == 0)
    assert len(list(read_log(log))) > 200
    assert not info_of(log).whole
    kept = iter(range(10**6))
    ours = copy_log(
        source,
        tmp_path / "ours",
        keep=lambda key, time_ns: next(kept) % 2 == 0,
        library="chaserdock 1.0",
    )
    with pytest.raises(LogError, match="follows where"):
        list(read_log(ours))
    unnumbered = copy_log(source, tmp_path / "zeros", numbered=False, library="chaserdock 1.0")
    assert content_of(unnumbered) == content_of(source)


@pytest.mark.parametrize("layout", LAYOUTS)
def test_the_viewer_shows_a_log_of_any_layout(layout: str, source: Path, tmp_path: Path) -> None:
    log = copy_log(source, tmp_path / "log", **LAYOUTS[layout])
    shown, original = LoggedMission(log).at(0.9), LoggedMission(GOLDEN).at(0.9)
    assert shown.target == original.target
    assert shown.target is not None


# -- the command -----------------------------------------------------------------------------------


def test_the_command_states_the_loss_with_status_1(
    source: Path, expected: Content, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = copy_log(source, tmp_path / "log")
    data = bytearray(log.read_bytes())
    begin, end = places(data, Opcode.CHUNK)[-1]
    data[(begin + end) // 2] ^= 0x10
    log.write_bytes(data)
    status, said = _run(capsys, "log", str(log), "--recover", str(tmp_path / "out"))
    held = _messages_of(bytes(data), begin, False) if False else None
    assert status == 1
    found: Recovered = recover(log, tmp_path / "again")
    assert f"lost: {found.lost_messages} of {len(expected)} messages" in said
    assert held is None


def _run(capsys: pytest.CaptureFixture[str], *words: str) -> tuple[Any, str]:
    try:
        app(list(words), standalone_mode=False)
    except BaseException as ended:
        return getattr(ended, "exit_code", None), capsys.readouterr().out
    return 0, capsys.readouterr().out


_ = struct
