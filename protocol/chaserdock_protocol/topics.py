# SPDX-License-Identifier: Apache-2.0
"""Table of topics: key, type, writer, readers, rate and quality of service.

Keys are relative to the run's namespace and begin with their publisher's name, so that an access
rule can restrict a process to its own branch. Only the world writes ``truth/**`` and
``reference/**``, and no flight process may read them.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Literal, get_args

from msgspec import Struct

from . import messages as m

Role = Literal[
    "world",
    "chaser",
    "controller",
    "mapper",
    "recorder",
    "operator",
    "analysis",
    "viewer",
    "bridge",
]
Qos = Literal["bulk", "state", "command", "event"]

CONTROLLERS = ("controller", "standby")
"""Processes of the role ``controller``, in the order of succession."""
FLYING: frozenset[Role] = frozenset({"chaser", "controller", "mapper"})
_EVERYONE: frozenset[Role] = frozenset(get_args(Role))
_OBSERVERS: frozenset[Role] = frozenset({"recorder", "operator", "analysis", "viewer", "bridge"})
_TRUTH_READERS: frozenset[Role] = frozenset({"recorder", "analysis", "viewer"})


@dataclass(frozen=True, eq=False)
class Topic:
    """A key with at most one placeholder, ``{chaser}`` or ``{process}``, and its properties.
    Compared by identity.

    ``rate``: every tick (``tick``), every tick with images (``image``), every second of simulated
    time (``second``) or of wall time (``presence``), on an event (``event``), or at a sensor's own
    rate (``sensor``).
    """

    key: str
    kind: type[Struct]
    writer: Role | Literal["any"]
    readers: frozenset[Role]
    rate: Literal["tick", "image", "second", "presence", "event", "sensor"]
    qos: Qos

    def key_of(self, place: int | str | None = None) -> str:
        """Return the concrete key. ``place``: chaser number or process name for the placeholder, if
        the key has one.
        """
        return _key_of(self, place)


@lru_cache(maxsize=4096, typed=True)
def _key_of(topic: Topic, place: int | str | None) -> str:
    if "{" not in topic.key:
        if place is not None:
            raise ValueError(f"topic {topic.key} has no placeholder for {place!r}")
        return topic.key
    if place is None:
        raise ValueError(f"topic {topic.key} needs a chaser or process")
    return topic.key.format(chaser=place, process=place)


def _topic(key, kind, writer, readers, rate, qos) -> Topic:
    return Topic(key, kind, writer, frozenset(readers) | _OBSERVERS, rate, qos)


TICK = _topic("world/tick", m.Tick, "world", FLYING, "tick", "state")
END = _topic("world/end", m.MissionEnd, "world", FLYING, "event", "event")
IMAGE = _topic("world/chaser/{chaser}/image", m.Image, "world", {"chaser"}, "image", "bulk")
ODOMETRY = _topic(
    "world/chaser/{chaser}/odometry", m.Odometry, "world", {"chaser", "controller"}, "tick", "state"
)
DOCKING = _topic(
    "world/chaser/{chaser}/docking",
    m.DockingStatus,
    "world",
    {"chaser", "controller"},
    "tick",
    "state",
)
TRUTH_BODY = Topic("truth/body/{process}", m.BodyTruth, "world", _TRUTH_READERS, "tick", "state")
TRUTH_WORLD = Topic("truth/world", m.WorldTruth, "world", _TRUTH_READERS, "tick", "state")
TRUTH_LOAD = Topic(
    "truth/chaser/{chaser}/load", m.PortLoad, "world", _TRUTH_READERS, "tick", "state"
)
TRUTH_PLUME = Topic("truth/plume/{process}", m.PlumeLoad, "world", _TRUTH_READERS, "tick", "state")
BODY_REFERENCE = Topic(
    "reference/body/{process}", m.BodyReference, "world", _TRUTH_READERS, "sensor", "state"
)
TRUTH_DRAWN = Topic("truth/drawn", m.DrawnTruth, "world", _TRUTH_READERS, "event", "state")
SIGHTING = _topic(
    "chaser/{chaser}/sighting", m.Sighting, "chaser", {"controller"}, "image", "state"
)
FEATURES = _topic(
    "chaser/{chaser}/features", m.FeatureTracks, "chaser", {"mapper"}, "image", "state"
)
MAP = _topic("mapper/map", m.LandmarkMap, "mapper", {"chaser"}, "event", "state")
ACTUATORS = _topic(
    "chaser/{chaser}/actuators", m.ActuatorCommand, "chaser", {"world"}, "tick", "command"
)
ASSURANCE = _topic("chaser/{chaser}/assurance", m.AssuranceStatus, "chaser", set(), "tick", "state")
THRUSTERS = _topic(
    "chaser/{chaser}/thrusters", m.ThrusterReport, "chaser", {"controller"}, "tick", "state"
)
LEASE = _topic("chaser/{chaser}/lease", m.Lease, "chaser", {"controller"}, "tick", "command")
WRENCH = _topic(
    "controller/chaser/{chaser}/wrench",
    m.WrenchCommand,
    "controller",
    {"chaser"},
    "tick",
    "command",
)
REFERENCE = _topic(
    "controller/chaser/{chaser}/reference", m.Reference, "controller", set(), "tick", "state"
)
# Same priority as the command, and sent before it; it may still arrive after the command.
PLAN = _topic(
    "controller/chaser/{chaser}/plan", m.Plan, "controller", {"chaser"}, "tick", "command"
)
TARGET = _topic("controller/target", m.TargetEstimate, "controller", {"chaser"}, "tick", "command")
STACK = _topic("controller/stack", m.StackEstimate, "controller", set(), "second", "state")
SAFETY = _topic(
    "controller/chaser/{chaser}/safety", m.PassiveSafety, "controller", set(), "tick", "state"
)
SOLVER = _topic("controller/solver", m.SolverStatus, "controller", set(), "tick", "state")
COMMAND = _topic("controller/command", m.CommandReply, "controller", set(), "event", "event")
STATE = _topic(
    "controller/state", m.ControllerState, "controller", {"controller"}, "tick", "command"
)
OPERATED = _topic("controller/operated", m.OperatorCommand, "controller", set(), "event", "event")
ACK = _topic("recorder/ack", m.RecorderAck, "recorder", {"world"}, "tick", "command")
_KILL_READERS: frozenset[Role] = frozenset({"world", "recorder", "analysis", "viewer", "bridge"})
KILL = Topic("operator/kill", m.Kill, "operator", _KILL_READERS, "event", "command")
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
    TRUTH_LOAD,
    TRUTH_PLUME,
    TRUTH_DRAWN,
    BODY_REFERENCE,
    SIGHTING,
    FEATURES,
    MAP,
    ACTUATORS,
    ASSURANCE,
    THRUSTERS,
    LEASE,
    WRENCH,
    REFERENCE,
    PLAN,
    TARGET,
    STACK,
    SAFETY,
    SOLVER,
    COMMAND,
    OPERATED,
    STATE,
    ACK,
    KILL,
    EVENT,
    HEALTH,
    PRESENCE,
    FAREWELL,
)

EXPRESS = (WRENCH, ACTUATORS, LEASE, ACK, STATE, KILL)
"""Sent at once (not batched), together with messages of their priority published before."""
WORLD_BRANCHES = ("world/", "truth/", "reference/")
"""Beginnings of the keys that only the world writes."""
NEVER_DROPPED = (END, FAREWELL)
"""Published once, at the end, and never dropped, not even in real time."""

JOIN_KEY = "world/join"
"""Query: JoinRequest -> JoinReply, with the flight scenario, for any client: the name in a request
is only a claim.
"""
SCENARIO_KEY = "truth/scenario"
"""Query: ScenarioRequest -> ScenarioReply, with the full scenario."""
OPERATE_KEY = "controller/operate"
"""Query: OperatorCommand -> CommandReply."""
PORT_KEY = "mapper/port"
"""Query: PortRequest -> CommandReply."""
THRUSTER_FAULT_KEY = "world/thruster_fault"
"""Query: ThrusterFaultCommand -> CommandReply."""
ARMING_KEY = "world/arming"
"""Query: ArmingCommand -> ArmingReply, of a gateway."""
LIVE_KEY = "live/{process}"
"""Liveliness token of a process."""


@lru_cache(maxsize=4096)
def topic_of_key(key: str) -> tuple[Topic, str | None] | None:
    """Return the topic of a concrete key and its placeholder value, or None for an unknown key."""
    for topic in TOPICS:
        if "{" not in topic.key:
            if key == topic.key:
                return topic, None
            continue
        head, _, rest = topic.key.partition("{")
        tail = rest.partition("}")[2]
        if key.startswith(head) and key.endswith(tail):
            place = key[len(head) : len(key) - len(tail)]
            if place and _is_valid_place(topic, place):
                return topic, place
    return None


def _is_valid_place(topic: Topic, place: str) -> bool:
    if "{chaser}" in topic.key:
        return _is_number(place)
    return is_process_name(place)


def _is_number(text: str) -> bool:
    # Without leading zeros, with which a chaser would have several names and keys.
    return text.isascii() and text.isdigit() and (text == "0" or text[0] != "0")


def is_process_name(name: str) -> bool:
    """Return whether ``name`` is a process or body: ``world``, ``target`` (a body), ``controller``,
    ``recorder``, ``chaser/3`` …
    """
    head, slash, number = name.partition("/")
    if head == "chaser":
        return slash == "/" and _is_number(number)
    members = {"world", *CONTROLLERS, "mapper", "recorder", "operator", "viewer", "bridge"}
    return slash == "" and head in members | _NON_MEMBERS


_NON_MEMBERS = {"target", "router"}


def is_member_name(name: str) -> bool:
    """Return whether ``name`` is a process that joins missions (not a body or the router)."""
    return is_process_name(name) and name not in _NON_MEMBERS


def may_read(role: Role, topic: Topic) -> bool:
    """Return whether a process of this role may subscribe to the topic."""
    return role in topic.readers


def may_write(role: Role, topic: Topic) -> bool:
    """Return whether a process of this role may publish on the topic."""
    return topic.writer in ("any", role)
