"""What messages are made of: kinds of fields, with their bounds, and parts that never stand alone."""

from __future__ import annotations

from typing import Annotated, Literal

from chaserdock_models.arrays import Quaternion, Vector3
from msgspec import Meta, Struct

MAX_COUNT = 2**53
"""Bounds every whole number: 104 days in nanoseconds; exact as a double, too, and sums of some stay encodable."""
Count = Annotated[int, Meta(ge=0, le=MAX_COUNT)]
ChaserId = Annotated[int, Meta(ge=0, le=255)]
ChaserIds = Annotated[tuple[ChaserId, ...], Meta(max_length=256)]
MarkerIds = Annotated[tuple[Annotated[int, Meta(ge=0, le=2**31)], ...], Meta(max_length=1024)]
ThrusterId = Annotated[int, Meta(ge=0, le=254)]
Thrusters = Annotated[tuple[ThrusterId, ...], Meta(max_length=255)]
Text = Annotated[str, Meta(max_length=2000)]
ThrusterState = Literal["healthy", "stuck_off", "stuck_on", "weak"]
Counts = Annotated[dict[Text, Count], Meta(max_length=1024)]
Names = Annotated[dict[Text, Text], Meta(max_length=1024)]
Level = Literal["info", "warning", "error"]
Square6 = Annotated[tuple[float, ...], Meta(min_length=36, max_length=36)]
Square12 = Annotated[tuple[float, ...], Meta(min_length=144, max_length=144)]


Phase = Literal[
    "acquire",
    "searching",
    "hold",
    "calibrate",
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
]
"""What a chaser is doing; from ``wait`` on, where docking ends by capture."""
Latch = Literal["keep", "arm", "release"]
"""What a probe's latch is told: as it is, to close at a proper touch (and stay closed), to open (and stay open)."""


class PoseSolution(Struct, frozen=True, kw_only=True):
    """One pose of the target in the camera frame.

    ``position_m`` is TRF's origin in IRF, ``q_wxyz`` takes TRF to IRF. ``covariance`` is row-major (6, 6)
    over (position in IRF axes, dtheta in TRF axes) with q_true = q (x) exp(dtheta).
    """

    position_m: Vector3
    q_wxyz: Quaternion
    covariance: Square6
    reprojection_rms_px: float


class CameraCalibration(Struct, frozen=True, kw_only=True):
    """How far chaser ``chaser``'s camera is from its calibration, as estimated in flight, with one sigma of each.

    ``turn_rad``: rotation vector in CRF by which it is turned from its told mounting; ``shift_m``: of its lens, in CRF;
    ``focal_share``: how much longer its focal length is.
    """

    chaser: ChaserId
    turn_rad: Vector3
    turn_sigma_rad: Vector3
    shift_m: Vector3
    shift_sigma_m: Vector3
    focal_share: float
    focal_sigma_share: float


class ProbeTouch(Struct, frozen=True, kw_only=True):
    """A probe's tip came to touch the target at ``sim_time_ns``: where and how fast, relative to its port.

    ``latched`` says whether the latch closed, ``refused`` why not.
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
    """A thruster's valve is to be open between two times."""

    thruster: ThrusterId
    open_ns: Count
    close_ns: Count
