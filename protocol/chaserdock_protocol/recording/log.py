# SPDX-License-Identifier: Apache-2.0
"""The mission log: MCAP files with every message verbatim, one channel per key and encoding.

``log_time`` is simulated time (the message's ``sim_time_ns``, or that of the message before if it
has none); ``publish_time`` is the sender's wall clock. Payloads are the transmitted bytes
(msgpack); the schema of a channel is the JSON Schema of its type. The resolved scenario, the lock
file and the versions are attachments and a metadata record. A second layer for viewers, under
``/viewer/``, is optional and never read back.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
from mcap.records import Channel
from mcap.records import Message as McapMessage

from chaserdock_protocol import topics
from chaserdock_protocol.codec import Rejected
from chaserdock_protocol.messages import encoding_of, schema_of
from chaserdock_protocol.scenario import Scenario, scenario_from_json
from chaserdock_protocol.scenario.migrations import migrated
from chaserdock_protocol.topics import Topic

from . import provenance
from .chunk_index import create_writer
from .scan import (
    METADATA,
    VIEWER_PREFIX,
    FileState,
    LogError,
    LogSource,
    log_files,
    read_head,
    stored_messages,
    with_checksum,
)
from .schema_migrations import decode_logged

_FLUSH_S = 0.5
"""Longest time (wall or simulated, s) between writes to disk: a killed recorder loses less than a
second (tests/protocol/test_record_again.py)."""
SCENARIO_ATTACHMENT = "scenario.json"
SCENARIO_KIND = "scenario"
FULL_SCENARIO, FLIGHT_SCENARIO = "full", "flight"
"""Key and values of a log's run data that say which scenario it holds: the full one (also without
the key), or only what flight software receives, of a world that gives no other.
"""
LOCK_ATTACHMENT = "uv.lock.gz"
VERSIONS_ATTACHMENT = "versions.json"
_PACKAGES = (
    "chaserdock",
    "casadi",
    "eclipse-zenoh",
    "mcap",
    "msgspec",
    "numpy",
    "opencv-python-headless",
)

__all__ = [
    "LogError",
    "LogSource",
    "LogWriter",
    "NoScenario",
    "Record",
    "count_messages",
    "logged_scenario",
    "read_log",
    "read_scenario",
]


class NoScenario(LogError):
    """A log without its scenario: of another program, or copied by a tool that left it out."""


@dataclass(frozen=True)
class Record:
    """A decoded message of a log. ``sent_ns`` is the sender's wall clock."""

    key: str
    topic: Topic
    place: str | None
    message: Any
    sent_ns: int


class _Header(msgspec.Struct):
    sim_time_ns: int = 0


_header = msgspec.msgpack.Decoder(_Header)


@dataclass(slots=True)
class _ChannelState:
    """A channel of the file, and its number of messages."""

    channel: int
    messages: int = 0


