# SPDX-License-Identifier: Apache-2.0
"""Inputs and outputs of a controller tick, and the results that its stages hand to each other."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, Protocol

from chaserdock_models.arrays import Array
from chaserdock_models.geometry_errors import GeometryParameter
from chaserdock_models.mounting import MountedChaser
from chaserdock_models.passive_safety import CoastCertificate
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.messages import (
    CameraCalibration,
    CommandReply,
    DockingStatus,
    Event,
    Latch,
    Level,
    Odometry,
    OperatorCommand,
    PassiveSafety,
    Plan,
    Reference,
    Sighting,
    SolverStatus,
    StackEstimate,
    TargetEstimate,
    ThrusterReport,
    WrenchCommand,
)

from .estimation.mass_properties import MassProperties
from .estimation.target_body import TargetBody
from .estimation.types import RelativePose, TargetState
from .guidance.phases import Phase
from .nmpc.plan_monitor import ChaserPlan, PlanningFailure
from .nmpc.types import NmpcPlan

LogEntry = tuple[Level, str]
"""Level and text of an event."""
ControlMode = Literal["nmpc", "track", "brake", "coast", "pull", "search", "detumble"]


@dataclass(frozen=True)
class TickInputs:
    """Messages of a tick. Sightings may belong to earlier ticks.

    ``odometry``: of the tick; a lost one is extrapolated for a while. ``outdated``: the newest
    odometry of chasers that have none of this tick, by chaser.
    """

    tick: int
    time_ns: int
    odometry: Mapping[int, Odometry]
    sightings: tuple[Sighting, ...]
    commands: tuple[OperatorCommand, ...] = ()
    thrusters: Mapping[int, ThrusterReport] = field(default_factory=dict)
    docking: Mapping[int, DockingStatus] = field(default_factory=dict)
    outdated: Mapping[int, Odometry] = field(default_factory=dict)


@dataclass
class TickOutputs:
    """Messages that a tick produces; dictionaries by chaser."""

    target: TargetEstimate
    stack: StackEstimate | None = None
    wrenches: dict[int, WrenchCommand] = field(default_factory=dict)
    references: dict[int, Reference] = field(default_factory=dict)
    plans: dict[int, Plan] = field(default_factory=dict)
    safety: dict[int, PassiveSafety] = field(default_factory=dict)
    solver: SolverStatus | None = None
    replies: list[CommandReply] = field(default_factory=list)
    events: list[Event] = field(default_factory=list)


class AppliedImpulse(NamedTuple):
    """Impulse (6,), N s and N m s, body axes, since the tick before: ``measured`` by thrusters, or
    commanded.
    """

    impulse: Array
    measured: bool


@dataclass(frozen=True)
class Observation:
    """Result of ingest: checked inputs and what follows from them about the chasers; mappings by
    chaser.

    ``effective_ns``: when this tick's commands take effect. ``odometry``: valid states, of
    ``outdated`` chasers extrapolated; ``invalid``: why a state is not. ``outdated``: valid odometry
    of earlier ticks, with the times of these, of chasers without newer. ``lost``: last odometry of
    chasers that are obstacles to the others. ``interrupted``: chasers without odometry for a while
    before this tick, as they sent none or this controller received none. ``ahead``: what acts on a
    chaser until ``effective_ns``, as durations (s) and wrenches (6,). ``input_limits``: (6,).
    Wrenches are N and N m, body axes. ``isolated``: thrusters that chasers report as closed.
    ``thruster_impulses``: of the thrusters (n,) since the tick before, N s, as chasers report them.
    ``last_commands``: to chasers without odometry in this tick, (6,); what they fly now is not
    known.
    """

    tick: int
    time_ns: int
    effective_ns: int
    odometry: Mapping[int, Odometry]
    outdated: Mapping[int, Odometry]
    invalid: Mapping[int, str]
    lost: Mapping[int, Odometry]
    sightings: tuple[Sighting, ...]
    commands: tuple[OperatorCommand, ...]
    docking: Mapping[int, DockingStatus]
    impulses: Mapping[int, AppliedImpulse]
    last_commands: Mapping[int, Array]
    thruster_impulses: Mapping[int, Array]
    ahead: Mapping[int, tuple[tuple[float, Array], ...]]
    input_limits: Mapping[int, Array]
    isolated: Mapping[int, tuple[int, ...]]
    events: tuple[LogEntry, ...]
    interrupted: frozenset[int] = frozenset()

    @property
    def time_s(self) -> float:
        """Return the simulated time in seconds."""
        return self.time_ns / 1e9

    @property
    def measured(self) -> dict[int, Odometry]:
        """Return the odometry of this tick without extrapolated states, which leave out the thrust."""
        return {i: odometry for i, odometry in self.odometry.items() if i not in self.outdated}


@dataclass(frozen=True, eq=False)
class IdentifiedStack:
    """Mass properties of the stack and of the target alone, as identified until now.

    ``chasers``: where they are fixed. ``motion``: of the centre of mass (WRF) and the target's
    axes. ``thrust_factors`` (n,): estimated over stated thrust, by chaser. ``failed``: thrusters
    found stuck, by chaser. ``informative`` returns the thrusters (chaser, number) whose pulses
    would tell most about the mass properties, the best first.
    """

    stack: MassProperties
    target: MassProperties
    chasers: Mapping[int, MountedChaser]
    motion: BodyState
    thrust_factors: Mapping[int, Array]
    failed: Mapping[int, tuple[int, ...]]
    informative: Callable[[], tuple[tuple[int, int], ...]]


@dataclass(frozen=True, eq=False)
class EstimatedShape:
    """Errors of the target's known geometry: ``parameters``, their estimated values (k,) and
    covariance (k, k), both in the parameters' standard deviations; number of ``views``, the share
    of directions that they cover, and whether this tick brought one (``changed``)."""

    parameters: tuple[GeometryParameter, ...]
    values: Array
    covariance: Array
    views: int
    coverage: float
    changed: bool


@dataclass(frozen=True)
class TargetEstimation:
    """Result of estimation. ``at_effect``: the target at ``Observation.effective_ns``, if its pose
    is known.

    ``own``: estimated states of the chasers with valid odometry; ``own_at_effect``: the same at
    ``Observation.effective_ns``, (13,): p, v (WRF), q_wxyz, omega (body). ``disturbances``:
    estimated force and torque (6,) on a chaser, body axes. ``motion_covariances``: (6, 6) of a
    chaser's position and velocity relative to the target, WRF, unless passive safety is off.
    ``relative``: poses of the chasers relative to the target, if estimated with covariance.
    ``visible_to``: chasers with a sighting of the target. ``latched``: chasers whose latch holds
    the target; ``body``: the target and these chasers as one rigid body. ``stack``: their mass
    properties as identified, if they are. ``shape``: errors of the known geometry, once they are
    estimated. ``doubtful``: chasers whose odometry may be wrong.
    """

    target: TargetState
    at_effect: TargetState | None
    own: Mapping[int, Odometry]
    own_at_effect: Mapping[int, Array]
    disturbances: Mapping[int, Array]
    motion_covariances: Mapping[int, Array]
    relative: tuple[RelativePose, ...]
    visible_to: frozenset[int]
    cameras: tuple[CameraCalibration, ...]
    latched: frozenset[int]
    body: TargetBody
    events: tuple[LogEntry, ...]
    stack: IdentifiedStack | None = None
    shape: EstimatedShape | None = None
    doubtful: frozenset[int] = frozenset()

    @property
    def known(self) -> bool:
        """Return whether the target's pose is known."""
        return self.at_effect is not None


