# SPDX-License-Identifier: Apache-2.0
"""Camera path and clock of films: what is in the picture when, and how time passes."""

from __future__ import annotations

import math

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_protocol.shipped_scenarios import find_scenario

from chaserdock.analysis.chase_path import CLOCK, ChasePath, FilmClock, approaches
from chaserdock.analysis.motion import Track

FREE_PX, SIZE_PX = (8, 60, 900, 620), (1280, 720)
SUN = np.array([-0.4, -0.5, 0.77])


def track(times: Array, positions: Array, attitudes: Array) -> Track:
    zero = np.zeros((len(times), 3))
    sigma = np.zeros(len(times))
    return Track(times, positions, zero, attitudes, zero, sigma, sigma)


def turning(scenario: Scenario, end_s: float) -> Track:
    """Return a target that turns at its scenario's rates about its initial axes."""
    times = np.arange(0.0, end_s + 1e-9, 0.1)
    omega, velocity = np.array(scenario.target.omega_rad_s), np.array(scenario.target.velocity_m_s)
    attitudes = np.array([rotations.exp(omega * t) for t in times])
    return track(times, times[:, None] * velocity, attitudes)


def docking(scenario: Scenario, target: Track, chaser: int, contact_s: float) -> Track:
    """Return a chaser that comes down its port's axis, 0.03 m/s, and stays."""
    port = scenario.docking.port_of(chaser)
    assert port is not None
    axis, reach = np.array(port.axis), scenario.chaser.probe_reach_m
    facing = rotations.from_matrix(frame_of(-axis))
    away = np.maximum(contact_s - target.time_s, 0.0) * 0.03 + reach
    offsets = np.array(port.position_m) + away[:, None] * axis
    positions = np.array(
        [rotations.rotate(q, o) for q, o in zip(target.q_wxyz, offsets, strict=True)]
    )
    attitudes = np.array([rotations.multiply(q, facing) for q in target.q_wxyz])
    return track(target.time_s, positions + target.position_m, attitudes)


def frame_of(x: Array) -> Array:
    up = np.array([0.0, 0.0, 1.0])
    return np.stack([x, np.cross(up, x), up], axis=1)


def path_of(
    name: str, contacts: dict[int, float], end_s: float, earth: Array | None = None
) -> tuple[ChasePath, dict[int, Track]]:
    scenario = load_scenario(find_scenario(name))
    target = turning(scenario, end_s)
    tracks = {i: docking(scenario, target, i, contacts.get(i, 1e3)) for i in contacts}
    phases = {
        i: [
            (0.0, "hold"),
            (t - 16.0, "approach"),
            (t - 6.0, "final"),
            (t, "latched"),
            (t + 4.0, "verified"),
        ]
        for i, t in contacts.items()
    }
    found = approaches(scenario, phases, end_s)
    path = ChasePath(scenario, target, tracks, found, SIZE_PX, FREE_PX, SUN, earth)
    return path, tracks


@pytest.mark.parametrize(
    ("name", "contacts", "end_s"),
    [("demo", {0: 20.0}, 28.0), ("four-chaser-capture", {0: 20.0, 3: 21.0, 1: 40.0}, 50.0)],
)
def test_port_and_probe_are_in_the_free_picture_from_approach_to_verified(
    name: str, contacts: dict[int, float], end_s: float
) -> None:
    path, _ = path_of(name, contacts, end_s)
    assert {a.chaser for a in path.approaches} == set(contacts)
    for approach in path.approaches:
        assert approach.end_s == pytest.approx(approach.contact_s + 4.0)
        for time_s in np.arange(approach.begin_s, approach.end_s, 0.13):
            port, tip, _ = path.gap(approach, time_s)
            px, depth = path.viewpoint(time_s).project(np.stack([port, tip]))
            assert (depth > 0.1).all()
            assert (px > FREE_PX[:2]).all()
            assert (px < FREE_PX[2:]).all()


