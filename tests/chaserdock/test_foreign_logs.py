# SPDX-License-Identifier: Apache-2.0
"""Logs that another tool has written: every way of the official library, cut, damaged."""

from __future__ import annotations

import json
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import pytest
from chaserdock_protocol.recording.log import LogError, read_log, read_scenario
from chaserdock_protocol.recording.scan import RECORD_HEAD, stored_messages
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message
from mcap.stream_reader import breakup_chunk
from mcap.writer import Writer
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


@pytest.mark.parametrize("writer", [w for w in WRITERS if "without chunks" not in w])
@pytest.mark.parametrize("where", [0, 3, -1])
def test_a_damaged_chunk_costs_itself_and_is_stated(
    writer: str, where: int, source: Path, expected: Content, tmp_path: Path
) -> None:
    """A wrong bit in the size that the first, the fourth or the last one states inside."""
    log = copy_log(source, tmp_path / "log", **WRITERS[writer])
    data = bytearray(log.read_bytes())
    begin, _ = places(data, Opcode.CHUNK)[where]
    held = _count(data, begin, Message)
    data[begin + 9 + 17] ^= 0x10
    log.write_bytes(data)
    found = recover(log, tmp_path / "out")
    saved = content_of(tmp_path / "out")
    assert is_part(saved, expected)
    # Channels that only this chunk declares are lost with it.
    declared = "no declarations" not in writer and "no summary" not in writer
    assert len(saved) == len(expected) - held or (where != -1 and not declared)
    _check_statement(found, len(saved), len(expected), writer)


@pytest.mark.parametrize("writer", [w for w in WRITERS if "without chunks" in w])
@pytest.mark.parametrize("where", [0, 3, -1])
@pytest.mark.parametrize("byte", [0, 2, 7])
def test_a_damaged_message_costs_no_more_than_the_one_before(
    writer: str, where: int, byte: int, source: Path, expected: Content, tmp_path: Path
) -> None:
    """A wrong bit in its opcode or length. The one before has no checksum, and nothing that states
    its length, either.
    """
    log = copy_log(source, tmp_path / "log", **WRITERS[writer])
    data = bytearray(log.read_bytes())
    data[places(data, Opcode.MESSAGE)[where][0] + byte] ^= 0x10
    log.write_bytes(data)
    found = recover(log, tmp_path / "out")
    saved = content_of(tmp_path / "out")
    assert is_part(saved, expected)
    assert 1 <= len(expected) - len(saved) <= 2
    _check_statement(found, len(saved), len(expected), writer)


def _check_statement(found: Recovered, saved: int, expected: int, writer: str) -> None:
    assert not found.complete
    if "no statistics" in writer or "no summary" in writer:
        assert found.lost_messages in (None, expected - saved)
        assert any(line.startswith("lost: ") for line in loss_lines(found))
    else:
        assert found.lost_messages == expected - saved
        assert f"lost: {found.lost_messages} of {expected} messages" in loss_lines(found)


@pytest.mark.parametrize("byte", [2, 3, 7])
@pytest.mark.parametrize("layout", [name for name in LAYOUTS if name != "without chunks"])
def test_a_chunk_of_a_wrong_length_is_read_by_the_size_inside(
    byte: int, layout: str, source: Path, expected: Content, tmp_path: Path
) -> None:
    log = copy_log(source, tmp_path / "log", **LAYOUTS[layout])
    for where in (0, 3, -1):
        data = bytearray(log.read_bytes())
        data[places(data, Opcode.CHUNK)[where][0] + byte] ^= 0x10
        (tmp_path / "damaged").write_bytes(data)
        found = recover(tmp_path / "damaged", tmp_path / f"{where}")
        assert found.complete
        assert content_of(tmp_path / f"{where}") == expected


def _count(data: bytes | bytearray, chunk: int, kind: type) -> int:
    """Number of records of a kind in the chunk at this offset, by the official library."""
    content = BytesIO(data[chunk + RECORD_HEAD.size :])
    return sum(isinstance(r, kind) for r in breakup_chunk(Chunk.read(ReadDataStream(content))))


def test_an_index_behind_a_damaged_chunk_counts_its_messages(
    source: Path, expected: Content, tmp_path: Path
) -> None:
    """In a log without end, which has no statistics. Nothing else needs the chunk's channels."""
    log = copy_log(source, tmp_path / "log")
    data = bytearray(log.read_bytes())
    begin, end = next(
        (begin, end)
        for begin, end in reversed(places(data, Opcode.CHUNK)[:-1])
        if not _count(data, begin, Channel)
    )
    held = _count(data, begin, Message)
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
    assert loss_lines(found)[1:] == [
        "lost: messages of 1 damaged record and of the last record, which is cut off; nothing "
        "states how many",
        "the log was not closed: what its writer had not yet written is not in it",
    ]


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
    held = 3 if unchunked else sum(_count(data, hits[k][0], Message) for k in range(3))
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
    assert f"one of {found.messages} messages, which have no checksum" in loss_lines(found)[0]


def test_a_channel_without_schema_is_kept(tmp_path: Path) -> None:
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
    assert app(["log", str(log), "--json"], standalone_mode=False) == 1
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
    words = ["log", str(log), "--recover", str(tmp_path / "out")]
    assert app(words, standalone_mode=False) == 1
    lost = len(expected) - len(content_of(tmp_path / "out"))
    assert lost > 0
    assert f"lost: {lost} of {len(expected)} messages" in capsys.readouterr().out
