# SPDX-License-Identifier: Apache-2.0
"""Copies the readable messages of a damaged or cut off log into a new one."""

from __future__ import annotations

import mmap
import re
import struct
import zlib
from collections.abc import Collection, Iterator
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from typing import Any

import msgspec
from chaserdock_protocol.recording.log import LogError
from chaserdock_protocol.recording.scan import (
    DAMAGE,
    MAX_RECORD_BYTES,
    RECORD_HEAD,
    RECOVERED,
    StoredRecord,
    parse_attachment,
    parse_metadata,
    parse_record,
    with_checksum,
)
from chaserdock_protocol.recording.summary import FileSummary, find_summary
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    Channel,
    Chunk,
    DataEnd,
    Header,
    MessageIndex,
    Metadata,
    Schema,
)
from mcap.records import Message as McapMessage
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

_Content = Attachment | Metadata | list[StoredRecord] | int
"""Content of a record: of an index the number of its messages."""
_INDEX_HEAD = struct.Struct("<HI")
_INDEX_ENTRY_BYTES = 16  # time and offset of a message, 8 bytes each (MCAP specification)
_CHUNK_HEAD = struct.Struct("<QQQII")
"""Times, size and checksum of a chunk, and the length of the name of its compression."""
_SIZE = struct.Struct("<Q")
_NO_SCHEMA = 0  # number, which the MCAP specification reserves
_KNOWN = frozenset({*range(Opcode.HEADER, Opcode.DATA_END + 1), *range(0x80, 0x100)})
"""Opcodes of the format, and those that are left to applications."""
_OUTSIDE_CHUNKS = (Opcode.CHUNK, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT, Opcode.METADATA)
"""Records of a file with chunks, in any of which the search behind damage may end. Those inside
a damaged chunk are not trusted."""
_WITHOUT_CHUNKS = (*_OUTSIDE_CHUNKS, Opcode.SCHEMA, Opcode.CHANNEL, Opcode.MESSAGE)
_WITH_LENGTHS: dict[int, Any] = {
    Opcode.HEADER: Header,
    Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
    Opcode.CHUNK: Chunk,
    Opcode.MESSAGE_INDEX: MessageIndex,
    Opcode.ATTACHMENT: Attachment,
    Opcode.METADATA: Metadata,
    Opcode.DATA_END: DataEnd,
}
"""Records that state the lengths of their fields. A message does not: it counts only where another
record follows it."""
_WITH_DATA = (Opcode.CHUNK, Opcode.MESSAGE, Opcode.ATTACHMENT, Opcode.METADATA)


class Recovered(msgspec.Struct):
    """What was recovered from a log, and what was lost.

    ``broken_records``: damaged stretches, with a wrong checksum or format, whose ``skipped_bytes``
    were not read; ``cut_bytes``: those of a last record that is cut off.
    ``messages_without_channel``: messages whose channel is declared in a damaged record.
    ``stated_messages``: number of messages by the statistics of the log, None without.
    ``lost_messages``: by them, or by the index behind a damaged chunk; None where some are lost
    and nothing states how many. ``lost_attachments``: lost attachments and metadata records, by the
    statistics. ``unchecked``: messages without a checksum of their own, one of which may be wrong,
    as the checksum over all data does not match. ``ended``: whether the data have an end mark.
    """

    messages: int = 0
    chunks: int = 0
    broken_records: int = 0
    skipped_bytes: int = 0
    cut_bytes: int = 0
    messages_without_channel: int = 0
    stated_messages: int | None = None
    lost_messages: int | None = 0
    lost_attachments: int = 0
    unchecked: int = 0
    ended: bool = True

    @property
    def complete(self) -> bool:
        """Return whether nothing is known to be lost or wrong."""
        return self.lost_messages == 0 and not self.lost_attachments and not self.unchecked


