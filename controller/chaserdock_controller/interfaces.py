# SPDX-License-Identifier: Apache-2.0
"""Inputs and outputs of a controller tick, and the results that its stages pass on.

``Observation``, ``TargetEstimation``, ``GuidanceResult`` and ``PlanResult`` hold one object per
chaser. The first two hold one for every chaser of the mission, so that ``chasers[i]`` is chaser i;
what is unknown of it is None.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, Protocol

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.geometry_errors import GeometryParameter
from chaserdock_models.mounting import MountedChaser
from chaserdock_models.passive_safety import CoastCertificate, DisturbedMotion
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.messages import (
    CameraCalibration,
    CommandReply,
    DockingStatus,
    Event,
    Innovation,
    Latch,
    Level,
    Odometry,
    OperatorCommand,
    PassiveSafety,
    PhaseName,
    Plan,
    Reference,
    Sighting,
    SolverStatus,
    StackEstimate,
    TargetEstimate,
    ThrusterReport,
    WrenchCommand,
)
from msgspec import Struct

from .bodies.mass_properties import MassProperties
from .bodies.target_body import TargetBody

LogEntry = tuple[Level, str]
"""Level and text of an event."""
ControlMode = Literal["nmpc", "track", "brake", "coast", "pull", "search", "detumble"]

# -- the tick --------------------------------------------------------------------------------------


class ChaserInputs(Struct, frozen=True):
    """Messages of one chaser for a tick.

    ``odometry``: of the tick; extrapolated for a while if lost. ``outdated``: the newest one, if it
    belongs to an earlier tick. ``thrusters``: the newest report. ``docking``: of the tick.
    """

    chaser: int
    odometry: Odometry | None = None
    outdated: Odometry | None = None
    thrusters: ThrusterReport | None = None
    docking: DockingStatus | None = None


class TickInputs(Struct, frozen=True):
    """Messages of a tick. Sightings may belong to earlier ticks. ``chasers``: those of which
    anything is known, in order.
    """

    tick: int
    time_ns: int
    chasers: tuple[ChaserInputs, ...]
    sightings: tuple[Sighting, ...] = ()
    commands: tuple[OperatorCommand, ...] = ()


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


# -- ingest ----------------------------------------------------------------------------------------


class AppliedImpulse(NamedTuple):
    """What the actuators of a chaser gave since the tick before; forces and torques, body axes.

    ``impulse`` (6,): N s and N m s. ``moment`` (6,): its first moment about the middle of that
    time, N s² and N m s², positive for what acts early. ``magnitude`` (6,): sum of the magnitudes
    of the parts, which may cancel. ``measured``: as thrusters report it; else as commanded.
    """

    impulse: Array
    moment: Array
    magnitude: Array
    measured: bool = False

    @classmethod
    def steady(cls, impulse: Array) -> AppliedImpulse:
        """Return the ``impulse`` (6,) of a wrench that was constant."""
        return cls(impulse, np.zeros(6), np.abs(impulse))


class ChaserObservation(Struct, frozen=True, eq=False):
    """What is known of one chaser in a tick before estimation.

    ``odometry``: its valid state, else None; ``invalid``: why it is not used, or empty.
    ``outdated``: valid odometry of an earlier tick, with that tick's time, if there is no newer
    one; an ``odometry`` beside it is extrapolated. ``lost``: its last odometry, while it is an
    obstacle to others. ``interrupted``: it had no odometry for a while before this tick, because it
    sent none or this controller received none.

    Wrenches are N and N m in body axes. ``impulse``: on a chaser with ``odometry``.
    ``last_command`` (6,): to a chaser without; what it flies now is unknown. ``ahead``: wrenches
    that act on it until ``Observation.effective_ns``, as durations (s) and wrenches (6,).
    ``input_limits``: (6,). ``thruster_impulses`` (n,): of its thrusters since the previous tick, N
    s, if reported. ``isolated``: thrusters that it reports as closed.
    """

    chaser: int
    input_limits: Array
    odometry: Odometry | None = None
    invalid: str = ""
    outdated: Odometry | None = None
    lost: Odometry | None = None
    interrupted: bool = False
    docking: DockingStatus | None = None
    impulse: AppliedImpulse | None = None
    last_command: Array | None = None
    ahead: tuple[tuple[float, Array], ...] = ()
    thruster_impulses: Array | None = None
    isolated: tuple[int, ...] = ()

    @property
    def measured(self) -> Odometry | None:
        """Return the odometry of this tick. None if it is extrapolated: that state ignores the
        thrust.
        """
        return self.odometry if self.outdated is None else None

    @property
    def touches(self) -> bool:
        """Return whether its probe tip touches the target while its latch is open."""
        return self.docking is not None and self.docking.contact and not self.docking.latched


class Observation(Struct, frozen=True):
    """Result of ingest: checked inputs, and what follows from them for each of the ``chasers``.

    ``effective_ns``: time at which this tick's commands take effect.
    """

    tick: int
    time_ns: int
    effective_ns: int
    chasers: tuple[ChaserObservation, ...]
    sightings: tuple[Sighting, ...] = ()
    commands: tuple[OperatorCommand, ...] = ()
    events: tuple[LogEntry, ...] = ()

    @property
    def time_s(self) -> float:
        """Return the simulated time in seconds."""
        return self.time_ns / 1e9


# -- estimation ------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class TargetState:
    """Estimated state of the target at ``time_ns``.

    position_m, velocity_m_s: (3,) WRF. q_wxyz: (4,) TRF to WRF. omega_rad_s: (3,) TRF axes.
    covariance: (12, 12), order (position WRF, velocity WRF, dtheta TRF, omega TRF).
    status: "none" (no measurement yet: pose and rates are zero, the covariance is 1e6 times
        identity), "tracking" (a measurement was accepted recently), "predicting" (motion model
        only), "lost" (too uncertain to use).
    sightings: number of chasers whose measurements were accepted at the newest exposure.
    rejected: chasers whose measurements were gated out at the newest exposure.
    """

    time_ns: int
    position_m: Array
    velocity_m_s: Array
    q_wxyz: Array
    omega_rad_s: Array
    covariance: Array
    status: str
    sightings: int
    rejected: tuple[int, ...]

    @property
    def is_known(self) -> bool:
        """Whether pose and rates may be used."""
        return self.status in ("tracking", "predicting")


@dataclass(frozen=True, eq=False)
class RelativePose:
    """Estimated pose of a chaser relative to the target.

    position_m: (3,) origin of CRF in TRF. q_wxyz: (4,) CRF to TRF. covariance: (6, 6), order
    (position in TRF axes, m; dtheta in CRF axes, rad). random_covariance: (6, 6), the part of it
    that two times in one view do not share, of a latched chaser.
    """

    position_m: Array
    q_wxyz: Array
    covariance: Array
    random_covariance: Array | None = None


class OwnMotion(Struct, frozen=True, eq=False):
    """Estimated motion of a chaser with valid odometry.

    ``state``: now. ``at_effect`` (13,): at ``Observation.effective_ns``; p, v (WRF), q_wxyz, omega
    (body). ``disturbance`` (6,): estimated force and torque, body axes.
    """

    state: Odometry
    at_effect: Array
    disturbance: Array


class ChaserEstimate(Struct, frozen=True, eq=False):
    """What is estimated of one chaser.

    ``own``: its motion, None without valid odometry. ``relative``: its pose relative to the target.
    ``disturbed``: what decides where it coasts besides its position and velocity; None while
    passive safety is off. Both only with ``own`` and if the estimator provides them.
    ``camera``: errors of its camera, once estimated. ``visible``: it sees the target in this tick.
    ``latched``: its latch holds the target. ``doubtful``: its odometry may be wrong.
    """

    chaser: int
    own: OwnMotion | None = None
    disturbed: DisturbedMotion | None = None
    relative: RelativePose | None = None
    camera: CameraCalibration | None = None
    visible: bool = False
    latched: bool = False
    doubtful: bool = False


@dataclass(frozen=True, eq=False)
class StackChaser:
    """A chaser that is part of the stack: its mounting, and the ratios (n,) of estimated to stated
    thrust of its thrusters.
    """

    chaser: int
    mounting: MountedChaser
    thrust_factors: Array


@dataclass(frozen=True, eq=False)
class IdentifiedStack:
    """Mass properties of the stack and of the target alone, as identified so far.

    ``motion``: of the centre of mass (WRF) and the target's axes. ``failed``: thrusters found
    stuck, as (chaser, number). ``informative``: function that returns the thrusters (chaser,
    number) in the order of the information of their pulses on the mass properties, best first.
    """

    stack: MassProperties
    target: MassProperties
    chasers: tuple[StackChaser, ...]
    motion: BodyState
    failed: frozenset[tuple[int, int]]
    informative: Callable[[], tuple[tuple[int, int], ...]]

    def failed_of(self, chaser: int) -> tuple[int, ...]:
        """Return the thrusters of a chaser that were found stuck."""
        return tuple(sorted(number for i, number in self.failed if i == chaser))


@dataclass(frozen=True, eq=False)
class EstimatedShape:
    """Errors of the target's known geometry.

    ``parameters`` and their covariance (k, k), values (k,): in units of the parameters' standard
    deviations. ``views``: number of views; ``coverage``: share of directions that they cover.
    ``changed``: this tick brought a view.
    """

    parameters: tuple[GeometryParameter, ...]
    values: Array
    covariance: Array
    views: int
    coverage: float
    changed: bool


@dataclass(frozen=True)
class TargetEstimation:
    """Result of estimation.

    ``at_effect``: the target at ``Observation.effective_ns``, None while its pose is unknown.
    ``body``: the target and the latched chasers as one rigid body. ``stack``: their identified mass
    properties, if identified. ``shape``: errors of the known geometry, once estimated.
    ``innovations``: of the tick's sightings; None if the estimator states none.
    """

    target: TargetState
    at_effect: TargetState | None
    chasers: tuple[ChaserEstimate, ...]
    body: TargetBody
    events: tuple[LogEntry, ...] = ()
    stack: IdentifiedStack | None = None
    shape: EstimatedShape | None = None
    innovations: tuple[Innovation, ...] | None = None

    @property
    def known(self) -> bool:
        """Return whether the target's pose is known."""
        return self.at_effect is not None


