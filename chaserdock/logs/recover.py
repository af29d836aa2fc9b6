# SPDX-License-Identifier: Apache-2.0
"""Copies the readable messages of a damaged or cut off log into a new one."""

from __future__ import annotations

import mmap
import struct
from collections.abc import Iterator
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from typing import Any

import msgspec
from chaserdock_protocol.recording.log import LogError
from chaserdock_protocol.recording.scan import (
    DAMAGE,
    MAX_RECORD_BYTES,
    RECOVERED,
    parse_attachment,
    parse_chunk,
    parse_metadata,
    with_checksum,
)
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Metadata, Schema
from mcap.records import Message as McapMessage
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

_HEAD = struct.Struct("<BQ")
# Head of a chunk: opcode and length, 28 bytes of times, size and checksum, then the name of its
# compression.
_CHUNK_MARK, _MARK_OFFSET = b"\x04\x00\x00\x00zstd", _HEAD.size + 28


class Recovered(msgspec.Struct):
    """Result of a recovery: copied messages and chunks; records with a wrong checksum or format;
    bytes that were skipped.
    """

    messages: int = 0
    chunks: int = 0
    broken_records: int = 0
    skipped_bytes: int = 0
    messages_without_channel: int = 0


def recover(log: Path, out: Path) -> Recovered:
    """Copy every message of ``log`` whose chunk has a valid checksum into the new log ``out``.

    Raises LogError when ``log`` is no log or holds no whole message, or ``out`` exists or cannot be
    written.
    """
    try:
        with log.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
            if data[: len(MCAP0_MAGIC)] != MCAP0_MAGIC:
                raise LogError(f"{log}: no MCAP log")
            found = Recovered()
            channels, schemas = _summary_declarations(data)
            with out.open("xb") as target:
                try:
                    _copy(data, target, channels, schemas, found, str(log))
                except OSError as error:
                    out.unlink(missing_ok=True)
                    raise LogError(f"{out}: cannot be written: {error.strerror or error}") from None
    except FileExistsError:
        raise LogError(f"{out}: already exists; a log is never overwritten") from None
    except OSError as error:
        raise LogError(f"{error.filename or log}: {error.strerror or error}") from None
    except ValueError:
        raise LogError(f"{log}: no MCAP log") from None  # an empty file cannot be mapped
    if not found.messages:
        out.unlink()
        raise LogError(f"{log}: holds no whole message")
    return found


def _walk(data: mmap.mmap, found: Recovered) -> Iterator[tuple[int, bytes]]:
    """Yield opcode and content of each record. After a broken one, continue with the next chunk."""
    place = len(MCAP0_MAGIC)
    while place + _HEAD.size <= len(data):
        opcode, length = _HEAD.unpack_from(data, place)
        known = Opcode.HEADER <= opcode <= Opcode.DATA_END
        if known and length <= min(MAX_RECORD_BYTES, len(data) - place - _HEAD.size):
            content = data[place + _HEAD.size : place + _HEAD.size + length]
            if opcode == Opcode.DATA_END and length == 4:
                return
            if opcode != Opcode.CHUNK or _is_valid(content):
                yield opcode, content
                place += _HEAD.size + length
                continue
        following = _next_chunk(data, place + 1)
        # After a kill the last record is partial. Only damage before the end counts.
        found.broken_records += following < len(data)
        found.skipped_bytes += following - place
        place = following


def _is_valid(chunk: bytes) -> bool:
    try:
        parse_chunk(chunk)
    except DAMAGE:
        return False
    return True


def _next_chunk(data: mmap.mmap, place: int) -> int:
    """Return the position of the next whole chunk, or the end of the data."""
    mark = data.find(_CHUNK_MARK, place)
    while mark >= 0:
        begin = mark - _MARK_OFFSET
        if begin >= place:
            opcode, length = _HEAD.unpack_from(data, begin)
            content = data[begin + _HEAD.size : begin + _HEAD.size + min(length, MAX_RECORD_BYTES)]
            if opcode == Opcode.CHUNK and len(content) == length and _is_valid(content):
                return begin
        mark = data.find(_CHUNK_MARK, mark + 1)
    return len(data)


def _summary_declarations(data: mmap.mmap) -> tuple[dict[int, Channel], dict[int, Schema]]:
    """Return the channels and schemas that a closed log repeats in its summary; the chunk that
    declares them may be lost.
    """
    channels: dict[int, Channel] = {}
    schemas: dict[int, Schema] = {}
    footer = len(data) - len(MCAP0_MAGIC) - 20 - _HEAD.size
    if footer < 0 or data[footer] != Opcode.FOOTER:
        return channels, schemas
    place = struct.unpack_from("<Q", data, footer + _HEAD.size)[0]
    while 0 < place < footer:
        opcode, length = _HEAD.unpack_from(data, place)
        stream = ReadDataStream(
            BytesIO(data[place + _HEAD.size : place + _HEAD.size + min(length, 1 << 24)])
        )
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(stream)
                schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(stream)
                channels[channel.id] = channel
        except DAMAGE:
            return {}, {}
        place += _HEAD.size + length
    return channels, schemas


def _copy(
    data: mmap.mmap,
    target: Any,
    channels: dict[int, Channel],
    schemas: dict[int, Schema],
    found: Recovered,
    source: str,
) -> None:
    writer = Writer(
        target, chunk_size=1 << 20, compression=CompressionType.ZSTD, enable_data_crcs=True
    )
    writer.start(profile="chaserdock", library=f"chaserdock {version('chaserdock')} recover")
    writer.add_metadata(RECOVERED, with_checksum({"from": source}))
    new_channels: dict[int, int] = {}
    new_schemas: dict[int, int] = {}
    for opcode, content in _walk(data, found):
        try:
            if opcode == Opcode.ATTACHMENT:
                a: Attachment = parse_attachment(content)
                writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, a.data)
            elif opcode == Opcode.METADATA:
                metadata: Metadata = parse_metadata(content)
                if metadata.name != RECOVERED:
                    writer.add_metadata(metadata.name, metadata.metadata)
            elif opcode == Opcode.CHUNK:
                found.chunks += 1
                for record in parse_chunk(content):
                    if isinstance(record, Schema):
                        schemas[record.id] = record
                    elif isinstance(record, Channel):
                        channels[record.id] = record
                    else:
                        _copy_message(
                            writer, record, channels, schemas, new_channels, new_schemas, found
                        )
        except DAMAGE:
            found.broken_records += 1
    writer.finish()


def _copy_message(
    writer: Writer,
    message: McapMessage,
    channels: dict[int, Channel],
    schemas: dict[int, Schema],
    new_channels: dict[int, int],
    new_schemas: dict[int, int],
    found: Recovered,
) -> None:
    channel = channels.get(message.channel_id)
    schema = schemas.get(channel.schema_id) if channel is not None else None
    if channel is None or schema is None:
        found.messages_without_channel += 1
        return
    if channel.id not in new_channels:
        if schema.id not in new_schemas:
            new_schemas[schema.id] = writer.register_schema(
                schema.name, schema.encoding, schema.data
            )
        new_channels[channel.id] = writer.register_channel(
            channel.topic, channel.message_encoding, new_schemas[schema.id], channel.metadata
        )
    writer.add_message(
        new_channels[channel.id],
        message.log_time,
        message.data,
        message.publish_time,
        message.sequence,
    )
    found.messages += 1
