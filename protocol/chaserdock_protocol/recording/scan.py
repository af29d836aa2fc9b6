# SPDX-License-Identifier: Apache-2.0
"""Sequential reader of the records of MCAP log files, with integrity checks. All log readers use
it.

Checks the CRC of each chunk, of the data section of a closed file, of attachments and of our
metadata, and that ``sequence`` has no gaps. Reads a file whose writer was killed up to its last
whole record. The ``mcap`` package's readers raise at that point, give no record positions, check
neither attachments nor sequences, and take a message that runs over the end of its chunk.

Reads what the official libraries write: with chunks or without, each compression, with or without
indexes, checksums and summary. Only a file of our recorder must have gapless numbers: another tool
may have left messages out, sorted them, or not numbered them at all.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Metadata, Schema
from mcap.records import Message as McapMessage
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

from chaserdock_protocol.errors import ChaserdockError

from .schema_migrations import current_key

LogSource = Path | Sequence[Path]
"""A log file, a folder with a log (rotated or not), or the ordered files of one log."""

LOG_NAME = "mission.mcap"
VIEWER_PREFIX = "/viewer/"
"""Prefix of channels for viewers, which are derived from the verbatim ones and never read back."""
METADATA = "chaserdock"
RECOVERED = "chaserdock.recovered"
"""Name of the metadata record of a repaired log, which may have gaps."""

# Exceeds every record that a recorder writes: chunks close after 1 MB, and a message has 17 MB at
# most.
MAX_RECORD_BYTES = 1 << 27
_MAX_CHUNK_BYTES = 1 << 30
"""Largest content of a chunk, in bytes, that is decompressed: a wrong size must not take all of the
memory."""
_COMPRESSIONS = ("", "lz4", "zstd")
RECORD_HEAD = struct.Struct("<BQ")
"""Opcode and length of a record."""
_CRC = struct.Struct("<I")
_MESSAGE_HEAD = struct.Struct("<HIQQ")
# Exceptions of the parsers for a damaged record; lz4 raises RuntimeError.
DAMAGE = (
    McapError,
    ValueError,
    KeyError,
    EOFError,
    RuntimeError,
    MemoryError,
    struct.error,
    zstandard.ZstdError,
)

StoredRecord = McapMessage | Channel | Schema


class LogError(ChaserdockError):
    """A log cannot be used. The text is one line."""


@dataclass
class FileState:
    """State of a file, complete once all its records were read.

    ``closed``: the writer closed it, and all checksums match. ``cut_bytes``: bytes after the last
    whole record of a file without end mark. ``place``: offset of the record read last.
    ``library``: what wrote the file, by its header.
    """

    closed: bool = False
    cut_bytes: int = 0
    recovered: bool = False
    place: int = 0
    library: str = ""

    @property
    def rewritten(self) -> bool:
        """Whether another tool than our recorder wrote the file."""
        return not self.library.startswith("chaserdock")


def part_name(part: int) -> str:
    """Return the file name of part ``part`` (from 0) of a rotated log."""
    return f"mission-{part:04d}.mcap"


def log_files(source: LogSource) -> list[Path]:
    """Return the files of a log in order. Raises LogError for a folder without a log or with
    missing parts.
    """
    if not isinstance(source, Path):
        return list(source)
    if not source.is_dir():
        return [source]
    if (source / LOG_NAME).exists():
        return [source / LOG_NAME]
    parts = sorted(source.glob("mission-[0-9]*.mcap"))
    if not parts:
        raise LogError(f"{source}: holds no log ({LOG_NAME}, or {part_name(0)} and so on)")
    for number, path in enumerate(parts):
        if path.name != part_name(number):
            raise LogError(f"{source}: {part_name(number)} is missing; {path.name} follows")
    return parts


def records(path: Path, state: FileState | None = None) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and content of every record up to the summary, and update ``state``.

    Raises LogError if a file cannot be read, is no log, or is damaged.
    """
    state = state if state is not None else FileState()
    try:
        with path.open("rb") as file:
            size = os.fstat(file.fileno()).st_size
            if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                raise LogError(f"{path}: no MCAP log")
            file.seek(max(len(MCAP0_MAGIC), size - len(MCAP0_MAGIC)))
            sealed = file.read() == MCAP0_MAGIC
            place = file.seek(len(MCAP0_MAGIC))
            crc = zlib.crc32(MCAP0_MAGIC)
            while size - place >= RECORD_HEAD.size:
                head = file.read(RECORD_HEAD.size)
                opcode, length = RECORD_HEAD.unpack(head)
                if not (Opcode.HEADER <= opcode <= Opcode.DATA_END or opcode >= 0x80):
                    raise LogError(f"{path}: damaged: no record begins at byte {place}")
                if length > size - place - RECORD_HEAD.size:
                    break
                if length > MAX_RECORD_BYTES:
                    raise LogError(f"{path}: damaged: a record of {length} bytes at byte {place}")
                content = file.read(length)
                if opcode == Opcode.DATA_END:
                    if length != _CRC.size or _CRC.unpack(content)[0] not in (0, crc):
                        raise LogError(
                            f"{path}: damaged: the checksum over all data does not match"
                        )
                    state.closed = sealed
                    return
                crc = zlib.crc32(content, zlib.crc32(head, crc))
                state.place = place
                place += RECORD_HEAD.size + length
                yield opcode, content
            if sealed:
                raise LogError(f"{path}: damaged: the record at byte {place} runs over the end")
            state.cut_bytes = size - place
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from None


