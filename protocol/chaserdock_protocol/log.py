"""The mission log: an MCAP file, every message verbatim, one channel a key and encoding.

``log_time`` is simulated time (the message's ``sim_time_ns``), so that a lock-step flight has its own
time line whatever the machine's speed; ``publish_time`` is the sender's wall clock. Payloads are the bytes that
travelled (msgpack), each channel's schema is the JSON Schema of its type; the resolved scenario and the
versions lie inside as an attachment and a metadata record.
"""

from __future__ import annotations

import os
import struct
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from importlib.metadata import version
from io import BytesIO
from pathlib import Path
from typing import Any

import msgspec
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Metadata
from mcap.records import Message as McapMessage
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from . import codec, topics
from .codec import Rejected
from .errors import ChaserdockError
from .messages import encoding_of, schema_of
from .topics import Topic

SCENARIO_ATTACHMENT = "scenario.json"
METADATA = "chaserdock"
_PACKAGES = (
    "chaserdock",
    "casadi",
    "eclipse-zenoh",
    "mcap",
    "msgspec",
    "numba",
    "numpy",
    "opencv-python-headless",
)


class LogError(ChaserdockError):
    """A log that cannot be used; the text is one clear line."""


@dataclass(frozen=True)
class Record:
    """One message of a log, opened. ``sent_ns`` is the sender's wall clock."""

    key: str
    topic: Topic
    place: str | None
    message: Any
    sent_ns: int


class _Header(msgspec.Struct):
    sim_time_ns: int = 0


_RECORD_HEAD = struct.Struct("<BQ")
# What the parsers of a damaged record raise.
_DAMAGE = (McapError, ValueError, KeyError, struct.error, zstandard.ZstdError)

_header = msgspec.msgpack.Decoder(_Header)


class LogWriter:
    """Writes a log; flushed to the file at least once a second of ``now_s``, so a kill costs at most the last second.

    Raises LogError when the file cannot be created or written.
    """

    def __init__(self, path: Path, now_s: Callable[[], float] = time.monotonic) -> None:
        self.path = path
        self.messages = 0
        self.unreadable = 0
        self._now_s = now_s
        self._channels: dict[tuple[str, str], int] = {}
        self._sequence: dict[int, int] = {}
        self._schemas: dict[str, int] = {}
        self._last_time_ns = 0
        try:
            self._file = path.open("xb")
        except FileExistsError:
            raise LogError(f"{path}: already exists; a log is never overwritten") from None
        except OSError as error:
            raise LogError(f"{path}: cannot be created: {error.strerror or error}") from None
        # Small chunks: what a reader holds in memory, and what an unclean end may cost inside the flush period.
        self._writer = Writer(self._file, chunk_size=1 << 20, compression=CompressionType.ZSTD)
        self._writer.start(profile="chaserdock", library=f"chaserdock {version('chaserdock')}")
        self._flushed_s = now_s()

    def describe(self, scenario_json: str, run: dict[str, str]) -> None:
        """Puts the resolved scenario, the run's data and the package versions into the log."""
        now = time.time_ns()
        self._writer.add_attachment(now, now, SCENARIO_ATTACHMENT, "application/json", scenario_json.encode())
        versions = {f"version.{name}": version(name) for name in _PACKAGES}
        self._writer.add_metadata(METADATA, {**run, **versions})

    def write(self, key: str, encoding: str, payload: bytes, sent_ns: int) -> None:
        """Appends one message, whatever it holds."""
        channel = self._channels.get((key, encoding))
        if channel is None:
            channel = self._channels[key, encoding] = self._register(key, encoding)
            self._sequence[channel] = 0
        try:
            self._last_time_ns = max(0, _header.decode(payload).sim_time_ns)
        except (msgspec.DecodeError, OverflowError, RecursionError, UnicodeDecodeError):
            self.unreadable += 1
        try:
            self._writer.add_message(
                channel, self._last_time_ns, payload, sent_ns or self._last_time_ns, self._sequence[channel]
            )
            self._sequence[channel] += 1
            self.messages += 1
            if self._now_s() - self._flushed_s >= 0.5:
                self.flush()
        except OSError as error:
            raise LogError(f"{self.path}: cannot be written: {error.strerror or error}") from None

    def flush(self) -> None:
        """Hands everything written so far to the operating system."""
        self._writer.flush()
        self._file.flush()
        self._flushed_s = self._now_s()

    def _register(self, key: str, encoding: str) -> int:
        found = topics.topic_of_key(key)
        known = found is not None and encoding_of(found[0].kind) == encoding
        name = encoding.rpartition(";")[2] if known else "unknown"
        if name not in self._schemas:
            schema = schema_of(found[0].kind) if known and found else b"{}"
            self._schemas[name] = self._writer.register_schema(name, "jsonschema", schema)
        message_encoding = "msgpack" if encoding.startswith("application/msgpack") else "unknown"
        return self._writer.register_channel(
            key, message_encoding, self._schemas[name], {"zenoh_encoding": encoding}
        )

    def close(self) -> None:
        """Writes index and footer and closes the file."""
        self._writer.finish()
        self._file.close()


