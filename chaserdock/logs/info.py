# SPDX-License-Identifier: Apache-2.0
"""Describes a log, and checks that it is complete."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import msgspec
from chaserdock_protocol import topics
from chaserdock_protocol.codec import Rejected
from chaserdock_protocol.recording.extent import late_begin_line, late_begin_s
from chaserdock_protocol.recording.gaps import SequenceGaps
from chaserdock_protocol.recording.log import LogSource, NoScenario, logged_scenario
from chaserdock_protocol.recording.scan import (
    VIEWER_PREFIX,
    FileState,
    log_files,
    read_head,
    stored_messages,
)
from chaserdock_protocol.recording.schema_migrations import decode_logged
from chaserdock_protocol.recording.summary import read_summary


class FileInfo(msgspec.Struct):
    """A file of a log. ``closed``, ``cut_bytes``, ``library``, ``rewritten``: as in
    ``recording.scan.FileState``. ``lost``: number of messages that it lacks by its statistics.
    """

    path: str
    bytes: int
    closed: bool
    cut_bytes: int
    recovered: bool
    library: str
    rewritten: bool
    lost: int


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
    messages of the viewer layer. ``missing``: what it lacks of its mission, a line each.
    ``scenario`` and ``seed``: None where the log holds no scenario.
    """

    scenario: str | None
    seed: int | None
    run: dict[str, str]
    files: list[FileInfo]
    keys: list[KeyInfo]
    rejected: dict[str, int]
    viewer: int
    missing: list[str]
    sim_time_s: float
    wall_time_s: float

    @property
    def whole(self) -> bool:
        """Return whether every file is closed and nothing is missing or invalid."""
        lost = any(k.lost for k in self.keys) or any(f.lost for f in self.files)
        return (
            all(f.closed and not f.recovered for f in self.files)
            and not lost
            and not self.rejected
            and not self.missing
        )


def info_of(log: LogSource) -> LogInfo:
    """Read a whole log and check every checksum and message. Raises LogError where it is damaged,
    and for a log without a message of ours.
    """
    name, seed, run, missing = None, None, dict[str, str](), list[str]()
    no_scenario: NoScenario | None = None
    try:
        scenario, run = logged_scenario(log)
        name, seed = scenario.name, scenario.seed
    except NoScenario as error:
        no_scenario, run = error, read_head(log_files(log)[0])[0]
        missing.append(
            "holds no scenario: it can be read and exported as bare messages by other tools, but "
            "not judged, shown or replayed"
        )

    keys: dict[str, KeyInfo] = {}
    gaps = SequenceGaps()
    rejected: Counter[str] = Counter()
    files: list[FileInfo] = []
    viewer, sent = 0, [0, 0]

    for path in log_files(log):
        state, messages = FileState(), 0
        for channel, stored in stored_messages(path, state):
            messages += 1
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
        files.append(_file_info(path, state, messages))

    if no_scenario is not None and not any(topics.topic_of_key(key) for key in keys):
        raise no_scenario
    sim_time_s = max((k.last_s for k in keys.values()), default=0.0)
    if (begin_s := late_begin_s(log)) is not None:
        missing.append(late_begin_line(begin_s))
    # Our recorder knows what it missed; another tool may have left out what came last.
    last = files[-1]
    if last.closed and last.rewritten and topics.END.key_of() not in keys:
        missing.append(
            f"ends at {round(sim_time_s, 2)} s without the end of the mission; later messages may "
            "be missing"
        )

    return LogInfo(
        scenario=name,
        seed=seed,
        run=run,
        files=files,
        keys=[keys[k] for k in sorted(keys)],
        rejected=dict(sorted(rejected.items())),
        viewer=viewer,
        missing=missing,
        sim_time_s=sim_time_s,
        wall_time_s=(sent[1] - sent[0]) / 1e9,
    )


def _file_info(path: Path, state: FileState, messages: int) -> FileInfo:
    summary = read_summary(path) if state.closed else None
    stated = None if summary is None else summary.statistics
    return FileInfo(
        path=str(path),
        bytes=path.stat().st_size,
        closed=state.closed,
        cut_bytes=state.cut_bytes,
        recovered=state.recovered,
        library=state.library,
        rewritten=state.rewritten,
        lost=0 if stated is None else max(0, stated.message_count - messages),
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
    flown = "no scenario" if info.scenario is None else f"{info.scenario}, seed {info.seed}"
    lines = [
        f"{flown}; {run}; chaserdock {info.run.get('version.chaserdock', '?')}",
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
        if f.lost:
            end += f"; lacks {f.lost} messages that its statistics count"
        if f.rewritten:
            end += f"; written by {f.library or 'an unknown tool'}"
        lines.append(f"{f.path}: {f.bytes / 1e6:.1f} MB, {end}")
    lines += info.missing
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
