# SPDX-License-Identifier: Apache-2.0
"""Parameters of the error-state Kalman filter."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import numpy as np
from chaserdock_models.arrays import Matrix3, Vector3

Matrix9 = tuple[tuple[float, ...], ...]
BodyPrior = tuple[Matrix3, Vector3, Matrix9]
"""Inertia, centre of mass and their covariance, as in ``MekfParameters``."""
MODELS = ("constant_rates", "torque_free")
GATE_CHI_SQUARE = 27.85634123601289
"""0.9999 quantile of the chi-square distribution with 6 degrees of freedom (tests compare with
SciPy).
"""


@dataclass(frozen=True)
class MekfParameters:
    """Parameters of ``Mekf``; docs/estimation.md gives the reasons for the values.

    motion_model: "constant_rates", or "torque_free" with ``inertia_ratios``, the target's inertia tensor in TRF (rows)
        up to a common factor.
    centre_of_mass_trf_m: the target's centre of mass in TRF.
    body_covariance: covariance (9, 9), rows, of its centre of mass (m) and of the elements xx, yy, zz, xy, xz, yz of
        ``inertia_ratios``, of which the joint filter makes states. Empty: both are exact.
    acceleration_noise_m_s2_sqrt_hz, angular_noise_rad_s2_sqrt_hz: square roots of the spectral densities of white
        (angular) acceleration. The true rates are constant, so these values set the filter's memory: larger values
        follow changes faster, smaller values smooth more.
    floor_*: white noise added to every measurement against overconfident covariances.
    bias_*: standard deviation of each camera's calibration error (mounting, optical centre, focal length; see
        ``camera_calibration``). The errors are estimated as first-order Gauss-Markov processes with the time constant
        ``bias_time_constant_s``. Zero switches an error off.
    considered_ratio: ratio of the measurement error that does not average out while the view stays the same, to the
        measurement's sigma. This error is considered, not estimated (Schmidt): reported covariances contain it.
    initial_*: standard deviation of the unknown rates at the first measurement.
    single_marker_scale: factor on the sigma of a first pose from one marker.
    reinitialised_*: standard deviation added to the rates, whose values are kept, at a re-initialization.
    gate_chi_square: bound of the normalized innovation squared (6 degrees of freedom).
    sustained_rejections: this many rejections in a row are reported; with most cameras they cause a
        re-initialization.
    recent_s: age up to which a camera's latest measurement counts in comparisons between cameras.
    ambiguity_log_odds, ambiguity_timeout_s: the less likely of two hypotheses after an ambiguous start is dropped at
        these log odds, or after this time.
    tracking_s: age of the last accepted measurement beyond which the status is "predicting".
    lost_*: standard deviations (largest axis of position and of attitude) beyond which the status is "lost".
    buffer_s: measurements up to this much older than the newest exposure are inserted at their exposure time.

    Raises ValueError for values out of range and for an unknown motion model.
    """

    motion_model: str = "constant_rates"
    inertia_ratios: Matrix3 = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    centre_of_mass_trf_m: Vector3 = (0.0, 0.0, 0.0)
    body_covariance: Matrix9 = ()
    acceleration_noise_m_s2_sqrt_hz: float = 1e-4
    angular_noise_rad_s2_sqrt_hz: float = 1e-4
    floor_position_m: float = 2e-4
    floor_attitude_rad: float = math.radians(0.02)
    bias_position_m: float = 2e-3
    bias_attitude_rad: float = math.radians(0.3)
    bias_focal_share: float = 1e-3
    bias_time_constant_s: float = 3600.0
    considered_ratio: float = 1.5
    initial_velocity_m_s: float = 0.1
    initial_omega_rad_s: float = 0.2
    single_marker_scale: float = 3.0
    reinitialised_velocity_m_s: float = 0.03
    reinitialised_omega_rad_s: float = 0.06
    gate_chi_square: float = GATE_CHI_SQUARE
    sustained_rejections: int = 10
    recent_s: float = 0.5
    ambiguity_log_odds: float = 10.0
    ambiguity_timeout_s: float = 5.0
    tracking_s: float = 0.25
    lost_position_m: float = 0.2
    lost_attitude_rad: float = math.radians(15.0)
    buffer_s: float = 1.0

    def __post_init__(self) -> None:
        if self.motion_model not in MODELS:
            raise ValueError(
                f"unknown motion model {self.motion_model!r}; known: {', '.join(MODELS)}"
            )
        may_be_zero = (
            "floor_position_m",
            "floor_attitude_rad",
            "bias_position_m",
            "bias_attitude_rad",
        )
        may_be_zero += ("bias_focal_share", "considered_ratio")
        may_be_zero += (
            "acceleration_noise_m_s2_sqrt_hz",
            "angular_noise_rad_s2_sqrt_hz",
            "buffer_s",
        )
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, float | int):
                low_ok = value >= 0.0 if field.name in may_be_zero else value > 0.0
                if not (low_ok and math.isfinite(value)):
                    raise ValueError(f"{field.name} is out of range: {value}")
        if not all(math.isfinite(x) for x in self.centre_of_mass_trf_m):
            raise ValueError(f"centre_of_mass_trf_m is out of range: {self.centre_of_mass_trf_m}")
        if self.single_marker_scale < 1.0:
            raise ValueError(f"single_marker_scale must be at least 1: {self.single_marker_scale}")
        inertia = np.array(self.inertia_ratios, dtype=float)
        if inertia.shape != (3, 3) or not np.allclose(inertia, inertia.T):
            raise ValueError("inertia_ratios must be a symmetric 3 x 3 tensor")
        principal = np.linalg.eigvalsh(inertia)
        if principal[0] <= 0.0 or principal[2] > (principal[0] + principal[1]) * (1.0 + 1e-9):
            raise ValueError(
                "inertia_ratios: principal moments of inertia violate the triangle inequality"
            )

    @property
    def body_prior(self) -> BodyPrior:
        """Return what is known of the target's body without measurements."""
        return self.inertia_ratios, self.centre_of_mass_trf_m, self.body_covariance

    @property
    def has_bias(self) -> bool:
        """Whether camera calibration errors are estimated."""
        return max(self.bias_position_m, self.bias_attitude_rad, self.bias_focal_share) > 0.0
