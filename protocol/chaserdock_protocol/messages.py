# SPDX-License-Identifier: Apache-2.0
"""Messages that processes exchange and logs store.

On the wire a message is a msgpack map of its field names; the Zenoh encoding carries its type and
version (see ``codec``). A new field gets a default, so that old logs stay readable. A renamed field
or a changed meaning gets a new ``VERSION`` and a migration in ``recording/schema_migrations.py``.

Common fields: ``seq`` numbers the messages of one publisher on one key from 0 (set when published);
``tick`` is the world's tick of the message; ``sim_time_ns`` is simulated time, and for everything
derived from an image the time of its *exposure*. No field depends on a wall clock, except those
whose name begins with ``wall_``.
"""

from __future__ import annotations

from functools import cache
from typing import Annotated, Literal, Protocol

import msgspec
from chaserdock_models.arrays import Quaternion as Quaternion
from chaserdock_models.arrays import Vector3 as Vector3
from msgspec import Meta, Struct

MAX_COUNT = 2**53
"""Bound of every integer: 104 days in ns, exact as a double, and sums of a few remain encodable."""
Count = Annotated[int, Meta(ge=0, le=MAX_COUNT)]
ChaserId = Annotated[int, Meta(ge=0, le=255)]
ChaserIds = Annotated[tuple[ChaserId, ...], Meta(max_length=256)]
MarkerIds = Annotated[tuple[Annotated[int, Meta(ge=0, le=2**31)], ...], Meta(max_length=1024)]
ThrusterId = Annotated[int, Meta(ge=0, le=254)]
Thrusters = Annotated[tuple[ThrusterId, ...], Meta(max_length=255)]
Text = Annotated[str, Meta(max_length=2000)]
ScenarioText = Annotated[str, Meta(max_length=2_000_000)]
ThrusterState = Literal["healthy", "stuck_off", "stuck_on", "weak"]
Counts = Annotated[dict[Text, Count], Meta(max_length=1024)]
Names = Annotated[dict[Text, Text], Meta(max_length=1024)]
OperatorCommandName = Literal[
    "approach",
    "hold",
    "retreat",
    "abort",
    "goto",
    "calibrate",
    "inspect",
    "identify",
    "detumble",
    "isolate",
    "restore",
]
Level = Literal["info", "warning", "error"]
Square3 = Annotated[tuple[float, ...], Meta(min_length=9, max_length=9)]
Square6 = Annotated[tuple[float, ...], Meta(min_length=36, max_length=36)]
Square12 = Annotated[tuple[float, ...], Meta(min_length=144, max_length=144)]


PhaseName = Literal[
    "acquire",
    "searching",
    "survey",
    "hold",
    "calibrate",
    "inspect",
    "approach",
    "docked",
    "retreat",
    "goto",
    "abort",
    "wait",
    "align",
    "final",
    "contact",
    "latched",
    "verified",
    "identify",
    "detumble",
    "stack_hold",
]
"""Phase of a chaser. Those from ``wait`` on occur only if docking ends by capture."""
Latch = Literal["keep", "arm", "release"]
"""Command to a probe's latch: ``keep`` changes nothing, ``arm`` lets it close at a valid touch and
stay closed, ``release`` opens it until it is armed again.
"""


class RangeMeasurement(Struct, frozen=True, kw_only=True):
    """Measurement of a range sensor, and the attitude that the target sends.

    ``range_m``: distance of TRF's origin from the camera's optical centre, with its standard
    deviation. ``q_wxyz`` takes TRF to IRF; ``attitude_covariance_rad2`` is row-major (3, 3) over
    dtheta in TRF axes with q_true = q (x) exp(dtheta).
    """

    range_m: float
    range_sigma_m: float
    q_wxyz: Quaternion
    attitude_covariance_rad2: Square3


class PoseSolution(Struct, frozen=True, kw_only=True):
    """One pose of the target in the camera frame.

    ``position_m`` is TRF's origin in IRF, ``q_wxyz`` takes TRF to IRF. ``covariance`` is row-major
    (6, 6) over (position in IRF axes, dtheta in TRF axes) with q_true = q (x) exp(dtheta).
    """

    position_m: Vector3
    q_wxyz: Quaternion
    covariance: Square6
    reprojection_rms_px: float


Parameters = Annotated[tuple[float, ...], Meta(max_length=64)]
SquareOfParameters = Annotated[tuple[float, ...], Meta(max_length=64 * 64)]


class ExpectedPose(Struct, frozen=True, kw_only=True):
    """Pose of the target that is expected in a chaser's camera at ``sim_time_ns``.

    Frames as in ``PoseSolution``.
    """

    sim_time_ns: Count
    position_m: Vector3
    q_wxyz: Quaternion


class GeometryMeasurement(Struct, frozen=True, kw_only=True):
    """Measurement, in one image, of the k errors of the target's known geometry.

    Errors are in units of their prior standard deviations, in the order of
    ``GeometryEstimate.names``. ``information``: row-major (k, k), for an unknown pose of the
    target. ``vector`` (k,): information times estimate. Both are empty for an image for which no
    view was rendered. ``position_m``: position of the target in IRF that the image shows if all
    errors are 0. ``position_by_errors``: its derivative by the errors, row-major (3, k).
    ``position_covariance_m2``: row-major (3, 3), its covariance if the errors are known.
    """

    information: SquareOfParameters = ()
    vector: Parameters = ()
    position_m: Vector3 = (0.0, 0.0, 0.0)
    position_by_errors: Annotated[tuple[float, ...], Meta(max_length=3 * 64)] = ()
    position_covariance_m2: Annotated[tuple[float, ...], Meta(max_length=9)] = ()


