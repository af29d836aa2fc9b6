# SPDX-License-Identifier: Apache-2.0
"""Messages of a flight: world, chaser and controller."""

from __future__ import annotations

from functools import cache
from typing import Annotated, Literal

import msgspec
from msgspec import Meta, Struct

from .base import Message
from .fields import (
    CameraCalibration,
    ChaserId,
    ChaserIds,
    Count,
    Counts,
    Latch,
    Level,
    MarkerIds,
    Names,
    OperatorCommandName,
    Phase,
    PoseSolution,
    ProbeTouch,
    Quaternion,
    Square12,
    Text,
    ThrusterId,
    ThrusterPulse,
    Thrusters,
    ThrusterState,
    Vector3,
)
from .session import Farewell, JoinReply, JoinRequest, Presence
from .thruster_fault import ThrusterFaultCommand


class Tick(Message, frozen=True, kw_only=True):
    """Start of a tick, or (``revision`` > 0) a correction of the processes that the world expects replies from.

    ``controller``: whether a controller is in command: ``commander``, with its ``instance``. ``term`` counts changes of
    command, 0 before the first and in logs without terms. ``standing_by``: standby controllers with their instances, in
    the order of succession.
    """

    revision: Count = 0
    images: bool
    chasers: ChaserIds
    controller: bool
    term: Count = 0
    commander: Text = ""
    instance: Text = ""
    standing_by: Names = msgspec.field(default_factory=dict)


class MissionEnd(Message, frozen=True, kw_only=True):
    """The world has finished its last tick or ends early. All processes finish their work."""

    reason: Text
    complete: bool


class Image(Message, frozen=True, kw_only=True):
    """An image of chaser ``chaser``'s camera; ``sim_time_ns`` is the middle of the exposure."""

    chaser: ChaserId
    width_px: Annotated[int, Meta(ge=1, le=8192)]
    height_px: Annotated[int, Meta(ge=1, le=8192)]
    encoding: Literal["jpeg", "mono8"]
    data: Annotated[bytes, Meta(max_length=16_000_000)]


class Odometry(Message, frozen=True, kw_only=True):
    """A chaser's own navigation solution: position and velocity in WRF, attitude CRF to WRF, rate in CRF."""

    chaser: ChaserId
    position_m: Vector3
    velocity_m_s: Vector3
    q_wxyz: Quaternion
    omega_rad_s: Vector3


class DockingStatus(Message, frozen=True, kw_only=True):
    """Measurement of a chaser's docking sensor. ``contact``: contact of the probe's tip since the last tick. ``armed``:
    the latch will close at a touch within its tolerances. ``latched``: it has closed."""

    chaser: ChaserId
    contact: bool
    armed: bool
    latched: bool


class BodyTruth(Message, frozen=True, kw_only=True):
    """Ground truth of one body (``target`` or ``chaser/0``), for recorder, analysis and viewer alone.

    ``impulse_N_s`` and ``angular_impulse_N_m_s``: impulses of its actuators since the last tick, in body axes.
    ``absolute_impulse_N_s``: time integral of the sum of the force components' magnitudes. With thrusters, since the
    last tick: ``thruster_impulse_N_s`` and valve opening time ``thruster_open_s`` of each, and ``propellant_kg`` used
    (the body's mass is constant).
    """

    body: Text
    position_m: Vector3
    velocity_m_s: Vector3
    q_wxyz: Quaternion
    omega_rad_s: Vector3
    impulse_N_s: Vector3 = (0.0, 0.0, 0.0)
    angular_impulse_N_m_s: Vector3 = (0.0, 0.0, 0.0)
    absolute_impulse_N_s: float = 0.0
    thruster_impulse_N_s: Annotated[tuple[float, ...], Meta(max_length=255)] = ()
    thruster_open_s: Annotated[tuple[float, ...], Meta(max_length=255)] = ()
    propellant_kg: float = 0.0


class WorldTruth(Message, frozen=True, kw_only=True):
    """Contacts between bodies in the physics steps since the last tick, and saturated commands.

    ``touches``: contacts of probe tips with the target, not included in ``contacts``. ``latched``: chasers latched now.
    """

    contacts: Annotated[tuple[tuple[Text, Text], ...], Meta(max_length=1024)]
    saturated: ChaserIds
    late_commands: Count = 0
    touches: Annotated[tuple[ProbeTouch, ...], Meta(max_length=1024)] = ()
    latched: ChaserIds = ()


