"""The mission log: an MCAP file, every message verbatim, one channel a key and encoding.

``log_time`` is simulated time (the message's ``sim_time_ns``), so that a lock-step flight has its own
time line whatever the machine's speed; ``publish_time`` is the sender's wall clock. Payloads are the bytes that
travelled (msgpack), each channel's schema is the JSON Schema of its type; the resolved scenario and the
versions lie inside as an attachment and a metadata record.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Attachment, Channel, Metadata
from mcap.records import Message as McapMessage
from mcap.stream_reader import StreamReader
from mcap.writer import CompressionType, Writer

from . import codec, topics
from .codec import Rejected
from .messages import encoding_of, schema_of
from .topics import Topic

SCENARIO_ATTACHMENT = "scenario.json"
METADATA = "chaserdock"
_PACKAGES = ("chaserdock", "casadi", "eclipse-zenoh", "mcap", "msgspec", "numba", "numpy", "opencv-python-headless")


class LogError(Exception):
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
        except (msgspec.DecodeError, OverflowError):
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
        return self._writer.register_channel(key, message_encoding, self._schemas[name], {"zenoh_encoding": encoding})

    def close(self) -> None:
        """Writes index and footer and closes the file."""
        self._writer.finish()
        self._file.close()


def _raw_messages(path: Path, keys: Iterable[str] | None) -> Iterator[tuple[Channel, McapMessage]]:
    wanted = None if keys is None else list(keys)
    try:
        with path.open("rb") as file:
            try:
                reader = make_reader(file)
                for _, channel, message in reader.iter_messages(topics=wanted, log_time_order=False):
                    yield channel, message
                return
            except McapError:
                # No footer: the writer was killed. The records up to there are good.
                file.seek(0)
            channels: dict[int, Channel] = {}
            try:
                for record in StreamReader(file).records:
                    if isinstance(record, Channel):
                        channels[record.id] = record
                    elif isinstance(record, McapMessage):
                        channel = channels[record.channel_id]
                        if wanted is None or channel.topic in wanted:
                            yield channel, record
            except (McapError, EOFError, OSError):
                return
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from None


def read_log(path: Path, keys: Iterable[str] | None = None) -> Iterator[Record]:
    """Messages of a log in file order, opened and checked; those that do not pass are left out.

    Raises LogError when the file cannot be read.
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
        with path.open("rb") as file:
            for record in StreamReader(file).records:
                if isinstance(record, Attachment) and record.name == SCENARIO_ATTACHMENT:
                    scenario = record.data.decode()
                elif isinstance(record, Metadata) and record.name == METADATA:
                    data = record.metadata
                if scenario is not None and data:
                    break
    except OSError as error:
        raise LogError(f"{path}: cannot be read: {error.strerror or error}") from None
    except (McapError, EOFError, UnicodeDecodeError) as error:
        raise LogError(f"{path}: no MCAP log, or damaged at its beginning: {error}") from None
    if scenario is None:
        raise LogError(f"{path}: holds no scenario; was it recorded by chaserdock?")
    return scenario, data