class GeometryEstimate(Struct, frozen=True, kw_only=True):
    """Estimated errors of the target's known geometry.

    ``names``: of the k errors: a joint and the body axis about which it is turned (rad), ``scale``
    (relative) or ``rim`` (m). ``sigmas``: prior standard deviations. ``values`` and row-major
    ``covariance`` (k, k): the estimate, in the same units. ``views``: number of images it is based
    on. ``coverage``: share of all viewing directions that these cover.
    """

    names: Annotated[tuple[Text, ...], Meta(max_length=64)]
    sigmas: Parameters
    values: Parameters
    covariance: SquareOfParameters
    views: Count
    coverage: float


class CameraCalibration(Struct, frozen=True, kw_only=True):
    """Calibration error of chaser ``chaser``'s camera, as estimated in flight, with standard
    deviations.

    ``turn_rad``: rotation vector in CRF from the nominal mounting. ``shift_m``: lens position error
    in CRF. ``focal_share``: relative error of the focal length.
    """

    chaser: ChaserId
    turn_rad: Vector3
    turn_sigma_rad: Vector3
    shift_m: Vector3
    shift_sigma_m: Vector3
    focal_share: float
    focal_sigma_share: float


class RelativeEstimate(Struct, frozen=True, kw_only=True):
    """Estimated pose of chaser ``chaser`` relative to the target, and the disturbance on the
    chaser.

    ``position_m`` is CRF's origin in TRF, ``q_wxyz`` takes CRF to TRF. ``covariance`` is row-major
    (6, 6) over (position in TRF axes, dtheta in CRF axes) with q_true = q (x) exp(dtheta).
    ``force_N`` and ``torque_N_m``: disturbance, body axes.
    """

    chaser: ChaserId
    position_m: Vector3
    q_wxyz: Quaternion
    covariance: Square6
    force_N: Vector3
    torque_N_m: Vector3


class ProbeTouch(Struct, frozen=True, kw_only=True):
    """First contact of a probe's tip with the target at ``sim_time_ns``.

    Positions and velocities are relative to the probe's port. ``latched``: whether the latch
    closed. ``refused``: the reason if it did not.
    """

    chaser: ChaserId
    sim_time_ns: Count
    lateral_m: float
    angle_rad: float
    closing_m_s: float
    lateral_speed_m_s: float
    latched: bool
    refused: Text = ""


class ThrusterPulse(Struct, frozen=True, kw_only=True):
    """Commanded opening interval of a thruster's valve."""

    thruster: ThrusterId
    open_ns: Count
    close_ns: Count


class Message(Struct, frozen=True, kw_only=True):
    """Fields that every message has."""

    seq: Count = 0
    tick: Annotated[int, Meta(ge=-1, le=MAX_COUNT)] = -1
    sim_time_ns: Count = 0


class Tick(Message, frozen=True, kw_only=True):
    """Start of a tick, or (``revision`` > 0) a correction of the processes that take part in it.

    ``chasers``: those whose reply the world expects. ``controllers``: connected controllers with
    their instances, in the order of succession. ``since``: by process, the tick since which it
    takes part without a break; a lease that was stated before is void. ``chaser_instances``:
    instances of ``chasers``, by process. ``mapper``: instance of a connected mapper. A process that
    is listed with another instance was lost and replaced; it ends.
    """

    revision: Count = 0
    images: bool
    chasers: ChaserIds
    controllers: Names = msgspec.field(default_factory=dict)
    since: Counts = msgspec.field(default_factory=dict)
    chaser_instances: Names = msgspec.field(default_factory=dict)
    mapper: Text = ""


class MissionEnd(Message, frozen=True, kw_only=True):
    """The world has finished its last tick or ends early. All processes finish their work."""

    reason: Text
    complete: bool


class Image(Message, frozen=True, kw_only=True):
    """An image of chaser ``chaser``'s camera; ``sim_time_ns`` is the middle of the exposure.

    ``ranging``: the target's range and sent attitude at that time, where the scenario has
    ``[ranging]`` and the target is in reach and in the image.
    """

    chaser: ChaserId
    width_px: Annotated[int, Meta(ge=1, le=8192)]
    height_px: Annotated[int, Meta(ge=1, le=8192)]
    encoding: Literal["jpeg", "mono8"]
    data: Annotated[bytes, Meta(max_length=16_000_000)]
    ranging: RangeMeasurement | None = None


_EXACT = (0.0,) * 9  # covariance (3, 3) of what has no error


class Odometry(Message, frozen=True, kw_only=True):
    """A chaser's own navigation solution: position and velocity in WRF, attitude CRF to WRF, rate
    in CRF.

    Covariances are row-major (3, 3), of position and velocity in WRF, of attitude (q_true = q (x)
    exp(dtheta)) and rate in CRF. They describe the white noise, which is new in every tick; zero is
    exact. The scenario's ``[navigation]`` states errors that are correlated in time.
    """

    chaser: ChaserId
    position_m: Vector3
    velocity_m_s: Vector3
    q_wxyz: Quaternion
    omega_rad_s: Vector3
    position_covariance_m2: Square3 = _EXACT
    velocity_covariance_m2_s2: Square3 = _EXACT
    attitude_covariance_rad2: Square3 = _EXACT
    omega_covariance_rad2_s2: Square3 = _EXACT