class Sighting(Message, frozen=True, kw_only=True):
    """Target poses that a chaser measured in one image; empty ``solutions`` if it detected nothing.

    The best solution comes first; a second one follows if a single small marker is ambiguous.
    ``corners_px``: u, v of the four corners of each used marker, in the distorted image.
    """

    chaser: ChaserId
    status: Literal["seen", "nothing", "bad_image"]
    solutions: Annotated[tuple[PoseSolution, ...], Meta(max_length=4)]
    marker_ids: MarkerIds
    corners_px: Annotated[tuple[float, ...], Meta(max_length=8192)]
    rejected_ids: MarkerIds
    detail: Text = ""
    wall_estimate_s: float = 0.0


class TargetEstimate(Message, frozen=True, kw_only=True):
    """Fused odometry of the target at ``sim_time_ns``: position and velocity in WRF, rate in TRF.

    ``covariance`` is row-major (12, 12) over (position, velocity, dtheta in TRF, rate in TRF). With status ``none``,
    before the first sighting, the values are meaningless. ``cameras``: estimated calibration errors, if estimated.
    """

    status: Literal["none", "tracking", "predicting", "lost"]
    position_m: Vector3
    velocity_m_s: Vector3
    q_wxyz: Quaternion
    omega_rad_s: Vector3
    covariance: Square12
    accepted: ChaserIds
    rejected: ChaserIds
    cameras: Annotated[tuple[CameraCalibration, ...], Meta(max_length=256)] = ()


class Reference(Message, frozen=True, kw_only=True):
    """Reference pose of a chaser at ``sim_time_ns``, and its phase.

    ``offset_m`` is the reference position in TRF; ``time_s`` counts from the start of the phase.
    """

    chaser: ChaserId
    phase: Phase
    phase_time_s: float
    position_m: Vector3
    q_wxyz: Quaternion
    offset_m: Vector3
    min_distance_target_m: float


class WrenchCommand(Message, frozen=True, kw_only=True):
    """Commanded force and torque of a chaser, in body axes, from ``effective_time_ns`` to ``expires_ns``.

    ``tick`` is that of the odometry that it is based on. ``mode`` is its origin: the NMPC's plan, a safe command
    (``brake`` to rest, ``coast`` without force), the ``search`` for a target that no chaser sees, the ``pull`` that
    verifies a latch, or ``none``: no command, as the chaser's state is unknown.
    ``isolated``: thrusters whose shut-off valve an operator closed. ``trusted``: thrusters that an operator declared
    healthy, which overrides the chaser's fault detection. ``free``: no contact or latch, so that the motion identifies
    thruster faults. ``term``, ``commander`` and ``instance`` are those of the ``Tick`` that put the sender in command.
    """

    chaser: ChaserId
    effective_time_ns: Count
    expires_ns: Count
    mode: Literal["nmpc", "brake", "coast", "pull", "search", "none"]
    force_N: Vector3
    torque_N_m: Vector3
    isolated: Thrusters = ()
    trusted: Thrusters = ()
    free: bool = True
    latch: Latch = "keep"
    term: Count = 0
    commander: Text = ""
    instance: Text = ""


class Plan(Message, frozen=True, kw_only=True):
    """The NMPC's plan for one chaser: ``stages`` + 1 states, ``stages`` inputs, ``step_s`` apart from ``sim_time_ns``.

    ``positions_m`` (3 numbers a state), ``q_wxyz`` (4 a state) and ``inputs`` (force, torque: 6 a stage), flattened.
    """

    chaser: ChaserId
    step_s: float
    positions_m: Annotated[tuple[float, ...], Meta(max_length=3 * 2001)]
    quaternions_wxyz: Annotated[tuple[float, ...], Meta(max_length=4 * 2001)]
    inputs: Annotated[tuple[float, ...], Meta(max_length=6 * 2000)]


class SolverStatus(Message, frozen=True, kw_only=True):
    """Result of the controller's solve in this tick, one entry per planned chaser."""

    solver: Text
    chasers: ChaserIds
    status: Annotated[tuple[Text, ...], Meta(max_length=256)]
    iterations: Annotated[tuple[Count, ...], Meta(max_length=256)]
    cost: Annotated[tuple[float, ...], Meta(max_length=256)]
    max_violation_m: Annotated[tuple[float, ...], Meta(max_length=256)]
    wall_solve_s: float = 0.0
    wall_tick_s: float = 0.0


class ActuatorCommand(Message, frozen=True, kw_only=True):
    """A chaser's command to its actuators, body axes, from ``effective_time_ns`` on.

    ``source``: ``command`` for the controller's command of ``term``. Without a valid command the chaser flies its last
    ``plan`` to its end, comes to rest (``brake``) and then keeps clear of the target (``hold``).
    With thrusters, ``pulses`` are those of the carrier periods that begin while this command acts, ``isolated`` the
    thrusters whose shut-off valves are closed from ``effective_time_ns`` on, and force and torque the demand.
    """

    chaser: ChaserId
    effective_time_ns: Count
    source: Literal["command", "plan", "brake", "hold"]
    force_N: Vector3
    torque_N_m: Vector3
    latch: Latch = "keep"
    pulses: Annotated[tuple[ThrusterPulse, ...], Meta(max_length=10_000)] = ()
    isolated: Thrusters = ()
    term: Count = 0


