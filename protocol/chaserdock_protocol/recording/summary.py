# SPDX-License-Identifier: Apache-2.0
"""What an MCAP file says of its content behind its data: declarations and numbers of records.

Finds it in a file that is cut off at either end, too.
"""

from __future__ import annotations

import mmap
import zlib
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Footer, Schema, Statistics
from mcap.writer import MCAP0_MAGIC

from .scan import DAMAGE, RECORD_HEAD, parse_record

_DATA_END = RECORD_HEAD.pack(Opcode.DATA_END, 4)
_DATA_END_BYTES = len(_DATA_END) + 4
_FOOTER_CONTENT_BYTES = 20  # two offsets of 8 bytes and a checksum (MCAP specification)
_FOOTER = RECORD_HEAD.pack(Opcode.FOOTER, _FOOTER_CONTENT_BYTES)
_FOOTER_BYTES = len(_FOOTER) + _FOOTER_CONTENT_BYTES
_CRC_BYTES = 4  # CRC-32
_SUMMARY_KINDS = (
    Opcode.SCHEMA,
    Opcode.CHANNEL,
    Opcode.STATISTICS,
    Opcode.CHUNK_INDEX,
    Opcode.ATTACHMENT_INDEX,
    Opcode.METADATA_INDEX,
    Opcode.SUMMARY_OFFSET,
    Opcode.FOOTER,
)


@dataclass
class FileSummary:
    """Summary of a file: ``channels`` and ``schemas`` by number, and ``statistics``, where the
    writer repeats them. ``data_end``: offset at which the data end; ``data_crc``: checksum over
    them, 0 for none.
    """

    data_end: int
    data_crc: int = 0
    channels: dict[int, Channel] = field(default_factory=dict)
    schemas: dict[int, Schema] = field(default_factory=dict)
    statistics: Statistics | None = None


def read_summary(path: Path) -> FileSummary | None:
    """Return the summary of a file, None for one without. Raises OSError."""
    with path.open("rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        return find_summary(data)


def find_summary(data: mmap.mmap) -> FileSummary | None:
    """Return the summary in the bytes of a file; None where the data have no end.

    Where the summary is damaged, only the end of the data is known.
    """
    stated = _stated_end(data)
    if stated is not None:
        return _parse(data, stated)
    place = data.rfind(_DATA_END)
    while place >= 0:
        begin = place + _DATA_END_BYTES
        # These bytes may stand in a message, too: then no record of a summary follows.
        if begin >= len(data) or data[begin] in _SUMMARY_KINDS:
            return _parse(data, place)
        place = data.rfind(_DATA_END, 0, place)
    return None


def _stated_end(data: mmap.mmap) -> int | None:
    """Return the end of the data by the footer of a whole file with a summary; None
    otherwise.
    """
    place = len(data) - len(MCAP0_MAGIC) - _FOOTER_BYTES
    if place < 0 or data[place : place + RECORD_HEAD.size] != _FOOTER:
        return None
    footer = _footer_at(data, place)
    end = footer.summary_start - _DATA_END_BYTES
    if not 0 < end < place:
        return None
    if data[end : end + len(_DATA_END)] == _DATA_END:
        return end
    # A file that lacks its beginning has all of its offsets wrong, and so no matching checksum.
    known = footer.summary_crc and _is_intact(data, footer.summary_start, place)
    return end if known else None


def _footer_at(data: mmap.mmap, place: int) -> Footer:
    content = data[place + RECORD_HEAD.size : place + _FOOTER_BYTES]
    return Footer.read(ReadDataStream(BytesIO(content)))


def _is_intact(data: mmap.mmap, begin: int, footer: int) -> bool:
    """Return whether the checksum of the footer at ``footer`` matches; true without a checksum."""
    stated = _footer_at(data, footer).summary_crc
    return stated in (0, zlib.crc32(data[begin : footer + _FOOTER_BYTES - _CRC_BYTES]))


def _parse(data: mmap.mmap, data_end: int) -> FileSummary:
    head = data_end + RECORD_HEAD.size
    begin = place = data_end + _DATA_END_BYTES
    crc = 0
    if data[data_end:head] == _DATA_END and place <= len(data):
        crc = int.from_bytes(data[head:place], "little")
    summary, unknown = FileSummary(data_end, crc), FileSummary(data_end, crc)
    while place + RECORD_HEAD.size <= len(data):
        opcode, length = RECORD_HEAD.unpack_from(data, place)
        following = place + RECORD_HEAD.size + length
        if following > len(data):
            break  # cut off within the summary
        if opcode not in _SUMMARY_KINDS:
            return unknown
        if opcode == Opcode.FOOTER:
            whole = length == _FOOTER_CONTENT_BYTES and _is_intact(data, begin, place)
            return summary if whole else unknown
        try:
            _add(summary, opcode, data[place + RECORD_HEAD.size : following])
        except DAMAGE:
            return unknown
        place = following
    return summary


def _add(summary: FileSummary, opcode: int, content: bytes) -> None:
    if opcode == Opcode.STATISTICS:
        summary.statistics = Statistics.read(ReadDataStream(BytesIO(content)))
    for record in parse_record(opcode, content):
        if isinstance(record, Channel):
            summary.channels[record.id] = record
        elif isinstance(record, Schema):
            summary.schemas[record.id] = record