def loss_lines(found: Recovered) -> list[str]:
    """Return what was lost as lines of text."""
    f, lines = found, list[str]()
    if f.skipped_bytes:
        lines.append(f"{f.skipped_bytes} bytes are not readable")
    if f.lost_messages is None:
        plural = "" if f.broken_records == 1 else "s"
        places = [f"{f.broken_records} damaged record{plural}"] if f.broken_records else []
        places += ["the last record, which is cut off"] if f.cut_bytes else []
        lines.append(f"lost: messages of {' and of '.join(places)}; nothing states how many")
    elif f.lost_messages:
        of = "" if f.stated_messages is None else f" of {f.stated_messages}"
        lines.append(f"lost: {f.lost_messages}{of} messages")
    if f.messages_without_channel:
        lines.append(
            f"{f.messages_without_channel} messages are of channels that a lost record declares"
        )
    if f.lost_attachments:
        lines.append(f"lost: {f.lost_attachments} attachments or metadata records")
    if f.unchecked:
        lines.append(
            f"the checksum over all data does not match: one of {f.unchecked} messages, which have "
            "no checksum of their own, may be wrong"
        )
    if not f.ended:
        lines.append("the log was not closed: what its writer had not yet written is not in it")
    return lines


def recover(log: Path, out: Path) -> Recovered:
    """Copy every message of ``log`` that is intact by its chunk's checksum into the new log
    ``out``; without chunks or checksums, every one that has the format.

    Raises LogError when ``log`` is no log or holds no whole message, or ``out`` exists or cannot be
    written.
    """
    try:
        with log.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            with out.open("xb") as target:
                try:
                    found = _recover(data, target, str(log))
                except OSError as error:
                    out.unlink(missing_ok=True)
                    raise LogError(f"{out}: cannot be written: {error.strerror or error}") from None
            is_log = data[: len(MCAP0_MAGIC)] == MCAP0_MAGIC
    except FileExistsError:
        raise LogError(f"{out}: already exists; a log is never overwritten") from None
    except OSError as error:
        raise LogError(f"{error.filename or log}: {error.strerror or error}") from None
    except ValueError:
        raise LogError(f"{log}: no MCAP log") from None  # an empty file cannot be mapped
    if not found.messages:
        out.unlink()
        raise LogError(f"{log}: {'holds no whole message' if is_log else 'no MCAP log'}")
    return found


def _recover(data: mmap.mmap, target: Any, source: str) -> Recovered:
    summary = find_summary(data)
    writer = Writer(
        target, chunk_size=1 << 20, compression=CompressionType.ZSTD, enable_data_crcs=True
    )
    writer.start(profile="chaserdock", library=f"chaserdock {version('chaserdock')} recover")
    writer.add_metadata(RECOVERED, with_checksum({"from": source}))
    walk = _Walk(data, summary)
    copy = _Copy(writer, walk.found, summary)
    for opcode, content in walk:
        copy.add(opcode, content)
    writer.finish()
    _count_losses(data, summary, copy, walk)
    return walk.found


def _count_losses(data: mmap.mmap, summary: FileSummary | None, copy: _Copy, walk: _Walk) -> None:
    found, stated = walk.found, None if summary is None else summary.statistics
    if stated is not None:
        found.stated_messages = stated.message_count
        found.lost_messages = max(0, stated.message_count - found.messages)
        records = stated.attachment_count + stated.metadata_count
        found.lost_attachments = max(0, records - copy.other_records)
    elif walk.unknown_losses:
        found.lost_messages = None
    else:
        found.lost_messages = walk.indexed_losses + found.messages_without_channel

    # A message outside of chunks has no other checksum.
    if summary is not None and summary.data_crc and copy.unchunked and not found.broken_records:
        with memoryview(data) as everything, everything[: summary.data_end] as covered:
            matches = zlib.crc32(covered) == summary.data_crc
        found.unchecked = 0 if matches else copy.unchunked


