"""The scenario's section of the chasers' camera, and of the light it works in."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from chaserdock_models import rotations
from chaserdock_models.camera import Q_CRF_IRF_FORWARD_WXYZ, Camera
from pydantic import AfterValidator, Field, model_validator

from .fields import NotNegative, Number, Positive, Section, Vector, finite

Share = Annotated[float, AfterValidator(finite), Field(ge=0, le=1)]


class Effects(Section):
    """What the camera does to the exact image: a gain of 1 and 0 elsewhere switch an effect off.

    Noise in grey levels (``read_noise``) and squared grey levels per grey level (``shot_noise``). ``exposure_s``:
    motion blur of a shutter that is open so long, about the image's time; the image's level is ``gain``'s.
    ``glare``: grey levels of stray light at one degree from the sun (it falls with the angle); the sun's disc
    itself is drawn when that is above 0.
    """

    gain: Positive = 1.0
    point_spread_px: NotNegative = 0.6
    read_noise: NotNegative = 1.5
    shot_noise: NotNegative = 0.025
    exposure_s: Annotated[float, AfterValidator(finite), Field(ge=0, le=0.5)] = 0.0
    glare: NotNegative = 0.0
    jpeg_quality: Annotated[int, Field(ge=0, le=100)] = 85


class Intrinsics(Section):
    """The camera matrix and lens of a calibration; ``distortion``: k1, k2, p1, p2[, k3], or none."""

    width_px: Annotated[int, Field(ge=64, le=4096)]
    height_px: Annotated[int, Field(ge=64, le=4096)]
    fx_px: Positive
    fy_px: Positive
    cx_px: Number
    cy_px: Number
    distortion: tuple[Number, ...] = ()

    @model_validator(mode="after")
    def _coefficients(self) -> Intrinsics:
        if len(self.distortion) not in (0, 4, 5):
            raise ValueError(f"distortion takes k1, k2, p1, p2[, k3], not {len(self.distortion)} numbers")
        return self


class CalibrationError(Section):
    """One sigma of how far the cameras are from what those who fly are told, drawn for each from the seed."""

    focal_length_share: NotNegative = 0.0
    centre_px: NotNegative = 0.0
    mounting_deg: NotNegative = 0.0
    mounting_m: NotNegative = 0.0

    @property
    def any(self) -> bool:
        return any((self.focal_length_share, self.centre_px, self.mounting_deg, self.mounting_m))


class Eclipse(Section):
    """The target passes through the Earth's shadow: no sun from ``from_s`` to ``to_s``."""

    from_s: NotNegative
    to_s: Positive

    @model_validator(mode="after")
    def _ordered(self) -> Eclipse:
        if self.to_s <= self.from_s:
            raise ValueError(f"to_s ({self.to_s}) must be after from_s ({self.from_s})")
        return self


class EarthSection(Section):
    """The Earth in the background: direction to its centre (WRF) and angular radius (66 deg from 500 km up)."""

    direction: Vector
    radius_deg: Annotated[float, AfterValidator(finite), Field(gt=1, lt=85)] = 66.0

    @model_validator(mode="after")
    def _somewhere(self) -> EarthSection:
        if not any(self.direction):
            raise ValueError("direction must not be zero")
        return self


class CameraSection(Section):
    """The chasers' camera, looking along the body's +X, its top towards +Z, turned by ``mounting_rotation_deg``
    (rotation vector, CRF). ``intrinsics`` (or ``calibration``: a file with them) take the place of size and field
    of view. ``sun_direction`` (WRF): to the sun; ``ambient``: the share of light from everywhere, of which
    ``eclipse_ambient`` is left in an eclipse; ``lamp``: grey level that the camera's own lamp gives to white at 1 m.
    """

    renderer: Literal["exact", "pybullet"] = "exact"
    width_px: Annotated[int, Field(ge=64, le=4096)] = 1280
    height_px: Annotated[int, Field(ge=64, le=4096)] = 720
    hfov_deg: Annotated[float, AfterValidator(finite), Field(gt=5, lt=150)] = 60.0
    intrinsics: Intrinsics | None = None
    position_m: Vector = (0.07, 0.0, 0.075)
    mounting_rotation_deg: Vector = (0.0, 0.0, 0.0)
    calibration_error: CalibrationError = CalibrationError()
    sun_direction: Vector = (-0.4, -0.5, 0.77)
    ambient: Share = 0.35
    eclipse_ambient: Share = 0.05
    lamp: NotNegative = 0.0
    eclipses: tuple[Eclipse, ...] = ()
    earth: EarthSection | None = None
    effects: Effects = Effects()

    @model_validator(mode="after")
    def _lit(self) -> CameraSection:
        if not any(self.sun_direction):
            raise ValueError("sun_direction must not be zero")
        return self

    def model(self) -> Camera:
        """The camera as those who fly are told it is."""
        i = self.intrinsics
        q = Q_CRF_IRF_FORWARD_WXYZ
        if any(self.mounting_rotation_deg):
            turn = rotations.exp([math.radians(v) for v in self.mounting_rotation_deg])
            qw, qx, qy, qz = rotations.multiply(turn, q).tolist()
            q = (qw, qx, qy, qz)
        if i is None:
            c = Camera.from_hfov(self.width_px, self.height_px, math.radians(self.hfov_deg), self.position_m)
            return Camera(c.width_px, c.height_px, c.fx_px, c.fy_px, c.cx_px, c.cy_px, (), self.position_m, q)
        return Camera(
            i.width_px,
            i.height_px,
            i.fx_px,
            i.fy_px,
            i.cx_px,
            i.cy_px,
            i.distortion if any(i.distortion) else (),
            self.position_m,
            q,
        )