class DockingStatus(Message, frozen=True, kw_only=True):
    """Measurement of a chaser's docking sensor. ``contact``: contact of the probe's tip since the
    last tick. ``armed``: the latch will close at a touch within its tolerances. ``latched``: it has
    closed."""

    chaser: ChaserId
    contact: bool
    armed: bool
    latched: bool


class BodyTruth(Message, frozen=True, kw_only=True):
    """Ground truth of one body (``target`` or ``chaser/0``), for recorder, analysis and viewer
    alone.

    ``impulse_N_s`` and ``angular_impulse_N_m_s``: impulses of its actuators since the last tick, in
    body axes. ``absolute_impulse_N_s``: time integral of the sum of the force components'
    magnitudes. With thrusters, since the last tick: ``thruster_impulse_N_s`` and valve opening time
    ``thruster_open_s`` of each, and ``propellant_kg`` used.
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


class BodyReference(Message, frozen=True, kw_only=True):
    """Pose of one body (``target`` or ``chaser/0``) as an independent system measured it, for
    recorder, analysis and viewer alone: what a flight without ground truth is judged against.

    ``sim_time_ns`` is the time of the measurement, which need not be that of a tick. ``source``:
    name of the system, such as that of a motion capture. Velocity (WRF) and rate (body axes): None
    if the system does not measure them. ``sigma_m``, ``sigma_rad``: standard deviation of the
    position and of the attitude about each axis.
    """

    body: Text
    source: Text
    position_m: Vector3
    q_wxyz: Quaternion
    sigma_m: float
    sigma_rad: float
    velocity_m_s: Vector3 | None = None
    omega_rad_s: Vector3 | None = None


class WorldTruth(Message, frozen=True, kw_only=True):
    """Contacts between bodies in the physics steps since the last tick, and saturated commands.

    ``touches``: contacts of probe tips with the target, not included in ``contacts``. ``latched``:
    chasers latched now.
    """

    contacts: Annotated[tuple[tuple[Text, Text], ...], Meta(max_length=1024)]
    saturated: ChaserIds
    late_commands: Count = 0
    touches: Annotated[tuple[ProbeTouch, ...], Meta(max_length=1024)] = ()
    latched: ChaserIds = ()


class PortLoad(Message, frozen=True, kw_only=True):
    """Ground truth of the load at a chaser's port: what the latched chaser exerts on it, torque
    about the tip. Zero without a latch.

    Axes of the port: x outward, z as that of the docked chaser's CRF. ``force_N``, ``torque_N_m``:
    in the last physics step. ``peak_*``: largest magnitudes in the physics steps since the last
    tick: of force and torque, of the force along the axis (``axial``) and across it (``shear``),
    and of the torque across it (``bending``). ``closing_impulse_N_s``: of the steps in which a
    latch closed, which are not in the peaks.
    """

    chaser: ChaserId
    force_N: Vector3
    torque_N_m: Vector3
    peak_force_N: float
    peak_torque_N_m: float
    peak_axial_N: float
    peak_shear_N: float
    peak_bending_N_m: float
    closing_impulse_N_s: float = 0.0


class PlumeLoad(Message, frozen=True, kw_only=True):
    """Ground truth of what the plumes of the chasers' thrusters gave a body since the last tick,
    with ``[plume]``.

    ``impulse_N_s``, ``angular_impulse_N_m_s``: about the body's origin, in its axes.
    ``peak_force_N``: largest force.
    """

    body: Text
    impulse_N_s: Vector3
    angular_impulse_N_m_s: Vector3
    peak_force_N: float


class DrawnBody(Struct, frozen=True, kw_only=True):
    """What the scenario drew for one body (``target`` or ``chaser/0``), body axes unless stated
    otherwise.

    ``inertia_kg_m2``: row-major (3, 3) about the centre of mass. ``thrust_share``: relative error
    of each thruster (with ideal actuation: of force and torque per axis); ``thrust_turn_rad``:
    three numbers each (with ideal actuation: of force and torque). Odometry biases: position in
    WRF. ``camera_*``: error against the calibration. ``marker_shift_m``: three numbers a marker.
    """

    body: Text
    mass_kg: float
    inertia_kg_m2: Square3
    centre_of_mass_m: Vector3 = (0.0, 0.0, 0.0)
    force_N: Vector3 = (0.0, 0.0, 0.0)
    torque_N_m: Vector3 = (0.0, 0.0, 0.0)
    thrust_share: Annotated[tuple[float, ...], Meta(max_length=255)] = ()
    thrust_turn_rad: Annotated[tuple[float, ...], Meta(max_length=765)] = ()
    clock_offset_s: float = 0.0
    position_bias_m: Vector3 = (0.0, 0.0, 0.0)
    attitude_bias_rad: Vector3 = (0.0, 0.0, 0.0)
    gyro_bias_rad_s: Vector3 = (0.0, 0.0, 0.0)
    camera_turn_rad: Vector3 = (0.0, 0.0, 0.0)
    camera_shift_m: Vector3 = (0.0, 0.0, 0.0)
    camera_focal_share: float = 0.0
    camera_centre_px: Annotated[tuple[float, ...], Meta(min_length=2, max_length=2)] = (0.0, 0.0)
    marker_shift_m: Annotated[tuple[float, ...], Meta(max_length=3072)] = ()


class DrawnTruth(Message, frozen=True, kw_only=True):
    """True bodies, actuators and sensors, as drawn from the seed; published once, at the first
    tick.
    """

    bodies: Annotated[tuple[DrawnBody, ...], Meta(max_length=257)]


class ChosenPort(Struct, frozen=True, kw_only=True):
    """A place on a mapped target where chaser ``chaser`` is to dock: position and outward unit
    normal, TRF, of the map that states it.

    ``number``: of the choice, from 1; it stays while the place follows the map. ``axis_sigma_rad``:
    standard deviation of the normal. ``flatness_m``: RMS distance of its landmarks from their
    plane, or of the ring's edge from its circle. ``clearance_m``: room about the corridor in front
    of it, at most 10 m. ``radius_m``: of the ring whose middle it is; None of a flat place.
    """

    chaser: ChaserId
    number: Annotated[int, Meta(ge=1, le=MAX_COUNT)]
    position_m: Vector3
    axis: Vector3
    axis_sigma_rad: float
    flatness_m: float
    clearance_m: float
    radius_m: float | None = None


class SightedMap(Struct, frozen=True, kw_only=True):
    """What the map by which a chaser sees an unknown target says: whether a side of the target has
    returned (``LandmarkMap.closed``), and the chaser's own port.
    """

    closed: bool
    port: ChosenPort | None = None


class Sighting(Message, frozen=True, kw_only=True):
    """Target poses that a chaser measured in one image; empty ``solutions`` if it detected nothing.

    The best solution comes first; a second one follows if a single small marker is ambiguous.
    ``corners_px``: u, v of the four corners of each used marker, in the distorted image.
    ``geometry``: by shape only. ``acquiring``: the chaser is still searching an earlier image for
    the target, or tracking it through those since then. ``map``: of an unknown target, once there
    is one.
    """

    chaser: ChaserId
    status: Literal["seen", "nothing", "bad_image"]
    solutions: Annotated[tuple[PoseSolution, ...], Meta(max_length=4)]
    marker_ids: MarkerIds
    corners_px: Annotated[tuple[float, ...], Meta(max_length=8192)]
    rejected_ids: MarkerIds
    detail: Text = ""
    geometry: GeometryMeasurement | None = None
    acquiring: bool = False
    map: SightedMap | None = None
    wall_estimate_s: float = 0.0


PX_STEP, AGE_STEP_S = 1.0 / 64.0, 0.2
"""Units of ``FeatureTracks``: a tenth of the noise of a point, px; the interval of images, s."""
DESCRIPTION_BYTES = 128
"""Size of the description of a point in ``FeatureTracks``."""
MAX_TRACKS = 1000
"""Most points of an image, and most landmarks of a map."""
MAX_ELLIPSES = 16
"""Ellipses of an image, the best covered: a ring has four edges, and few satellites four rings."""
TrackIds = Annotated[tuple[Count, ...], Meta(max_length=MAX_TRACKS)]


class FeatureTracks(Message, frozen=True, kw_only=True):
    """Points of the target that a chaser follows in one image, without knowledge of its shape.

    ``position_m``, ``q_wxyz``: optical centre and attitude (IRF to WRF) of the camera by odometry
    and calibration. Of n points: ``ids``, ascending and never reused in a mission; ``places``, u
    and v of each, ideal pixels in steps of 1/64 px; ``ages``, for how long each was followed, in
    steps of 0.2 s. ``described`` (k,): ids of points with a description, in ``descriptions``, 128
    bytes each; empty in most images. ``ellipses``: six numbers of each ellipse of edges, which may
    be the rim of a ring: u and v of its centre, half axes, the longer one first, ideal pixels,
    angle from u to the longer axis, rad, and the share of its circumference that has an edge;
    sought in few images. ``status``: of the image, as in ``Sighting``.
    """

    chaser: ChaserId
    status: Literal["seen", "nothing", "bad_image"]
    position_m: Vector3
    q_wxyz: Quaternion
    ids: TrackIds = ()
    places: Annotated[
        tuple[Annotated[int, Meta(ge=-(2**20), le=2**20)], ...], Meta(max_length=2 * MAX_TRACKS)
    ] = ()
    ages: TrackIds = ()
    described: TrackIds = ()
    descriptions: Annotated[bytes, Meta(max_length=DESCRIPTION_BYTES * MAX_TRACKS)] = b""
    ellipses: Annotated[tuple[float, ...], Meta(max_length=6 * MAX_ELLIPSES)] = ()


MapStatus = Literal[
    "gathering",
    "no texture",
    "does not turn",
    "ambiguous",
    "inconsistent",
    "scale unknown",
    "mapped",
]
"""Why there is no map yet, or how good it is.