class _Sink:
    """Output file of the MCAP writer. Truncates a record that could not be written completely."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.size = 0

    def write(self, data: bytes) -> None:
        done = 0
        try:
            while done < len(data):
                done += self._file.write(memoryview(data)[done:])
        except OSError:
            # Best effort: readers also skip a truncated record.
            os.ftruncate(self._file.fileno(), self.size)
            raise
        self.size += len(data)

    def tell(self) -> int:
        return self.size

    def flush(self) -> None:
        """Do nothing: writes are unbuffered."""


class LogWriter:
    """Writes a log. A kill loses at most the last second, by ``now_s`` and by simulated time.

    Flushes every 0.5 s of both, as lock-step flights run faster or slower than the wall clock.

    Raises LogError if the file cannot be created or written. What was written before stays
    readable.
    """

    def __init__(
        self, path: Path, now_s: Callable[[], float] = time.monotonic, compressed: bool = True
    ) -> None:
        self.path = path
        self.messages = 0
        self.unreadable = 0
        self.last_time_ns = 0
        self._now_s = now_s
        self._broken = False
        self._channels: dict[tuple[str, str], _ChannelState] = {}
        self._schemas: dict[str, int] = {}
        try:
            self._file = path.open("xb", buffering=0)
        except FileExistsError:
            raise LogError(f"{path}: already exists; a log is never overwritten") from None
        except OSError as error:
            raise LogError(f"{path}: cannot be created: {error.strerror or error}") from None
        self._sink: Any = _Sink(self._file)
        self._writer = create_writer(self._sink, compressed)
        with self._writing():
            self._writer.start(
                profile="chaserdock", library=f"chaserdock {provenance.version('chaserdock')}"
            )
        self._flushed_s, self._flushed_ns = now_s(), 0

    @property
    def size_bytes(self) -> int:
        """Return the size of the file in bytes, without the chunk in progress."""
        return self._sink.size

    def describe(self, scenario_json: str, run: dict[str, str]) -> None:
        """Write what a reader needs to reproduce the run.

        Resolved scenario, the run's data, lock file, package versions, commit if there is one, BLAS
        in use.
        """
        now = time.time_ns()
        attached = [
            (SCENARIO_ATTACHMENT, "application/json", scenario_json.encode()),
            (VERSIONS_ATTACHMENT, "application/json", provenance.versions_json()),
            (LOCK_ATTACHMENT, "application/gzip", provenance.lock_file_gz()),
        ]
        versions = {f"version.{name}": provenance.version(name) for name in _PACKAGES}
        commit = provenance.commit_of()
        source = {} if commit is None else {"commit": commit}
        about = {"blas": provenance.blas_in_use(), **source, **run, **versions}
        with self._writing():
            for name, kind, data in attached:
                if data is not None:
                    self._writer.add_attachment(now, now, name, kind, data)
            self._writer.add_metadata(METADATA, with_checksum(about))

    def note(self, name: str, data: dict[str, str]) -> None:
        """Write a metadata record."""
        with self._writing():
            self._writer.add_metadata(name, with_checksum(data))

    def write(
        self, key: str, encoding: str, payload: bytes, sent_ns: int, time_ns: int | None = None
    ) -> None:
        """Append a message, valid or not. ``time_ns``: its ``sim_time_ns`` if the caller has
        decoded it.
        """
        channel = self._channels.get((key, encoding))
        if channel is None:
            with self._writing():
                channel = self._channels[key, encoding] = _ChannelState(
                    self._register(key, encoding)
                )
        try:
            if time_ns is None:
                time_ns = max(0, _header.decode(payload).sim_time_ns)
            # A message without a simulated time (presence) gets the time of the message before.
            self.last_time_ns = time_ns or self.last_time_ns
        except (msgspec.DecodeError, OverflowError, RecursionError, UnicodeDecodeError):
            self.unreadable += 1
        self._add(channel, self.last_time_ns, payload, sent_ns or self.last_time_ns)
        self.messages += 1
        self.flush_if_due()

    def write_view(
        self, topic: str, schema: tuple[str, str, bytes], payload: bytes, time_ns: int
    ) -> None:
        """Append a message of the viewer layer; ``topic`` begins with ``/viewer/``.

        ``schema``: name, encoding (also the message's, such as ``protobuf``) and data.
        """
        if not topic.startswith(VIEWER_PREFIX):
            raise ValueError(f"{topic} is not a topic of the viewer layer")
        name, encoding, data = schema
        channel = self._channels.get((topic, name))
        if channel is None:
            with self._writing():
                if name not in self._schemas:
                    self._schemas[name] = self._writer.register_schema(name, encoding, data)
                channel = _ChannelState(
                    self._writer.register_channel(topic, encoding, self._schemas[name])
                )
            self._channels[topic, name] = channel
        self._add(channel, time_ns, payload, time_ns)

    def _add(self, written: _ChannelState, time_ns: int, payload: bytes, sent_ns: int) -> None:
        # Not ``with self._writing()``: it would add a third to the cost of a small message.
        if self._broken:
            raise self._not_continued()
        try:
            self._writer.add_message(written.channel, time_ns, payload, sent_ns, written.messages)
        except OSError as error:
            raise self._broken_by(error) from None
        written.messages += 1

    @contextmanager
    def _writing(self) -> Iterator[None]:
        if self._broken:
            raise self._not_continued()
        try:
            yield
        except OSError as error:
            raise self._broken_by(error) from None

    def _not_continued(self) -> LogError:
        return LogError(f"{self.path}: not continued after a failed write")

    def _broken_by(self, error: OSError) -> LogError:
        self._broken = True
        return LogError(f"{self.path}: cannot be written: {error.strerror or error}")

    def flush_if_due(self) -> None:
        """Flush every 0.5 s; called with every message, and to be called while none arrives."""
        flown_ns = self.last_time_ns - self._flushed_ns
        if self._now_s() - self._flushed_s >= _FLUSH_S or flown_ns >= _FLUSH_S * 1e9:
            self.flush()

    def flush(self) -> None:
        """Write the chunk in progress to the file."""
        with self._writing():
            self._writer.flush()
        self._flushed_s, self._flushed_ns = self._now_s(), self.last_time_ns

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
        """Write index and footer unless a write has failed, and close the file. Raises LogError."""
        try:
            if not self._broken:
                with self._writing():
                    self._writer.finish()
        finally:
            self._file.close()


def _raw_messages(
    source: LogSource, keys: Iterable[str] | None, state: FileState | None = None
) -> Iterator[tuple[Channel, McapMessage]]:
    wanted = None if keys is None else set(keys)
    for path in log_files(source):
        for channel, message in stored_messages(path, state):
            key = channel.topic
            if not key.startswith(VIEWER_PREFIX) and (wanted is None or key in wanted):
                yield channel, message


def read_log(
    source: LogSource, keys: Iterable[str] | None = None, rejected: Counter[str] | None = None
) -> Iterator[Record]:
    """Yield the valid messages of a log in file order; messages of older versions are upgraded.

    Invalid messages are counted in ``rejected`` as ``key: reason``. Raises LogError if a file
    cannot be read, is no log, or at the position where it is damaged. A truncated log is read up to
    its last whole record.
    """
    for channel, message in _raw_messages(source, keys):
        found = topics.topic_of_key(channel.topic)
        try:
            if found is None:
                raise Rejected("key", "unknown key")
            encoding = channel.metadata.get("zenoh_encoding", "")
            decoded = decode_logged(found[0].kind, message.data, encoding)
        except Rejected as refusal:
            if rejected is not None:
                rejected[f"{channel.topic}: {refusal.reason}"] += 1
            continue
        yield Record(channel.topic, found[0], found[1], decoded, message.publish_time)


def count_messages(source: LogSource) -> dict[str, int]:
    """Return the number of messages by key, valid or not."""
    counts: dict[str, int] = {}
    for channel, _ in _raw_messages(source, None):
        counts[channel.topic] = counts.get(channel.topic, 0) + 1
    return dict(sorted(counts.items()))


def read_scenario(source: LogSource) -> tuple[str, dict[str, str]]:
    """Return the resolved scenario (JSON, present format) and the run's data and versions. Raises
    LogError without them.

    All files of a rotated log must belong to one run.
    """
    files = log_files(source)
    first, scenario = _scenario_of(files[0])
    for path in files[1:]:
        data = _scenario_of(path)[0]
        if data.get("run_id") != first.get("run_id"):
            raise LogError(f"{path}: of another run than {files[0]}")
    return migrated(scenario), first


def logged_scenario(source: LogSource) -> tuple[Scenario, dict[str, str]]:
    """Return the scenario of a log, and the run's data and versions. Raises LogError,
    ScenarioError.
    """
    text, run = read_scenario(source)
    return scenario_from_json(text, f"{source}: scenario"), run


def _scenario_of(path: Path) -> tuple[dict[str, str], str]:
    data, attachments = read_head(path)
    if SCENARIO_ATTACHMENT not in attachments:
        raise NoScenario(f"{path}: holds no scenario; was it recorded by chaserdock?")
    try:
        return data, attachments[SCENARIO_ATTACHMENT].decode()
    except UnicodeDecodeError:
        raise LogError(f"{path}: its {SCENARIO_ATTACHMENT} is no UTF-8 text") from None
