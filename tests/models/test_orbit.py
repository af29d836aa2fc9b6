# SPDX-License-Identifier: Apache-2.0
"""Orbits, relative motion in the Hill frame, and the environment of an orbit."""

from __future__ import annotations

import itertools
import json
import math
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.orbit import (
    EARTH_MU_M3_S2,
    EARTH_RADIUS_M,
    OrbitalElements,
    from_eci,
    gravity,
    hill_frame,
    propagate,
    state_of,
    to_eci,
)
from chaserdock_models.orbit_environment import density, drag, sun_position, sunlit_share
from chaserdock_models.relative_motion import (
    cw_acceleration,
    cw_matrix,
    cw_transition,
    gravity_gradient,
    propagate_relative,
    relative_torque,
)
from chaserdock_models.rigid_body import rk4_step
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.linalg import expm

BASILISK = Path(__file__).parent / "basilisk_relative_orbit.json"

ELEMENTS = st.builds(
    OrbitalElements,
    semi_major_axis_m=st.floats(7.2e6, 4.2e7),
    eccentricity=st.floats(0.0, 0.1),
    inclination_rad=st.floats(0.0, math.pi),
    ascending_node_rad=st.floats(-3.0, 3.0),
    perigee_argument_rad=st.floats(-3.0, 3.0),
    true_anomaly_rad=st.floats(-3.0, 3.0),
)
OFFSETS = st.tuples(*[st.floats(-500.0, 500.0)] * 3)
SPEEDS = st.tuples(*[st.floats(-1.0, 1.0)] * 3)


@given(ELEMENTS)
def test_state_has_energy_momentum_and_eccentricity_of_its_elements(
    elements: OrbitalElements,
) -> None:
    state = state_of(elements)
    r, v, mu = state.position_m, state.velocity_m_s, EARTH_MU_M3_S2
    energy = v @ v / 2.0 - mu / np.linalg.norm(r)
    assert energy == pytest.approx(-mu / (2.0 * elements.semi_major_axis_m), rel=1e-10)
    momentum = np.cross(r, v)
    assert momentum[2] == pytest.approx(
        np.linalg.norm(momentum) * math.cos(elements.inclination_rad),
        abs=1e-9 * float(np.linalg.norm(momentum)),
    )
    eccentricity = np.cross(v, momentum) / mu - r / np.linalg.norm(r)
    assert np.linalg.norm(eccentricity) == pytest.approx(elements.eccentricity, abs=1e-9)
    assert r @ eccentricity == pytest.approx(
        np.linalg.norm(r) * elements.eccentricity * math.cos(elements.true_anomaly_rad), abs=1.0
    )


def test_kepler_orbit_closes_after_its_period() -> None:
    elements = OrbitalElements(7.5e6, 0.05, 0.9, 0.3, 0.2, 0.1)
    start = state_of(elements)
    end = propagate(start, elements.period_s, j2=0.0)
    assert end.position_m == pytest.approx(start.position_m, abs=0.02)


def test_j2_turns_the_node_at_the_secular_rate() -> None:
    # Vallado, equation 9-38: -3/2 J2 (R / p)^2 n cos i. Osculating and mean elements differ by a
    # share of J2.
    elements = OrbitalElements(7.0e6, 0.0, 0.9)
    end = propagate(state_of(elements), 3 * elements.period_s)
    momentum = np.cross(end.position_m, end.velocity_m_s)
    node = math.atan2(momentum[0], -momentum[1])
    expected = -1.5 * 1.0826269e-3 * (EARTH_RADIUS_M / 7.0e6) ** 2 * 2 * math.pi * 3 * math.cos(0.9)
    assert node == pytest.approx(expected, rel=0.01)


def test_gravity_is_the_gradient_of_its_potential() -> None:
    def potential(p: np.ndarray) -> float:
        r = np.linalg.norm(p)
        oblate = 1.0826269e-3 * (EARTH_RADIUS_M / r) ** 2 * (1.5 * (p[2] / r) ** 2 - 0.5)
        return float(EARTH_MU_M3_S2 / r * (1.0 - oblate))

    place = np.array([4.1e6, -3.3e6, 4.9e6])
    slope = [(potential(place + d) - potential(place - d)) / 200.0 for d in 100.0 * np.eye(3)]
    assert gravity(place) == pytest.approx(slope, rel=1e-7)


@given(ELEMENTS, OFFSETS, SPEEDS)
def test_hill_frame_conversion_is_invertible(
    elements: OrbitalElements, offset: tuple[float, ...], speed: tuple[float, ...]
) -> None:
    orbit = state_of(elements)
    position, velocity = from_eci(orbit, to_eci(orbit, offset, speed))
    assert position == pytest.approx(offset, abs=2e-8)
    assert velocity == pytest.approx(speed, abs=1e-10)