class ThrusterReport(Message, frozen=True, kw_only=True):
    """Capability of a chaser's thrusters, by its own estimate, at the time of the odometry of the same tick.

    ``force_max_N`` and ``torque_max_N_m`` can be reached on all body axes at once. ``coming_*``: remaining impulse (body
    axes) of commanded pulses, without the part that belongs to the next command. ``given_*``: expected impulse of the
    thrusters since the previous report.
    """

    chaser: ChaserId
    force_max_N: Vector3
    torque_max_N_m: Vector3
    coming_impulse_N_s: Vector3
    coming_angular_impulse_N_m_s: Vector3
    thrusters: Annotated[tuple[ThrusterState, ...], Meta(max_length=255)]
    isolated: Thrusters = ()
    given_impulse_N_s: Vector3 = (0.0, 0.0, 0.0)
    given_angular_impulse_N_m_s: Vector3 = (0.0, 0.0, 0.0)


class Event(Message, frozen=True, kw_only=True):
    """A single occurrence for log and operators."""

    process: Text
    level: Level
    what: Text
    detail: Text = ""


class Health(Message, frozen=True, kw_only=True):
    """Message counters of a process: rejected (by reason), lost (gaps in ``seq``), discarded as stale."""

    process: Text
    rejected: Counts
    lost: Count
    stale: Count
    wall_busy_s: float = 0.0


class RecorderAck(Message, frozen=True, kw_only=True):
    """The recorder has all expected messages up to ``tick``."""


class OperatorCommand(Message, frozen=True, kw_only=True):
    """An operator's command, sent as a query. ``offset_m`` (TRF): with ``goto`` only.

    ``operator``: name for the log. A command is rejected after ``expires_ns``. The controller publishes it with the tick
    at which it was accepted or rejected, so that the log holds all inputs.

    ``calibrate`` rotates the chaser while it observes the target, which makes its camera mounting observable.
    ``isolate`` closes the shut-off valve of ``thruster``; ``restore`` opens it and declares the thruster healthy.
    """

    command: OperatorCommandName
    chaser: ChaserId
    offset_m: Vector3 | None = None
    thruster: ThrusterId | None = None
    operator: Text = ""
    expires_ns: Count | None = None


class CommandReply(Message, frozen=True, kw_only=True):
    """Reply of the controller to an operator command, also published for the log."""

    command: Text
    chaser: ChaserId
    accepted: bool
    reason: Text
    operator: Text = ""


class ControllerState(Message, frozen=True, kw_only=True):
    """The commanding controller's report to standbys: the tick is complete; ``operated``: its operator commands.

    ``state``, at intervals: serialized controller state after the tick, for standbys that joined late; else empty.
    """

    process: Text
    term: Count
    operated: Annotated[tuple[OperatorCommand, ...], Meta(max_length=1024)] = ()
    state: Annotated[bytes, Meta(max_length=4_000_000)] = b""


VERSION: dict[type[Struct], int] = {
    Tick: 2,
    MissionEnd: 1,
    Image: 1,
    Odometry: 1,
    DockingStatus: 1,
    BodyTruth: 2,
    WorldTruth: 1,
    Sighting: 2,
    TargetEstimate: 1,
    Reference: 1,
    WrenchCommand: 1,
    Plan: 1,
    SolverStatus: 1,
    ActuatorCommand: 2,
    ThrusterReport: 2,
    Event: 1,
    Health: 1,
    RecorderAck: 1,
    OperatorCommand: 2,
    ThrusterFaultCommand: 2,
    CommandReply: 1,
    ControllerState: 2,
    Presence: 1,
    Farewell: 1,
    JoinRequest: 1,
    JoinReply: 1,
}
"""Version of every top-level message type."""


def encoding_of(kind: type[Struct]) -> str:
    """Return the Zenoh encoding of a message type, such as ``application/msgpack;chaserdock.Odometry.v1``."""
    return _encoding(kind, VERSION[kind])


@cache
def _encoding(kind: type[Struct], number: int) -> str:
    return f"application/msgpack;chaserdock.{kind.__name__}.v{number}"


def schema_of(kind: type[Struct]) -> bytes:
    """Return the JSON Schema of a message type, as stored in logs."""
    return msgspec.json.encode(msgspec.json.schema(kind))
