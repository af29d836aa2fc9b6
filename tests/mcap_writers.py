# SPDX-License-Identifier: Apache-2.0
"""Logs as other tools write them: a log copied with each of the options of the official library."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

from chaserdock_protocol.recording.scan import RECORD_HEAD
from mcap.opcode import Opcode
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

LAYOUTS: dict[str, dict[str, Any]] = {
    "without chunks": {"use_chunking": False},
    "uncompressed": {"compression": CompressionType.NONE},
    "lz4": {"compression": CompressionType.LZ4},
    "zstd": {"compression": CompressionType.ZSTD},
}
_NO_INDEX = {"index_types": IndexType.NONE}
_NO_SUMMARY = {
    **_NO_INDEX,
    "use_statistics": False,
    "use_summary_offsets": False,
    "repeat_channels": False,
    "repeat_schemas": False,
}
OPTIONS: dict[str, dict[str, Any]] = {
    "all": {},
    "checksum over all data": {"enable_data_crcs": True},
    "no checksums": {"enable_crcs": False},
    "no index": _NO_INDEX,
    "no statistics": {"use_statistics": False},
    "no declarations": {"repeat_channels": False, "repeat_schemas": False},
    "no summary": _NO_SUMMARY,
}


def copy_log(
    source: Path,
    out: Path,
    *,
    attachments: str = "first",
    keep: Callable[[str, int], bool] = lambda key, time_ns: True,
    numbered: bool = True,
    library: str = "other tool",
    **options: Any,
) -> Path:
    """Copy a log with the official library; ``attachments``: ``first``, ``last`` or ``none``."""
    with source.open("rb") as file, out.open("wb") as target:
        writer, reader = Writer(target, **{"chunk_size": 40_000, **options}), make_reader(file)
        writer.start(profile=reader.get_header().profile, library=library)

        def attach() -> None:
            for a in reader.iter_attachments():
                writer.add_attachment(a.create_time, a.log_time, a.name, a.media_type, a.data)
            for m in reader.iter_metadata():
                writer.add_metadata(m.name, m.metadata)

        if attachments == "first":
            attach()
        schemas: dict[int, int] = {}
        channels: dict[int, int] = {}
        for schema, channel, m in reader.iter_messages(log_time_order=False):
            if not keep(channel.topic, m.log_time):
                continue
            assert schema is not None
            if schema.id not in schemas:
                schemas[schema.id] = writer.register_schema(
                    schema.name, schema.encoding, schema.data
                )
            if channel.id not in channels:
                channels[channel.id] = writer.register_channel(
                    channel.topic, channel.message_encoding, schemas[schema.id], channel.metadata
                )
            sequence = m.sequence if numbered else 0
            writer.add_message(channels[channel.id], m.log_time, m.data, m.publish_time, sequence)
        if attachments == "last":
            attach()
        writer.finish()
    return out


def places(data: bytes | bytearray, *opcodes: Opcode) -> list[tuple[int, int]]:
    """Return offset and end of the records of these kinds before the end of the data."""
    place, found = 8, list[tuple[int, int]]()
    while True:
        opcode, length = RECORD_HEAD.unpack_from(data, place)
        following = place + RECORD_HEAD.size + length
        if opcode in opcodes:
            found.append((place, following))
        if opcode == Opcode.DATA_END:
            return found
        place = following
