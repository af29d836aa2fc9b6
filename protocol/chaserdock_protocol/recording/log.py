"""The mission log: MCAP files, every message verbatim, one channel a key and encoding.

``log_time`` is simulated time (the message's ``sim_time_ns``; the time of the one before where it has none), so that
a lock-step flight has its own time line whatever the machine's speed; ``publish_time`` is the sender's wall clock.
Payloads are the bytes that travelled (msgpack), each channel's schema is the JSON Schema of its type; the resolved
scenario, the lock file and the versions lie inside as attachments and a metadata record. Beside this verbatim layer
there may be a second one for viewers, under ``/viewer/``, which nothing here reads back.
"""

from __future__ import annotations

import os
import time
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, BinaryIO

import msgspec
from mcap.records import Channel
from mcap.records import Message as McapMessage

from chaserdock_protocol import topics
from chaserdock_protocol.codec import Rejected
from chaserdock_protocol.messages import encoding_of, schema_of
from chaserdock_protocol.scenario.migrations import migrated
from chaserdock_protocol.topics import Topic

from . import provenance
from .chunk_writer import LeanWriter
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
SCENARIO_ATTACHMENT = "scenario.json"
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

__all__ = ["LogError", "LogSource", "LogWriter", "Record", "count_messages", "read_log", "read_scenario"]


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


_header = msgspec.msgpack.Decoder(_Header)


@dataclass(slots=True)
class _Written:
    """A channel of the file, and how many messages of it are there."""

    channel: int
    messages: int = 0


