"""Every message that travels between processes, or lies in a log.

On the wire a message is a msgpack map of the field names below; its type and version travel in the
Zenoh encoding (see ``codec``). A new field gets a default, so that old logs stay readable; a changed
meaning gets a new VERSION.

Common fields: ``seq`` numbers the messages of one publisher on one key from 0 (set when published);
``tick`` is the world's tick the message belongs to; ``sim_time_ns`` is simulated time: for whatever
derives from a picture, the time of its *exposure*. Nothing in these messages depends on a wall clock,
except fields whose name begins with ``wall_``.

Units SI, radians; frames in the names: WRF world, CRF chaser body, TRF target body, IRF camera.
``q_wxyz`` is a Hamilton unit quaternion, body to world unless said otherwise; ``omega_rad_s`` is in body axes.
"""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta, Struct

from .message_fields import (
    ChaserId,
    Count,
    JetId,
    JetPulse,
    Jets,
    Latch,
    Level,
    Phase,
    PoseSolution,
    ProbeTouch,
    Quaternion,
    Square12,
    Text,
    Vector3,
)


class Message(Struct, frozen=True, kw_only=True):
    """Fields that every message has."""

    seq: Count = 0
    tick: Annotated[int, Meta(ge=-1)] = -1
    sim_time_ns: Count = 0


class Tick(Message, frozen=True, kw_only=True):
    """The world opens a tick, or (``revision`` > 0) takes back whom it expects an answer from."""

    revision: Count = 0
    pictures: bool
    chasers: tuple[ChaserId, ...]
    controller: bool


class MissionEnd(Message, frozen=True, kw_only=True):
    """The world has flown its last tick, or gives up: everyone finishes what they have."""

    reason: Text
    complete: bool


class Image(Message, frozen=True, kw_only=True):
    """A picture of chaser ``chaser``'s camera; ``sim_time_ns`` is the middle of the exposure."""

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
    """Ground truth of one body (``target`` or ``chaser/0``), for recorder and analysis alone.

    ``impulse_N_s`` and ``angular_impulse_N_m_s`` are what its actuators gave it since the last tick, in
    body axes; ``absolute_impulse_N_s`` is the time integral of the sum of the force components' magnitudes.
    With thrusters: ``jet_impulse_N_s`` that every jet gave, ``jet_open_s`` that its valves were open, and the
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
    jet_impulse_N_s: Annotated[tuple[float, ...], Meta(max_length=255)] = ()
    jet_open_s: Annotated[tuple[float, ...], Meta(max_length=255)] = ()
    propellant_kg: float = 0.0


class WorldTruth(Message, frozen=True, kw_only=True):
    """Contacts between bodies, in this tick and the physics steps since the last, and saturated commands.

    A touch of a probe's tip on the target is no contact here but one of ``touches``; ``latched``: who holds on now.
    """

    contacts: tuple[tuple[Text, Text], ...]
    saturated: tuple[ChaserId, ...]
    late_commands: Count = 0
    touches: tuple[ProbeTouch, ...] = ()
    latched: tuple[ChaserId, ...] = ()


class Sighting(Message, frozen=True, kw_only=True):
    """What a chaser saw of the target in one picture; no ``solutions`` means "I see nothing".

    The best solution comes first; a second one is there when a single small marker allows both.
    ``corners_px`` are eight numbers a used marker: u, v of its four corners, in the picture as taken.
    """

    chaser: ChaserId
    status: Literal["seen", "nothing", "bad_picture"]
    solutions: Annotated[tuple[PoseSolution, ...], Meta(max_length=4)]
    marker_ids: Annotated[tuple[int, ...], Meta(max_length=1024)]
    corners_px: Annotated[tuple[float, ...], Meta(max_length=8192)]
    rejected_ids: Annotated[tuple[int, ...], Meta(max_length=1024)]
    detail: Text = ""
    wall_estimate_s: float = 0.0


class TargetEstimate(Message, frozen=True, kw_only=True):
    """The fused odometry of the target at ``sim_time_ns``; position and velocity WRF, rate in TRF.

    ``covariance`` is row-major (12, 12) over (position, velocity, dtheta in TRF, rate in TRF). With status
    ``none`` nothing has been seen yet and the numbers mean nothing.
    """

    status: Literal["none", "tracking", "predicting", "lost"]
    position_m: Vector3
    velocity_m_s: Vector3
    q_wxyz: Quaternion
    omega_rad_s: Vector3
    covariance: Square12
    accepted: tuple[ChaserId, ...]
    rejected: tuple[ChaserId, ...]


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
    the NMPC's plan, a safe command (``brake`` stops the chaser, ``coast`` gives nothing), or the ``pull`` that
    verifies a latch.
    ``isolated``: jets whose shut-off valve an operator wants closed; ``trusted``: jets that an operator vouches for,
    whatever the chaser has found. ``free``: nothing holds or touches the chaser, so that its motion shows its jets.
    """

    chaser: ChaserId
    effective_time_ns: Count
    expires_ns: Count
    mode: Literal["nmpc", "brake", "coast", "pull"]
    force_N: Vector3
    torque_N_m: Vector3
    isolated: Jets = ()
    trusted: Jets = ()
    free: bool = True
    latch: Latch = "keep"


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
    chasers: tuple[ChaserId, ...]
    status: tuple[Text, ...]
    iterations: tuple[Count, ...]
    cost: tuple[float, ...]
    max_violation_m: tuple[float, ...]
    wall_solve_s: float = 0.0
    wall_tick_s: float = 0.0


