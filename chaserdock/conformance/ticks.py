"""What a recorded log has to say to one process, tick by tick."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import msgspec
from chaserdock_protocol import codec, topics
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.messages import Image, Tick, encoding_of
from chaserdock_protocol.recording.log import LogSource, read_log, read_scenario
from chaserdock_protocol.scenario import Scenario, scenario_from_json
from chaserdock_protocol.topics import Role, Topic
from chaserdock_protocol.transport import RawSample

# By so many ticks the messages of a lock-step flight may come late to a recorder, by far.
_LATE_TICKS = 64


class CheckError(ChaserdockError):
    """A check that cannot be done as asked; the text is one clear line."""


@dataclass
class Turn:
    """One tick: the world's messages in ``opening``, then what the others answered to it in ``answers``.

    ``exposure_ns``: the time of the process' own image, None without one.
    """

    tick: Tick
    opening: list[RawSample] = field(default_factory=list)
    answers: list[RawSample] = field(default_factory=list)
    exposure_ns: int | None = None


def named(turn: Turn, process: str, instance: str) -> Turn:
    """The turn with ``instance`` for the start of ``process`` that the recorded tick gives the command to, if it does."""
    if turn.tick.commander != process:
        return turn
    tick = msgspec.structs.replace(turn.tick, instance=instance)
    payload = codec.encode(tick)
    opening = [
        msgspec.structs.replace(raw, payload=payload) if raw.key == topics.TICK.key else raw
        for raw in turn.opening
    ]
    return replace(turn, tick=tick, opening=opening)


@dataclass(frozen=True)
class Recorded:
    """A log as one process would hear it. ``scenario_json`` is what the world answers who joins."""

    scenario: Scenario
    scenario_json: str
    turns: list[Turn]


def role_of(process: str, chasers: int) -> tuple[Role, int | None]:
    """Role and chaser's number of the process to be checked; raises CheckError unless the mission has it."""
    if process == "controller":
        return "controller", None
    if process.startswith("chaser/") and topics.is_process_name(process):
        number = int(process.partition("/")[2])
        if number < chasers:
            return "chaser", number
        raise CheckError(f"{process}: the log's chasers are 0 to {chasers - 1}")
    raise CheckError(f"{process}: must be controller or chaser/N")


def topics_told(role: Role) -> list[Topic]:
    """What belongs to a tick and reaches a process of this role from others, in the order it is played."""
    told = [
        t
        for t in topics.TOPICS
        if role in t.readers and t.writer not in ("any", role) and t.rate in ("tick", "image")
    ]
    return sorted(told, key=lambda t: (t.writer != "world", t is not topics.TICK, topics.TOPICS.index(t)))


def read_turns(log: LogSource, process: str, most: int) -> Recorded:
    """The first ``most`` ticks of a log, up to the first that did not expect an answer of ``process``.

    Raises LogError, ScenarioError, or CheckError when there is nothing to play.
    """
    text, run = read_scenario(log)
    if run.get("mode") == "realtime":
        raise CheckError(
            f"{log}: flown in real time; a check needs a lock-step log, where every tick is whole"
        )
    scenario = scenario_from_json(text, f"{log}: scenario")
    role, number = role_of(process, len(scenario.chasers))
    told = topics_told(role)
    keys = [
        topic.key_of(place)
        for topic in told
        for place in (_places(number, len(scenario.chasers)) if "{chaser}" in topic.key else (None,))
    ]
    turns: dict[int, Turn] = {}
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
                turns[message.tick] = Turn(message)
        exposure_ns = message.sim_time_ns if isinstance(message, Image) else None
        waiting.setdefault(message.tick, []).append((told.index(record.topic), raw, exposure_ns))
    played = []
    for tick in range(most):
        if tick not in turns:
            break
        turn = turns[tick]
        for rank, raw, exposure_ns in sorted(waiting[tick], key=lambda item: item[0]):
            (turn.opening if told[rank].writer == "world" else turn.answers).append(raw)
            turn.exposure_ns = exposure_ns if exposure_ns is not None else turn.exposure_ns
        played.append(turn)
    if not played:
        raise CheckError(
            f"{log}: its first tick expects no answer of {process}; give a log that begins at tick 0"
        )
    return Recorded(scenario, text, played)


def _places(number: int | None, chasers: int) -> range | tuple[int]:
    return range(chasers) if number is None else (number,)


def _expected(tick: Tick, number: int | None) -> bool:
    return tick.controller if number is None else number in tick.chasers