class _Sink:
    """The file under the MCAP writer, which hands over whole records: one that does not fit is taken back."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.size = 0

    def write(self, data: bytes) -> None:
        done = 0
        try:
            while done < len(data):
                done += self._file.write(memoryview(data)[done:])
        except OSError:
            # Best effort: a cut record is found and left out by every reader, too.
            os.ftruncate(self._file.fileno(), self.size)
            raise
        self.size += len(data)

    def tell(self) -> int:
        return self.size

    def flush(self) -> None:
        """Nothing is held back."""


class LogWriter:
    """Writes a log; a kill costs at most the last second, be it of ``now_s`` or of the flight.

    It is flushed to the file each half second of both: a flight in lock-step may be faster than the clock, or slower.

    Raises LogError when the file cannot be created or written; what was written until then stays readable.
    """

    def __init__(self, path: Path, now_s: Callable[[], float] = time.monotonic) -> None:
        self.path = path
        self.messages = 0
        self.unreadable = 0
        self.last_time_ns = 0
        self._now_s = now_s
        self._broken = False
        self._channels: dict[tuple[str, str], _Written] = {}
        self._schemas: dict[str, int] = {}
        try:
            self._file = path.open("xb", buffering=0)
        except FileExistsError:
            raise LogError(f"{path}: already exists; a log is never overwritten") from None
        except OSError as error:
            raise LogError(f"{path}: cannot be created: {error.strerror or error}") from None
        self._sink: Any = _Sink(self._file)
        self._writer = LeanWriter(self._sink)
        with self._writing():
            self._writer.start(profile="chaserdock", library=f"chaserdock {version('chaserdock')}")
        self._flushed_s, self._flushed_ns = now_s(), 0

    @property
    def size_bytes(self) -> int:
        """Bytes in the file so far; the chunk in progress is not among them."""
        return self._sink.size

    def describe(self, scenario_json: str, run: dict[str, str]) -> None:
        """Puts the resolved scenario, the run's data, the lock file and the package versions into the log."""
        now = time.time_ns()
        attached = [
            (SCENARIO_ATTACHMENT, "application/json", scenario_json.encode()),
            (VERSIONS_ATTACHMENT, "application/json", provenance.versions_json()),
            (LOCK_ATTACHMENT, "application/gzip", provenance.lock_file_gz()),
        ]
        versions = {f"version.{name}": version(name) for name in _PACKAGES}
        with self._writing():
            for name, kind, data in attached:
                if data is not None:
                    self._writer.add_attachment(now, now, name, kind, data)
            self._writer.add_metadata(METADATA, with_checksum({**run, **versions}))

    def note(self, name: str, data: dict[str, str]) -> None:
        """Adds a metadata record of another name."""
        with self._writing():
            self._writer.add_metadata(name, with_checksum(data))

    def write(
        self, key: str, encoding: str, payload: bytes, sent_ns: int, time_ns: int | None = None
    ) -> None:
        """Appends one message, whatever it holds. ``time_ns`` is its ``sim_time_ns``, where the caller has opened it."""
        channel = self._channels.get((key, encoding))
        if channel is None:
            with self._writing():
                channel = self._channels[key, encoding] = _Written(self._register(key, encoding))
        try:
            if time_ns is None:
                time_ns = max(0, _header.decode(payload).sim_time_ns)
            # Zero: a message without a time of its own (presence), which belongs where it arrived.
            self.last_time_ns = time_ns or self.last_time_ns
        except (msgspec.DecodeError, OverflowError, RecursionError, UnicodeDecodeError):
            self.unreadable += 1
        self._add(channel, self.last_time_ns, payload, sent_ns or self.last_time_ns)
        self.messages += 1
        flown_ns = self.last_time_ns - self._flushed_ns
        if self._now_s() - self._flushed_s >= _FLUSH_S or flown_ns >= _FLUSH_S * 1e9:
            self.flush()

    def write_view(self, topic: str, schema: tuple[str, str, bytes], payload: bytes, time_ns: int) -> None:
        """Appends a message of the viewer layer, whose ``topic`` begins with ``/viewer/``.

        ``schema``: its name, its encoding (also the message's, such as ``protobuf``) and its data.
        """
        if not topic.startswith(VIEWER_PREFIX):
            raise ValueError(f"{topic} is none of the viewer layer's")
        name, encoding, data = schema
        channel = self._channels.get((topic, name))
        if channel is None:
            with self._writing():
                if name not in self._schemas:
                    self._schemas[name] = self._writer.register_schema(name, encoding, data)
                channel = _Written(self._writer.register_channel(topic, encoding, self._schemas[name]))
            self._channels[topic, name] = channel
        self._add(channel, time_ns, payload, time_ns)

    def _add(self, written: _Written, time_ns: int, payload: bytes, sent_ns: int) -> None:
        # As ``_writing``, which would be a third of what a small message costs.
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
        return LogError(f"{self.path}: could not be written before, and is not continued")

    def _broken_by(self, error: OSError) -> LogError:
        self._broken = True
        return LogError(f"{self.path}: cannot be written: {error.strerror or error}")

    def flush(self) -> None:
        """Hands everything written so far to the operating system."""
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
        """Writes index and footer, where the file can still be written, and closes it; raises LogError."""
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
    """Messages of a log in file order, opened and checked, older versions upgraded.

    Those that do not pass are left out, and counted in ``rejected`` as ``key: reason``. Raises LogError when a file
    cannot be read, is no log, or where it is damaged; a log cut off is read up to there.
    """
    for channel, message in _raw_messages(source, keys):
        found = topics.topic_of_key(channel.topic)
        try:
            if found is None:
                raise Rejected("key", "none of ours")
            encoding = channel.metadata.get("zenoh_encoding", "")
            opened = decode_logged(found[0].kind, message.data, encoding)
        except Rejected as refusal:
            if rejected is not None:
                rejected[f"{channel.topic}: {refusal.reason}"] += 1
            continue
        yield Record(channel.topic, found[0], found[1], opened, message.publish_time)


def count_messages(source: LogSource) -> dict[str, int]:
    """Messages by key, whatever they hold."""
    counts: dict[str, int] = {}
    for channel, _ in _raw_messages(source, None):
        counts[channel.topic] = counts.get(channel.topic, 0) + 1
    return dict(sorted(counts.items()))


def read_scenario(source: LogSource) -> tuple[str, dict[str, str]]:
    """The resolved scenario (JSON, in the present format) and the run's data and versions; raises LogError if the log lacks them.

    All files of a rotated log must be parts of one run.
    """
    files = log_files(source)
    first, scenario = _scenario_of(files[0])
    for path in files[1:]:
        data = _scenario_of(path)[0]
        if data.get("run_id") != first.get("run_id"):
            raise LogError(f"{path}: of another run than {files[0]}")
    return migrated(scenario), first


def _scenario_of(path: Path) -> tuple[dict[str, str], str]:
    data, attachments = read_head(path)
    if SCENARIO_ATTACHMENT not in attachments:
        raise LogError(f"{path}: holds no scenario; was it recorded by chaserdock?")
    try:
        return data, attachments[SCENARIO_ATTACHMENT].decode()
    except UnicodeDecodeError:
        raise LogError(f"{path}: its {SCENARIO_ATTACHMENT} is no UTF-8 text") from None
