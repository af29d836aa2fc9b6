"""Parameters of the error-state filter, and the chi-square quantile its gates use."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from functools import lru_cache

import numpy as np

from .motion_models import MODELS

_Row = tuple[float, float, float]


@lru_cache(maxsize=64)
def chi_square_6(probability: float) -> float:
    """The value that a chi-square variable of 6 degrees of freedom stays below with ``probability``.

    Its distribution function is 1 - exp(-x/2) (1 + x/2 + x^2/8), inverted here by bisection. Raises
    ValueError unless 0 < probability < 1.
    """
    if not 0.0 < probability < 1.0:
        raise ValueError(f"probability must lie between 0 and 1, got {probability}")
    low, high = 0.0, 200.0
    for _ in range(80):
        x = 0.5 * (low + high)
        if 1.0 - math.exp(-x / 2.0) * (1.0 + x / 2.0 + x * x / 8.0) < probability:
            low = x
        else:
            high = x
    return high


@dataclass(frozen=True)
class MekfParameters:
    """All tunables of ``Mekf``; the reasons for the values are in docs/fusion.md.

    motion_model: "constant_rates", or "torque_free" with ``inertia_ratios``: the target's inertia
        tensor in TRF (rows), to any common factor.
    centre_of_mass_trf_m: where the target's centre of mass is; TRF's origin circles round it.
    acceleration_noise_m_s2_sqrt_hz, angular_noise_rad_s2_sqrt_hz: square roots of the spectral
        densities of white (angular) acceleration. The target's rates are truly constant, so these only
        say how long the filter remembers: larger follows surprises faster, smaller is smoother.
    floor_*: white noise added to every measurement, against overconfident covariances.
    bias_*: one sigma of each camera's calibration error (mounting, lens position, focal length; ``eyes``), constant in
        its own axes but for a slow change with the time constant, estimated with the target (first-order
        Gauss-Markov). Zero sigma switches one off.
    frozen_share: what of a measurement's sigma does not average out while the view stays the same. It is not
        estimated but considered: published covariances contain it.
    initial_*: sigma of the unknown rates at the first sight.
    single_marker_scale: factor on the sigma of a first pose that rests on one marker.
    reinitialised_*: sigma added to the rates, whose values are kept, at a re-initialisation.
    gate_probability: of the chi-square gate (6 degrees of freedom).
    sustained_rejections: so many in a row are reported and, if most cameras see them, re-initialise.
    recent_s: a camera's latest measurement counts as its present opinion for this long.
    ambiguity_log_odds, ambiguity_timeout_s: the less likely of two filters after an ambiguous start is
        dropped at these log odds, or after this time.
    tracking_s: without an accepted measurement for longer the status is "predicting".
    lost_*: the status is "lost" beyond these sigmas (largest axis of position and of attitude).
    buffer_s: measurements up to this much older than the newest exposure are put in at their time.

    Raises ValueError for values out of range and for an unknown motion model.
    """

    motion_model: str = "constant_rates"
    inertia_ratios: tuple[_Row, _Row, _Row] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    centre_of_mass_trf_m: _Row = (0.0, 0.0, 0.0)
    acceleration_noise_m_s2_sqrt_hz: float = 1e-4
    angular_noise_rad_s2_sqrt_hz: float = 1e-4
    floor_position_m: float = 2e-4
    floor_attitude_rad: float = math.radians(0.02)
    bias_position_m: float = 2e-3
    bias_attitude_rad: float = math.radians(0.3)
    bias_focal_share: float = 1e-3
    bias_time_constant_s: float = 3600.0
    frozen_share: float = 1.5
    initial_velocity_m_s: float = 0.1
    initial_omega_rad_s: float = 0.2
    single_marker_scale: float = 3.0
    reinitialised_velocity_m_s: float = 0.03
    reinitialised_omega_rad_s: float = 0.06
    gate_probability: float = 0.9999
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
            raise ValueError(f"unknown motion model {self.motion_model!r}; known: {', '.join(MODELS)}")
        may_be_zero = ("floor_position_m", "floor_attitude_rad", "bias_position_m", "bias_attitude_rad")
        may_be_zero += ("bias_focal_share", "frozen_share")
        may_be_zero += ("acceleration_noise_m_s2_sqrt_hz", "angular_noise_rad_s2_sqrt_hz", "buffer_s")
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, float | int):
                low_ok = value >= 0.0 if field.name in may_be_zero else value > 0.0
                if not (low_ok and math.isfinite(value)):
                    raise ValueError(f"{field.name} is out of range: {value}")
        if not all(math.isfinite(x) for x in self.centre_of_mass_trf_m):
            raise ValueError(f"centre_of_mass_trf_m is out of range: {self.centre_of_mass_trf_m}")
        if not 0.0 < self.gate_probability < 1.0:
            raise ValueError(f"gate_probability must lie between 0 and 1: {self.gate_probability}")
        if self.single_marker_scale < 1.0:
            raise ValueError(f"single_marker_scale must be at least 1: {self.single_marker_scale}")
        inertia = np.array(self.inertia_ratios, dtype=float)
        if inertia.shape != (3, 3) or not np.allclose(inertia, inertia.T):
            raise ValueError("inertia_ratios must be a symmetric 3 x 3 tensor")
        principal = np.linalg.eigvalsh(inertia)
        if principal[0] <= 0.0 or principal[2] > (principal[0] + principal[1]) * (1.0 + 1e-9):
            raise ValueError("inertia_ratios: no rigid body has these principal moments of inertia")

    @property
    def has_bias(self) -> bool:
        """Whether camera biases are estimated."""
        return max(self.bias_position_m, self.bias_attitude_rad, self.bias_focal_share) > 0.0