class _Walk:
    """Iterates over opcode and content of the intact records of a file; behind a damaged one it
    continues with the next one that is intact.

    ``indexed_losses``: number of messages in damaged chunks, by the indexes behind them.
    ``unknown_losses``: number of damaged records of which that is not known.
    """

    def __init__(self, data: mmap.mmap, summary: FileSummary | None) -> None:
        self.found = Recovered(ended=summary is not None)
        self.indexed_losses = self.unknown_losses = 0
        self._data, self._ended = data, summary is not None
        self._end = len(data) if summary is None else summary.data_end
        stated = None if summary is None else summary.statistics
        self._chunked = None if stated is None else stated.chunk_count > 0
        self._channels = set[int]() if summary is None else set(summary.channels)

    def __iter__(self) -> Iterator[tuple[int, _Content]]:
        starts = self._data[: len(MCAP0_MAGIC)] == MCAP0_MAGIC
        place = len(MCAP0_MAGIC) if starts else 0
        counting = uncounted = False

        while place < self._end:
            record = self._record(place)
            if record is None:
                following = self._next(place)
                counting = uncounted = self._count_damage(place, following)
                place = following
                continue

            opcode, content, place = record
            if opcode == Opcode.DATA_END:
                self.found.ended = True
                return
            if isinstance(content, int):  # an index
                if counting:
                    self.indexed_losses += content
                    self.unknown_losses -= uncounted
                    uncounted = False
                continue

            counting = uncounted = False
            if opcode in (Opcode.CHUNK, Opcode.MESSAGE) and self._chunked is None:
                self._chunked = opcode == Opcode.CHUNK
            if opcode == Opcode.CHANNEL and isinstance(content, list):
                self._channels |= {r.id for r in content if isinstance(r, Channel)}
            yield opcode, content

    def _head(self, place: int, kinds: Collection[int] | None = None) -> tuple[int, int] | None:
        """Return opcode and end of the record at ``place`` if its head may be one."""
        if place + RECORD_HEAD.size > self._end:
            return None
        opcode, length = RECORD_HEAD.unpack_from(self._data, place)
        known = opcode in (_KNOWN if kinds is None else kinds)
        following = place + RECORD_HEAD.size + length
        fits = length <= MAX_RECORD_BYTES and following <= self._end
        return (opcode, following) if known and fits else None

    def _record(
        self, place: int, kinds: Collection[int] | None = None
    ) -> tuple[int, _Content, int] | None:
        """Return opcode, content and end of the record at ``place`` if it is intact."""
        head = self._head(place, kinds)
        record = None if head is None else self._record_until(place, *head)
        if record is None and self._data[place] == Opcode.CHUNK:
            # Its length may be what is wrong: a chunk states its size again inside.
            end = self._chunk_end(place)
            record = None if end is None else self._record_until(place, Opcode.CHUNK, end)
        return record

    def _record_until(self, place: int, opcode: int, end: int) -> tuple[int, _Content, int] | None:
        content = self._data[place + RECORD_HEAD.size : end]
        try:
            if not self._continues(end) and not _is_exact(opcode, content):
                return None
            return opcode, _parse(opcode, content), end
        except DAMAGE:
            return None

    def _continues(self, place: int) -> bool:
        """Return whether a record may begin at ``place``, whole or cut off, or the data end."""
        if place == self._end or self._head(place) is not None:
            return True
        head = self._data[place : place + RECORD_HEAD.size]
        if self._ended or len(head) < RECORD_HEAD.size:
            return not self._ended
        opcode, length = RECORD_HEAD.unpack(head)
        return opcode in _KNOWN and length <= MAX_RECORD_BYTES

    def _chunk_end(self, place: int) -> int | None:
        begin = place + RECORD_HEAD.size + _CHUNK_HEAD.size
        if begin > self._end:
            return None
        *_, name_bytes = _CHUNK_HEAD.unpack_from(self._data, place + RECORD_HEAD.size)
        begin += name_bytes + _SIZE.size
        if begin > self._end:
            return None
        end = begin + _SIZE.unpack_from(self._data, begin - _SIZE.size)[0]
        return end if end <= self._end else None

    def _next(self, place: int) -> int:
        """Return where the next intact record begins behind the damaged one at ``place``; the end
        if there is none.
        """
        head = self._head(place)
        if head is not None and (head[1] == self._end or self._record(head[1]) is not None):
            return head[1]
        if self._chunked is None:
            self._chunked = self._search(place + 1, (Opcode.CHUNK,)) < self._end
        return self._search(place + 1, _OUTSIDE_CHUNKS if self._chunked else _WITHOUT_CHUNKS)

    def _search(self, place: int, kinds: Collection[int]) -> int:
        # Opcode, and a length of at most MAX_RECORD_BYTES.
        heads = re.compile(
            b"[" + re.escape(bytes(kinds)) + rb"](?=.{3}[\x00-\x08]\x00{4})", re.DOTALL
        )
        for match in heads.finditer(self._data, place, self._end):
            record = self._record(match.start(), kinds)
            if record is not None and self._is_trusted(*record):
                return match.start()
        return self._end

    def _is_trusted(self, opcode: int, content: _Content, following: int) -> bool:
        """Return whether a record that was found by searching is one: another one, or the end,
        follows it, and a message has a known channel.
        """
        if not self._continues(following):
            return False
        return opcode != Opcode.MESSAGE or all(
            isinstance(r, McapMessage) and r.channel_id in self._channels
            for r in (content if isinstance(content, list) else ())
        )

    def _count_damage(self, place: int, following: int) -> bool:
        """Count the damage from ``place`` to ``following``; return whether an index that follows
        states its messages.
        """
        self.found.skipped_bytes += following - place
        opcode, head = self._data[place], self._head(place)
        if head is None and following == self._end and not self._ended:
            self.found.cut_bytes = following - place
            self.unknown_losses += opcode in _WITH_DATA
            return False
        self.found.broken_records += 1
        alone = head is not None and head[1] == following
        lossy = not alone or opcode in _WITH_DATA
        self.unknown_losses += lossy
        return alone and opcode == Opcode.CHUNK


