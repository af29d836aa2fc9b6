"""The records of MCAP log files, as they lie there, with every checksum held: the ground that all log readers stand on.

Guards: each chunk's CRC, the data section's CRC in a closed file, the attachments' CRC, and the gapless ``sequence``
of every channel. A file whose writer was killed ends with its last whole record; what was flushed before is good.
"""

from __future__ import annotations

import os
import struct
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path

import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata, Schema
from mcap.records import Message as McapMessage
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC

from chaserdock_protocol.errors import ChaserdockError

from .schema_migrations import current_key

LogSource = Path | Sequence[Path]
"""A log file, a folder that holds a log (rotated or not), or the files of one log in their order."""

LOG_NAME = "mission.mcap"
VIEWER_PREFIX = "/viewer/"
"""Channels for viewers, derived from the verbatim ones: never read back."""
METADATA = "chaserdock"
RECOVERED = "chaserdock.recovered"
"""Metadata record of a repaired log: gaps are known there."""

# Longest record that a recorder of ours writes: a chunk closes after a megabyte, one message has 17 at most.
MAX_RECORD_BYTES = 1 << 27
_HEAD = struct.Struct("<BQ")
_CRC = struct.Struct("<I")
_MESSAGE = struct.Struct("<HIQQ")
# What the parsers of a damaged record raise.
DAMAGE = (McapError, ValueError, KeyError, EOFError, struct.error, zstandard.ZstdError)


class LogError(ChaserdockError):
    """A log that cannot be used; the text is one clear line."""


@dataclass
class FileState:
    """What became known of a file while its records were read: all of it only after the last one.

    ``closed``: its writer ended it properly, and all checksums hold. ``cut_bytes``: what follows the last whole
    record of a file that ends without an end mark. ``place``: where the record that was read last begins.
    """

    closed: bool = False
    cut_bytes: int = 0
    recovered: bool = False
    place: int = 0


def part_name(part: int) -> str:
    """File name of part ``part``, from 0, of a log that is rotated."""
    return f"mission-{part:04d}.mcap"