@given(ELEMENTS)
@settings(max_examples=10, deadline=None)
def test_hill_frame_rates_are_those_of_its_axes(elements: OrbitalElements) -> None:
    state = state_of(elements)
    frame, dt = hill_frame(state), 0.5
    before, after = (hill_frame(propagate(state, t)) for t in (-dt, dt))
    spin = (after.axes - before.axes) / (2 * dt) @ frame.axes.T
    n = frame.rate_rad_s[2]
    measured = np.array([spin[1, 2], spin[2, 0], spin[0, 1]])
    assert measured == pytest.approx(frame.rate_rad_s, abs=1e-6 * n)
    change = (np.array(after.rate_rad_s) - np.array(before.rate_rad_s)) / (2 * dt)
    assert change == pytest.approx(frame.rate_change_rad_s2, abs=1e-6 * n * n)


@given(ELEMENTS, OFFSETS, SPEEDS)
@settings(max_examples=5, deadline=None)
def test_relative_motion_is_the_difference_of_two_orbits(
    elements: OrbitalElements, offset: tuple[float, ...], speed: tuple[float, ...]
) -> None:
    orbit = state_of(elements)
    body = to_eci(orbit, offset, speed)
    position, velocity = propagate_relative(orbit, offset, speed, 600.0)
    expected = from_eci(propagate(orbit, 600.0), propagate(body, 600.0))
    assert position == pytest.approx(expected[0], abs=2e-6)
    assert velocity == pytest.approx(expected[1], abs=5e-9)


@given(st.floats(1e-4, 1.5e-3), st.floats(-12000.0, 12000.0))
def test_cw_transition_is_the_exponential_of_its_matrix(n: float, time_s: float) -> None:
    scale = np.repeat(
        [1.0, n], 3
    )  # positions in m, velocities in m/s over n: all entries of order one
    phi = cw_transition(n, time_s) * scale / scale[:, None]
    expected = expm(cw_matrix(n) * time_s * scale / scale[:, None])
    assert phi == pytest.approx(expected, abs=1e-9)


def test_cw_transition_without_rate_is_free_motion_and_its_limit() -> None:
    free = cw_transition(0.0, 30.0)
    assert free[:3, 3:] == pytest.approx(30.0 * np.eye(3))
    assert cw_transition(1e-9, 30.0) == pytest.approx(free, abs=1e-6)


def test_numerical_relative_motion_agrees_with_clohessy_wiltshire() -> None:
    # On a circular orbit without J2 both hold up to terms of (distance / radius)^2: at 0.1 m, below
    # 1e-9 m.
    elements = OrbitalElements(6.8e6, 0.0, 0.9)
    n, start = elements.mean_motion_rad_s, np.array([0.02, -0.01, 0.015])
    speed = np.array([1e-5, -2 * n * 0.02, 1e-5])
    position, velocity = propagate_relative(
        state_of(elements), start, speed, elements.period_s, j2=0.0
    )
    expected = cw_transition(n, elements.period_s) @ np.concatenate([start, speed])
    assert position == pytest.approx(expected[:3], abs=1e-9)
    assert velocity == pytest.approx(expected[3:], abs=1e-12)


def test_integrated_clohessy_wiltshire_agrees_with_its_closed_form() -> None:
    n = 1.1e-3
    y = np.array([100.0, -50.0, 20.0, 0.05, -0.1, 0.02])
    expected = cw_transition(n, 6000.0) @ y
    for _ in range(1200):
        y = rk4_step(lambda s: np.concatenate([s[3:], cw_acceleration(n, s[:3], s[3:])]), y, 5.0)
    assert y[:3] == pytest.approx(expected[:3], abs=1e-9 * float(np.linalg.norm(expected[:3])))


def test_relative_motion_agrees_with_basilisk() -> None:
    """Reference: ``python benchmarks/physics.py --only orbit --basilisk PYTHON --write``."""
    chosen = {"circular_j2_radial", "eccentric_j2_along"}
    for case in json.loads(BASILISK.read_text())["cases"]:
        if case["name"] not in chosen:
            continue
        elements = OrbitalElements(**case["elements"])
        position, _ = propagate_relative(
            state_of(elements),
            case["position_m"],
            case["velocity_m_s"],
            case["duration_s"],
            case["j2"],
        )
        assert math.dist(position, case["end_position_m"]) < 1e-3, case["name"]