``gathering``: views span too short a time. ``no texture``: too few points. ``does not turn``:
points do not move. ``ambiguous``: two motions explain the images alike. ``inconsistent``: none
does, or updates disagree. ``scale unknown``: one camera, or all on one line, tell no distances: no
approach. ``mapped``.
"""


class MappedMotion(Struct, frozen=True, kw_only=True):
    """Motion of a mapped target at the time of its message, at constant rates.

    Frames and ``covariance`` as in ``TargetEstimate``. TRF: axes and origin are those of the map.
    """

    position_m: Vector3
    velocity_m_s: Vector3
    q_wxyz: Quaternion
    omega_rad_s: Vector3
    covariance: Square12


class KnownTracks(Struct, frozen=True, kw_only=True):
    """Points of chaser ``chaser`` that are landmarks of a map: their ``ids`` (n,), ascending, and
    the numbers of their ``landmarks`` (n,).
    """

    chaser: ChaserId
    ids: Annotated[tuple[Count, ...], Meta(max_length=10 * MAX_TRACKS)]
    landmarks: Annotated[tuple[Count, ...], Meta(max_length=10 * MAX_TRACKS)]


class LandmarkMap(Message, frozen=True, kw_only=True):
    """Map of a target of unknown shape from all images up to ``tick``. It counts from
    ``mapping.latency_s`` later on; the next one is from images up to ``next_tick`` at the earliest.

    ``instance``: of the mapper's process. Without a map (see ``status``) there are neither
    ``motion`` nor landmarks. ``landmarks_m``: 3 numbers a landmark, TRF; ``moments_m2``: 6 numbers
    of its covariance (xx, yy, zz, xy, xz, yz). ``scale_share``: standard deviation of all
    distances, as a share; 1 without a map. ``residual_px``: median of the points'. ``closed``: a
    side of the target was seen again after a turn, which makes the rate right. ``ports``: chosen
    places, at most one a chaser.
    """

    status: MapStatus
    next_tick: Count
    instance: Text = ""
    motion: MappedMotion | None = None
    landmarks_m: Annotated[tuple[float, ...], Meta(max_length=3 * MAX_TRACKS)] = ()
    moments_m2: Annotated[tuple[float, ...], Meta(max_length=6 * MAX_TRACKS)] = ()
    tracks: Annotated[tuple[KnownTracks, ...], Meta(max_length=256)] = ()
    scale_share: float = 1.0
    residual_px: float = 0.0
    merges: Count = 0
    closed: bool = False
    ports: Annotated[tuple[ChosenPort, ...], Meta(max_length=256)] = ()


class Innovation(Struct, frozen=True, kw_only=True):
    """How a sighting of chaser ``chaser``, exposed at ``sim_time_ns``, agrees with what the
    estimator expected: the squared residual, normalized by its covariance.

    ``squared`` of a consistent estimator is a chi-square variable with ``freedoms`` degrees of
    freedom. ``used``: the sighting passed its gate.
    """

    chaser: ChaserId
    sim_time_ns: Count
    squared: float
    freedoms: Annotated[int, Meta(ge=1, le=100)]
    used: bool


class TargetEstimate(Message, frozen=True, kw_only=True):
    """Fused odometry of the target at ``sim_time_ns``: position and velocity in WRF, rate in TRF.

    ``covariance`` is row-major (12, 12) over (position, velocity, dtheta in TRF, rate in TRF). With
    status ``none``, before the first sighting, the values are meaningless. ``cameras``: estimated
    calibration errors, if estimated. ``relative``: poses of the chasers relative to the target,
    from an estimator that estimates the chasers, too. ``innovations``: of the sightings that the
    tick has processed, but those that start an estimate; None from an estimator that states none,
    and in older logs.
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
    relative: Annotated[tuple[RelativeEstimate, ...], Meta(max_length=256)] = ()
    innovations: Annotated[tuple[Innovation, ...], Meta(max_length=1024)] | None = None

    @property
    def is_known(self) -> bool:
        """Whether pose and rates may be used."""
        return self.status in ("tracking", "predicting")


