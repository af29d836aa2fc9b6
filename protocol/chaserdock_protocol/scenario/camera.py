# SPDX-License-Identifier: Apache-2.0
"""Scenario section ``[camera]``: the chasers' cameras and the light."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Annotated

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.camera import Q_CRF_IRF_FORWARD_WXYZ, Camera
from chaserdock_models.lenses import LensModel
from pydantic import Field, model_validator

from .fields import Fraction, NotNegative, Number, Positive, Section, Vector

SidePixels = Annotated[int, Field(ge=64, le=4096)]
_LEAST_SHARE = 0.5
"""A lens must be invertible in so much of the image (chosen): published wide-angle calibrations
that turn back do so at the corners, in a tenth of it."""
_NO_FISHEYE = math.tan(math.radians(85.0))
"""A fisheye that ends at a larger angle draws a circle in a black image, as it should."""
_GRID = 61
"""Points along the image, and about the rim of a lens, at which validity is looked at."""
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
    point_spread_px: NotNegative = Field(
        default=0.6, description="Standard deviation of the lens' Gaussian blur, pixels."
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
        default=(),
        description="OpenCV's coefficients: k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4[, "
        "tau_x, tau_y]]]]; of an `equidistant` lens k1, k2, k3, k4. Empty: no distortion.",
    )
    lens_model: LensModel = Field(
        default="perspective",
        description="`perspective`, or `equidistant`: a fisheye lens.",
    )

    @model_validator(mode="after")
    def _check_lens(self) -> Intrinsics:
        check_lens(self.camera())
        return self

    def camera(self) -> Camera:
        """Return the camera at the origin. Raises ValueError for a wrong number of coefficients."""
        fisheye = self.lens_model == "equidistant"
        return Camera(
            self.width_px,
            self.height_px,
            self.fx_px,
            self.fy_px,
            self.cx_px,
            self.cy_px,
            self.distortion if fisheye or any(self.distortion) else (),
            lens_model=self.lens_model,
        )


def check_lens(camera: Camera) -> None:
    """Raise ValueError for a lens that can be inverted in less than half of the image: a wrong
    calibration.

    Where the lens ends before the corners only, the image is black beyond, as with a fisheye.
    """
    share, reach_px = valid_share(camera), valid_reach_px(camera)
    if share < _LEAST_SHARE and camera.lens.valid_radius < _NO_FISHEYE:
        angle = math.degrees(math.atan(camera.lens.valid_radius))
        raise ValueError(
            f"the distortion can be inverted only up to {reach_px:.0f} px from the principal point "
            f"({angle:.1f} degrees), in {share:.0%} of the image of {camera.width_px} x "
            f"{camera.height_px}; calibrate with the board in all of the image"
        )


def valid_share(camera: Camera) -> float:
    """Return the share of the image in which the distortion can be inverted."""
    if not camera.distorts:
        return 1.0
    u, v = (np.linspace(0.0, n - 1.0, _GRID) for n in (camera.width_px, camera.height_px))
    ideal = camera.undistort(np.stack(np.meshgrid(u, v), axis=-1))
    return float(np.isfinite(ideal).all(axis=-1).mean())


def valid_reach_px(camera: Camera) -> float:
    """Return the least distance from the principal point, pixels of the image, at which the lens
    ends.
    """
    radius = camera.lens.valid_radius
    radius = (1.0 - 1e-9) * radius if math.isfinite(radius) else _NO_FISHEYE
    turn = np.linspace(0.0, 2.0 * math.pi, _GRID, endpoint=False)
    rim = camera.lens.distort(radius * np.stack([np.cos(turn), np.sin(turn)], axis=-1))
    return float(np.linalg.norm(rim * (camera.fx_px, camera.fy_px), axis=-1).min())


def lens_note(camera: Camera) -> str | None:
    """Return a line on a lens that ends before the corners of the image, None for others."""
    share = valid_share(camera)
    if share == 1.0:
        return None
    return (
        f"camera: the lens ends {valid_reach_px(camera):.0f} px from the principal point "
        f"({math.degrees(math.atan(camera.lens.valid_radius)):.1f} degrees): the image beyond, "
        f"{1.0 - share:.1%} of it, stays black"
    )


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
        if not any(self.direction):
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
        return replace(i.camera(), position_crf_m=self.position_m, q_crf_irf_wxyz=q)


class CameraSection(FlightCamera):
    """The camera of every chaser, and the light. The camera looks along +X of CRF, its top towards
    +Z.
    """

    calibration: str | None = Field(
        default=None,
        exclude=True,
        description="Path, relative to the scenario file, of a calibration file to read "
        "`intrinsics` from: of OpenCV (YAML, JSON or XML), ROS (`camera_info`) or Kalibr "
        "(camchain; `camchain.yaml#cam1` names one of several cameras).",
    )
    sun_direction: Vector = Field(
        default=(-0.4, -0.5, 0.77), description="Direction to the sun (WRF), any length but 0."
    )
    ambient: Fraction = Field(
        default=0.35, description="Share of the light that comes from all directions."
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
        if not any(self.sun_direction):
            raise ValueError("sun_direction must not be zero")
        if self.calibration is not None:
            raise ValueError("calibration is resolved in scenario files only; give intrinsics")
        return self