@dataclass(frozen=True)
class ReferencePose:
    """Reference of one chaser now: position (3,) and attitude (4,) in WRF, ``offset_m`` (3,) in
    TRF.
    """

    position_m: Array
    q_wxyz: Array
    offset_m: Array
    min_distance_target_m: float


@dataclass(frozen=True)
class DirectCommand:
    """Force and torque (6,), body axes, of a chaser that is not flown by the NMPC; ``thrusts_N``
    (n,), if not None: those of its thrusters, which give that wrench."""

    mode: ControlMode
    wrench: Array
    thrusts_N: Array | None = None


@dataclass(frozen=True)
class Directive:
    """Guidance of one chaser. ``isolated`` and ``trusted``: thrusters, by operator command.
    ``reference`` is None while the target or the chaser's own state is unknown."""

    phase: Phase
    phase_time_s: float
    latch: Latch
    free: bool
    isolated: tuple[int, ...]
    trusted: tuple[int, ...]
    reference: ReferencePose | None
    direct: DirectCommand | None


@dataclass(frozen=True)
class HorizonReference:
    """References of N ``chasers`` over D stages: the guidance part of an ``NmpcInput`` (shapes
    there).

    ``attached``: chasers whose latch holds the target; they are obstacles and follow its motion.
    """

    chasers: tuple[int, ...]
    references: Array
    u_ref: Array
    target_positions: Array
    min_distance_target_m: Array
    corridors: Array | None
    attached: frozenset[int]
    boxes: Array | None = None
    box_clearance_m: Array | None = None


@dataclass(frozen=True)
class GuidanceResult:
    """Result of guidance. ``horizon`` is None when no chaser is planned for. ``abort_margins``:
    margin in sigmas of the best abort of each chaser whose passive safety is enforced now."""

    directives: Mapping[int, Directive]
    horizon: HorizonReference | None
    replies: tuple[CommandReply, ...]
    events: tuple[LogEntry, ...]
    abort_margins: Mapping[int, float] = field(default_factory=dict)

    @property
    def inspecting(self) -> frozenset[int]:
        """Return the chasers that fly around the target to view it."""
        return frozenset(i for i, d in self.directives.items() if d.phase is Phase.INSPECT)


@dataclass(frozen=True)
class PlanCertificate:
    """Passive safety of a chaser's newest plan: the worst coast, and the time (s) from the plan's
    beginning to its loss of thrust.
    """

    coast: CoastCertificate
    loss_s: float
    safe: bool


class PlanningHistory(Protocol):
    """What guidance learns about the plans of earlier ticks."""

    def failures(self, time_ns: int) -> Mapping[int, PlanningFailure]:
        """Return the chasers that have to retreat at ``time_ns`` because planning has failed."""
        ...

    def unsafe(self, time_ns: int) -> Mapping[int, str]:
        """Return why chasers lack passive safety at ``time_ns``."""
        ...


@dataclass(frozen=True)
class PlanResult:
    """Result of planning: the plan of ``chasers``, row by row; None without a usable solve.
    ``wall_s``: time of the solve.

    ``flyable``: the plan of each chaser that may be flown, an earlier one for a while after a
    failed solve. ``certificates``: passive safety of the newest plans, where it is monitored.
    """

    chasers: tuple[int, ...]
    plan: NmpcPlan | None
    wall_s: float
    events: tuple[LogEntry, ...]
    flyable: Mapping[int, ChaserPlan]
    certificates: Mapping[int, PlanCertificate]
