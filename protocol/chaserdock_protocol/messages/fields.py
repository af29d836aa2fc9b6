# SPDX-License-Identifier: Apache-2.0
"""Field types of messages with their bounds, and nested structures."""

from __future__ import annotations

from typing import Annotated, Literal

from chaserdock_models.arrays import Quaternion, Vector3
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
ThrusterState = Literal["healthy", "stuck_off", "stuck_on", "weak"]
Counts = Annotated[dict[Text, Count], Meta(max_length=1024)]
Names = Annotated[dict[Text, Text], Meta(max_length=1024)]
OperatorCommandName = Literal[
    "approach", "hold", "retreat", "abort", "goto", "calibrate", "isolate", "restore"
]
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
"""Phase of a chaser. Those from ``wait`` on occur only if docking ends by capture."""
Latch = Literal["keep", "arm", "release"]
"""Command of a probe's latch: no change; close at a valid touch and stay closed; open and stay open."""


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
    """Calibration error of chaser ``chaser``'s camera, as estimated in flight, with standard deviations.

    ``turn_rad``: rotation vector in CRF from the nominal mounting. ``shift_m``: lens position error in CRF.
    ``focal_share``: relative error of the focal length.
    """

    chaser: ChaserId
    turn_rad: Vector3
    turn_sigma_rad: Vector3
    shift_m: Vector3
    shift_sigma_m: Vector3
    focal_share: float
    focal_sigma_share: float


class ProbeTouch(Struct, frozen=True, kw_only=True):
    """First contact of a probe's tip with the target at ``sim_time_ns``: position and velocity relative to its port.

    ``latched``: whether the latch closed. ``refused``: the reason if it did not.
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
