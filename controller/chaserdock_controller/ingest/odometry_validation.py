# SPDX-License-Identifier: Apache-2.0
"""Validates odometry: rejects states that no rigid body can have, removes jumps that no chaser can
make. No I/O.

A chaser whose odometry jumps would fly to the wrong place, possibly through the target. A jump is
therefore removed by a correction that continues the state before it; a jump back removes the
correction. If sightings contradict the state before the jump and have never confirmed it, the jump
may lead to the truth and is accepted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import msgspec
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.codec import vector
from chaserdock_protocol.extrapolation import extrapolate
from chaserdock_protocol.messages import Level, Odometry
from chaserdock_protocol.scenario import FlightScenario

# Change of position (m) and attitude between two ticks, beyond motion and stated noise, up to which
# odometry has not jumped. Larger than steps of motion capture, smaller than errors that endanger a
# docking.
PLAUSIBLE_M = 0.02
PLAUSIBLE_RAD = math.radians(2.0)
LONGEST_S = 1.0
"""After a longer gap every state is accepted."""
UNIT_WITHIN = 0.1
"""Deviation of a quaternion's length from 1 that passes as its sender's rounding."""
_ROUNDING = 1e-9
"""Asymmetry and negative eigenvalues of a covariance, as a share of its largest element, that pass
as rounding.
"""

COVARIANCES = (
    "position_covariance_m2",
    "velocity_covariance_m2_s2",
    "attitude_covariance_rad2",
    "omega_covariance_rad2_s2",
)
"""Covariance fields of ``Odometry``."""


def why_invalid(odometry: Odometry) -> str:
    """Return why an odometry is not the state of a rigid body with covariances; empty if it is."""
    for name in ("position_m", "velocity_m_s", "q_wxyz", "omega_rad_s"):
        if not all(map(math.isfinite, getattr(odometry, name))):
            return f"{name} holds a value that is not finite"
    length = math.hypot(*odometry.q_wxyz)
    if abs(length - 1.0) > UNIT_WITHIN:
        return f"q_wxyz has length {length:.3g}, not 1"
    o = odometry
    return _why_no_covariances(
        o.position_covariance_m2,
        o.velocity_covariance_m2_s2,
        o.attitude_covariance_rad2,
        o.omega_covariance_rad2_s2,
    )


@lru_cache(maxsize=64)  # sensors mostly state the same covariances in every message
def _why_no_covariances(*covariances: tuple[float, ...]) -> str:
    """Return which of ``COVARIANCES`` is not a covariance; empty if all are."""
    named = zip(COVARIANCES, covariances, strict=True)
    return next(
        (f"{name} is not a covariance" for name, elements in named if not _is_covariance(elements)),
        "",
    )


def _is_covariance(elements: tuple[float, ...]) -> bool:
    """Return whether elements (9,) form a symmetric positive semi-definite (3, 3) matrix, up to
    rounding.
    """
    matrix = np.array(elements).reshape(3, 3)
    largest = np.abs(matrix).max()
    if not math.isfinite(largest) or np.abs(matrix - matrix.T).max() > _ROUNDING * largest:
        return False
    return bool(np.linalg.eigvalsh(matrix)[0] >= -_ROUNDING * largest)


@dataclass
class Known:
    """Last corrected odometry of a chaser, with the correction in use: offset (3,) in WRF, rotation
    (4,) in CRF.
    """

    last: Odometry
    correction: tuple[Array, Array] | None = None


class OdometryValidation:
    """Removes jumps from the odometry of one chaser."""

    def __init__(self, scenario: FlightScenario) -> None:
        body, errors = scenario.chaser, scenario.navigation.errors()
        # Six sigma of the difference of two.
        self._noise_m = 6 * math.sqrt(2.0) * errors.position_noise_m
        self._noise_rad = (
            6 * math.sqrt(2.0) * max(errors.attitude_noise_rad, errors.attitude_roll_noise_rad)
        )
        self._velocity_noise_m_s = 6 * errors.velocity_noise_m_s
        self._acceleration_m_s2 = math.sqrt(3.0) * body.force_max_N / body.mass_kg
        self._alpha_rad_s2 = math.sqrt(3.0) * body.torque_max_N_m / min(body.inertia)
        self.known: Known | None = None

    def update(
        self, odometry: Odometry, doubtful: bool = False
    ) -> tuple[Odometry, list[tuple[Level, str]]]:
        """Return the chaser's next odometry with jumps removed, and the events to log.
        ``doubtful``: its odometry before may be wrong.
        """
        i, known = odometry.chaser, self.known
        gap_s = 0.0 if known is None else (odometry.sim_time_ns - known.last.sim_time_ns) / 1e9
        if known is None or not 0.0 < gap_s <= LONGEST_S:
            self.known = Known(odometry)
            return odometry, []
        expected = extrapolate(known.last, odometry.tick, odometry.sim_time_ns)
        corrected = odometry if known.correction is None else _remove(odometry, *known.correction)
        if self._is_plausible(corrected, expected, gap_s):
            known.last = corrected
            return corrected, []
        if known.correction is not None and self._is_plausible(odometry, expected, gap_s):
            self.known = Known(odometry)
            return odometry, [("info", f"chaser {i}: odometry jumped back; correction removed")]
        jump_m, jump_rad = _distance(corrected, expected)
        jump = f"jumped by {jump_m * 1e3:.0f} mm, {math.degrees(jump_rad):.1f} deg"
        if doubtful:
            self.known = Known(odometry)
            text = f"chaser {i}: odometry {jump}; accepted, as its sightings contradicted it before"
            return odometry, [("warning", text)]
        offset = np.subtract(odometry.position_m, expected.position_m)
        rotation = rotations.multiply(rotations.conjugate(expected.q_wxyz), odometry.q_wxyz)
        self.known = Known(_remove(odometry, offset, rotation), (offset, rotation))
        text = f"chaser {i}: odometry {jump}, more than the chaser can have moved; jump removed"
        return self.known.last, [("warning", text)]

    def _is_plausible(self, odometry: Odometry, expected: Odometry, gap_s: float) -> bool:
        limit_m = (
            PLAUSIBLE_M
            + self._noise_m
            + self._velocity_noise_m_s * gap_s
            + self._acceleration_m_s2 * gap_s**2
        )
        limit_rad = PLAUSIBLE_RAD + self._noise_rad + self._alpha_rad_s2 * gap_s**2
        jump_m, jump_rad = _distance(odometry, expected)
        return jump_m <= limit_m and jump_rad <= limit_rad


def _distance(a: Odometry, b: Odometry) -> tuple[float, float]:
    return math.dist(a.position_m, b.position_m), float(rotations.angle_between(a.q_wxyz, b.q_wxyz))


def _remove(odometry: Odometry, offset_m: Array, rotation: Array) -> Odometry:
    """Return odometry with an offset (WRF) and a rotation (4,) (CRF) subtracted."""
    q = rotations.multiply(odometry.q_wxyz, rotations.conjugate(rotation))
    return msgspec.structs.replace(
        odometry,
        position_m=vector(np.subtract(odometry.position_m, offset_m)),
        q_wxyz=vector(rotations.normalize(q)),
    )