def test_rotation_against_hill_frame_is_the_inertial_rotation_seen_from_it() -> None:
    moments, orbit, dt, steps = (
        (0.2, 0.3, 0.4),
        state_of(OrbitalElements(6.9e6, 0.01, 0.6)),
        2.0,
        200,
    )
    orbits = [orbit]
    for _ in range(2 * steps):
        orbits.append(propagate(orbits[-1], dt / 2))
    frames = [hill_frame(o) for o in orbits]
    q, omega = rotations.exp([0.3, -0.2, 0.5]), np.array([0.01, -0.02, 0.03])

    def derivative(s: np.ndarray, torque: Sequence[float]) -> np.ndarray:
        spin = 0.5 * rotations.multiply(s[:4], np.array([0.0, *s[4:]]))
        return np.concatenate(
            [spin, (torque - np.cross(s[4:], np.array(moments) * s[4:])) / moments]
        )

    def relative(s: np.ndarray, at: int) -> np.ndarray:
        return derivative(s, relative_torque(frames[at], s[:4].tolist(), tuple(s[4:]), moments))

    def inertial(s: np.ndarray, at: int) -> np.ndarray:
        up = rotations.rotate_inverse(s[:4], frames[at].axes[0])
        return derivative(s, gravity_gradient(frames[at].radius_m, tuple(up), moments))

    def fly(rate: Callable[[np.ndarray, int], np.ndarray], y: np.ndarray) -> np.ndarray:
        for k in range(0, 2 * steps, 2):
            k1 = rate(y, k)
            k2 = rate(y + 0.5 * dt * k1, k + 1)
            k3 = rate(y + 0.5 * dt * k2, k + 1)
            k4 = rate(y + dt * k3, k + 2)
            y = y + dt / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        return rotations.normalize(y[:4])

    turn = rotations.from_matrix(frames[0].axes.T)
    against_space = omega + rotations.rotate_inverse(q, frames[0].rate_rad_s)
    seen = fly(relative, np.concatenate([q, omega]))
    truth = fly(inertial, np.concatenate([rotations.multiply(turn, q), against_space]))
    expected = rotations.multiply(rotations.from_matrix(frames[-1].axes), truth)
    off = rotations.log(rotations.multiply(rotations.conjugate(expected), seen))
    assert np.linalg.norm(off) < 2e-5


def test_gravity_gradient_pulls_the_long_axis_to_the_vertical() -> None:
    # A rod along x (small moment about x), tilted by a small angle about z: up = (cos, -sin, 0) in
    # body axes.
    up = (math.cos(0.1), -math.sin(0.1), 0.0)
    torque = gravity_gradient(7e6, up, (0.1, 1.0, 1.0))
    assert torque[2] < 0.0
    assert gravity_gradient(7e6, up, (1.0, 1.0, 1.0)) == (0.0, 0.0, 0.0)


def test_sun_position_matches_published_example() -> None:
    # Vallado, example 5-1: 2 April 2006, 00:00.
    sun_m = sun_position(datetime(2006, 4, 2, tzinfo=UTC))
    assert sun_m == pytest.approx(np.array([146186212.0, 28788976.0, 12481064.0]) * 1e3, abs=3e7)


def test_sunlit_share_falls_from_light_through_penumbra_to_shadow() -> None:
    sun = np.array([1.495978707e11, 0.0, 0.0])
    assert sunlit_share([7e6, 0.0, 0.0], sun) == 1.0
    assert sunlit_share([-7e6, 0.0, 0.0], sun) == 0.0
    heights = np.linspace(6.2e6, 6.5e6, 200)
    shares = [sunlit_share([-math.sqrt(7e6**2 - h * h), h, 0.0], sun) for h in heights]
    assert all(a <= b + 1e-12 for a, b in itertools.pairwise(shares))
    assert shares[0] == 0.0
    assert shares[-1] == 1.0
    assert any(0.2 < share < 0.8 for share in shares)


def test_density_is_continuous_and_falls_with_altitude() -> None:
    values = [density(h) for h in np.linspace(1e5, 1.2e6, 5000)]
    assert all(b < 1.01 * a for a, b in itertools.pairwise(values))
    assert density(4e5) == pytest.approx(3.725e-12)
    for base in (150e3, 350e3, 500e3, 900e3):
        assert density(base - 1.0) == pytest.approx(density(base), rel=0.02)


def test_drag_opposes_the_motion_through_the_turning_atmosphere() -> None:
    state = state_of(OrbitalElements(EARTH_RADIUS_M + 4e5))
    acceleration = drag(state.position_m, state.velocity_m_s, 100.0)
    speed = np.linalg.norm(state.velocity_m_s) - 7.2921159e-5 * (EARTH_RADIUS_M + 4e5)
    assert acceleration @ state.velocity_m_s < 0
    assert np.linalg.norm(acceleration) == pytest.approx(
        0.5 * 3.725e-12 * speed**2 / 100.0, rel=1e-6
    )