def _is_exact(opcode: int, content: bytes) -> bool:
    """Return whether a record ends where its own fields end. Raises one of ``DAMAGE``."""
    kind = _WITH_LENGTHS.get(opcode)
    if kind is None:
        return False
    stream = ReadDataStream(BytesIO(content))
    kind.read(stream)
    return stream.count == len(content)


def _parse(opcode: int, content: bytes) -> _Content:
    """Parse a record; for an index, count its messages. Raises one of ``DAMAGE``."""
    if opcode == Opcode.ATTACHMENT:
        return parse_attachment(content)
    if opcode == Opcode.METADATA:
        return parse_metadata(content)
    if opcode == Opcode.MESSAGE_INDEX:
        _, size = _INDEX_HEAD.unpack_from(content)
        if size % _INDEX_ENTRY_BYTES or size != len(content) - _INDEX_HEAD.size:
            raise ValueError("an index of a wrong length")
        return size // _INDEX_ENTRY_BYTES
    return parse_record(opcode, content)


class _Copy:
    """Copies records into a new log. ``unchunked``: number of messages outside of chunks.
    ``other_records``: number of attachments and metadata records.
    """

    def __init__(self, writer: Writer, found: Recovered, summary: FileSummary | None) -> None:
        self.unchunked = self.other_records = 0
        self._writer, self._found = writer, found
        # A closed log repeats them: the chunk that declares them may be lost.
        self._channels = {} if summary is None else dict(summary.channels)
        self._schemas = {} if summary is None else dict(summary.schemas)
        self._new_channels: dict[int, int] = {}
        self._new_schemas = {_NO_SCHEMA: _NO_SCHEMA}

    def add(self, opcode: int, content: _Content) -> None:
        """Copy the content of a record."""
        if isinstance(content, Attachment):
            a = content
            self._writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, a.data)
            self.other_records += 1
        elif isinstance(content, Metadata):
            if content.name != RECOVERED:
                self._writer.add_metadata(content.name, content.metadata)
            self.other_records += 1
        elif isinstance(content, list):
            self._found.chunks += opcode == Opcode.CHUNK
            self.unchunked += opcode == Opcode.MESSAGE
            for record in content:
                self._add_record(record)

    def _add_record(self, record: StoredRecord) -> None:
        if isinstance(record, Schema):
            self._schemas[record.id] = record
        elif isinstance(record, Channel):
            self._channels[record.id] = record
        elif (channel := self._channel(record.channel_id)) is None:
            self._found.messages_without_channel += 1
        else:
            m = record
            self._writer.add_message(channel, m.log_time, m.data, m.publish_time, m.sequence)
            self._found.messages += 1

    def _channel(self, number: int) -> int | None:
        """Return the new number of a channel, declared at its first use; None if it is unknown."""
        if number in self._new_channels:
            return self._new_channels[number]
        channel = self._channels.get(number)
        if channel is None:
            return None
        if channel.schema_id not in self._new_schemas:
            schema = self._schemas.get(channel.schema_id)
            if schema is None:
                return None
            self._new_schemas[schema.id] = self._writer.register_schema(
                schema.name, schema.encoding, schema.data
            )
        self._new_channels[number] = self._writer.register_channel(
            channel.topic,
            channel.message_encoding,
            self._new_schemas[channel.schema_id],
            channel.metadata,
        )
        return self._new_channels[number]