class MassEstimate(Struct, frozen=True, kw_only=True):
    """Estimated mass properties of a body.

    Centre of mass, and inertia about it, in TRF axes; inertia as xx, yy, zz, xy, xz, yz.
    ``covariance`` is row-major (10, 10) over (mass, centre of mass, inertia).
    """

    mass_kg: float
    centre_of_mass_m: Vector3
    inertia_kg_m2: Annotated[tuple[float, ...], Meta(min_length=6, max_length=6)]
    covariance: Annotated[tuple[float, ...], Meta(min_length=100, max_length=100)]


class StackEstimate(Message, frozen=True, kw_only=True):
    """Mass properties identified in flight, at ``sim_time_ns``.

    ``stack``: of the target with ``chasers``. ``target``: of the target alone. ``thrust_factors``:
    estimated over stated thrust of every thruster, chaser after chaser. ``failed``: for each chaser
    the thrusters that the motion of the stack shows to be stuck. Without chasers both bodies are
    the freely tumbling target.
    """

    chasers: ChaserIds
    stack: MassEstimate
    target: MassEstimate
    thrust_factors: Annotated[tuple[float, ...], Meta(max_length=8192)]
    failed: Annotated[tuple[Thrusters, ...], Meta(max_length=256)] = ()


class Reference(Message, frozen=True, kw_only=True):
    """Reference pose of a chaser at ``sim_time_ns``, and its phase.

    ``offset_m`` is the reference position in TRF; ``time_s`` counts from the start of the phase.
    """

    chaser: ChaserId
    phase: PhaseName
    phase_time_s: float
    position_m: Vector3
    q_wxyz: Quaternion
    offset_m: Vector3
    min_distance_target_m: float


