# SPDX-License-Identifier: Apache-2.0
"""The view of a chaser's camera as a pyramid, for 3-D replay and film."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.scenario import FlightScenario

_LENGTH_M = 0.22
"""Length (m) of the drawn pyramid, chosen: that of a chaser. Larger: pyramids hide the target."""
_WIDEST_RAD = math.radians(75.0)
"""Largest angle of the drawn field of view from the optical axis: a pyramid cannot show more."""


@dataclass(frozen=True)
class CameraFrustum:
    """Tip ``origin_m`` (3,) and far ``corners_m`` (4, 3) in CRF."""

    origin_m: Array
    corners_m: Array


def camera_frustum(scenario: FlightScenario) -> CameraFrustum:
    """Return the field of view of the chasers' camera."""
    camera = scenario.camera_model()
    left, top, right, bottom = (math.tan(min(a, _WIDEST_RAD)) for a in camera.angles_to_borders())
    rays = ((-left, -top, 1.0), (right, -top, 1.0), (right, bottom, 1.0), (-left, bottom, 1.0))
    origin = np.array(camera.position_crf_m)
    turned = rotations.rotate(camera.q_crf_irf_wxyz, _LENGTH_M * np.array(rays))
    return CameraFrustum(origin, turned + origin)
