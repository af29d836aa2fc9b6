# SPDX-License-Identifier: Apache-2.0
"""Replays a log through one stage of the present code and compares with the recorded output."""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from importlib.metadata import entry_points

import msgspec
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.recording.extent import late_begin_line, late_begin_s
from chaserdock_protocol.recording.log import LogError, LogSource, read_log, read_scenario
from chaserdock_protocol.replay_node import Stage, order_by_tick
from chaserdock_protocol.scenario import flight_scenario, parse_scenario
from chaserdock_protocol.topics import Topic
from chaserdock_protocol.transport import ReceivedMessage

from .difference import Comparison, TopicDifference


class ReplayError(ChaserdockError):
    """A replay with the given arguments is impossible."""


class Replay(msgspec.Struct):
    """Result of a replay. ``notes``: limitations of the comparison."""

    through: str
    topics: list[TopicDifference]
    notes: list[str] = []

    @property
    def equal(self) -> bool:
        return all(t.equal for t in self.topics)


def stage_of(name: str) -> Stage:
    """Return the stage of that name (entry points, group ``chaserdock.replays``). Raise
    ReplayError.
    """
    stages = {e.name: e for e in entry_points(group="chaserdock.replays")}
    if name not in stages:
        raise ReplayError(f"--through {name}: must be one of {', '.join(sorted(stages))}")
    return stages[name].load()


def _places(topic: Topic, stage: Stage, chasers: int) -> Iterable[int | str | None]:
    if "{chaser}" in topic.key:
        return range(chasers)
    return [stage.process] if "{process}" in topic.key else [None]


def replay(
    log: LogSource, through: str, overrides: tuple[str, ...] = (), tolerance: float = 0.0
) -> Replay:
    """Replay a log through ``perception``, ``fusion`` or ``controller`` with ``overrides`` of its
    scenario.

    Raise LogError, ScenarioError or ReplayError.
    """
    stage = stage_of(through)
    text, run = read_scenario(log)
    scenario = parse_scenario(json.loads(text), "the log's scenario", overrides)
    keys = [
        topic.key_of(place)
        for topic in (*stage.inputs, *stage.outputs)
        for place in _places(topic, stage, len(scenario.chasers))
    ]
    answers = {id(t) for t in stage.outputs}
    comparison = Comparison(tolerance)

    def recorded() -> Iterator[ReceivedMessage]:
        for record in read_log(log, keys):
            if id(record.topic) in answers:
                comparison.add(0, record.key, record.message)
            yield ReceivedMessage(record.topic, record.place, record.message, record.sent_ns)

    lockstep = run.get("mode") != "realtime"
    played = 0
    for topic, place, message in stage.play(
        flight_scenario(scenario), order_by_tick(stage, recorded()) if lockstep else recorded()
    ):
        if id(topic) in answers:
            comparison.add(1, topic.key_of(place), message)
            played += 1
    if not played:
        raise LogError(f"{log}: holds nothing to replay through {through}")
    notes = []
    if not lockstep:
        notes.append(
            "flown in real time: arrival times are not recorded, so that differences are not "
            "conclusive"
        )
    if (begin_s := late_begin_s(log)) is not None:
        notes.append(
            f"{late_begin_line(begin_s)}, so that the replay does not start from the state of the "
            "flight and differences are not conclusive"
        )
    return Replay(through=through, topics=comparison.finish(), notes=notes)
