"""The one table of topics: key, type, who may write and read it, how often, and how it is sent.

Keys are relative to the run's namespace and begin with their publisher's name, so that a rule can hold a
process to its own branch. ``truth/**`` is the world's, and no process that flies may read it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, get_args

from msgspec import Struct

from . import messages as m

Role = Literal["world", "chaser", "controller", "recorder", "operator", "analysis", "viewer"]
Qos = Literal["bulk", "state", "command", "event"]

CONTROLLERS = ("controller", "standby")
"""Processes of the role ``controller``, in the order in which they are given the command."""
FLYING: frozenset[Role] = frozenset({"chaser", "controller"})
_EVERYONE: frozenset[Role] = frozenset(get_args(Role))
_WATCHERS: frozenset[Role] = frozenset({"recorder", "operator", "analysis", "viewer"})
_KNOW_THE_TRUTH: frozenset[Role] = frozenset({"recorder", "analysis", "viewer"})


@dataclass(frozen=True, eq=False)
class Topic:
    """A key with one ``{chaser}`` or ``{process}`` place at most, and what goes over it. There is one of each.

    ``rate`` is per tick (``tick``), per tick with images (``image``), once a second of simulated time
    (``second``), of wall time (``presence``), or when something happens (``event``).
    """

    key: str
    kind: type[Struct]
    writer: Role | Literal["any"]
    readers: frozenset[Role]
    rate: Literal["tick", "image", "second", "presence", "event"]
    qos: Qos

    def key_of(self, place: int | str | None = None) -> str:
        """The concrete key, for a chaser's number or a process' name where the key has a place."""
        return _key_of(self, place)


@lru_cache(maxsize=4096, typed=True)
def _key_of(topic: Topic, place: int | str | None) -> str:
    if "{" not in topic.key:
        if place is not None:
            raise ValueError(f"topic {topic.key} has no place for {place!r}")
        return topic.key
    if place is None:
        raise ValueError(f"topic {topic.key} needs a chaser or process")
    return topic.key.format(chaser=place, process=place)


def _topic(key, kind, writer, readers, rate, qos) -> Topic:
    return Topic(key, kind, writer, frozenset(readers) | _WATCHERS, rate, qos)


TICK = _topic("world/tick", m.Tick, "world", {"chaser", "controller"}, "tick", "state")
END = _topic("world/end", m.MissionEnd, "world", {"chaser", "controller"}, "event", "event")
IMAGE = _topic("world/chaser/{chaser}/image", m.Image, "world", {"chaser"}, "image", "bulk")
ODOMETRY = _topic(
    "world/chaser/{chaser}/odometry", m.Odometry, "world", {"chaser", "controller"}, "tick", "state"
)
DOCKING = _topic(
    "world/chaser/{chaser}/docking", m.DockingStatus, "world", {"chaser", "controller"}, "tick", "state"
)
TRUTH_BODY = Topic("truth/body/{process}", m.BodyTruth, "world", _KNOW_THE_TRUTH, "tick", "state")
TRUTH_WORLD = Topic("truth/world", m.WorldTruth, "world", _KNOW_THE_TRUTH, "tick", "state")
SIGHTING = _topic("chaser/{chaser}/sighting", m.Sighting, "chaser", {"controller"}, "image", "state")
ACTUATORS = _topic("chaser/{chaser}/actuators", m.ActuatorCommand, "chaser", {"world"}, "tick", "command")
THRUSTERS = _topic("chaser/{chaser}/thrusters", m.ThrusterReport, "chaser", {"controller"}, "tick", "state")
WRENCH = _topic(
    "controller/chaser/{chaser}/wrench", m.WrenchCommand, "controller", {"chaser"}, "tick", "command"
)
REFERENCE = _topic("controller/chaser/{chaser}/reference", m.Reference, "controller", set(), "tick", "state")
# As urgent as the command, and sent before it; the network may still bring it after the command.
PLAN = _topic("controller/chaser/{chaser}/plan", m.Plan, "controller", {"chaser"}, "tick", "command")
TARGET = _topic("controller/target", m.TargetEstimate, "controller", {"chaser"}, "tick", "command")
SOLVER = _topic("controller/solver", m.SolverStatus, "controller", set(), "tick", "state")
COMMAND = _topic("controller/command", m.CommandReply, "controller", set(), "event", "event")
STATE = _topic("controller/state", m.ControllerState, "controller", {"controller"}, "tick", "command")
OPERATED = _topic("controller/operated", m.OperatorCommand, "controller", set(), "event", "event")
ACK = _topic("recorder/ack", m.RecorderAck, "recorder", {"world"}, "tick", "command")
EVENT = _topic("{process}/event", m.Event, "any", set(), "event", "event")
HEALTH = _topic("{process}/health", m.Health, "any", set(), "second", "event")
PRESENCE = _topic("{process}/presence", m.Presence, "any", _EVERYONE, "presence", "event")
FAREWELL = _topic("{process}/farewell", m.Farewell, "any", set(), "event", "event")

TOPICS: tuple[Topic, ...] = (
    TICK,
    END,
    IMAGE,
    ODOMETRY,
    DOCKING,
    TRUTH_BODY,
    TRUTH_WORLD,
    SIGHTING,
    ACTUATORS,
    THRUSTERS,
    WRENCH,
    REFERENCE,
    PLAN,
    TARGET,
    SOLVER,
    COMMAND,
    OPERATED,
    STATE,
    ACK,
    EVENT,
    HEALTH,
    PRESENCE,
    FAREWELL,
)

EXPRESS = (WRENCH, ACTUATORS, ACK, STATE)
"""Sent without waiting for more, with all of their priority that was published before them."""
NEVER_DROPPED = (END, FAREWELL)
"""Published once, at the end, and waited for even in real time."""

JOIN_KEY = "world/join"
"""Query: JoinRequest -> JoinReply."""
OPERATE_KEY = "controller/operate"
"""Query: OperatorCommand -> CommandReply."""
THRUSTER_FAULT_KEY = "world/thruster_fault"
"""Query: ThrusterFaultCommand -> CommandReply."""
LIVE_KEY = "live/{process}"
"""Liveliness token of a process."""


@lru_cache(maxsize=4096)
def topic_of_key(key: str) -> tuple[Topic, str | None] | None:
    """The topic a concrete key belongs to and what stands in its place, or None for a foreign key."""
    for topic in TOPICS:
        if "{" not in topic.key:
            if key == topic.key:
                return topic, None
            continue
        head, _, rest = topic.key.partition("{")
        tail = rest.partition("}")[2]
        if key.startswith(head) and key.endswith(tail):
            place = key[len(head) : len(key) - len(tail)]
            if place and _fits(topic, place):
                return topic, place
    return None


def _fits(topic: Topic, place: str) -> bool:
    if "{chaser}" in topic.key:
        return _is_number(place)
    return is_process_name(place)


def _is_number(text: str) -> bool:
    # Written in one way only: with leading zeros a chaser would have several names and keys.
    return text.isascii() and text.isdigit() and (text == "0" or text[0] != "0")


def is_process_name(name: str) -> bool:
    """Whether ``name`` is one of ours: ``world``, ``target`` (a body), ``controller``, ``recorder``, ``chaser/3`` …"""
    head, slash, number = name.partition("/")
    if head == "chaser":
        return slash == "/" and _is_number(number)
    members = {"world", *CONTROLLERS, "recorder", "operator", "viewer"}
    return slash == "" and head in members | _NO_MEMBERS


_NO_MEMBERS = {"target", "router"}


def is_member_name(name: str) -> bool:
    """Whether ``name`` is one of ours that takes part in a mission: no body, nor the router."""
    return is_process_name(name) and name not in _NO_MEMBERS


def may_read(role: Role, topic: Topic) -> bool:
    """Whether a process of this role may subscribe to the topic."""
    return role in topic.readers


def may_write(role: Role, topic: Topic) -> bool:
    """Whether a process of this role may publish on the topic."""
    return topic.writer in ("any", role)
