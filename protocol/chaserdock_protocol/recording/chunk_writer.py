"""The MCAP library's writer, with leaner lists of what it has written: the same file to the byte, for less work.

Most of a recorder's time went into records built number by number. What is overridden here are private parts of the
library, which no setting of its reaches; ``tests/test_log.py`` tells should they change.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from typing import Any

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, ChunkIndex, Schema, Statistics
from mcap.writer import CompressionType, Writer

# Small chunks: what a reader holds in memory, and what an unclean end may cost inside the flush period.
CHUNK_BYTES = 1 << 20
# A message's record up to its data: opcode, length of what follows; channel, number, log time, time of publishing.
_MESSAGE = struct.Struct("<BQHIQQ")
_pack_message, _MESSAGE_OPCODE, _MESSAGE_BYTES = _MESSAGE.pack, int(Opcode.MESSAGE), _MESSAGE.size - 9


class LeanWriter(Writer):
    """The library's writer of chunks of ``CHUNK_BYTES``."""

    def __init__(self, output: Any) -> None:
        super().__init__(
            output, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD, enable_data_crcs=True
        )
        private = vars(self)
        self._chunk = private["_Writer__chunk_builder"] = _Chunk(private["_Writer__statistics"])
        private["_Writer__chunk_indices"] = _ChunkIndexes()

    def add_message(
        self, channel_id: int, log_time: int, data: bytes, publish_time: int, sequence: int = 0
    ) -> None:
        """As the library's."""
        chunk = self._chunk
        chunk.add(channel_id, log_time, data, publish_time, sequence)
        if chunk.count > CHUNK_BYTES:
            self.flush()


class _Chunk:
    """The chunk in progress: its records, and by channel where its messages begin.

    The library asks for ``count``, ``num_messages``, ``end``, the times and the indexes in this order, then for ``reset``.
    """

    def __init__(self, statistics: Statistics) -> None:
        self.count = 0
        self.message_start_time = self.message_end_time = 0
        self._statistics = statistics
        self._records: list[bytes] = []
        self._begun: dict[int, list[int]] = {}

    @property
    def num_messages(self) -> int:
        return sum(map(len, self._begun.values())) // 2

    @property
    def message_indices(self) -> dict[int, _MessageIndex]:
        return {channel: _MessageIndex(channel, begun) for channel, begun in self._begun.items()}

    def add(self, channel: int, time_ns: int, data: bytes, sent_ns: int, number: int) -> None:
        """Appends a message."""
        size = len(data)
        head = _pack_message(_MESSAGE_OPCODE, _MESSAGE_BYTES + size, channel, number, time_ns, sent_ns)
        begun = self._begun.get(channel)
        if begun is None:
            begun = self._begun[channel] = []
        begun += (time_ns, self.count)
        self._records += (head, data)
        self.count += len(head) + size

    def add_channel(self, channel: Channel) -> None:
        self._add_record(channel)

    def add_schema(self, schema: Schema) -> None:
        self._add_record(schema)

    def _add_record(self, record: Channel | Schema) -> None:
        written = _bytes_of(record)
        self._records.append(written)
        self.count += len(written)

    def end(self) -> bytes:
        """All of its records; also counts its messages among the file's."""
        self.message_start_time = min(min(begun[::2]) for begun in self._begun.values())
        self.message_end_time = max(max(begun[::2]) for begun in self._begun.values())
        file = self._statistics
        if file.message_count:
            file.message_start_time = min(file.message_start_time, self.message_start_time)
        else:
            file.message_start_time = self.message_start_time
        file.message_end_time = max(file.message_end_time, self.message_end_time)
        file.message_count += self.num_messages
        for channel, begun in self._begun.items():
            file.channel_message_counts[channel] += len(begun) // 2
        return b"".join(self._records)

    def reset(self) -> None:
        self.count = 0
        self._records, self._begun = [], {}


class _MessageIndex:
    """Where a channel's messages begin in a chunk: time and place in turn."""

    def __init__(self, channel: int, begun: list[int]) -> None:
        self._channel, self._begun = channel, begun

    def write(self, stream: RecordBuilder) -> None:
        size = 8 * len(self._begun)
        head = (Opcode.MESSAGE_INDEX, 6 + size, self._channel, size)
        stream.write(struct.pack(f"<BQHI{len(self._begun)}Q", *head, *self._begun))


class _ChunkIndexes:
    """The list of chunk indexes, as the bytes that they become in the file.

    As objects they take about ten kilobytes a chunk with sixty channels, in a flight of ten hours a gigabyte.
    """

    def __init__(self) -> None:
        self._written, self._number = bytearray(), 0

    def append(self, index: ChunkIndex) -> None:
        self._written += _bytes_of(index)
        self._number += 1

    def __iter__(self) -> Iterator[_ChunkIndexes]:
        return iter((self,))  # the writer asks each to write itself

    def __len__(self) -> int:
        return self._number

    def write(self, stream: RecordBuilder) -> None:
        stream.write(bytes(self._written))


def _bytes_of(record: Channel | Schema | ChunkIndex) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return builder.end()
