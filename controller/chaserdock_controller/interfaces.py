"""What a tick of the controller takes and gives."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from chaserdock_protocol.messages import (
    CommandReply,
    DockingStatus,
    Event,
    Odometry,
    OperatorCommand,
    Plan,
    Reference,
    Sighting,
    SolverStatus,
    TargetEstimate,
    ThrusterReport,
    WrenchCommand,
)


@dataclass(frozen=True)
class TickInputs:
    """What a tick brings. Sightings may belong to earlier ticks."""

    tick: int
    time_ns: int
    odometry: dict[int, Odometry]
    sightings: tuple[Sighting, ...]
    commands: tuple[OperatorCommand, ...] = ()
    thrusters: Mapping[int, ThrusterReport] = field(default_factory=dict)
    docking: Mapping[int, DockingStatus] = field(default_factory=dict)


@dataclass
class TickOutputs:
    """What a tick yields; dictionaries by chaser."""

    target: TargetEstimate
    wrenches: dict[int, WrenchCommand] = field(default_factory=dict)
    references: dict[int, Reference] = field(default_factory=dict)
    plans: dict[int, Plan] = field(default_factory=dict)
    solver: SolverStatus | None = None
    replies: list[CommandReply] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)