def record_at(path: Path, place: int) -> tuple[int, bytes]:
    """Return opcode and content of the record at byte ``place``. Raises LogError if the file has
    changed meanwhile.
    """
    try:
        with path.open("rb") as file:
            file.seek(place)
            head = file.read(RECORD_HEAD.size)
            if len(head) == RECORD_HEAD.size:
                opcode, length = RECORD_HEAD.unpack(head)
                content = file.read(min(length, MAX_RECORD_BYTES))
                if len(content) == length:
                    return opcode, content
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from None
    raise LogError(f"{path}: changed while it was open: no whole record at byte {place}")


@contextmanager
def errors_of_parsing(path: Path) -> Iterator[None]:
    """Turn the exceptions of the parsers into LogError for a damaged file."""
    try:
        yield
    except DAMAGE as error:
        raise LogError(f"{path}: damaged: {error or type(error).__name__}") from None


def parse_record(opcode: int, content: bytes) -> list[StoredRecord]:
    """Parse the messages, channels and schemas of a record: those in a chunk, whose CRC is checked,
    or the one that the record is; none in a record of another kind. Raises one of ``DAMAGE``.
    """
    if opcode == Opcode.CHUNK:
        return _parse_chunk(content)
    if opcode == Opcode.MESSAGE:
        channel, sequence, log_time, publish_time = _MESSAGE_HEAD.unpack_from(content)
        data = content[_MESSAGE_HEAD.size :]
        return [McapMessage(channel, log_time, data, publish_time, sequence)]
    if opcode == Opcode.CHANNEL:
        channel = Channel.read(ReadDataStream(BytesIO(content)))
        channel.topic = current_key(channel.topic)
        return [channel]
    if opcode == Opcode.SCHEMA:
        return [Schema.read(ReadDataStream(BytesIO(content)))]
    return []


def _parse_chunk(content: bytes) -> list[StoredRecord]:
    chunk = Chunk.read(ReadDataStream(BytesIO(content)))
    if chunk.compression not in _COMPRESSIONS:
        raise ValueError(f"compression {chunk.compression!r} of a chunk; known: none, lz4, zstd")
    if chunk.uncompressed_size > _MAX_CHUNK_BYTES:
        raise ValueError(f"a chunk of {chunk.uncompressed_size} bytes")
    stream, size = get_chunk_data_stream(chunk, validate_crc=True)
    if size != chunk.uncompressed_size:
        raise ValueError(f"a chunk holds {size} bytes where it states {chunk.uncompressed_size}")
    data, place = stream.read(size), 0
    out: list[StoredRecord] = []
    while place < size:
        opcode, length = RECORD_HEAD.unpack_from(data, place)
        begin = place + RECORD_HEAD.size
        place = begin + length
        if place > size:
            raise ValueError("a record runs over the end of its chunk")
        out += parse_record(opcode, data[begin:place]) if opcode != Opcode.CHUNK else []
    return out


