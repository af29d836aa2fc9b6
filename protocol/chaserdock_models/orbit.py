# SPDX-License-Identifier: Apache-2.0
"""Orbits about the Earth: elements, two-body gravity with J2, and the Hill frame of an orbit.

Positions and velocities are in ECI: inertial axes at the Earth's centre, Z along its pole, X to the
vernal equinox. The Hill frame (also LVLH or RSW) moves with the orbit: X radial, away from the
Earth; Z along the angular momentum; Y completes the right-handed frame, along the motion on a
circular orbit. Sources: Vallado, Fundamentals of Astrodynamics and Applications, 4th edition,
sections 2.6 and 8.6; Alfriend et al., Spacecraft Formation Flying, section 4.1.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Array
from .rigid_body import rk4_step
from .scalar_rotations import cross_components

EARTH_MU_M3_S2 = 3.986004415e14  # EGM96
EARTH_RADIUS_M = 6378136.3  # EGM96
EARTH_J2 = 1.0826269e-3
"""Gravitational parameter, equatorial radius and second zonal coefficient: EGM96."""

MAX_STEP_S = 10.0
"""Longest integration step: RK4 then errs by about 1 cm per low orbit, and by micrometres relative
to it at 100 m.
"""

Scalars3 = tuple[float, float, float]


@dataclass(frozen=True)
class OrbitalElements:
    """Osculating Keplerian elements, m and radians: a bound orbit, 0 <= eccentricity < 1."""

    semi_major_axis_m: float
    eccentricity: float = 0.0
    inclination_rad: float = 0.0
    ascending_node_rad: float = 0.0
    perigee_argument_rad: float = 0.0
    true_anomaly_rad: float = 0.0

    @property
    def perigee_radius_m(self) -> float:
        return self.semi_major_axis_m * (1.0 - self.eccentricity)

    @property
    def mean_motion_rad_s(self) -> float:
        return math.sqrt(EARTH_MU_M3_S2 / self.semi_major_axis_m**3)

    @property
    def period_s(self) -> float:
        return 2.0 * math.pi / self.mean_motion_rad_s


@dataclass(frozen=True)
class OrbitState:
    """Position (3,) and velocity (3,) in ECI."""

    position_m: Array
    velocity_m_s: Array


def state_of(elements: OrbitalElements) -> OrbitState:
    """Return position and velocity of a body with these elements (Vallado, algorithm 10)."""
    e, nu = elements.eccentricity, elements.true_anomaly_rad
    p = elements.semi_major_axis_m * (1.0 - e * e)
    cos_nu, sin_nu = math.cos(nu), math.sin(nu)
    in_plane = p / (1.0 + e * cos_nu) * np.array([cos_nu, sin_nu, 0.0])
    speed = math.sqrt(EARTH_MU_M3_S2 / p) * np.array([-sin_nu, e + cos_nu, 0.0])
    turn = (
        _about_z(elements.ascending_node_rad)
        @ _about_x(elements.inclination_rad)
        @ _about_z(elements.perigee_argument_rad)
    )
    return OrbitState(turn @ in_plane, turn @ speed)


def gravity(position_m: Array, j2: float = EARTH_J2) -> Array:
    """Return the acceleration (3,) of gravity at a position (3,), ECI. ``j2`` = 0: of a point
    mass.
    """
    r2 = float(position_m @ position_m)
    r = math.sqrt(r2)
    two_body = -EARTH_MU_M3_S2 / (r2 * r) * position_m
    if not j2:
        return two_body
    z = float(position_m[2])
    k = -1.5 * j2 * EARTH_MU_M3_S2 * EARTH_RADIUS_M**2 / (r2 * r2 * r)
    oblate = k * (1.0 - 5.0 * z * z / r2) * position_m
    oblate[2] += 2.0 * k * z
    return two_body + oblate


def propagate(state: OrbitState, duration_s: float, j2: float = EARTH_J2) -> OrbitState:
    """Return an orbit's state after ``duration_s`` (also negative), integrated by RK4."""
    y = np.concatenate([state.position_m, state.velocity_m_s])
    count = max(1, math.ceil(abs(duration_s) / MAX_STEP_S))
    for _ in range(count):
        y = rk4_step(lambda s: np.concatenate([s[3:], gravity(s[:3], j2)]), y, duration_s / count)
    return OrbitState(y[:3], y[3:])