class ActuatorCommand(Message, frozen=True, kw_only=True):
    """What a chaser tells its actuators, body axes, from ``effective_time_ns`` on.

    ``source`` is ``command`` when it passes on the controller's, ``brake`` when it had none that it could trust.
    With thrusters, ``pulses`` are those of the carrier periods that begin while this command acts, and ``isolated``
    the jets whose shut-off valves are closed from ``effective_time_ns`` on; force and torque say what was asked for.
    """

    chaser: ChaserId
    effective_time_ns: Count
    source: Literal["command", "brake"]
    force_N: Vector3
    torque_N_m: Vector3
    latch: Latch = "keep"
    pulses: Annotated[tuple[JetPulse, ...], Meta(max_length=10_000)] = ()
    isolated: Jets = ()


JetState = Literal["healthy", "stuck_off", "stuck_on", "weak"]


class JetReport(Message, frozen=True, kw_only=True):
    """What a chaser's jets can do, as it knows them, at the time of the odometry of the same tick.

    ``force_max_N`` and ``torque_max_N_m`` are within reach on all body axes at once. ``coming_*`` is the impulse (body
    axes) that it will get from pulses under way, less what of them counts as the next command's; ``given_*`` is what
    its jets should have given since the report before.
    """

    chaser: ChaserId
    force_max_N: Vector3
    torque_max_N_m: Vector3
    coming_impulse_N_s: Vector3
    coming_angular_impulse_N_m_s: Vector3
    jets: Annotated[tuple[JetState, ...], Meta(max_length=255)]
    isolated: Jets = ()
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
    rejected: dict[str, int]
    lost: Count
    stale: Count
    wall_busy_s: float = 0.0


class RecorderAck(Message, frozen=True, kw_only=True):
    """The recorder holds everything up to ``tick`` from all who were expected."""


class OperatorCommand(Message, frozen=True, kw_only=True):
    """An operator's wish, sent as a query; ``offset_m`` (TRF) goes with ``goto`` alone.

    ``operator`` says who asks, for the log; after ``expires_ns`` the wish is stale and refused.

    The controller publishes it again, with the tick it was obeyed or refused at: the log must hold all inputs.

    ``isolate`` closes a jet's shut-off valve, ``restore`` opens it and vouches for the jet; ``jet`` goes with these.
    """

    command: Literal["approach", "hold", "retreat", "abort", "goto", "isolate", "restore"]
    chaser: ChaserId
    offset_m: Vector3 | None = None
    jet: JetId | None = None
    operator: Text = ""
    expires_ns: Count | None = None


class CommandReply(Message, frozen=True, kw_only=True):
    """The controller's answer to an operator command, also published for the log."""

    command: Text
    chaser: ChaserId
    accepted: bool
    reason: Text
    operator: Text = ""


class Presence(Message, frozen=True, kw_only=True):
    """Who a process is, and whose presence has reached it: process name to instance (see ``presence``)."""

    process: Text
    instance: Text
    heard: dict[str, str]


class Farewell(Message, frozen=True, kw_only=True):
    """The last message of a process: how many messages it has published on each key."""

    process: Text
    published: dict[str, int]


class JoinRequest(Struct, frozen=True, kw_only=True):
    """A process asks the world to take part, before it opens any topic."""

    process: Text
    instance: Text


class JoinReply(Struct, frozen=True, kw_only=True):
    """The world's answer: the resolved scenario as JSON, or why not."""

    accepted: bool
    reason: Text
    run_id: Text = ""
    mode: Literal["lockstep", "realtime"] = "lockstep"
    scenario_json: Annotated[str, Meta(max_length=2_000_000)] = ""


VERSION: dict[type[Struct], int] = {
    Tick: 1,
    MissionEnd: 1,
    Image: 1,
    Odometry: 1,
    DockingStatus: 1,
    BodyTruth: 1,
    WorldTruth: 1,
    Sighting: 1,
    TargetEstimate: 1,
    Reference: 1,
    WrenchCommand: 1,
    Plan: 1,
    SolverStatus: 1,
    ActuatorCommand: 1,
    JetReport: 1,
    Event: 1,
    Health: 1,
    RecorderAck: 1,
    OperatorCommand: 1,
    CommandReply: 1,
    Presence: 1,
    Farewell: 1,
    JoinRequest: 1,
    JoinReply: 1,
}
"""Version of every message type that may stand alone on the wire."""


def encoding_of(kind: type[Struct]) -> str:
    """Zenoh encoding of a message type, such as ``application/msgpack;chaserdock.Odometry.v1``."""
    return f"application/msgpack;chaserdock.{kind.__name__}.v{VERSION[kind]}"


def schema_of(kind: type[Struct]) -> bytes:
    """JSON Schema of a message type, as the log carries it."""
    return msgspec.json.encode(msgspec.json.schema(kind))
