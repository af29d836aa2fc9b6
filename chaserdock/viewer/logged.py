# SPDX-License-Identifier: Apache-2.0
"""Random access to a log for the viewer: one pass builds an index, images stay in the file."""

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
from chaserdock_protocol.recording.log import logged_scenario
from chaserdock_protocol.recording.scan import (
    VIEWER_PREFIX,
    FileState,
    LogSource,
    errors_of_parsing,
    log_files,
    parse_record,
    record_at,
    records,
)
from chaserdock_protocol.recording.schema_migrations import decode_logged
from chaserdock_protocol.topics import Topic
from mcap.records import Channel
from mcap.records import Message as McapMessage

from .history import History
from .snapshot import EVENT_TOPICS, OF_ALL, OF_CHASERS, MissionState

_BODIES = (topics.TRUTH_BODY, topics.BODY_REFERENCE)
"""Topics of where the bodies are."""
_DECODED = (
    topics.ODOMETRY,
    topics.REFERENCE,
    topics.TARGET,
    topics.STACK,
    topics.SOLVER,
    *_BODIES,
    topics.TRUTH_LOAD,
    topics.ACTUATORS,
    topics.TICK,
    *EVENT_TOPICS,
)
"""Topics of the plots and the event list; they are decoded while the log is indexed."""
_CHUNKS_KEPT = 24
"""Decoded chunks of a log that are kept; without chunks, messages. Chosen, for memory.
"""


class _Exposure(msgspec.Struct):
    """The fields of an image needed for the index."""

    tick: int
    chaser: int


_exposure = msgspec.msgpack.Decoder(_Exposure)


class LoggedMission:
    """A recorded mission. ``history``: covers all of it. ``at``: returns the state at any time.
    Raises LogError.
    """

    def __init__(self, source: LogSource) -> None:
        self.scenario, self.run = logged_scenario(source)
        self.chasers = len(self.scenario.chasers)
        self.history = History(self.chasers)
        self.end_s = 0.0
        self.truth = False
        self._chunks: list[tuple[Path, int]] = []
        self._channels: dict[Path, dict[int, Channel]] = {}
        # By key: for each chunk with messages of that key, the time of the first one and the number
        # of the chunk. One entry per message would take 0.5 GB for ten hours.
        self._index: dict[str, tuple[array[int], array[int]]] = defaultdict(
            lambda: (array("q"), array("l"))
        )
        self._latest: dict[str, int] = defaultdict(int)
        self._shown = {topic.key_of(): topic for topic in (*OF_ALL, topics.TRUTH_DRAWN)}
        self._shown |= {topic.key_of(i): topic for topic in OF_CHASERS for i in range(self.chasers)}
        bodies = ("target", *(f"chaser/{i}" for i in range(self.chasers)))
        self._shown |= {topic.key_of(body): topic for topic in _BODIES for body in bodies}
        self._chunk = lru_cache(maxsize=_CHUNKS_KEPT)(self._read_chunk)
        for path in log_files(source):
            self._index_file(path)

    def _index_file(self, path: Path) -> None:
        state, channels = FileState(), self._channels.setdefault(path, {})
        for opcode, content in records(path, state):
            with errors_of_parsing(path):
                inside = parse_record(opcode, content)
                channels |= {record.id: record for record in inside if isinstance(record, Channel)}
                found = [(channels[r.channel_id], r) for r in inside if isinstance(r, McapMessage)]
            if not found:
                continue
            number = len(self._chunks)
            self._chunks.append((path, state.place))
            for channel, message in found:
                self._index_message(channel, message, number)

    def _index_message(self, channel: Channel, stored: McapMessage, chunk: int) -> None:
        key = channel.topic
        if key.startswith(VIEWER_PREFIX):
            return
        found = topics.topic_of_key(key)
        if found is None:
            return
        topic = found[0]
        if key in self._shown:
            times, chunks = self._index[key]
            # A log is in order of arrival; within a key that is the order of time, except for late
            # messages.
            self._latest[key] = max(stored.log_time, self._latest[key])
            if not chunks or chunks[-1] != chunk:
                times.append(self._latest[key])
                chunks.append(chunk)
        if topic is topics.IMAGE:
            try:
                seen = _exposure.decode(stored.data)
            except msgspec.DecodeError:
                return
            self.history.add_exposure(seen.chaser, seen.tick, stored.publish_time)
        elif topic in _DECODED and (message := self._decode(topic, channel, stored)) is not None:
            self.history.update(topic, message, stored.publish_time)
            self.truth |= topic in _BODIES
            if topic is topics.TICK:
                self.end_s = max(self.end_s, message.sim_time_ns / 1e9)

    def _decode(self, topic: Topic, channel: Channel, stored: McapMessage) -> Any:
        try:
            return decode_logged(
                topic.kind, stored.data, channel.metadata.get("zenoh_encoding", "")
            )
        except Rejected:
            return None

    def _read_chunk(self, number: int) -> dict[str, list[tuple[Channel, McapMessage]]]:
        """Return the messages of a chunk by key."""
        path, place = self._chunks[number]
        with errors_of_parsing(path):
            inside = parse_record(*record_at(path, place))
        out: dict[str, list[tuple[Channel, McapMessage]]] = defaultdict(list)
        for record in inside:
            if isinstance(record, McapMessage):
                channel = self._channels[path][record.channel_id]
                out[channel.topic].append((channel, record))
        return out

    def at(self, time_s: float) -> MissionState:
        """Return the state at a simulated time: the latest message of every key until then. Raise
        LogError.
        """
        state, until = MissionState.empty(self.chasers), round(time_s * 1e9) + 1
        for key, topic in self._shown.items():
            times, chunks = self._index[key]
            last = bisect_right(times, until) - 1
            if last < 0:
                continue
            # The first message of the chunk counts whatever its own time, since an earlier one had
            # a later time.
            first, *more = self._chunk(chunks[last])[key]
            channel, stored = first
            for later in more:
                if later[1].log_time > until:
                    break
                channel, stored = later
            message = self._decode(topic, channel, stored)
            if message is not None:
                state.update(topic, message)
        return state
