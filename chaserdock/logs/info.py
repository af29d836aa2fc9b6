# SPDX-License-Identifier: Apache-2.0
"""Describes a log, and checks that it is complete."""

from __future__ import annotations

from collections import Counter
from typing import Any

import msgspec
from chaserdock_protocol import topics
from chaserdock_protocol.codec import Rejected
from chaserdock_protocol.recording.gaps import SequenceGaps
from chaserdock_protocol.recording.log import LogSource, logged_scenario
from chaserdock_protocol.recording.scan import VIEWER_PREFIX, FileState, log_files, stored_messages
from chaserdock_protocol.recording.schema_migrations import decode_logged


class FileInfo(msgspec.Struct):
    """A file of a log. ``closed``, ``cut_bytes``: as in ``recording.scan.FileState``."""

    path: str
    bytes: int
    closed: bool
    cut_bytes: int
    recovered: bool


class KeyInfo(msgspec.Struct):
    """Content of a log for one key: number and bytes of messages, first and last simulated time
    (s). ``lost``: gaps in their sequence numbers.
    """

    key: str
    messages: int = 0
    bytes: int = 0
    first_s: float = 0.0
    last_s: float = 0.0
    lost: int = 0


class LogInfo(msgspec.Struct):
    """Content of a log. ``rejected``: number of invalid messages by key and reason. ``viewer``:
    messages of the viewer layer.
    """

    scenario: str
    seed: int
    run: dict[str, str]
    files: list[FileInfo]
    keys: list[KeyInfo]
    rejected: dict[str, int]
    viewer: int
    sim_time_s: float
    wall_time_s: float

    @property
    def whole(self) -> bool:
        """Return whether every file is closed and no message is missing or invalid."""
        lost = any(k.lost for k in self.keys)
        return (
            all(f.closed and not f.recovered for f in self.files) and not lost and not self.rejected
        )


def info_of(log: LogSource) -> LogInfo:
    """Read a whole log and check every checksum and message. Raises LogError where it is
    damaged.
    """
    scenario, run = logged_scenario(log)
    keys: dict[str, KeyInfo] = {}
    gaps = SequenceGaps()
    rejected: Counter[str] = Counter()
    files: list[FileInfo] = []
    viewer, sent = 0, [0, 0]

    for path in log_files(log):
        state = FileState()
        for channel, stored in stored_messages(path, state):
            if channel.topic.startswith(VIEWER_PREFIX):
                viewer += 1
                continue

            key = keys.get(channel.topic)
            time_s = stored.log_time / 1e9
            if key is None:
                key = keys[channel.topic] = KeyInfo(channel.topic, first_s=time_s)
            key.messages += 1
            key.bytes += len(stored.data)
            key.last_s = time_s
            sent = [
                min(sent[0] or stored.publish_time, stored.publish_time),
                max(sent[1], stored.publish_time),
            ]

            seq = _seq_of(
                channel.topic, stored.data, channel.metadata.get("zenoh_encoding", ""), rejected
            )
            if seq is not None:
                gaps.update(channel.topic, seq)
                key.lost = gaps.lost[channel.topic]

        size = path.stat().st_size
        files.append(FileInfo(str(path), size, state.closed, state.cut_bytes, state.recovered))

    return LogInfo(
        scenario=scenario.name,
        seed=scenario.seed,
        run=run,
        files=files,
        keys=[keys[k] for k in sorted(keys)],
        rejected=dict(sorted(rejected.items())),
        viewer=viewer,
        sim_time_s=max((k.last_s for k in keys.values()), default=0.0),
        wall_time_s=(sent[1] - sent[0]) / 1e9,
    )


def _seq_of(key: str, payload: bytes, encoding: str, rejected: Counter[str]) -> int | None:
    match = topics.topic_of_key(key)
    try:
        if match is None:
            raise Rejected("key", "not in the topics table")
        message: Any = decode_logged(match[0].kind, payload, encoding)
        return message.seq
    except Rejected as error:
        rejected[f"{key}: {error.reason}"] += 1
        return None


def info_lines(info: LogInfo) -> list[str]:
    """Return the information as lines of text."""
    run = ", ".join(
        f"{k} {v}" for k, v in info.run.items() if not k.startswith("version.") and k != "crc32"
    )
    lines = [
        f"{info.scenario}, seed {info.seed}; {run}; chaserdock "
        f"{info.run.get('version.chaserdock', '?')}",
        f"{info.sim_time_s:.2f} s of simulated, {info.wall_time_s:.1f} s of wall time",
    ]
    for f in info.files:
        end = (
            "closed, all checksums valid"
            if f.closed
            else f"cut off ({f.cut_bytes} bytes of a broken record)"
        )
        if not f.closed:
            end += "; `chaserdock log --recover` makes a complete file of it"
        if f.recovered:
            end += "; recovered"
        lines.append(f"{f.path}: {f.bytes / 1e6:.1f} MB, {end}")
    width = max((len(k.key) for k in info.keys), default=3)
    lines.append(
        f"{'key':{width}} {'messages':>9} {'kB':>10} {'from s':>9} {'to s':>9} {'lost':>6}"
    )
    for k in info.keys:
        lines.append(
            f"{k.key:{width}} {k.messages:9d} {k.bytes / 1e3:10.1f} {k.first_s:9.2f} "
            f"{k.last_s:9.2f} {k.lost:6d}"
        )
    lines += [f"rejected: {what}: {number}" for what, number in info.rejected.items()]
    lines.append(f"{info.viewer} messages of the viewer layer")
    return lines