def log_files(source: LogSource) -> list[Path]:
    """The files of a log in their order. Raises LogError for a folder without one, or with parts missing."""
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
    """Opcode and content of every record up to the summary; ``state`` learns how the file ends.

    Raises LogError for a file that cannot be read, is no log, or is damaged.
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
            while size - place >= _HEAD.size:
                head = file.read(_HEAD.size)
                opcode, length = _HEAD.unpack(head)
                if not (Opcode.HEADER <= opcode <= Opcode.DATA_END or opcode >= 0x80):
                    raise LogError(f"{path}: damaged: no record begins at byte {place}")
                if length > size - place - _HEAD.size:
                    break
                if length > MAX_RECORD_BYTES:
                    raise LogError(f"{path}: damaged: a record of {length} bytes at byte {place}")
                content = file.read(length)
                if opcode == Opcode.DATA_END:
                    if length != _CRC.size or _CRC.unpack(content)[0] not in (0, crc):
                        raise LogError(f"{path}: damaged: the checksum over all data does not hold")
                    state.closed = sealed
                    return
                crc = zlib.crc32(content, zlib.crc32(head, crc))
                state.place = place
                place += _HEAD.size + length
                yield opcode, content
            if sealed:
                raise LogError(f"{path}: damaged: the record at byte {place} runs over the end")
            state.cut_bytes = size - place
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from None


def record_at(path: Path, place: int) -> bytes:
    """Content of the record that begins at byte ``place``; raises LogError where the file has changed meanwhile."""
    try:
        with path.open("rb") as file:
            file.seek(place)
            head = file.read(_HEAD.size)
            if len(head) == _HEAD.size and (length := _HEAD.unpack(head)[1]) <= MAX_RECORD_BYTES:
                content = file.read(length)
                if len(content) == length:
                    return content
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from None
    raise LogError(f"{path}: changed while it was open: no whole record at byte {place}")


def parse_chunk(content: bytes) -> list[McapMessage | Channel | Schema]:
    """Channels, schemas and messages of a chunk record, its checksum held; raises one of ``DAMAGE``."""
    stream, size = get_chunk_data_stream(Chunk.read(ReadDataStream(BytesIO(content))), validate_crc=True)
    data, place = stream.read(size), 0
    out: list[McapMessage | Channel | Schema] = []
    # Messages are most of a log, and the library reads them field by field.
    while place < size:
        opcode, length = _HEAD.unpack_from(data, place)
        begin, place = place + _HEAD.size, place + _HEAD.size + length
        if place > size or (opcode == Opcode.MESSAGE and length < _MESSAGE.size):
            raise ValueError("a record runs over its end")
        if opcode == Opcode.MESSAGE:
            channel_id, sequence, log_time, publish_time = _MESSAGE.unpack_from(data, begin)
            payload = data[begin + _MESSAGE.size : place]
            out.append(McapMessage(channel_id, log_time, payload, publish_time, sequence))
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(ReadDataStream(BytesIO(data[begin:place])))
            channel.topic = current_key(channel.topic)
            out.append(channel)
        elif opcode == Opcode.SCHEMA:
            out.append(Schema.read(ReadDataStream(BytesIO(data[begin:place]))))
    return out


def parse_attachment(content: bytes) -> Attachment:
    """An attachment record, its checksum held; raises one of ``DAMAGE``."""
    attachment = Attachment.read(ReadDataStream(BytesIO(content)))
    if _CRC.unpack(content[-_CRC.size :])[0] not in (0, zlib.crc32(content[: -_CRC.size])):
        raise ValueError(f"the checksum of {attachment.name} does not hold")
    return attachment


def with_checksum(data: dict[str, str]) -> dict[str, str]:
    """Metadata with a checksum among them, as MCAP has none for metadata records."""
    return {**data, "crc32": f"{_metadata_crc(data):08x}"}


def parse_metadata(content: bytes) -> Metadata:
    """A metadata record, its checksum held where ``with_checksum`` put one; raises one of ``DAMAGE``."""
    metadata = Metadata.read(ReadDataStream(BytesIO(content)))
    data = metadata.metadata
    if "crc32" in data and data["crc32"] != f"{_metadata_crc(data):08x}":
        raise ValueError("the checksum of the metadata does not hold")
    return metadata


def _metadata_crc(data: dict[str, str]) -> int:
    return zlib.crc32("\n".join(f"{k}={v}" for k, v in sorted(data.items()) if k != "crc32").encode())


def stored_messages(path: Path, state: FileState | None = None) -> Iterator[tuple[Channel, McapMessage]]:
    """Every message of a file, unopened, viewer layer included; raises LogError as ``records``, or for a gap."""
    state = state if state is not None else FileState()
    channels: dict[int, Channel] = {}
    following: dict[int, int] = {}
    for opcode, content in records(path, state):
        try:
            if opcode == Opcode.METADATA:
                state.recovered |= parse_metadata(content).name == RECOVERED
            if opcode != Opcode.CHUNK:
                continue
            inside = parse_chunk(content)
            channels |= {record.id: record for record in inside if isinstance(record, Channel)}
            found = [(channels[r.channel_id], r) for r in inside if isinstance(r, McapMessage)]
        except DAMAGE as error:
            raise LogError(f"{path}: damaged: {error or type(error).__name__}") from None
        for channel, message in found:
            expected = following.get(channel.id, message.sequence if state.recovered else 0)
            if message.sequence != expected and not state.recovered:
                raise LogError(
                    f"{path}: damaged: {channel.topic}: message {message.sequence} follows where {expected} belongs"
                )
            following[channel.id] = message.sequence + 1
            yield channel, message


def read_head(path: Path) -> tuple[dict[str, str], dict[str, bytes]]:
    """Our metadata and all attachments (by name) of a file; raises LogError.

    They lie before the first chunk, where a recorder of ours puts them; with none there, the file is searched.
    """
    data: dict[str, str] = {}
    attachments: dict[str, bytes] = {}
    try:
        for opcode, content in records(path):
            if opcode == Opcode.ATTACHMENT:
                attachment = parse_attachment(content)
                attachments[attachment.name] = attachment.data
            elif opcode == Opcode.METADATA:
                metadata = parse_metadata(content)
                if metadata.name == METADATA:
                    data = metadata.metadata
            elif opcode == Opcode.CHUNK and data and attachments:
                break
    except DAMAGE as error:
        raise LogError(f"{path}: damaged: {error or type(error).__name__}") from None
    return data, attachments
