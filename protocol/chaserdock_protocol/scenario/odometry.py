"""The scenario's section of the chasers' own odometry."""

from __future__ import annotations

from .fields import NotNegative, Section


class OdometrySection(Section):
    """One sigma, an axis, of how far the chasers' odometry is from the truth: ``*_noise_*`` anew each tick, ``*_bias_*``
    once a flight (attitude in CRF). All 0, the default: known exactly, as the paper assumes."""

    position_noise_m: NotNegative = 0.0
    velocity_noise_m_s: NotNegative = 0.0
    attitude_noise_deg: NotNegative = 0.0
    omega_noise_deg_s: NotNegative = 0.0
    position_bias_m: NotNegative = 0.0
    attitude_bias_deg: NotNegative = 0.0

    @property
    def any(self) -> bool:
        return any(float(v) > 0.0 for v in dict(self).values())
