# SPDX-License-Identifier: Apache-2.0
"""Write logs by the package ``mcap``, with faster messages and a compact list of chunk indexes.

The package keeps one object per chunk until the file is closed. With 60 channels and a flush every
0.5 s that is 4.6 kB per chunk, 330 MB in a flight of ten hours, and slows down garbage collection;
as bytes it is 0.7 kB. The file is the same to the byte (``tests/protocol/test_log.py``).

A message record and its index are written by one ``struct.pack`` each, as messages are most of a
log (measured in docs/evidence/simulation.md).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from io import BytesIO
from typing import Any

from mcap._chunk_builder import ChunkBuilder
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import ChunkIndex, Statistics
from mcap.writer import CompressionType, Writer

# Bounds the memory of a reader, and what a crash may cost within a flush period.
CHUNK_BYTES = 1 << 20


_pack_message = struct.Struct("<BQHIQQ").pack
"""Opcode, length, channel, sequence, log time and publish time of a message record."""
_HEAD_BYTES = 22
"""Length of a message record without its data."""


def create_writer(output: Any, compressed: bool = True) -> Writer:
    """Return a writer with chunks, compressed by zstd or not, indexes and checksums."""
    return _LogFileWriter(output, CompressionType.ZSTD if compressed else CompressionType.NONE)


class _LogFileWriter(Writer):
    """Replace the parts of the package's writer that handle messages.

    These are private attributes, as the package has no option for them.
    """

    def __init__(self, output: Any, compression: CompressionType) -> None:
        super().__init__(
            output, chunk_size=CHUNK_BYTES, compression=compression, enable_data_crcs=True
        )
        private = vars(self)
        self._chunk = private["_Writer__chunk_builder"] = _Chunk(private["_Writer__statistics"])
        private["_Writer__chunk_indices"] = _ChunkIndexes()
        self._finish_chunk = getattr(self, "_Writer__finalize_chunk")  # noqa: B009

    def add_message(
        self, channel_id: int, log_time: int, data: bytes, publish_time: int, sequence: int = 0
    ) -> None:
        """See ``Writer.add_message``."""
        size = self._chunk.append(channel_id, log_time, data, publish_time, sequence)
        if size > CHUNK_BYTES:
            self._finish_chunk()


class _Chunk(ChunkBuilder):
    """Chunk in progress, which also counts its messages in the statistics of the file."""

    def __init__(self, statistics: Statistics) -> None:
        super().__init__()
        self._statistics = statistics
        self.message_indices: dict[int, Any] = {}

    def append(
        self, channel: int, log_time: int, data: bytes, publish_time: int, sequence: int
    ) -> int:
        """Append a message record. Returns the size of the chunk, bytes."""
        buffer: BytesIO = self.record_writer._buffer  # pyright: ignore[reportPrivateUsage]
        index = self.message_indices.get(channel)
        if index is None:
            index = self.message_indices[channel] = _MessageIndex(channel)
        index.entries += (log_time, buffer.tell())
        length = _HEAD_BYTES + len(data)
        buffer.write(
            _pack_message(Opcode.MESSAGE, length, channel, sequence, log_time, publish_time)
        )
        buffer.write(data)
        if self.num_messages == 0 or log_time < self.message_start_time:
            self.message_start_time = log_time
        if log_time > self.message_end_time:
            self.message_end_time = log_time
        self.num_messages += 1
        total = self._statistics
        if total.message_count == 0 or log_time < total.message_start_time:
            total.message_start_time = log_time
        if log_time > total.message_end_time:
            total.message_end_time = log_time
        total.message_count += 1
        total.channel_message_counts[channel] += 1
        return buffer.tell()


class _MessageIndex:
    """Index of one channel's messages in a chunk: time and offset of each, alternating."""

    def __init__(self, channel: int) -> None:
        self._channel = channel
        self.entries: list[int] = []

    def write(self, stream: RecordBuilder) -> None:
        """See ``MessageIndex.write`` of the package."""
        entries = self.entries
        size = 8 * len(entries)
        stream.write(
            struct.pack(
                f"<BQHI{len(entries)}Q",
                Opcode.MESSAGE_INDEX,
                6 + size,
                self._channel,
                size,
                *entries,
            )
        )


class _ChunkIndexes:
    """List of chunk indexes, stored as the bytes of the records."""

    def __init__(self) -> None:
        self._records, self._count = bytearray(), 0

    def append(self, index: ChunkIndex) -> None:
        builder = RecordBuilder()
        index.write(builder)
        self._records += builder.end()
        self._count += 1

    def __iter__(self) -> Iterator[_ChunkIndexes]:
        return iter((self,))  # the package calls write() of each element

    def __len__(self) -> int:
        return self._count

    def write(self, stream: RecordBuilder) -> None:
        stream.write(bytes(self._records))
