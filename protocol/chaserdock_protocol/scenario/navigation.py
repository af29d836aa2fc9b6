# SPDX-License-Identifier: Apache-2.0
"""Scenario section ``[navigation]``: errors of the chasers' odometry and cameras that the flight
software assumes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Annotated, Literal

from pydantic import Field

from .fields import Section

Metres = Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)]
MetresPerSecond = Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)]
Degrees = Annotated[float, Field(ge=0, le=90, allow_inf_nan=False)]
OffsetPixels = Annotated[float, Field(ge=0, le=100, allow_inf_nan=False)]
FocalShare = Annotated[float, Field(ge=0, le=0.1, allow_inf_nan=False)]
Duration = Annotated[float, Field(ge=0.1, le=1e6, allow_inf_nan=False)]

GRADES: dict[str, dict[str, float]] = {
    "exact": {},
    "lab": {
        "position_noise_m": 0.0005,
        "velocity_noise_m_s": 0.0005,
        "attitude_noise_deg": 0.05,
        "attitude_roll_noise_deg": 0.05,
        "omega_noise_deg_s": 0.02,
        "camera_turn_deg": 0.05,
        "camera_shift_m": 0.0005,
        "camera_focal_share": 0.0005,
    },
    "orbit": {
        "position_noise_m": 0.003,
        "position_drift_m": 0.02,
        "velocity_noise_m_s": 0.001,
        "attitude_noise_deg": 0.01,
        "attitude_roll_noise_deg": 0.05,
        "attitude_drift_deg": 0.02,
        "omega_noise_deg_s": 0.01,
        "gyro_bias_deg_s": 0.001,
        "camera_turn_deg": 0.1,
        "camera_shift_m": 0.002,
        "camera_focal_share": 0.001,
    },
    "poor": {
        "position_noise_m": 0.009,
        "position_drift_m": 0.06,
        "velocity_noise_m_s": 0.003,
        "attitude_noise_deg": 0.03,
        "attitude_roll_noise_deg": 0.15,
        "attitude_drift_deg": 0.06,
        "omega_noise_deg_s": 0.03,
        "gyro_bias_deg_s": 0.003,
        "camera_turn_deg": 0.3,
        "camera_shift_m": 0.006,
        "camera_focal_share": 0.003,
    },
}
"""Figures of the grades; those that a grade does not have are 0, and time constants those of
``DRIFT_TIMES``.

lab: motion capture. orbit: differential carrier-phase GNSS, star tracker and gyro. poor: three
times orbit.
"""

DRIFT_TIMES = {"position_drift_time_s": 100.0, "attitude_drift_time_s": 300.0}
"""Time constants of the Gauss-Markov processes in all grades, s."""


@dataclass(frozen=True)
class NavigationErrors:
    """Standard deviations per axis of a chaser's odometry and of its camera against its
    calibration. SI units and radians.

    Noise is white, drawn each tick. Drift is a stationary Gauss-Markov process. Bias and the
    camera's errors are constant in a mission. Position, velocity: WRF. Attitude (rotation vector),
    rate, camera: CRF; ``attitude_roll_noise_rad`` is about x, ``attitude_noise_rad`` about y and z.
    """

    position_noise_m: float
    position_drift_m: float
    position_drift_time_s: float
    velocity_noise_m_s: float
    attitude_noise_rad: float
    attitude_roll_noise_rad: float
    attitude_drift_rad: float
    attitude_drift_time_s: float
    omega_noise_rad_s: float
    gyro_bias_rad_s: float
    position_bias_m: float
    attitude_bias_rad: float
    camera_turn_rad: float
    camera_shift_m: float
    camera_focal_share: float
    camera_centre_px: float

    @property
    def exact_odometry(self) -> bool:
        """Whether odometry has no errors."""
        names = (f.name for f in fields(self) if not f.name.startswith("camera_"))
        return not any(getattr(self, name) for name in names if not name.endswith("_time_s"))

    @property
    def uncertain_mounting(self) -> bool:
        """Whether mounting, lens position or focal length of the cameras are uncertain."""
        return any((self.camera_turn_rad, self.camera_shift_m, self.camera_focal_share))


class NavigationSection(Section):
    """Errors of the chasers' odometry and cameras, known to the flight software: standard
    deviations per axis. A figure that is not given is that of the grade ([world.md](world.md))."""

    grade: Literal["exact", "lab", "orbit", "poor"] = Field(
        default="lab",
        description="`exact`: no errors. `lab`: motion capture. `orbit`: differential GNSS, star "
        "tracker and gyro. `poor`: three times `orbit`.",
    )
    position_noise_m: Metres | None = Field(
        default=None, description="White noise of the position (WRF), m, drawn each tick."
    )
    position_drift_m: Metres | None = Field(
        default=None,
        description="Time-correlated error of the position (WRF; Gauss-Markov process), m.",
    )
    position_drift_time_s: Duration | None = Field(
        default=None, description="Correlation time of `position_drift_m`, s. Without it: 100."
    )
    velocity_noise_m_s: MetresPerSecond | None = Field(
        default=None, description="White noise of the velocity (WRF), m/s, drawn each tick."
    )
    attitude_noise_deg: Degrees | None = Field(
        default=None,
        description="White noise of the attitude about y and z (rotation vector, CRF), degrees, "
        "drawn each tick.",
    )
    attitude_roll_noise_deg: Degrees | None = Field(
        default=None,
        description="White noise of the attitude about x (CRF), degrees, drawn each tick.",
    )
    attitude_drift_deg: Degrees | None = Field(
        default=None,
        description="Time-correlated error of the attitude (rotation vector, CRF; Gauss-Markov "
        "process), degrees.",
    )
    attitude_drift_time_s: Duration | None = Field(
        default=None, description="Correlation time of `attitude_drift_deg`, s. Without it: 300."
    )
    omega_noise_deg_s: Degrees | None = Field(
        default=None,
        description="White noise of the angular velocity (CRF), degrees/s, drawn each tick.",
    )
    gyro_bias_deg_s: Degrees | None = Field(
        default=None,
        description="Constant offset of the angular velocity (CRF), degrees/s, drawn once per "
        "mission and chaser.",
    )
    position_bias_m: Metres | None = Field(
        default=None,
        description="Constant offset of the position (WRF), m, drawn once per mission and chaser.",
    )
    attitude_bias_deg: Degrees | None = Field(
        default=None,
        description="Constant offset of the attitude (rotation vector, CRF), degrees, drawn once "
        "per mission and chaser.",
    )
    camera_turn_deg: Degrees | None = Field(
        default=None,
        description="Rotation of each camera from its calibrated mounting (rotation vector, "
        "CRF), degrees.",
    )
    camera_shift_m: Metres | None = Field(
        default=None, description="Shift of each camera from its calibrated position (CRF), m."
    )
    camera_focal_share: FocalShare | None = Field(
        default=None, description="Relative error of each camera's focal length."
    )
    camera_centre_px: OffsetPixels | None = Field(
        default=None, description="Error of each camera's principal point, pixels."
    )

    def _figure(self, key: str) -> float:
        given: float | None = getattr(self, key)
        return GRADES[self.grade].get(key, DRIFT_TIMES.get(key, 0.0)) if given is None else given

    def errors(self) -> NavigationErrors:
        """Return all figures in SI units and radians."""
        resolved: dict[str, float] = {}
        for key in (k for k in NavigationSection.model_fields if k != "grade"):
            value = self._figure(key)
            resolved[key.replace("_deg", "_rad")] = math.radians(value) if "_deg" in key else value
        return NavigationErrors(**resolved)
