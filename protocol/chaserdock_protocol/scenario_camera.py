"""The scenario's section of the chasers' camera."""

from __future__ import annotations

from typing import Annotated

from pydantic import AfterValidator, Field

from .scenario_fields import NotNegative, Positive, Section, Vector, finite


class Effects(Section):
    """What the camera does to the exact picture: a gain of 1 and 0 elsewhere switch an effect off.

    Noise in grey levels (``read_noise``) and squared grey levels per grey level (``shot_noise``).
    """

    gain: Positive = 1.0
    point_spread_px: NotNegative = 0.6
    read_noise: NotNegative = 1.5
    shot_noise: NotNegative = 0.025
    jpeg_quality: Annotated[int, Field(ge=0, le=100)] = 85


class CameraSection(Section):
    """The chasers' camera, looking along the body's +X, its top towards +Z; ``sun_direction`` (WRF): to the sun."""

    width_px: Annotated[int, Field(ge=64, le=4096)] = 1280
    height_px: Annotated[int, Field(ge=64, le=4096)] = 720
    hfov_deg: Annotated[float, AfterValidator(finite), Field(gt=5, lt=150)] = 60.0
    position_m: Vector = (0.07, 0.0, 0.075)
    sun_direction: Vector = (-0.4, -0.5, 0.77)
    effects: Effects = Effects()