class WrenchCommand(Message, frozen=True, kw_only=True):
    """Commanded force and torque of a chaser, body axes, from ``effective_time_ns`` to
    ``expires_ns``.

    ``tick``: of the odometry that the command is based on. ``mode``: its origin. ``nmpc`` is the
    plan. ``track`` (the reference without a plan), ``brake`` (to rest) and ``coast`` (without
    force) are safe commands. ``search`` looks for a target that no chaser sees, ``pull`` verifies a
    latch, ``detumble`` stops a stack. ``none``: no command, as the chaser's state is unknown.
    ``wait`` and ``yield``: the controller has no majority of leases and commands nothing; with
    ``yield`` it gives the lease back.

    ``thrusts_N``, with ``detumble`` only: thrust of every thruster, in place of an allocation by
    the chaser; force and torque are then those of the thrusts. ``isolated``: thrusters whose
    shut-off valve an operator closed. ``trusted``: thrusters that an operator declared healthy,
    which overrides the chaser's fault detection. ``free``: neither contact nor latch, so that the
    motion identifies thruster faults.

    ``geometry``: newest estimate of the target's geometry, by which the chaser corrects its mesh;
    sent when it has changed, and once a second. ``expected``: pose of the target in the next tick;
    sent to a chaser that does not see a target without markers. ``term``, ``commander`` (the
    sender) and its ``instance``: see ``Lease``.
    """

    chaser: ChaserId
    effective_time_ns: Count
    expires_ns: Count
    mode: Literal[
        "nmpc", "track", "brake", "coast", "pull", "search", "detumble", "none", "wait", "yield"
    ]
    force_N: Vector3
    torque_N_m: Vector3
    thrusts_N: Annotated[tuple[float, ...], Meta(max_length=255)] = ()
    isolated: Thrusters = ()
    trusted: Thrusters = ()
    free: bool = True
    latch: Latch = "keep"
    geometry: GeometryEstimate | None = None
    expected: ExpectedPose | None = None
    term: Count = 0
    commander: Text = ""
    instance: Text = ""


class Plan(Message, frozen=True, kw_only=True):
    """Plan of the NMPC for one chaser: ``stages`` + 1 states and ``stages`` inputs.

    The first state is at ``sim_time_ns``; states are ``step_s`` apart. Arrays are flattened:
    ``positions_m`` has 3 numbers a state, ``quaternions_wxyz`` 4 a state, ``inputs`` (force,
    torque) 6 a stage.
    """

    chaser: ChaserId
    step_s: float
    positions_m: Annotated[tuple[float, ...], Meta(max_length=3 * 2001)]
    quaternions_wxyz: Annotated[tuple[float, ...], Meta(max_length=4 * 2001)]
    inputs: Annotated[tuple[float, ...], Meta(max_length=6 * 2000)]


class PassiveSafety(Message, frozen=True, kw_only=True):
    """Certificate of passive safety of one chaser's newest plan (``limits.passive_safety``).

    It holds for the coasts after a loss of all thrust at any state of the plan. ``margin_sigmas``:
    smallest distance of a coast from the keep-out, in standard deviations; negative inside.
    ``distance_m``: lower bound on the distance from the target at that moment, ``closest_s`` after
    the loss of thrust. ``loss_s``: time of the loss after the plan's beginning. ``safe``: whether
    the margin is at least ``limits.estimate_margin_sigmas``. ``enforced``: whether the chaser
    aborts otherwise. ``abort_margin_sigmas``: the same margin of the best abort from here; None
    where none is sought.
    """

    chaser: ChaserId
    margin_sigmas: float
    distance_m: float
    closest_s: float
    loss_s: float
    safe: bool
    enforced: bool
    abort_margin_sigmas: float | None = None


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
    """Command of a chaser to its actuators, body axes, from ``effective_time_ns`` on.

    ``source``: ``command`` for the command of the controller that holds its lease, in ``term``.
    Without one the chaser flies its last ``plan`` to its end, comes to rest (``brake``) and then
    keeps clear of the target (``hold``). With thrusters, force and torque are the demand,
    ``pulses`` are those of the carrier periods that begin while this command acts, and ``isolated``
    are the thrusters whose shut-off valves are closed from ``effective_time_ns`` on. ``instance``:
    of the chaser's process.
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
    instance: Text = ""


Hazard = Literal["target", "chaser", "corridor", "alignment", "closing speed", "rate"]
"""What a chaser's assurance guards against: too near to the target's centre; to another chaser;
outside of its corridor's cone; in its corridor with a wrong attitude; too fast towards its port;
too fast a rotation."""


AssuranceState = Literal["unchanged", "changed", "backup", "blind", "off"]
"""What a chaser's assurance has done with a command: see ``AssuranceStatus``."""


class AssuranceStatus(Message, frozen=True, kw_only=True):
    """What a chaser's assurance has done with the command of the same tick (``[assurance]``).

    ``state``: ``unchanged``; ``changed``, the nearest command that keeps all conditions;
    ``backup``, none keeps them, and the one that misses them least is given; ``blind``, the target
    is unknown, so only the rate is bounded; ``off``, the chaser is latched. ``hazards``: what
    required a change. ``asked_*``: force and torque as commanded, body axes; those given are in
    ``ActuatorCommand``. ``room_m``: least distance, with its margin, to a surface that must not be
    crossed, ``nearest`` its hazard; None where none is known.
    """

    chaser: ChaserId
    state: AssuranceState
    hazards: Annotated[tuple[Hazard, ...], Meta(max_length=6)]
    asked_force_N: Vector3
    asked_torque_N_m: Vector3
    room_m: float | None = None
    nearest: Hazard | None = None


class Lease(Message, frozen=True, kw_only=True):
    """Command authority over chaser ``chaser``, which it has granted to the controller ``holder``.

    An empty holder: to none. The lease covers the ticks from ``from_tick`` (from its revision
    ``from_revision`` on) to ``until_tick``. The chaser executes commands of that controller's
    ``instance`` only, and of no term before ``term``. ``tick`` and ``revision`` are those of the
    newest ``Tick`` that the chaser has received.
    """

    chaser: ChaserId
    revision: Count = 0
    holder: Text
    instance: Text
    term: Count
    from_tick: Count
    from_revision: Count = 0
    until_tick: Annotated[int, Meta(ge=-1, le=MAX_COUNT)]


