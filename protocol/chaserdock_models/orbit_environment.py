# SPDX-License-Identifier: Apache-2.0
"""Environment of an orbit: direction and eclipse of the Sun, and drag. Vectors are in ECI
(orbit.py).
"""

from __future__ import annotations

import math
from datetime import UTC, datetime

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Array
from .orbit import EARTH_RADIUS_M

EARTH_RATE_RAD_S = 7.2921159e-5  # sidereal rotation, WGS 84
_AU_M = 1.495978707e11  # IAU 2012, resolution B2
_SUN_RADIUS_M = 6.957e8  # IAU 2015, resolution B3
_J2000 = datetime(2000, 1, 1, 12, tzinfo=UTC)
# Altitude, km; density there, kg/m^3; scale height, km. Vallado, 4th edition, table 8-4.
_ATMOSPHERE = (
    (100.0, 5.297e-07, 5.877),
    (110.0, 9.661e-08, 7.263),
    (120.0, 2.438e-08, 9.473),
    (130.0, 8.484e-09, 12.636),
    (140.0, 3.845e-09, 16.149),
    (150.0, 2.070e-09, 22.523),
    (180.0, 5.464e-10, 29.740),
    (200.0, 2.789e-10, 37.105),
    (250.0, 7.248e-11, 45.546),
    (300.0, 2.418e-11, 53.628),
    (350.0, 9.518e-12, 53.298),
    (400.0, 3.725e-12, 58.515),
    (450.0, 1.585e-12, 60.828),
    (500.0, 6.967e-13, 63.822),
    (600.0, 1.454e-13, 71.835),
    (700.0, 3.614e-14, 88.667),
    (800.0, 1.170e-14, 124.64),
    (900.0, 5.245e-15, 181.05),
    (1000.0, 3.019e-15, 268.00),
)


def sun_position(when: datetime) -> Array:
    """Return the Sun's position (3,), m, to 0.01 degrees between 1950 and 2050 (Vallado, algorithm
    29).

    ``when`` carries a time zone.
    """
    centuries = (when - _J2000).total_seconds() / 86400.0 / 36525.0
    anomaly = math.radians(357.5291092 + 35999.05034 * centuries)
    longitude = math.radians(
        280.460
        + 36000.771 * centuries
        + 1.914666471 * math.sin(anomaly)
        + 0.019994643 * math.sin(2.0 * anomaly)
    )
    distance_m = _AU_M * (
        1.000140612 - 0.016708617 * math.cos(anomaly) - 0.000139589 * math.cos(2.0 * anomaly)
    )
    tilt = math.radians(23.439291 - 0.0130042 * centuries)
    sine = math.sin(longitude)
    return distance_m * np.array(
        [math.cos(longitude), math.cos(tilt) * sine, math.sin(tilt) * sine]
    )


def sunlit_share(position_m: ArrayLike, sun_m: ArrayLike) -> float:
    """Return the share of the Sun's disc, 0 to 1, that the Earth leaves visible from a position
    outside it.

    Discs of the Sun and of a spherical Earth (Montenbruck and Gill, Satellite Orbits, section
    3.4.2).
    """
    position, sun = np.asarray(position_m, dtype=float), np.asarray(sun_m, dtype=float)
    to_sun = sun - position
    r, d = float(np.linalg.norm(position)), float(np.linalg.norm(to_sun))
    a = math.asin(min(1.0, _SUN_RADIUS_M / d))
    b = math.asin(min(1.0, EARTH_RADIUS_M / r))
    c = math.acos(max(-1.0, min(1.0, -float(position @ to_sun) / (r * d))))
    if c >= a + b:
        return 1.0
    if c <= b - a:
        return 0.0
    x = (c * c + a * a - b * b) / (2.0 * c)
    y = math.sqrt(max(0.0, a * a - x * x))
    overlap = a * a * math.acos(x / a) + b * b * math.acos((c - x) / b) - c * y
    return 1.0 - overlap / (math.pi * a * a)


def density(altitude_m: float) -> float:
    """Return the density of a mean atmosphere, kg/m^3, at 100 km and above (Vallado, table 8-4)."""
    km = altitude_m / 1e3
    base, at_base, scale = next(
        (row for row in reversed(_ATMOSPHERE) if row[0] <= km), _ATMOSPHERE[0]
    )
    return at_base * math.exp(-(km - base) / scale)


def drag(position_m: Array, velocity_m_s: Array, ballistic_coefficient_kg_m2: float) -> Array:
    """Return the acceleration (3,) of drag in an atmosphere that turns with the Earth.

    ``ballistic_coefficient_kg_m2``: mass over drag coefficient and area.
    """
    wind = EARTH_RATE_RAD_S * np.array([-position_m[1], position_m[0], 0.0])
    relative = velocity_m_s - wind
    rho = density(float(np.linalg.norm(position_m)) - EARTH_RADIUS_M)
    return -0.5 * rho * float(np.linalg.norm(relative)) / ballistic_coefficient_kg_m2 * relative