@pytest.mark.parametrize(
    ("name", "contacts", "end_s"),
    [("demo", {0: 20.0}, 28.0), ("four-chaser-capture", {0: 20.0, 1: 40.0}, 50.0)],
)
def test_no_body_hides_the_gap_at_contact(
    name: str, contacts: dict[int, float], end_s: float
) -> None:
    path, _ = path_of(name, contacts, end_s)
    for approach in path.approaches:
        for time_s in np.arange(approach.contact_s - 2.0, approach.end_s, 0.25):
            assert path.focus(time_s) == approach
            assert not path.hidden(path.viewpoint(time_s), approach, time_s)
            close = path.close_up(time_s, 320, 240)
            assert close is not None
            assert not path.hidden(close, approach, time_s)
    # Seen through the target from behind, it is hidden.
    first = path.approaches[0]
    axis = path.gap(first, 20.0)[2]
    look = path.viewpoint(20.0)
    behind = type(look)(look.centre_m, 2.0, math.atan2(-axis[1], -axis[0]), 0.0, 640, 360)
    assert path.hidden(behind, first, 20.0)


def test_camera_moves_smoothly_and_comes_closer() -> None:
    path, _ = path_of("demo", {0: 20.0}, 28.0)
    eyes = np.array([path.viewpoint(t).eye_m for t in np.arange(0.0, 28.0, 1.0 / 15.0)])
    speeds = np.linalg.norm(np.diff(eyes, axis=0), axis=1) * 15.0
    assert speeds.max() < 0.8
    assert path.viewpoint(21.0).distance_m < 0.95 * path.viewpoint(4.0).distance_m


def test_close_up_stays_until_verified() -> None:
    path, _ = path_of("demo", {0: 20.0}, 28.0)
    shown = [t for t in np.arange(0.0, 28.0, 0.1) if path.close_up(t, 320, 240) is not None]
    assert shown[0] == pytest.approx(4.0, abs=0.11)
    assert shown[-1] == pytest.approx(25.5, abs=0.11)  # verified at 24 s, and 1.5 s to read it


def test_a_camera_sees_the_earth_behind_the_docking() -> None:
    earth = np.array([0.0, 0.0, -1.0])
    path, _ = path_of("demo", {0: 20.0}, 28.0, earth)
    look = path.viewpoint(20.0)
    assert -look.axes()[2] @ earth > 0.2


@pytest.mark.parametrize("speed", [1.0, 4.0])
def test_clock_covers_the_flight_in_order_and_is_slow_at_contact(speed: float) -> None:
    clock = FilmClock(2.0, 30.0, [12.0, 13.0], speed)
    shown = np.array([clock.flight_time(t) for t in np.linspace(0.0, clock.duration_s, 2000)])
    assert (np.diff(shown) > 0.0).all()
    assert shown[[0, -1]] == pytest.approx([2.0, 30.0])
    film_at = np.interp([5.0, 12.0, 25.0], shown, np.linspace(0.0, clock.duration_s, 2000))
    assert [clock.slowdown(t) for t in film_at] == pytest.approx([1.0, CLOCK.slower, 1.0], abs=0.02)
    plain = FilmClock(2.0, 30.0, [], speed)
    assert plain.duration_s == pytest.approx(28.0 / speed)


def test_an_approach_that_is_broken_off_ends_and_a_second_one_counts() -> None:
    scenario = load_scenario(find_scenario("demo"))
    phases = {0: [(0.0, "hold"), (2.0, "align"), (6.0, "approach"), (9.0, "retreat")]}
    phases[0] += [(15.0, "align"), (20.0, "final"), (24.0, "latched")]
    first, second = sorted(approaches(scenario, phases, 28.0), key=lambda a: a.begin_s)
    assert (first.begin_s, first.contact_s, first.end_s) == (2.0, math.inf, 9.0)
    assert (second.begin_s, second.contact_s, second.end_s) == (15.0, 24.0, 28.0)