class ThrusterReport(Message, frozen=True, kw_only=True):
    """Capability of a chaser's thrusters as it estimates it, at the time of the same tick's
    odometry.

    ``force_max_N`` and ``torque_max_N_m`` can be reached on all body axes at once. ``coming_*``:
    remaining impulse (body axes) of commanded pulses, without the part that belongs to the next
    command. ``given_*``: of the thrusters since the previous report, as expected: their impulse,
    its first moment about the middle of that time (positive for what acts early), and the sum of
    the magnitudes of each thruster's part; ``given_thrusters_N_s``: of each, with identification
    only.
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
    given_moment_N_s2: Vector3 = (0.0, 0.0, 0.0)
    given_angular_moment_N_m_s2: Vector3 = (0.0, 0.0, 0.0)
    given_magnitude_N_s: Vector3 = (0.0, 0.0, 0.0)
    given_angular_magnitude_N_m_s: Vector3 = (0.0, 0.0, 0.0)
    given_thrusters_N_s: Annotated[tuple[float, ...], Meta(max_length=255)] = ()


class Event(Message, frozen=True, kw_only=True):
    """A single occurrence for log and operators."""

    process: Text
    level: Level
    what: Text
    detail: Text = ""


class Health(Message, frozen=True, kw_only=True):
    """Message counters of a process.

    ``rejected``: invalid messages by reason. ``lost``: gaps in ``seq``. ``stale``: messages
    discarded as too late. ``blas``: linear algebra library in use, whose kernels differ in the last
    bits; empty if unknown.
    """

    process: Text
    rejected: Counts
    lost: Count
    stale: Count
    wall_busy_s: float = 0.0
    blas: Text = ""


class RecorderAck(Message, frozen=True, kw_only=True):
    """Acknowledge that the recorder has all expected messages up to ``tick``."""


class OperatorCommand(Message, frozen=True, kw_only=True):
    """An operator's command, sent as a query. ``offset_m`` (TRF): with ``goto`` only.

    ``operator``: name for the log. A command is rejected after ``expires_ns``. The controller
    publishes it with the tick at which it was accepted or rejected, so that the log holds all
    inputs.

    ``calibrate`` rotates the chaser while it observes the target, which makes its camera mounting
    observable. ``inspect`` flies once around the target, whose geometry is estimated from the
    images meanwhile. ``detumble`` stops the tumble of the target with the thrusters of the latched
    chasers that it is sent to. ``isolate`` closes the shut-off valve of ``thruster``; ``restore``
    opens it and declares the thruster healthy.
    """

    command: OperatorCommandName
    chaser: ChaserId
    offset_m: Vector3 | None = None
    thruster: ThrusterId | None = None
    operator: Text = ""
    expires_ns: Count | None = None


PortKind = Literal["flat", "ring"]
"""What a port can be found by."""


class PortRequest(Struct, frozen=True, kw_only=True):
    """Request to the mapper to judge a place on the target, and to make it the port of chaser
    ``chaser`` if it will do. Exactly one of ``pixel``, ``point_m`` and ``find`` says where.

    ``pixel``: in the newest image of chaser ``image``, or in that of the exposure ``exposed_ns``,
    distorted as it is. ``point_m``: the place of the surface nearest to this one, TRF. ``find``:
    ``flat`` takes the best flat place of all, ``ring`` the middle of the best ring, with a radius
    in ``radii_m`` if that is stated.
    """

    chaser: ChaserId
    image: ChaserId | None = None
    pixel: tuple[float, float] | None = None
    exposed_ns: Count | None = None
    point_m: Vector3 | None = None
    find: PortKind | None = None
    radii_m: tuple[float, float] | None = None
    operator: Text = ""

    @property
    def says_one_place(self) -> bool:
        """Whether it says where in exactly one way."""
        exposed = self.exposed_ns is None or self.pixel is not None
        return exposed and one_place(self)


class PortPlace(Protocol):
    """What of a request or of the timeline says where a port is to be."""

    @property
    def image(self) -> int | None: ...
    @property
    def pixel(self) -> tuple[float, float] | None: ...
    @property
    def point_m(self) -> tuple[float, float, float] | None: ...
    @property
    def find(self) -> PortKind | None: ...
    @property
    def radii_m(self) -> tuple[float, float] | None: ...


ONE_PLACE = "needs either image and pixel, or point_m, or find, with radii_m for a ring only"
"""What `one_place` asks for."""


def one_place(where: PortPlace) -> bool:
    """Return whether a place is said in exactly one way."""
    wanted = sum(part is not None for part in (where.pixel, where.point_m, where.find))
    radii = where.radii_m
    return (
        wanted == 1
        and (where.image is None) == (where.pixel is None)
        and (radii is None or (where.find == "ring" and 0.0 <= radii[0] < radii[1]))
    )


class CommandReply(Message, frozen=True, kw_only=True):
    """Reply of the controller to an operator command, also published for the log; of the mapper to
    a ``PortRequest``.
    """

    command: Text
    chaser: ChaserId
    accepted: bool
    reason: Text
    operator: Text = ""


class CommandedWrench(Struct, frozen=True, kw_only=True):
    """Force and torque that were commanded to a chaser, body axes."""

    chaser: ChaserId
    force_N: Vector3
    torque_N_m: Vector3


class ControllerState(Message, frozen=True, kw_only=True):
    """Report of the commanding controller to standbys that it has completed the tick.

    ``operated``: operator commands of the tick. ``commanded``: its commands, in real time, where a
    standby may have computed others; a standby takes these for what acts on the chasers. ``state``:
    serialized controller state after the tick, for standbys that joined late; sent at intervals,
    else empty. ``process``, ``instance`` and ``term``: of the sender; see ``Lease``.
    """

    process: Text
    term: Count
    operated: Annotated[tuple[OperatorCommand, ...], Meta(max_length=1024)] = ()
    state: Annotated[bytes, Meta(max_length=4_000_000)] = b""
    instance: Text = ""
    commanded: Annotated[tuple[CommandedWrench, ...], Meta(max_length=256)] = ()


class ThrusterFaultCommand(Struct, frozen=True, kw_only=True):
    """Make a simulated thruster fail or repair it (``healthy``), if the scenario allows it.

    The chaser does not receive it. ``factor``, with ``weak`` only: remaining share of the thrust, 0
    to 1.
    """

    chaser: ChaserId
    thruster: ThrusterId
    kind: ThrusterState
    factor: float | None = None
    operator: Text = ""


class ArmingCommand(Struct, frozen=True, kw_only=True):
    """Let the robots of a laboratory move (``arm``), stop them (``disarm``), or stop them for good
    (``kill``).
    """

    action: Literal["arm", "disarm", "kill"]
    operator: Text = ""


class ArmingReply(Struct, frozen=True, kw_only=True):
    """Whether the gateway did what an ``ArmingCommand`` asks for, and why."""

    accepted: bool
    reason: Text


class Kill(Message, frozen=True, kw_only=True):
    """Stop the robots of a laboratory for good. Anything may publish it that may be an operator,
    such as an emergency button.
    """

    by: Text = ""


class Presence(Message, frozen=True, kw_only=True):
    """Heartbeat of a process. ``heard``: processes whose presence it has received, name to
    instance.

    ``waiting_for``: keys of the messages that it waits for, if it has nothing else to do.
    ``world``: identity of the session of its mission's world, empty if unknown.
    """

    process: Text
    instance: Text
    heard: Names
    waiting_for: Annotated[tuple[Text, ...], Meta(max_length=1024)] = ()
    world: Text = ""


class Farewell(Message, frozen=True, kw_only=True):
    """Last message of a process: the number of messages that it has published on each key."""

    process: Text
    published: Counts


class JoinRequest(Struct, frozen=True, kw_only=True):
    """Request of a process to join the mission, before it declares any topic."""

    process: Text
    instance: Text


class JoinReply(Struct, frozen=True, kw_only=True):
    """Reply of the world to a request to join: the flight scenario as JSON, or why it refuses.

    ``faults``: JSON of what the test bed injects at this process; for the code around the flight
    software only. ``source``: identity of the world's session, which stamps its messages; messages
    of other sessions on its keys are ignored. Empty: unknown.
    """

    accepted: bool
    reason: Text
    run_id: Text = ""
    mode: Literal["lockstep", "realtime"] = "lockstep"
    scenario_json: ScenarioText = ""
    faults: ScenarioText = "{}"
    source: Text = ""


class ScenarioRequest(Struct, frozen=True, kw_only=True):
    """Request for the full scenario, ground truth included."""

    process: Text


class ScenarioReply(Struct, frozen=True, kw_only=True):
    """The world's reply: the full scenario as JSON, and the run that it belongs to."""

    run_id: Text
    scenario_json: ScenarioText


