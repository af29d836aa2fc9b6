# SPDX-License-Identifier: Apache-2.0
"""Reads the input of one process from a log, tick by tick."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import msgspec
from chaserdock_protocol import codec, topics
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.messages import Image, Lease, Tick, encoding_of
from chaserdock_protocol.recording.log import LogSource, logged_scenario, read_log
from chaserdock_protocol.scenario import Scenario, flight_scenario_json
from chaserdock_protocol.topics import Role, Topic
from chaserdock_protocol.transport import RawSample

# Bound on the delay of messages at a recorder in a lock-step flight, in ticks; generous.
_LATE_TICKS = 64


class CheckError(ChaserdockError):
    """The given process, log or command cannot be checked."""


@dataclass
class RecordedTick:
    """One recorded tick. ``opening``: the world's messages. ``answers``: those of the other
    processes.

    ``exposure_ns``: time of the process' own image, None without one.
    """

    tick: Tick
    opening: list[RawSample] = field(default_factory=list)
    answers: list[RawSample] = field(default_factory=list)
    exposure_ns: int | None = None


def with_instance(turn: RecordedTick, process: str, instance: str) -> RecordedTick:
    """Return the tick with ``instance`` as the instance of the controller or chaser ``process``,
    also in the leases that it holds.
    """

    def renamed(raw: RawSample) -> RawSample:
        found = topics.topic_of_key(raw.key)
        if found is None or found[0] not in (topics.TICK, topics.LEASE):
            return raw
        message = codec.decode(found[0].kind, raw.payload)
        match message:
            case Tick():
                message = _with_instance(message, process, instance)
            case Lease(holder=holder) if holder == process:
                message = msgspec.structs.replace(message, instance=instance)
        return msgspec.structs.replace(raw, payload=codec.encode(message))

    tick = _with_instance(turn.tick, process, instance)
    if tick == turn.tick:
        return turn
    opening, answers = ([renamed(raw) for raw in raws] for raws in (turn.opening, turn.answers))
    return replace(turn, tick=tick, opening=opening, answers=answers)


def _with_instance(tick: Tick, process: str, instance: str) -> Tick:
    """Return a tick that lists ``instance`` as that of a controller or chaser, if it lists it."""
    listed = {
        name: {**instances, process: instance}
        for name, instances in (
            ("controllers", tick.controllers),
            ("chaser_instances", tick.chaser_instances),
        )
        if process in instances
    }
    return msgspec.structs.replace(tick, **listed)


@dataclass(frozen=True)
class Recorded:
    """Input of one process. ``scenario_json``: content of the world's join reply."""

    scenario: Scenario
    scenario_json: str
    turns: list[RecordedTick]


def role_of(process: str, chasers: int) -> tuple[Role, int | None]:
    """Return role and chaser number of a process. Raise CheckError unless it is part of the
    mission.
    """
    if process == "controller":
        return "controller", None
    if process.startswith("chaser/") and topics.is_process_name(process):
        number = int(process.partition("/")[2])
        if number < chasers:
            return "chaser", number
        raise CheckError(f"{process}: the log's chasers are 0 to {chasers - 1}")
    raise CheckError(f"{process}: must be controller or chaser/N")


def input_topics(role: Role) -> list[Topic]:
    """Return the topics of a tick that a role receives from others, in the order of playing."""
    inputs = [
        t
        for t in topics.TOPICS
        if role in t.readers and t.writer not in ("any", role) and t.rate in ("tick", "image")
    ]
    return sorted(
        inputs, key=lambda t: (t.writer != "world", t is not topics.TICK, topics.TOPICS.index(t))
    )


def read_turns(log: LogSource, process: str, most: int) -> Recorded:
    """Read the first ``most`` ticks of a log, up to the first one without an expected answer of
    ``process``.

    Raise LogError, ScenarioError, or CheckError when there is nothing to play.
    """
    scenario, run = logged_scenario(log)
    if run.get("mode") == "realtime":
        raise CheckError(
            f"{log}: flown in real time; a check needs a lock-step log, in which every tick is "
            "complete"
        )

    role, number = role_of(process, len(scenario.chasers))
    inputs = input_topics(role)
    keys = [
        topic.key_of(place)
        for topic in inputs
        for place in (
            _places(number, len(scenario.chasers)) if "{chaser}" in topic.key else (None,)
        )
    ]

    turns: dict[int, RecordedTick] = {}
    waiting: dict[int, list[tuple[int, RawSample, int | None]]] = {}
    for record in read_log(log, keys):
        message = record.message
        if message.tick >= most + _LATE_TICKS:
            break
        raw = RawSample(record.key, encoding_of(type(message)), codec.encode(message), 0)
        if isinstance(message, Tick):
            if message.revision or not _expected(message, number):
                most = min(most, message.tick)
            else:
                turns[message.tick] = RecordedTick(message)
        exposure_ns = message.sim_time_ns if isinstance(message, Image) else None
        waiting.setdefault(message.tick, []).append((inputs.index(record.topic), raw, exposure_ns))

    played = []
    for tick in range(most):
        if tick not in turns:
            break
        turn = turns[tick]
        for rank, raw, exposure_ns in sorted(waiting[tick], key=lambda item: item[0]):
            (turn.opening if inputs[rank].writer == "world" else turn.answers).append(raw)
            turn.exposure_ns = exposure_ns if exposure_ns is not None else turn.exposure_ns
        played.append(turn)

    if not played:
        raise CheckError(
            f"{log}: its first tick expects no answer of {process}; give a log that begins at tick "
            "0"
        )

    return Recorded(scenario, flight_scenario_json(scenario), played)


def _places(number: int | None, chasers: int) -> range | tuple[int]:
    return range(chasers) if number is None else (number,)


def _expected(tick: Tick, number: int | None) -> bool:
    return "controller" in tick.controllers if number is None else number in tick.chasers