def parse_attachment(content: bytes) -> Attachment:
    """Parse an attachment record and check its CRC. Raises one of ``DAMAGE``."""
    attachment = Attachment.read(ReadDataStream(BytesIO(content)))
    if _CRC.unpack(content[-_CRC.size :])[0] not in (0, zlib.crc32(content[: -_CRC.size])):
        raise ValueError(f"the checksum of {attachment.name} does not match")
    return attachment


def with_checksum(data: dict[str, str]) -> dict[str, str]:
    """Return metadata with a checksum entry, as MCAP has none for metadata records."""
    return {**data, "crc32": f"{_metadata_crc(data):08x}"}


def parse_metadata(content: bytes) -> Metadata:
    """Parse a metadata record and check the checksum of ``with_checksum``, if any. Raises one of
    ``DAMAGE``.
    """
    metadata = Metadata.read(ReadDataStream(BytesIO(content)))
    data = metadata.metadata
    if "crc32" in data and data["crc32"] != f"{_metadata_crc(data):08x}":
        raise ValueError("the checksum of the metadata does not match")
    return metadata


def _metadata_crc(data: dict[str, str]) -> int:
    return zlib.crc32(
        "\n".join(f"{k}={v}" for k, v in sorted(data.items()) if k != "crc32").encode()
    )


def stored_messages(
    path: Path, state: FileState | None = None
) -> Iterator[tuple[Channel, McapMessage]]:
    """Yield every message of a file, not decoded, viewer layer included. Raises LogError as
    ``records``, or for a gap within a file that our recorder wrote.
    """
    state = state if state is not None else FileState()
    channels: dict[int, Channel] = {}
    following: dict[int, int] = {}
    for opcode, content in records(path, state):
        with errors_of_parsing(path):
            if opcode == Opcode.METADATA:
                state.recovered |= parse_metadata(content).name == RECOVERED
            elif opcode == Opcode.HEADER:
                state.library = Header.read(ReadDataStream(BytesIO(content))).library
            inside = parse_record(opcode, content)
            found: list[tuple[Channel, McapMessage]] = []
            for record in inside:
                if isinstance(record, Channel):
                    channels[record.id] = record
                elif isinstance(record, McapMessage):
                    if record.channel_id not in channels:
                        raise ValueError(f"a message of channel {record.channel_id}, not declared")
                    found.append((channels[record.channel_id], record))
        for channel, message in found:
            # A log that was cut at its beginning starts with any number; some tools write 0 only.
            expected = following.get(channel.id, message.sequence)
            unnumbered = (message.sequence, expected) == (0, 1)
            numbered = not (state.recovered or state.rewritten or unnumbered)
            if message.sequence != expected and numbered:
                raise LogError(
                    f"{path}: damaged: {channel.topic}: message {message.sequence} follows where "
                    f"{expected} belongs"
                )
            following[channel.id] = message.sequence + 1
            yield channel, message


def read_head(path: Path) -> tuple[dict[str, str], dict[str, bytes]]:
    """Return our metadata and all attachments (by name) of a file. Raises LogError.

    The recorder writes them before the first chunk. If they are not there, the whole file is
    searched.
    """
    data: dict[str, str] = {}
    attachments: dict[str, bytes] = {}
    with errors_of_parsing(path):
        for opcode, content in records(path):
            if opcode == Opcode.ATTACHMENT:
                attachment = parse_attachment(content)
                attachments[attachment.name] = attachment.data
            elif opcode == Opcode.METADATA:
                metadata = parse_metadata(content)
                if metadata.name == METADATA:
                    data = metadata.metadata
            elif opcode in (Opcode.CHUNK, Opcode.MESSAGE) and data and attachments:
                break
    return data, attachments
