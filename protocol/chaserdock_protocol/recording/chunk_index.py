# SPDX-License-Identifier: Apache-2.0
"""MCAP writer of the logs: the ``mcap`` package's, with a compact list of chunk indexes.

The package keeps one object per chunk until the file is closed. With 60 channels and a flush every 0.5 s that is 4.6 kB
per chunk, 330 MB in a flight of ten hours, and slows down garbage collection; as bytes it is 0.7 kB. The file is the
same to the byte (``tests/protocol/test_log.py``).

The package's writer takes 11 us per message, recorder included and images excluded; one of our own takes 5 to 8 us, and
as long with images, which is not worth its code.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from mcap.data_stream import RecordBuilder
from mcap.records import ChunkIndex
from mcap.writer import CompressionType, Writer

# Bounds the memory of a reader, and what a crash may cost within a flush period.
CHUNK_BYTES = 1 << 20


def create_writer(output: Any) -> Writer:
    """Return a writer with zstd chunks, indexes and checksums."""
    writer = Writer(output, chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD, enable_data_crcs=True)
    vars(writer)["_Writer__chunk_indices"] = _ChunkIndexes()  # private: no option selects it
    return writer


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