# -- guidance --------------------------------------------------------------------------------------


class ReferencePose(Struct, frozen=True):
    """Reference of one chaser now: position (3,) and attitude (4,) in WRF, ``offset_m`` (3,) in
    TRF.
    """

    position_m: Array
    q_wxyz: Array
    offset_m: Array
    min_distance_target_m: float


class DirectCommand(Struct, frozen=True):
    """Wrench of a chaser that the NMPC does not fly: force and torque (6,), body axes.

    ``thrusts_N`` (n,): thrusts of its thrusters that give this wrench; None to leave the allocation
    to the chaser.
    """

    mode: ControlMode
    wrench: Array
    thrusts_N: Array | None = None


class Directive(Struct, frozen=True):
    """What guidance wants of one chaser.

    ``phase``: name of its phase. ``isolated``, ``trusted``: thrusters, by operator command.
    ``reference``: None while the target or the chaser's own state is unknown. ``inspects``: it
    flies around the target to view it. ``abort_margin``: margin of its best abort, in sigmas, while
    passive safety is enforced.
    """

    chaser: int
    phase: PhaseName
    phase_time_s: float
    latch: Latch
    free: bool
    isolated: tuple[int, ...]
    trusted: tuple[int, ...]
    reference: ReferencePose | None
    direct: DirectCommand | None
    inspects: bool = False
    abort_margin: float | None = None


