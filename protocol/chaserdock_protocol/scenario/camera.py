# SPDX-License-Identifier: Apache-2.0
"""Scenario section ``[camera]``: the chasers' cameras and the light."""

from __future__ import annotations

import math
from typing import Annotated

from chaserdock_models import rotations
from chaserdock_models.camera import Q_CRF_IRF_FORWARD_WXYZ, Camera
from pydantic import Field, model_validator

from .fields import Fraction, NotNegative, Number, Positive, Section, Vector, is_zero

SidePixels = Annotated[int, Field(ge=64, le=4096)]
REPLACED_BY_INTRINSICS = ("width_px", "height_px", "hfov_deg")


class Effects(Section):
    """Image effects. A gain of 1, and 0 elsewhere, switch an effect off."""

    gain: Positive = Field(default=1.0, description="Exposure: factor on the grey levels.")
    auto_exposure: float = Field(
        default=0.0,
        ge=0,
        le=255,
        allow_inf_nan=False,
        description="Grey level that the brightest hundredth of each image is exposed to, in "
        "place of `gain`, by a factor of 1/8 to 8. 0: off.",
    )
    point_spread_px: float = Field(
        default=0.6,
        ge=0,
        le=20,
        allow_inf_nan=False,
        description="Standard deviation of the lens' Gaussian blur, pixels.",
    )
    read_noise: NotNegative = Field(
        default=1.5, description="Standard deviation of the read noise, grey levels."
    )
    shot_noise: NotNegative = Field(
        default=0.025, description="Variance of the shot noise, squared grey levels per grey level."
    )
    exposure_s: float = Field(
        default=0.0,
        ge=0,
        le=0.5,
        allow_inf_nan=False,
        description="Time for which the shutter is open, centred on the image's time, s. It "
        "blurs moving edges; the brightness depends on `gain` alone.",
    )
    glare: NotNegative = Field(
        default=0.0,
        description="Stray light at one degree from the sun, grey levels; it falls with the "
        "angle. Above 0, the sun's disc is drawn, too.",
    )
    jpeg_quality: int = Field(
        default=85,
        ge=0,
        le=100,
        description="JPEG quality of the images that chasers receive. 0: uncompressed.",
    )


class Intrinsics(Section):
    """Camera matrix and lens distortion of a calibration."""

    width_px: SidePixels = Field(description="Image width, pixels.")
    height_px: SidePixels = Field(description="Image height, pixels.")
    fx_px: Positive = Field(description="Focal length along x, pixels.")
    fy_px: Positive = Field(description="Focal length along y, pixels.")
    cx_px: Number = Field(description="Principal point, x, pixels.")
    cy_px: Number = Field(description="Principal point, y, pixels.")
    distortion: tuple[Number, ...] = Field(
        default=(), description="OpenCV's coefficients k1, k2, p1, p2[, k3]. Empty: no distortion."
    )

    @model_validator(mode="after")
    def _check_coefficients(self) -> Intrinsics:
        if len(self.distortion) not in (0, 4, 5):
            raise ValueError(
                f"distortion takes k1, k2, p1, p2[, k3], not {len(self.distortion)} numbers"
            )
        return self


class Eclipse(Section):
    """An interval in which the target is in the Earth's shadow and the sun gives no light."""

    from_s: NotNegative = Field(description="Begin, s of mission time.")
    to_s: Positive = Field(description="End, s of mission time; after `from_s`.")

    @model_validator(mode="after")
    def _check_order(self) -> Eclipse:
        if self.to_s <= self.from_s:
            raise ValueError(f"to_s ({self.to_s}) must be after from_s ({self.from_s})")
        return self


class EarthSection(Section):
    """The Earth in the background."""

    direction: Vector = Field(
        description="Direction to the Earth's centre (WRF), any length but 0."
    )
    radius_deg: float = Field(
        default=66.0,
        gt=1,
        lt=85,
        allow_inf_nan=False,
        description="Angular radius of the Earth's disc, degrees: 66 from 500 km altitude.",
    )

    @model_validator(mode="after")
    def _check_direction(self) -> EarthSection:
        if is_zero(self.direction):
            raise ValueError("direction must not be zero")
        return self


class FlightCamera(Section):
    """The calibration of every chaser's camera. It looks along +X of CRF, its top towards +Z."""

    width_px: SidePixels = Field(default=1280, description="Image width, pixels.")
    height_px: SidePixels = Field(default=720, description="Image height, pixels.")
    hfov_deg: float = Field(
        default=60.0,
        gt=5,
        lt=150,
        allow_inf_nan=False,
        description="Horizontal field of view, degrees.",
    )
    intrinsics: Intrinsics | None = Field(
        default=None,
        description="Calibrated camera, in place of `width_px`, `height_px` and `hfov_deg`.",
    )
    position_m: Vector = Field(
        default=(0.07, 0.0, 0.075), description="Position of the optical centre (CRF), m."
    )
    mounting_rotation_deg: Vector = Field(
        default=(0.0, 0.0, 0.0),
        description="Rotation from looking along +X to the camera's mounting: rotation vector "
        "(CRF), degrees.",
    )

    def model(self) -> Camera:
        """Return the camera as calibrated."""
        i = self.intrinsics
        q = Q_CRF_IRF_FORWARD_WXYZ
        if any(self.mounting_rotation_deg):
            turn = rotations.exp([math.radians(v) for v in self.mounting_rotation_deg])
            qw, qx, qy, qz = rotations.multiply(turn, q).tolist()
            q = (qw, qx, qy, qz)
        if i is None:
            c = Camera.from_hfov(
                self.width_px, self.height_px, math.radians(self.hfov_deg), self.position_m
            )
            return Camera(
                c.width_px, c.height_px, c.fx_px, c.fy_px, c.cx_px, c.cy_px, (), self.position_m, q
            )
        distortion = i.distortion if any(i.distortion) else ()
        return Camera(
            i.width_px,
            i.height_px,
            i.fx_px,
            i.fy_px,
            i.cx_px,
            i.cy_px,
            distortion,
            self.position_m,
            q,
        )


class CameraSection(FlightCamera):
    """The camera of every chaser, and the light. The camera looks along +X of CRF, its top towards
    +Z.
    """

    calibration: str | None = Field(
        default=None,
        exclude=True,
        description="Path, relative to the scenario file, of an OpenCV calibration file (YAML, "
        "JSON or XML) to read `intrinsics` from.",
    )
    sun_direction: Vector = Field(
        default=(-0.4, -0.5, 0.77), description="Direction to the sun (WRF), any length but 0."
    )
    ambient: Fraction = Field(
        default=0.35, description="Share of the light that comes from all directions."
    )
    eclipse_ambient: Fraction = Field(
        default=0.05, description="Share of `ambient` that remains in an eclipse."
    )
    lamp: NotNegative = Field(
        default=0.0,
        description="Light of the camera's own lamp: grey level of a white surface at 1 m "
        "distance.",
    )
    eclipses: tuple[Eclipse, ...] = ()
    earth: EarthSection | None = None
    effects: Effects = Effects()

    @model_validator(mode="after")
    def _check_section(self) -> CameraSection:
        if is_zero(self.sun_direction):
            raise ValueError("sun_direction must not be zero")
        if self.calibration is not None:
            raise ValueError("calibration is resolved in scenario files only; give intrinsics")
        return self
