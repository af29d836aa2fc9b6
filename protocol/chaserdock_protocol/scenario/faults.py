# SPDX-License-Identifier: Apache-2.0
"""Scenario tables ``[[fault]]``: failures to inject, with time and place (docs/faults.md)."""

from __future__ import annotations

import hashlib
import math
from typing import TYPE_CHECKING, Annotated, Literal, NamedTuple

from pydantic import AfterValidator, Field, ValidationError, model_validator

from chaserdock_protocol import topics
from chaserdock_protocol.topics import Role, Topic

from .errors import invalid
from .fields import Number, Positive, Section, Vector
from .thrusters import ThrusterFailure

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
    "latch_slip",
    "latch_open",
    "latch_stuck",
]
TopicName = Literal[
    "image", "odometry", "docking", "sighting", "thrusters", "lease", "wrench", "actuators"
]

FAULTY_TOPICS: dict[str, Topic] = {
    "image": topics.IMAGE,
    "odometry": topics.ODOMETRY,
    "docking": topics.DOCKING,
    "sighting": topics.SIGHTING,
    "thrusters": topics.THRUSTERS,
    "lease": topics.LEASE,
    "wrench": topics.WRENCH,
    "actuators": topics.ACTUATORS,
}
"""Topics that faults may affect. Tick, end, confirmation, presence and farewell belong to the test
bed and are exempt.
"""

ON_RECEIPT: frozenset[str] = frozenset(
    {"cut", "drop", "delay", "duplicate", "reorder", "corrupt", "camera_off"}
)
ON_PUBLISHING: frozenset[str] = frozenset({"flood", "clock_jump", "lying_sensor", "odometry_lie"})


LATCH_FAULTS: frozenset[str] = frozenset({"latch_slip", "latch_open", "latch_stuck"})
_BY_WORLD: frozenset[str] = LATCH_FAULTS | {"odometry_lie"}
"""Faults that happen to chasers, but in the world's process."""


class _Signature(NamedTuple):
    """Required and optional keys of a kind of fault, and the roles that it applies to."""

    required: frozenset[str]
    optional: frozenset[str]
    roles: frozenset[str]


def _signature(required: str, optional: str, roles: str) -> _Signature:
    return _Signature(
        frozenset(required.split()), frozenset(optional.split()), frozenset(roles.split())
    )


_ALL_BUT_RECORDER = "world controller chaser"
_SIGNATURES: dict[str, _Signature] = {
    "kill": _signature("", "", "controller chaser mapper recorder"),
    "freeze": _signature("duration_s", "", "world controller chaser mapper recorder"),
    "cut": _signature("duration_s", "peer", "controller chaser"),
    "drop": _signature("duration_s topic", "share peer", _ALL_BUT_RECORDER),
    "delay": _signature("duration_s topic delay_s", "peer", _ALL_BUT_RECORDER),
    "duplicate": _signature("duration_s topic", "share peer", _ALL_BUT_RECORDER),
    "reorder": _signature("duration_s topic", "share peer", _ALL_BUT_RECORDER),
    "corrupt": _signature("duration_s topic", "share peer", _ALL_BUT_RECORDER),
    "flood": _signature("duration_s topic copies", "", _ALL_BUT_RECORDER),
    "clock_jump": _signature("duration_s offset_s", "", "controller chaser"),
    "camera_off": _signature("duration_s", "", "chaser"),
    "lying_sensor": _signature("duration_s", "offset_m rotation_deg", "chaser"),
    "odometry_lie": _signature("duration_s", "offset_m rotation_deg", "chaser"),
    "latch_slip": _signature("duration_s", "force_N torque_N_m", "chaser"),
    "latch_open": _signature("duration_s", "", "chaser"),
    "latch_stuck": _signature("duration_s", "", "chaser"),
}
_COMMON = frozenset({"kind", "at_s", "process"})


