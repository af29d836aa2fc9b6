"""Every message that travels between processes, or lies in a log.

On the wire a message is a msgpack map of the field names below; its type and version travel in the
Zenoh encoding (see ``codec``). A new field gets a default, so that old logs stay readable; a changed
meaning gets a new VERSION.

Common fields: ``seq`` numbers the messages of one publisher on one key from 0 (set when published);
``tick`` is the world's tick the message belongs to; ``sim_time_ns`` is simulated time: for whatever
derives from an image, the time of its *exposure*. Nothing in these messages depends on a wall clock,
except fields whose name begins with ``wall_``.

Units SI, radians; frames in the names: WRF world, CRF chaser body, TRF target body, IRF camera.
``q_wxyz`` is a Hamilton unit quaternion, body to world unless said otherwise; ``omega_rad_s`` is in body axes.
"""

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
    """The world opens a tick, or (``revision`` > 0) takes back whom it expects an answer from.

    ``controller``: whether one commands. ``commander`` is that process, ``instance`` its start, ``term`` numbers the
    times that the command was given; 0 before the first, and in logs from before there were terms. ``standing_by``:
    controllers that would take over, with their instances, the next in line first.
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
    """The world has flown its last tick, or gives up: everyone finishes what they have."""

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
    """A chaser's own state as it knows it: position and velocity WRF, attitude CRF to WRF, rate in CRF."""

    chaser: ChaserId
    position_m: Vector3
    velocity_m_s: Vector3
    q_wxyz: Quaternion
    omega_rad_s: Vector3


class DockingStatus(Message, frozen=True, kw_only=True):
    """What a chaser's own docking sensor says: ``contact`` of the probe's tip since the last tick, ``armed``: the
    latch closes at a touch within its tolerances, ``latched``: it has closed."""

    chaser: ChaserId
    contact: bool
    armed: bool
    latched: bool


class BodyTruth(Message, frozen=True, kw_only=True):
    """Ground truth of one body (``target`` or ``chaser/0``), for recorder, analysis and viewer alone.

    ``impulse_N_s`` and ``angular_impulse_N_m_s`` are what its actuators gave it since the last tick, in
    body axes; ``absolute_impulse_N_s`` is the time integral of the sum of the force components' magnitudes.
    With thrusters: ``thruster_impulse_N_s`` that every thruster gave, ``thruster_open_s`` that its valves were open, and the
    ``propellant_kg`` that took, since the last tick (the body's mass stays what it is).
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
    """Contacts between bodies, in this tick and the physics steps since the last, and saturated commands.

    A touch of a probe's tip on the target is no contact here but one of ``touches``; ``latched``: who holds on now.
    """

    contacts: Annotated[tuple[tuple[Text, Text], ...], Meta(max_length=1024)]
    saturated: ChaserIds
    late_commands: Count = 0
    touches: Annotated[tuple[ProbeTouch, ...], Meta(max_length=1024)] = ()
    latched: ChaserIds = ()


class Sighting(Message, frozen=True, kw_only=True):
    """What a chaser saw of the target in one image; no ``solutions`` means "I see nothing".

    The best solution comes first; a second one is there when a single small marker allows both.
    ``corners_px`` are eight numbers a used marker: u, v of its four corners, in the image as taken.
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
    """The fused odometry of the target at ``sim_time_ns``; position and velocity WRF, rate in TRF.

    ``covariance`` is row-major (12, 12) over (position, velocity, dtheta in TRF, rate in TRF). With status
    ``none`` nothing has been seen yet and the numbers mean nothing. ``cameras``: where the estimator finds out how far the
    cameras are from their calibration.
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
    """Where a chaser is to be at ``sim_time_ns``, and what it is doing there.

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
    """What a chaser's actuators are to give, in body axes, from ``effective_time_ns`` on.

    Valid until ``expires_ns``; ``tick`` is that of the odometry it answers. ``mode`` says where it comes from:
    the NMPC's plan, a safe command (``brake`` stops the chaser, ``coast`` gives nothing), the ``search`` for a target
    that nobody sees, the ``pull`` that verifies a latch, or ``none``: the controller has no command, as it does not know
    where the chaser is.
    ``isolated``: thrusters whose shut-off valve an operator wants closed; ``trusted``: thrusters that an operator vouches for,
    whatever the chaser has found. ``free``: nothing holds or touches the chaser, so that its motion shows its thrusters.
    ``term``, ``commander`` and ``instance``: as the ``Tick`` had them that gave the command to who sends this.
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
    """How the controller's solve of this tick went; one entry a chaser that took part."""

    solver: Text
    chasers: ChaserIds
    status: Annotated[tuple[Text, ...], Meta(max_length=256)]
    iterations: Annotated[tuple[Count, ...], Meta(max_length=256)]
    cost: Annotated[tuple[float, ...], Meta(max_length=256)]
    max_violation_m: Annotated[tuple[float, ...], Meta(max_length=256)]
    wall_solve_s: float = 0.0
    wall_tick_s: float = 0.0