VERSION: dict[type[Struct], int] = {
    Tick: 3,
    MissionEnd: 1,
    Image: 1,
    Odometry: 2,
    DockingStatus: 1,
    BodyTruth: 2,
    BodyReference: 1,
    WorldTruth: 1,
    PortLoad: 1,
    PlumeLoad: 1,
    DrawnTruth: 1,
    Sighting: 2,
    FeatureTracks: 1,
    LandmarkMap: 1,
    TargetEstimate: 1,
    StackEstimate: 1,
    Reference: 1,
    WrenchCommand: 1,
    Plan: 1,
    PassiveSafety: 1,
    SolverStatus: 1,
    ActuatorCommand: 2,
    AssuranceStatus: 1,
    Lease: 1,
    ThrusterReport: 3,
    Event: 1,
    Health: 1,
    RecorderAck: 1,
    OperatorCommand: 2,
    ThrusterFaultCommand: 2,
    PortRequest: 1,
    CommandReply: 1,
    ControllerState: 2,
    ArmingCommand: 1,
    ArmingReply: 1,
    Kill: 1,
    Presence: 1,
    Farewell: 1,
    JoinRequest: 1,
    JoinReply: 1,
    ScenarioRequest: 1,
    ScenarioReply: 1,
}
"""Version of every top-level message type."""


def encoding_of(kind: type[Struct]) -> str:
    """Return the Zenoh encoding of a message type, such as
    ``application/msgpack;chaserdock.Odometry.v1``.
    """
    return _encoding(kind, VERSION[kind])


@cache
def _encoding(kind: type[Struct], number: int) -> str:
    return f"application/msgpack;chaserdock.{kind.__name__}.v{number}"


@cache
def schema_of(kind: type[Struct]) -> bytes:
    """Return the JSON Schema of a message type, as stored in logs."""
    return msgspec.json.encode(msgspec.json.schema(kind))
