"""A log as the viewer reads it: read through once, then opened at any moment. Images stay in the file."""

from __future__ import annotations

from array import array
from bisect import bisect_right
from collections import defaultdict
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec
from chaserdock_protocol import topics
from chaserdock_protocol.codec import Rejected
from chaserdock_protocol.recording.log import read_scenario
from chaserdock_protocol.recording.scan import (
    DAMAGE,
    VIEWER_PREFIX,
    FileState,
    LogError,
    LogSource,
    log_files,
    parse_chunk,
    record_at,
    records,
)
from chaserdock_protocol.recording.schema_migrations import decode_logged
from chaserdock_protocol.scenario import scenario_from_json
from chaserdock_protocol.topics import Topic
from mcap.opcode import Opcode
from mcap.records import Channel
from mcap.records import Message as McapMessage

from .history import History
from .snapshot import OF_ALL, OF_CHASERS, Now

_TOLD = (topics.COMMAND, topics.EVENT, topics.HEALTH, topics.END)
_OPENED = (
    topics.ODOMETRY,
    topics.REFERENCE,
    topics.TARGET,
    topics.SOLVER,
    topics.TRUTH_BODY,
    topics.ACTUATORS,
    topics.TICK,
    *_TOLD,
)
"""What the plots and the list of events are made of: opened while the log is read through."""
_CHUNKS_KEPT = 24


class _Exposure(msgspec.Struct):
    """What is read of an image when it is not looked at."""

    tick: int
    chaser: int


_exposure = msgspec.msgpack.Decoder(_Exposure)


class LoggedMission:
    """A recorded mission: ``history`` is all of it, ``at`` the present at any time of it. Raises LogError."""

    def __init__(self, source: LogSource) -> None:
        text, self.run = read_scenario(source)
        self.scenario = scenario_from_json(text, f"{source}: scenario")
        self.chasers = len(self.scenario.chasers)
        self.history = History(self.chasers)
        self.end_s = 0.0
        self.truth = False
        self._chunks: list[tuple[Path, int]] = []
        self._channels: dict[Path, dict[int, Channel]] = {}
        # By key, of each chunk that holds some of its messages: time of the first of them, and the chunk's number. An
        # entry a message would be half a gigabyte after ten hours.
        self._index: dict[str, tuple[array[int], array[int]]] = defaultdict(lambda: (array("q"), array("l")))
        self._latest: dict[str, int] = defaultdict(int)
        self._shown = {topic.key_of(): topic for topic in OF_ALL}
        self._shown |= {topic.key_of(i): topic for topic in OF_CHASERS for i in range(self.chasers)}
        bodies = ("target", *(f"chaser/{i}" for i in range(self.chasers)))
        self._shown |= {topics.TRUTH_BODY.key_of(body): topics.TRUTH_BODY for body in bodies}
        self._chunk = lru_cache(maxsize=_CHUNKS_KEPT)(self._read_chunk)
        for path in log_files(source):
            self._read_through(path)

    def _read_through(self, path: Path) -> None:
        state, channels = FileState(), self._channels.setdefault(path, {})
        for opcode, content in records(path, state):
            if opcode != Opcode.CHUNK:
                continue
            try:
                inside = parse_chunk(content)
            except DAMAGE as error:
                raise LogError(f"{path}: damaged: {error or type(error).__name__}") from None
            channels |= {record.id: record for record in inside if isinstance(record, Channel)}
            number = len(self._chunks)
            self._chunks.append((path, state.place))
            for record in inside:
                if isinstance(record, McapMessage):
                    self._note(channels[record.channel_id], record, number)

    def _note(self, channel: Channel, stored: McapMessage, chunk: int) -> None:
        key = channel.topic
        if key.startswith(VIEWER_PREFIX):
            return
        found = topics.topic_of_key(key)
        if found is None:
            return
        topic = found[0]
        if key in self._shown:
            times, chunks = self._index[key]
            # A log's order is that of arrival; of one key it is that of time but for what came late.
            self._latest[key] = max(stored.log_time, self._latest[key])
            if not chunks or chunks[-1] != chunk:
                times.append(self._latest[key])
                chunks.append(chunk)
        if topic is topics.IMAGE:
            try:
                seen = _exposure.decode(stored.data)
            except msgspec.DecodeError:
                return
            self.history.exposed(seen.chaser, seen.tick, stored.publish_time)
        elif topic in _OPENED and (message := self._open(topic, channel, stored)) is not None:
            self.history.take(topic, message, stored.publish_time)
            self.truth |= topic is topics.TRUTH_BODY
            if topic is topics.TICK:
                self.end_s = max(self.end_s, message.sim_time_ns / 1e9)

    def _open(self, topic: Topic, channel: Channel, stored: McapMessage) -> Any:
        try:
            return decode_logged(topic.kind, stored.data, channel.metadata.get("zenoh_encoding", ""))
        except Rejected:
            return None

    def _read_chunk(self, number: int) -> dict[str, list[tuple[Channel, McapMessage]]]:
        """A chunk's messages by key."""
        path, place = self._chunks[number]
        try:
            inside = parse_chunk(record_at(path, place))
        except DAMAGE as error:
            raise LogError(f"{path}: damaged: {error or type(error).__name__}") from None
        out: dict[str, list[tuple[Channel, McapMessage]]] = defaultdict(list)
        for record in inside:
            if isinstance(record, McapMessage):
                channel = self._channels[path][record.channel_id]
                out[channel.topic].append((channel, record))
        return out

    def at(self, time_s: float) -> Now:
        """The mission at a simulated time: of every key its latest message up to then. Raises LogError."""
        now, until = Now.of(self.chasers), round(time_s * 1e9) + 1
        for key, topic in self._shown.items():
            times, chunks = self._index[key]
            last = bisect_right(times, until) - 1
            if last < 0:
                continue
            # The first one of the chunk is early enough, whatever its own time: others before it were later.
            first, *more = self._chunk(chunks[last])[key]
            channel, stored = first
            for later in more:
                if later[1].log_time > until:
                    break
                channel, stored = later
            message = self._open(topic, channel, stored)
            if message is not None:
                now.take(topic, message)
        return now