def role_of(process: str) -> Role:
    """Return the role of a process from its name; ``standby`` is a controller."""
    head = process.partition("/")[0]
    return "controller" if head == "standby" else head  # type: ignore[return-value]


def _check_process_name(name: str) -> str:
    if not topics.is_member_name(name) or name == "operator":
        raise ValueError(
            f"{name!r} is no process of a mission; valid: world, controller, standby, "
            "chaser/NUMBER, mapper, recorder"
        )
    return name


Process = Annotated[str, AfterValidator(_check_process_name)]


class Fault(Section):
    """One failure to inject. Which keys a kind takes: [faults.md](faults.md)."""

    kind: FaultKind = Field(description="What happens.")
    at_s: float = Field(gt=0, allow_inf_nan=False, description="Begin, s of mission time.")
    duration_s: Positive | None = Field(
        default=None,
        description="Duration, s of mission time; of wall time for `freeze`. `kill` has none.",
    )
    process: Process = Field(
        description="Process that is affected: `world`, `controller`, `standby`, "
        "`chaser/NUMBER`, `mapper` or `recorder`. Faults of messages affect what it receives; "
        "`flood`, `clock_jump`, `lying_sensor` and `odometry_lie` what it publishes; "
        "`latch_slip`, `latch_open` and `latch_stuck` its latch."
    )
    peer: Process | None = Field(
        default=None, description="Limits the fault to messages from this process."
    )
    topic: TopicName | None = Field(default=None, description="Kind of message that is affected.")
    share: float | None = Field(
        default=None,
        gt=0,
        le=1,
        allow_inf_nan=False,
        description="Share of the messages that are affected, drawn from the scenario's seed. "
        "Without it: all.",
    )
    delay_s: Positive | None = Field(default=None, description="Delay of each message, s.")
    copies: int | None = Field(
        default=None, ge=1, le=1000, description="Extra copies of each message in a flood."
    )
    offset_s: Number | None = Field(
        default=None, description="Error of the process' time stamps, s."
    )
    offset_m: Vector | None = Field(
        default=None,
        description="Error of the position, m: of sightings in IRF, of odometry in WRF.",
    )
    rotation_deg: Vector | None = Field(
        default=None,
        description="Error of the attitude, rotation vector, degrees: of sightings in IRF, of "
        "odometry in CRF.",
    )

    force_N: Positive | None = Field(
        default=None,
        description="Largest force that a slipping latch transmits, N. Without it: any.",
    )
    torque_N_m: Positive | None = Field(
        default=None,
        description="Largest torque that a slipping latch transmits, N m. Without it: any.",
    )

    @model_validator(mode="after")
    def _check_keys(self) -> Fault:
        signature = _SIGNATURES[self.kind]
        present = {name for name, value in dict(self).items() if value is not None} - _COMMON
        for name in sorted(signature.required - present):
            raise ValueError(f"{self.kind} needs {name}")
        for name in sorted(present - signature.required - signature.optional):
            raise ValueError(f"{name} does not go with {self.kind}")
        for kinds, (one, other) in (
            (("lying_sensor", "odometry_lie"), ("offset_m", "rotation_deg")),
            (("latch_slip",), ("force_N", "torque_N_m")),
        ):
            if self.kind in kinds and not present & {one, other}:
                raise ValueError(f"{self.kind} needs {one} or {other}")
        return self

    @model_validator(mode="after")
    def _check_process(self) -> Fault:
        roles, role = _SIGNATURES[self.kind].roles, role_of(self.process)
        if role not in roles:
            raise ValueError(
                f"{self.kind} cannot happen to {self.process}; valid: {', '.join(sorted(roles))}"
            )
        if self.topic is not None:
            topic = FAULTY_TOPICS[self.topic]
            verb, allowed = ("receives", topics.may_read)
            if self.kind == "flood":
                verb, allowed = ("publishes", topics.may_write)
            if not allowed(role, topic):
                raise ValueError(f"{self.process} {verb} no {self.topic}")
        if self.peer is not None and (
            self.peer == self.process or role_of(self.peer) == "recorder"
        ):
            raise ValueError(
                f"peer: {self.process} receives no message that can be faulty from {self.peer}"
            )
        return self

    def ticks(self, rate_hz: int) -> tuple[int, int]:
        """Return the first tick of the fault and the first tick after it. A fault lasts at least
        one tick.
        """
        begin = max(1, math.ceil(self.at_s * rate_hz - 1e-9))
        return begin, begin + max(1, round((self.duration_s or 0.0) * rate_hz))

    def text(self) -> str:
        """Return the fault as one line for the log."""
        parts = [f"{self.kind} {self.process}"]
        for name, value in dict(self).items():
            if value is not None and name not in ("kind", "process", "at_s"):
                parts.append(f"{name} {value}")
        return ", ".join(parts)