@dataclass(frozen=True)
class HillFrame:
    """Hill frame of an orbit at one moment.

    ``axes``: (3, 3), rows are its axes in ECI. ``rate_rad_s``, ``rate_change_rad_s2``: (3,) its
    angular velocity against inertial space and the derivative of that, in its own axes. ``pole``:
    (3,) the Earth's pole in its axes. ``speed_m_s``: (3,) velocity of the origin in its axes.
    """

    axes: Array
    radius_m: float
    speed_m_s: Scalars3
    rate_rad_s: Scalars3
    rate_change_rad_s2: Scalars3
    pole: Scalars3
    j2: float


def hill_frame(state: OrbitState, j2: float = EARTH_J2) -> HillFrame:
    """Return the Hill frame of an orbit under two-body gravity and J2.

    With the perturbing acceleration (f_r, f_t, f_h): rate = (r f_h / h, 0, h / r^2), h' = r f_t
    (Gauss's equations).
    """
    position, velocity = state.position_m, state.velocity_m_s
    r = float(np.linalg.norm(position))
    momentum = np.array(cross_components(*position.tolist(), *velocity.tolist()))
    h = float(np.linalg.norm(momentum))
    radial, normal = position / r, momentum / h
    axes = np.stack(
        [radial, np.array(cross_components(*normal.tolist(), *radial.tolist())), normal]
    )
    v_r, v_t, _ = (axes @ velocity).tolist()
    _, f_t, f_h = (axes @ gravity(position, j2)).tolist() if j2 else (0.0, 0.0, 0.0)
    rate_r, rate_n = r * f_h / h, h / (r * r)
    # f_h is along an axis that turns itself: d(f . n) = f' . n + f . (rate x n), and rate x n =
    # -rate_r y.
    f_h_change = float(normal @ _j2_change(position, velocity, j2)) - rate_r * f_t
    h_change = r * f_t
    rate_r_change = (v_r * f_h + r * f_h_change) / h - r * f_h * h_change / (h * h)
    rate_n_change = h_change / (r * r) - 2.0 * h * v_r / r**3
    x, y, z = axes[:, 2].tolist()
    return HillFrame(
        axes,
        r,
        (v_r, v_t, 0.0),
        (rate_r, 0.0, rate_n),
        (rate_r_change, 0.0, rate_n_change),
        (x, y, z),
        j2,
    )


def _j2_change(position_m: Array, velocity_m_s: Array, j2: float) -> Array:
    """Return the rate of change (3,) of the acceleration of J2 along an orbit."""
    r2, s = float(position_m @ position_m), float(position_m @ velocity_m_s)
    z, v_z = float(position_m[2]), float(velocity_m_s[2])
    k = -1.5 * j2 * EARTH_MU_M3_S2 * EARTH_RADIUS_M**2 / r2**2.5
    change = k * (-5.0 * s - 10.0 * z * v_z + 35.0 * z * z * s / r2) / r2 * position_m
    change += k * (1.0 - 5.0 * z * z / r2) * velocity_m_s
    change[2] += 2.0 * k * (v_z - 5.0 * z * s / r2)
    return change


def to_eci(
    state: OrbitState, position_m: ArrayLike, velocity_m_s: ArrayLike, j2: float = EARTH_J2
) -> OrbitState:
    """Return the ECI state of a body at a position (3,) and velocity (3,) in an orbit's Hill
    frame.
    """
    frame = hill_frame(state, j2)
    rho, v = np.asarray(position_m, dtype=float), np.asarray(velocity_m_s, dtype=float)
    moving = v + np.cross(frame.rate_rad_s, rho)
    return OrbitState(state.position_m + rho @ frame.axes, state.velocity_m_s + moving @ frame.axes)


def from_eci(state: OrbitState, body: OrbitState, j2: float = EARTH_J2) -> tuple[Array, Array]:
    """Return position (3,) and velocity (3,) of a body in an orbit's Hill frame; inverse of
    ``to_eci``.
    """
    frame = hill_frame(state, j2)
    rho = frame.axes @ (body.position_m - state.position_m)
    v = frame.axes @ (body.velocity_m_s - state.velocity_m_s)
    return rho, v - np.cross(frame.rate_rad_s, rho)


def _about_z(angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def _about_x(angle: float) -> Array:
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
