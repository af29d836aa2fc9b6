# SPDX-License-Identifier: Apache-2.0
"""Scenario section ``[odometry]``: errors of the chasers' own odometry."""

from __future__ import annotations

from pydantic import Field

from .fields import NotNegative, Section


class OdometrySection(Section):
    """Errors of the chasers' odometry, one standard deviation per axis. All 0, the default, is perfect odometry."""

    position_noise_m: NotNegative = Field(
        default=0.0, description="White noise of the position (WRF), m, drawn each tick."
    )
    velocity_noise_m_s: NotNegative = Field(
        default=0.0, description="White noise of the velocity (WRF), m/s, drawn each tick."
    )
    attitude_noise_deg: NotNegative = Field(
        default=0.0,
        description="White noise of the attitude (rotation vector, CRF), degrees, drawn each tick.",
    )
    omega_noise_deg_s: NotNegative = Field(
        default=0.0, description="White noise of the angular velocity (CRF), degrees/s, drawn each tick."
    )
    position_bias_m: NotNegative = Field(
        default=0.0,
        description="Constant offset of the position (WRF), m, drawn once per mission and chaser.",
    )
    attitude_bias_deg: NotNegative = Field(
        default=0.0,
        description="Constant offset of the attitude (rotation vector, CRF), degrees, drawn once per mission and chaser.",
    )

    @property
    def any(self) -> bool:
        return any(float(v) > 0.0 for v in dict(self).values())