def _records(path: Path) -> Iterator[tuple[int, ReadDataStream]]:
    """Opcode and content of every record up to the summary.

    A log whose writer was killed ends with its last whole record: what was flushed before is good. Raises
    LogError for a file that cannot be read, is no log, or is damaged.
    """
    try:
        with path.open("rb") as file:
            if file.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
                raise LogError(f"{path}: no MCAP log")
            left = os.fstat(file.fileno()).st_size - file.tell()
            while left >= _RECORD_HEAD.size:
                opcode, length = _RECORD_HEAD.unpack(file.read(_RECORD_HEAD.size))
                left -= _RECORD_HEAD.size + length
                if left < 0 or opcode == Opcode.DATA_END:
                    return
                yield opcode, ReadDataStream(BytesIO(file.read(length)))
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from None


def _raw_messages(path: Path, keys: Iterable[str] | None) -> Iterator[tuple[Channel, McapMessage]]:
    wanted = None if keys is None else set(keys)
    channels: dict[int, Channel] = {}
    for opcode, content in _records(path):
        if opcode != Opcode.CHUNK:
            continue
        try:
            inside = breakup_chunk(Chunk.read(content), validate_crc=True)
        except _DAMAGE as error:
            raise LogError(f"{path}: damaged: {error or type(error).__name__}") from None
        channels |= {record.id: record for record in inside if isinstance(record, Channel)}
        for record in inside:
            if isinstance(record, McapMessage):
                channel = channels[record.channel_id]
                if wanted is None or channel.topic in wanted:
                    yield channel, record


def read_log(path: Path, keys: Iterable[str] | None = None) -> Iterator[Record]:
    """Messages of a log in file order, opened and checked; those that do not pass are left out.

    Raises LogError when the file cannot be read, is no log, or where it is damaged; a log cut off is read up to there.
    """
    for channel, message in _raw_messages(path, keys):
        found = topics.topic_of_key(channel.topic)
        if found is None:
            continue
        try:
            opened = codec.decode(found[0].kind, message.data, channel.metadata.get("zenoh_encoding"))
        except Rejected:
            continue
        yield Record(channel.topic, found[0], found[1], opened, message.publish_time)


def count_messages(path: Path) -> dict[str, int]:
    """Messages by key, whatever they hold."""
    counts: dict[str, int] = {}
    for channel, _ in _raw_messages(path, None):
        counts[channel.topic] = counts.get(channel.topic, 0) + 1
    return dict(sorted(counts.items()))


def read_scenario(path: Path) -> tuple[str, dict[str, str]]:
    """The resolved scenario (JSON) and the run's data and versions; raises LogError if the log lacks them."""
    scenario: str | None = None
    data: dict[str, str] = {}
    try:
        for opcode, content in _records(path):
            if opcode == Opcode.ATTACHMENT:
                attachment = Attachment.read(content)
                if attachment.name == SCENARIO_ATTACHMENT:
                    scenario = attachment.data.decode()
            elif opcode == Opcode.METADATA:
                metadata = Metadata.read(content)
                if metadata.name == METADATA:
                    data = metadata.metadata
            if scenario is not None and data:
                break
    except _DAMAGE as error:
        raise LogError(f"{path}: damaged: {error or type(error).__name__}") from None
    if scenario is None:
        raise LogError(f"{path}: holds no scenario; was it recorded by chaserdock?")
    return scenario, data
