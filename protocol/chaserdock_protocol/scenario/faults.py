"""``[[fault]]``: what goes wrong in a mission, when and where (docs/faults.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

from pydantic import AfterValidator, Field, model_validator

from chaserdock_protocol import topics
from chaserdock_protocol.topics import Role, Topic

from .fields import Number, Positive, Section, Vector, finite

if TYPE_CHECKING:
    from . import Scenario

FaultKind = Literal[
    "kill",
    "freeze",
    "cut",
    "drop",
    "delay",
    "duplicate",
    "reorder",
    "corrupt",
    "flood",
    "clock_jump",
    "camera_off",
    "lying_sensor",
    "odometry_lie",
]
TopicName = Literal["image", "odometry", "docking", "sighting", "thrusters", "wrench", "actuators"]

FAULTY_TOPICS: dict[str, Topic] = {
    "image": topics.IMAGE,
    "odometry": topics.ODOMETRY,
    "docking": topics.DOCKING,
    "sighting": topics.SIGHTING,
    "thrusters": topics.THRUSTERS,
    "wrench": topics.WRENCH,
    "actuators": topics.ACTUATORS,
}
"""What can be faulty. Tick, end, confirmation, presence and farewell are the test bed's own, and are not."""

ON_RECEIPT: frozenset[str] = frozenset(
    {"cut", "drop", "delay", "duplicate", "reorder", "corrupt", "camera_off"}
)
ON_PUBLISHING: frozenset[str] = frozenset({"flood", "clock_jump", "lying_sensor", "odometry_lie"})


class _Takes(NamedTuple):
    """Which fields a kind needs, which it may have beside them, and which processes it can happen to."""

    needs: frozenset[str]
    may: frozenset[str]
    roles: frozenset[str]


def _takes(needs: str, may: str, roles: str) -> _Takes:
    return _Takes(frozenset(needs.split()), frozenset(may.split()), frozenset(roles.split()))


_ANYBODY = "world controller chaser"
_TAKES: dict[str, _Takes] = {
    "kill": _takes("", "", "controller chaser recorder"),
    "freeze": _takes("duration_s", "", "world controller chaser recorder"),
    "cut": _takes("duration_s", "peer", "controller chaser"),
    "drop": _takes("duration_s topic", "share peer", _ANYBODY),
    "delay": _takes("duration_s topic delay_s", "peer", _ANYBODY),
    "duplicate": _takes("duration_s topic", "share peer", _ANYBODY),
    "reorder": _takes("duration_s topic", "share peer", _ANYBODY),
    "corrupt": _takes("duration_s topic", "share peer", _ANYBODY),
    "flood": _takes("duration_s topic copies", "", _ANYBODY),
    "clock_jump": _takes("duration_s offset_s", "", "controller chaser"),
    "camera_off": _takes("duration_s", "", "chaser"),
    "lying_sensor": _takes("duration_s", "offset_m rotation_deg", "chaser"),
    "odometry_lie": _takes("duration_s", "offset_m rotation_deg", "chaser"),
}
_COMMON = frozenset({"kind", "at_s", "process"})


def role_of(process: str) -> Role:
    """The role of a process by its name; ``standby`` is a controller."""
    head = process.partition("/")[0]
    return "controller" if head == "standby" else head  # type: ignore[return-value]


def _process(name: str) -> str:
    if not topics.is_member_name(name) or name == "operator":
        raise ValueError(
            f"{name!r} is no process of a mission; such are world, controller, standby, chaser/0, recorder"
        )
    return name


Process = Annotated[str, AfterValidator(_process)]


class Fault(Section):
    """One fault: of which kind, from when, for how long, and where.

    ``process``: whom it happens to. Faults of messages happen to ``topic`` where it is received by ``process``, with
    ``peer`` only to what comes from there; a flood, a clock's jump and a sensor's lie to what it publishes. ``share``
    of the messages, drawn from the scenario's seed. ``offset_m``, ``rotation_deg``: a rotation vector; of sightings in
    IRF, of odometry in WRF and CRF.
    """

    kind: FaultKind
    at_s: Annotated[float, AfterValidator(finite), Field(gt=0)]
    duration_s: Positive | None = None
    process: Process
    peer: Process | None = None
    topic: TopicName | None = None
    share: Annotated[float, AfterValidator(finite), Field(gt=0, le=1)] | None = None
    delay_s: Positive | None = None
    copies: Annotated[int, Field(ge=1, le=1000)] | None = None
    offset_s: Number | None = None
    offset_m: Vector | None = None
    rotation_deg: Vector | None = None

    @model_validator(mode="after")
    def _fits(self) -> Fault:
        takes = _TAKES[self.kind]
        given = {name for name, value in dict(self).items() if value is not None} - _COMMON
        for name in sorted(takes.needs - given):
            raise ValueError(f"{self.kind} needs {name}")
        for name in sorted(given - takes.needs - takes.may):
            raise ValueError(f"{name} does not go with {self.kind}")
        role = role_of(self.process)
        if role not in takes.roles:
            raise ValueError(
                f"{self.kind} cannot happen to {self.process}; to: {', '.join(sorted(takes.roles))}"
            )
        if self.topic is not None:
            topic = FAULTY_TOPICS[self.topic]
            does = topics.may_write(role, topic) if self.kind == "flood" else topics.may_read(role, topic)
            if not does:
                verb = "publishes" if self.kind == "flood" else "receives"
                raise ValueError(f"{self.process} {verb} no {self.topic}")
        if self.peer is not None and (self.peer == self.process or role_of(self.peer) == "recorder"):
            raise ValueError(f"peer: nothing that counts comes to {self.process} from {self.peer}")
        if (
            self.kind in ("lying_sensor", "odometry_lie")
            and self.offset_m is None
            and self.rotation_deg is None
        ):
            raise ValueError(f"{self.kind} needs offset_m or rotation_deg")
        return self

    def text(self) -> str:
        """The fault in a line, for the log."""
        said = [f"{self.kind} {self.process}"]
        for name, value in dict(self).items():
            if value is not None and name not in ("kind", "process", "at_s"):
                said.append(f"{name} {value}")
        return ", ".join(said)


def check_faults(faults: tuple[Fault, ...], scenario: Scenario) -> None:
    """Raises ValueError, with its path, for a fault that names what this mission does not have."""
    chasers, ports = len(scenario.chasers), scenario.docking.kind == "capture"
    for k, fault in enumerate(faults):
        for name in (fault.process, fault.peer or "world"):
            if name == "standby" and not scenario.controller.standby:
                raise ValueError(f"fault.{k}: there is a standby only with controller.standby = true")
            head, _, number = name.partition("/")
            if head == "chaser" and int(number) >= chasers:
                raise ValueError(
                    f"fault.{k}: there is no {name}; this mission has chaser/0 to chaser/{chasers - 1}"
                )
        if fault.topic == "thrusters" and scenario.chaser.actuation != "thrusters":
            raise ValueError(f'fault.{k}.topic: there are thrusters only with chaser.actuation = "thrusters"')
        if fault.topic == "docking" and not ports:
            raise ValueError(f"fault.{k}.topic: there is a docking sensor only with docking.ports")