@dataclass(frozen=True)
class HorizonReference:
    """References of N ``chasers`` over D stages: the part of an ``NmpcInput`` that guidance
    provides (shapes there).

    ``attached``: chasers whose latch holds the target. They are obstacles that follow its motion.
    ``docking``: rows of the chasers on their way to dock.
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
    docking: tuple[int, ...] = ()


class GuidanceResult(Struct, frozen=True):
    """Result of guidance. ``directives``: one for every chaser of the mission, in order.
    ``horizon``: None if no chaser is planned for.
    """

    directives: tuple[Directive, ...]
    horizon: HorizonReference | None
    replies: tuple[CommandReply, ...]
    events: tuple[LogEntry, ...]


# -- planning --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ChaserPlan:
    """Plan of one chaser from ``time_ns`` on: states (D+1, 13) and inputs (D, 6), as in
    ``NmpcPlan``.
    """

    time_ns: int
    states: Array
    inputs: Array

    def input_at(self, time_ns: int, step_s: float) -> Array | None:
        """Return the input (6,) at a time; None after the plan's end."""
        stage = int((time_ns - self.time_ns) / 1e9 / step_s + 1e-9)
        return self.inputs[stage] if 0 <= stage < len(self.inputs) else None


@dataclass(frozen=True)
class PlanningFailure:
    """Reason why a chaser has to retreat: planning has failed for too long. ``without_plan``: there
    is no usable plan; otherwise plans are degraded.
    """

    without_plan: bool
    text: str


class PlanningHistory(Protocol):
    """What guidance needs to know about the plans of earlier ticks."""

    def failure(self, chaser: int, time_ns: int) -> PlanningFailure | None:
        """Return why a chaser has to retreat at ``time_ns``, or None if planning has not failed."""
        ...

    def unsafe(self, chaser: int, time_ns: int) -> str:
        """Return why a chaser's plans are not passively safe at ``time_ns``; empty if they are."""
        ...


@dataclass(frozen=True)
class PlanCertificate:
    """Passive safety of a chaser's newest plan: the worst coast, and the time (s) from the start of
    the plan to its loss of thrust.
    """

    coast: CoastCertificate
    loss_s: float
    safe: bool


class SolveStatus(NamedTuple):
    """How the solver ended for one chaser, as in ``NmpcPlan``."""

    status: str
    iterations: int
    cost: float
    max_violation_m: float


class ChaserPlanning(Struct, frozen=True):
    """Result of planning for one chaser.

    ``solve``: result of this tick's solve, None without one. ``flyable``: plan that may be flown;
    after a failed solve for a while an earlier one. ``certificate``: passive safety of its newest
    plan, where monitored.
    """

    chaser: int
    solve: SolveStatus | None = None
    flyable: ChaserPlan | None = None
    certificate: PlanCertificate | None = None


class PlanResult(Struct, frozen=True):
    """Result of planning. ``chasers``: one for every chaser of the mission, in order. ``wall_s``:
    duration of the solve.
    """

    chasers: tuple[ChaserPlanning, ...]
    wall_s: float = 0.0
    events: tuple[LogEntry, ...] = ()
