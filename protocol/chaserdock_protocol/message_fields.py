"""What messages are made of: kinds of fields, with their bounds, and parts that never stand alone."""

from __future__ import annotations

from typing import Annotated, Literal

from msgspec import Meta, Struct

Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]
Count = Annotated[int, Meta(ge=0)]
ChaserId = Annotated[int, Meta(ge=0, le=255)]
JetId = Annotated[int, Meta(ge=0, le=254)]
Jets = Annotated[tuple[JetId, ...], Meta(max_length=255)]
Text = Annotated[str, Meta(max_length=2000)]
Level = Literal["info", "warning", "error"]
Square6 = Annotated[tuple[float, ...], Meta(min_length=36, max_length=36)]
Square12 = Annotated[tuple[float, ...], Meta(min_length=144, max_length=144)]


Phase = Literal[
    "acquire",
    "hold",
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


class JetPulse(Struct, frozen=True, kw_only=True):
    """A jet's valve is to be open between two times."""

    jet: JetId
    open_ns: Count
    close_ns: Count