class ProcessFaults(Section):
    """What the test bed injects at one process. Read by the process' shell, not by its flight
    software.

    ``seed``: of the random draws, a hash, so that it does not give away the scenario's.
    ``reported_failures``: thruster failures that the chaser's hardware reports when they happen.
    """

    seed: int = Field(default=0, ge=0, lt=2**64)
    faults: tuple[Fault, ...] = ()
    reported_failures: tuple[ThrusterFailure, ...] = ()


def faults_of(scenario: Scenario, process: str) -> ProcessFaults:
    """Return the faults that a process injects into its own messages; the world announces, and so
    gets, all.
    """
    faults = tuple(f for f in scenario.fault if process == "world" or _concerns(f, process))
    digest = hashlib.sha256(f"{scenario.seed}/faults/{process}".encode()).digest()
    return ProcessFaults(
        seed=int.from_bytes(digest[:8], "big") if faults else 0,
        faults=faults,
        reported_failures=tuple(
            f for f in scenario.thruster_failure if f.reported and process == f"chaser/{f.chaser}"
        ),
    )


def _concerns(fault: Fault, process: str) -> bool:
    if fault.kind == "cut" and fault.process != process:
        return fault.peer in (None, process)
    return fault.process == process and fault.kind not in _BY_WORLD


def process_faults_from_json(text: str) -> ProcessFaults:
    """Return the faults of a join reply. Raises ScenarioError."""
    try:
        return ProcessFaults.model_validate_json(text)
    except ValidationError as error:
        raise invalid(error, ProcessFaults, "the world's faults") from None


def check_faults(faults: tuple[Fault, ...], scenario: Scenario) -> None:
    """Raise ValueError, with its path, for a fault that names what this mission does not have."""
    chasers = len(scenario.chasers)
    for k, fault in enumerate(faults):
        for name in (fault.process, fault.peer or "world"):
            if name == "standby" and not scenario.controller.standby:
                raise ValueError(f"fault.{k}: a standby exists only with controller.standby = true")
            if name == "mapper" and not scenario.maps_target:
                raise ValueError(
                    f'fault.{k}: a mapper exists only with perception.name = "features"'
                )
            head, _, number = name.partition("/")
            if head == "chaser" and int(number) >= chasers:
                raise ValueError(
                    f"fault.{k}: there is no {name}; this mission has chaser/0 to "
                    f"chaser/{chasers - 1}"
                )
        if fault.topic == "thrusters" and scenario.chaser.actuation != "thrusters":
            raise ValueError(
                f'fault.{k}.topic: thrusters exist only with chaser.actuation = "thrusters"'
            )
        if fault.topic == "docking" and scenario.docking.kind != "capture":
            raise ValueError(
                f'fault.{k}.topic: docking sensors exist only with docking.kind = "capture"'
            )
        if (
            fault.kind in LATCH_FAULTS
            and scenario.docking.port_of(int(fault.process.partition("/")[2])) is None
        ):
            raise ValueError(
                f"fault.{k}: {fault.kind} cannot happen to {fault.process}, which has no port; "
                "see docking.kind and "
                "[[docking.ports]]"
            )