class ActuatorCommand(Message, frozen=True, kw_only=True):
    """What a chaser tells its actuators, body axes, from ``effective_time_ns`` on.

    ``source`` is ``command`` when it passes on the controller's, of ``term``. When it has none that it can trust it flies
    its last ``plan`` to the end, then comes to rest (``brake``), then keeps clear of the target (``hold``).
    With thrusters, ``pulses`` are those of the carrier periods that begin while this command acts, and ``isolated``
    the thrusters whose shut-off valves are closed from ``effective_time_ns`` on; force and torque say what was asked for.
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
    """What a chaser's thrusters can do, as it knows them, at the time of the odometry of the same tick.

    ``force_max_N`` and ``torque_max_N_m`` are within reach on all body axes at once. ``coming_*`` is the impulse (body
    axes) that it will get from pulses under way, less what of them counts as the next command's; ``given_*`` is what
    its thrusters should have given since the report before.
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
    """Something worth telling, once."""

    process: Text
    level: Level
    what: Text
    detail: Text = ""


class Health(Message, frozen=True, kw_only=True):
    """A process counts: messages it rejected (by reason), lost (gaps in ``seq``), discarded as stale."""

    process: Text
    rejected: Counts
    lost: Count
    stale: Count
    wall_busy_s: float = 0.0


class RecorderAck(Message, frozen=True, kw_only=True):
    """The recorder holds everything up to ``tick`` from all who were expected."""


class OperatorCommand(Message, frozen=True, kw_only=True):
    """An operator's wish, sent as a query; ``offset_m`` (TRF) goes with ``goto`` alone.

    ``operator`` says who asks, for the log; after ``expires_ns`` the wish is stale and refused.

    The controller publishes it again, with the tick it was obeyed or refused at: the log must hold all inputs.

    ``calibrate`` turns the chaser about while it watches the target, which shows how its camera is mounted.
    ``isolate`` closes a thruster's shut-off valve, ``restore`` opens it and vouches for the thruster; ``thruster`` goes with these.
    """

    command: Literal["approach", "hold", "retreat", "abort", "goto", "calibrate", "isolate", "restore"]
    chaser: ChaserId
    offset_m: Vector3 | None = None
    thruster: ThrusterId | None = None
    operator: Text = ""
    expires_ns: Count | None = None


class CommandReply(Message, frozen=True, kw_only=True):
    """The controller's answer to an operator command, also published for the log."""

    command: Text
    chaser: ChaserId
    accepted: bool
    reason: Text
    operator: Text = ""


class ControllerState(Message, frozen=True, kw_only=True):
    """The commander's word to who stands by: this tick is worked out, with what operators asked in it (``operated``).

    ``state``, now and then: all that it knows after the tick, for one that came late (``controller/state.py``); else empty.
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
"""Version of every message type that may stand alone on the wire."""


def encoding_of(kind: type[Struct]) -> str:
    """Zenoh encoding of a message type, such as ``application/msgpack;chaserdock.Odometry.v1``."""
    return _encoding(kind, VERSION[kind])


@cache
def _encoding(kind: type[Struct], number: int) -> str:
    return f"application/msgpack;chaserdock.{kind.__name__}.v{number}"


def schema_of(kind: type[Struct]) -> bytes:
    """JSON Schema of a message type, as the log carries it."""
    return msgspec.json.encode(msgspec.json.schema(kind))
