# SPDX-License-Identifier: Apache-2.0
"""The surface of a mapped target: closed, near the true one, and marked where nothing was seen."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from chaserdock_agents.mapper.docking_site import SiteLimits, judged_site, site_on_ray
from chaserdock_agents.mapper.ports import MappedPoints, PortChooser, PortDecision
from chaserdock_agents.mapper.rings import Ring
from chaserdock_agents.mapper.surface import MappedSurface, SightLines, surface_of
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.scenario import PortChoice, flight_scenario, parse_scenario

BOXES = (
    (np.array([0.0, 0.0, 0.0]), np.array([0.3, 0.2, 0.25])),
    (np.array([0.0, 0.55, 0.02]), np.array([0.02, 0.3, 0.2])),
)
"""Centre and half edges of a bus and of a panel beside it, with a gap of 5 cm between them."""
SIGMA_M = 0.003


def points_on_boxes(rng: np.random.Generator, count: int) -> Array:
    """Return points on the surfaces of the boxes, also on their edges and corners."""
    out = []
    for centre, half in BOXES:
        for axis in range(3):
            for side in (-1.0, 1.0):
                p = rng.uniform(-1.0, 1.0, (count, 3))
                p[: count // 4] = np.sign(p[: count // 4])
                p[:, axis] = side
                out.append(centre + p * half)
    return np.unique(np.concatenate(out).astype(float), axis=0)


def distance_outside(points: Array) -> Array:
    """Return the distance of points from the boxes, negative inside."""
    out = np.full(len(points), np.inf)
    for centre, half in BOXES:
        off = np.abs(points - centre) - half
        beyond = np.linalg.norm(np.maximum(off, 0.0), axis=1)
        out = np.minimum(out, np.where((off < 0.0).all(axis=1), off.max(axis=1), beyond))
    return out


def visible(camera: Array, points: Array) -> Array:
    """Return whether points (n, 3) are seen from a camera, by samples along the lines of sight."""
    out = np.ones(len(points), dtype=bool)
    for share in np.linspace(0.02, 0.98, 97):
        out &= distance_outside(points + share * (camera - points)) > 0.0
    return out


def mapped(
    seed: int, cameras: Array, wrong: int = 0, count: int = 40
) -> tuple[MappedSurface, Array]:
    """Return the surface of noisy landmarks, and the true places of what was seen."""
    rng = np.random.default_rng(seed)
    points = points_on_boxes(rng, count)
    numbers, places = [], []
    for camera in cameras:
        found = np.flatnonzero(visible(camera, points))
        numbers.append(found)
        places.append(np.tile(camera, (len(found), 1)))
    seen_often = np.flatnonzero(np.bincount(np.concatenate(numbers), minlength=len(points)) >= 2)
    renamed = {int(k): i for i, k in enumerate(seen_often)}
    pairs = [
        (renamed[int(k)], camera)
        for found, at in zip(numbers, places, strict=True)
        for k, camera in zip(found, at, strict=True)
        if int(k) in renamed
    ]
    landmarks = points[seen_often] + SIGMA_M * rng.normal(size=(len(seen_often), 3))
    landmarks[:wrong] += rng.normal(size=(wrong, 3)) * 0.1
    covariances = np.tile(SIGMA_M**2 * np.eye(3), (len(landmarks), 1, 1))
    sights = SightLines(np.array([k for k, _ in pairs]), np.array([c for _, c in pairs]))
    surface = surface_of(landmarks, covariances, sights)
    assert surface is not None
    return surface, points[seen_often]


def around(count: int, height: float = 0.0) -> Array:
    """Return cameras on a circle of 2 m about z."""
    angles = np.linspace(0.0, 2.0 * np.pi, count, endpoint=False)
    circle = [2.0 * np.cos(angles), 2.0 * np.sin(angles), np.full(count, height)]
    return np.column_stack(circle)


EVERYWHERE = np.concatenate([around(12), around(8, 1.6), around(8, -1.6)])


def sampled(surface: MappedSurface) -> Array:
    """Return points on the triangles of a surface, weighted by their areas."""
    rng = np.random.default_rng(9)
    triangles = surface.triangles
    a, b, c = (surface.vertices_m[triangles[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    at = rng.choice(len(triangles), 4000, p=area / area.sum())
    u, v = np.sort(rng.uniform(size=(2, 4000)), axis=0)
    u, v = u[:, None], v[:, None]
    return u * a[at] + (v - u) * b[at] + (1.0 - v) * c[at]


@pytest.mark.parametrize("wrong", [0, 4])
def test_the_surface_is_closed_near_the_true_one_and_leaves_the_gap_free(wrong: int) -> None:
    surface, _ = mapped(1, EVERYWHERE, wrong)
    edges = Counter((int(t[i]), int(t[(i + 1) % 3])) for t in surface.triangles for i in range(3))
    assert all(count == edges[b, a] for (a, b), count in edges.items())
    off = distance_outside(sampled(surface))
    assert np.abs(np.median(off)) < 0.004
    low, high = np.quantile(off, [0.05, 0.95])
    assert low > -0.025
    assert high < 0.02  # nothing stands in the gap of 5 cm
    true_volume = sum(8.0 * np.prod(half) for _, half in BOXES)
    assert surface.volume_m3() == pytest.approx(true_volume, rel=0.15)
    assert surface.seen.mean() > 0.9
    assert surface.sigma_m == pytest.approx(SIGMA_M)


def test_normals_point_outwards() -> None:
    surface, _ = mapped(2, EVERYWHERE)
    corners = surface.vertices_m[surface.triangles]
    middles, normals = corners.mean(axis=1), surface.normals()
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    bus = np.abs(middles[:, 1]) < 0.21  # the panel is thinner than the step
    outside = distance_outside(middles + 0.04 * normals)
    inside = distance_outside(middles - 0.04 * normals)
    right = (outside > inside)[bus]
    assert (area[bus] * right).sum() > 0.9 * area[bus].sum()


def test_what_no_camera_saw_is_marked_and_not_empty() -> None:
    half = around(12)[around(12)[:, 0] > 0.2]
    surface, seen_points = mapped(3, half)
    normals = surface.normals()
    behind = normals[:, 0] < -0.5
    assert behind.any()
    assert surface.seen[behind].mean() < 0.1
    assert surface.seen[normals[:, 0] > 0.5].mean() > 0.9
    hull_volume = np.prod(np.ptp(seen_points, axis=0))
    assert 0.0 < surface.volume_m3() < hull_volume


def test_too_few_landmarks_are_no_surface() -> None:
    points = np.random.default_rng(0).normal(size=(19, 3))
    sights = SightLines(np.zeros(0, dtype=np.int64), np.zeros((0, 3)))
    assert surface_of(points, np.tile(np.eye(3), (19, 1, 1)), sights) is None


# -- places to dock --------------------------------------------------------------------------------


@cache
def the_map() -> tuple[MappedSurface, Array, Array]:
    """Return a surface of the boxes, and the landmarks of all their sides with covariances."""
    surface, _ = mapped(1, EVERYWHERE)
    rng = np.random.default_rng(5)
    points = points_on_boxes(rng, 300)
    landmarks = points + SIGMA_M * rng.normal(size=points.shape)
    return surface, landmarks, np.tile(SIGMA_M**2 * np.eye(3), (len(landmarks), 1, 1))


LIMITS = SiteLimits(corridor_m=0.5, radius_m=0.1, reach_m=0.2)


def test_a_line_of_sight_finds_a_flat_place_with_its_normal() -> None:
    surface, landmarks, covariances = the_map()
    camera = np.array([1.9, -0.3, 0.4])
    place = np.array([0.3, -0.03, 0.04])
    site = site_on_ray(camera, place - camera, surface, landmarks, covariances, LIMITS)
    assert site is not None
    assert site.why_not == ()
    assert np.linalg.norm(site.position_m - place) < 0.02
    assert abs(site.position_m[0] - 0.3) < 4.0 * site.sigma_m
    assert np.arccos(site.normal[0]) < 4.0 * site.normal_sigma_rad
    assert site.sigma_m < SIGMA_M
    away = site_on_ray(camera, camera - place, surface, landmarks, covariances, LIMITS)
    assert away is None


def test_the_accuracy_of_a_normal_is_what_it_is_said_to_be() -> None:
    rng = np.random.default_rng(7)
    surface = the_map()[0]
    turned = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    turned[:, 2] *= np.sign(np.linalg.det(turned))
    squares = []
    for _ in range(200):
        flat = rng.uniform(-0.1, 0.1, (15, 3)) * [1.0, 0.6, 0.0]
        points = flat @ turned.T + SIGMA_M * rng.normal(size=(15, 3))
        covariances = np.tile(SIGMA_M**2 * np.eye(3), (15, 1, 1))
        site = judged_site(np.zeros(3), turned[:, 2], surface, points, covariances, LIMITS)
        about = np.cross(site.normal, turned[:, 2]) @ turned[:, 0]  # the less certain axis
        squares.append((about / site.normal_sigma_rad) ** 2)
    assert 0.5 < np.mean(squares) < 1.3


@pytest.mark.parametrize(
    ("at", "outward", "reason"),
    [
        ((0.0, 0.2, 0.0), (0.0, 1.0, 0.0), "within the corridor"),  # the panel is in the way
        ((0.3, 0.2, 0.0), (1.0, 1.0, 0.0), "not flat"),  # an edge
        ((0.0, -1.0, 0.0), (0.0, -1.0, 0.0), "landmarks within"),
    ],
)
def test_a_bad_place_states_why(
    at: tuple[float, ...], outward: tuple[float, ...], reason: str
) -> None:
    surface, landmarks, covariances = the_map()
    place, direction = np.array(at), np.array(outward)
    site = judged_site(place, direction, surface, landmarks, covariances, LIMITS)
    assert any(reason in why for why in site.why_not), site.why_not


def test_an_unseen_place_and_an_uncertain_normal_state_why() -> None:
    surface, landmarks, covariances = the_map()
    at, outward = np.array([0.3, 0.0, 0.0]), np.array([1.0, 0.0, 0.0])
    unseen = judged_site(at, outward, surface, landmarks, covariances, LIMITS, seen=False)
    assert unseen.why_not == ("no camera has seen it from outside",)
    vague = judged_site(at, outward, surface, landmarks[::4], 100.0 * covariances[::4], LIMITS)
    assert any("normal known to" in why for why in vague.why_not)


PORTS: dict[str, Any] = {
    "name": "ports",
    "duration_s": 60.0,
    "perception": {"name": "features"},
    "target": {"model": "geo_servicer"},
    "approach": {"dock_distance_m": 0.5},
    "limits": {"min_distance_target_m": 0.6, "min_distance_chasers_m": 0.4},
    "docking": {"corridor_angle_deg": 10.0},
    "chasers": [
        {"position_m": [-1.9, 0.1, 0.2], "look_at": "target"},
        {"position_m": [-0.8, -1.7, -0.1], "look_at": "target"},
    ],
}
"""Names, sizes and distances of a mission whose chasers choose ports."""


def points_of(turn: Array, shift_m: Array, seed: int = 5) -> MappedPoints:
    """Return landmarks of the boxes, with noise of their own, in a turned and shifted frame."""
    surface, landmarks, covariances = the_map()
    noise = 0.1 * SIGMA_M * np.random.default_rng(seed).normal(size=landmarks.shape)
    no_sights = SightLines(np.zeros(0, dtype=np.int64), np.zeros((0, 3)))
    keys = np.arange(len(landmarks))
    points = MappedPoints(keys, (landmarks + noise) @ turn.T + shift_m, covariances, no_sights)
    vertices_m = surface.vertices_m @ turn.T + shift_m
    vars(points)["surface"] = replace(surface, vertices_m=vertices_m)
    return points


def chooser(**changes: Any) -> PortChooser:
    out = PortChooser(flight_scenario(parse_scenario(PORTS | changes, "ports")))
    out.follow(points_of(np.eye(3), np.zeros(3)))
    return out


AT_X = PortChoice(point_m=(0.33, -0.03, 0.04))
"""A place before the bus, on the side of +X."""


def test_a_port_becomes_that_of_its_chaser_and_follows_the_map() -> None:
    ports = chooser()
    decision = ports.decide(1, AT_X, None)
    assert decision.accepted, decision.answer
    (port,) = ports.ports()
    assert (port.chaser, port.number) == (1, 1)
    assert abs(port.position_m[0] - 0.3) < 0.004
    assert np.degrees(np.arccos(port.axis[0])) < 2.0
    turn = rotations.to_matrix(rotations.exp([0.02, -0.03, 0.05]))
    shift = np.array([0.01, -0.02, 0.015])
    ports.follow(points_of(turn, shift, seed=6))
    (moved,) = ports.ports()
    # Fewer landmarks, of which some stray, do not turn it.
    whole = points_of(turn, shift, seed=7)
    few = whole.landmarks_m[::6] + 0.008 * np.random.default_rng(8).normal(
        size=(len(whole.keys[::6]), 3)
    )
    ports.follow(MappedPoints(whole.keys[::6], few, whole.covariances_m2[::6], whole.sights))
    assert ports.ports()[0].axis == moved.axis
    assert 0.0 < np.linalg.norm(np.subtract(ports.ports()[0].position_m, moved.position_m)) < 0.02
    assert moved.number == 1
    assert np.linalg.norm(moved.position_m - turn @ port.position_m - shift) < 0.003
    assert np.degrees(np.arccos(np.dot(moved.axis, turn @ port.axis))) < 0.5
    ports.follow(whole)
    assert ports.decide(1, PortChoice(point_m=(0.3, 0.05, -0.1)), None).accepted
    assert ports.ports()[0].number == 2


def test_a_pixel_chooses_where_its_line_of_sight_meets_the_target() -> None:
    ports, camera = chooser(), np.array([1.9, -0.3, 0.4])
    choice = PortChoice(image=0, pixel=(480.0, 270.0))
    place = np.array([0.3, -0.03, 0.04])
    assert ports.decide(0, choice, (camera, place - camera)).accepted
    assert np.linalg.norm(ports.ports()[0].position_m - place) < 0.02
    away = ports.decide(0, choice, (camera, camera - place))
    assert away == PortDecision(False, "the line of sight does not meet the target")
    assert len(ports.ports()) == 1  # the one before stays


def test_a_place_is_refused_for_its_reasons_and_those_of_reach() -> None:
    ports = chooser()
    edge = ports.decide(0, PortChoice(point_m=(0.3, 0.2, 0.0)), None)
    assert not edge.accepted
    assert "not flat" in edge.answer
    assert ports.decide(0, AT_X, None).accepted
    beside = ports.decide(1, AT_X, None)
    assert "from chaser 0 at its port; at least 0.4 m" in beside.answer
    assert "there is no chaser 2" in ports.decide(2, AT_X, None).answer
    near = chooser(approach={"dock_distance_m": 0.3}).decide(0, AT_X, None)
    assert "more than chaser.probe_reach_m (0.35 m)" in near.answer
    empty = PortChooser(flight_scenario(parse_scenario(PORTS, "ports")))
    assert not empty.decide(0, AT_X, None).accepted


def test_a_search_finds_flat_places_for_two_chasers() -> None:
    ports = chooser()
    for chaser in (0, 1):
        decision = ports.decide(chaser, PortChoice(find="flat"), None)
        assert decision.accepted, decision.answer
        assert "places will do" in decision.answer
    one, other = ports.ports()
    for port in (one, other):
        at, axis = np.array(port.position_m), np.array(port.axis)
        assert abs(distance_outside(at[None])[0]) < 0.01
        assert np.degrees(np.arccos(np.abs(axis).max())) < 3.0  # a side of a box
        assert port.clearance_m > 0.0
    docked = [np.array(p.position_m) + 0.5 * np.array(p.axis) for p in (one, other)]
    assert np.linalg.norm(docked[0] - docked[1]) >= 0.4


# -- rings -----------------------------------------------------------------------------------------

ON_BUS = Ring(
    np.array([0.33, -0.03, 0.02]), np.array([1.0, 0.0, 0.0]), 0.11, 0.002, 0.015, 0.6, 0.002, 0.9, 9
)
"""A ring that stands 3 cm before the side +X of the bus."""
BEHIND_PANEL = replace(
    ON_BUS, centre_m=np.array([0.0, 0.22, 0.0]), normal=np.array([0.0, 1.0, 0.0]), radius_m=0.08
)
INWARD = replace(ON_BUS, normal=-ON_BUS.normal, images=20)
ROUGH = replace(ON_BUS, radius_m=0.09, normal_sigma_rad=0.06)


def with_rings(*rings: Ring, turn: Array | None = None) -> PortChooser:
    ports = PortChooser(flight_scenario(parse_scenario(PORTS, "ports")))
    points = points_of(np.eye(3) if turn is None else turn, np.zeros(3))
    vars(points)["rings"] = rings
    ports.follow(points)
    return ports


def test_a_search_takes_the_best_ring_and_states_the_others() -> None:
    other = replace(ON_BUS, radius_m=0.05, images=6)
    ports = with_rings(INWARD, other, ROUGH, ON_BUS)
    decision = ports.decide(0, PortChoice(find="ring"), None)
    assert decision.accepted, decision.answer
    assert decision.answer.startswith("ring of radius 0.110 m about (0.330, -0.030, 0.020) m")
    assert (
        "2 of 4 places will do, next: 0.330, -0.030, 0.020 m of radius 0.050 m" in decision.answer
    )
    (port,) = ports.ports()
    assert (port.radius_m, port.axis, port.flatness_m) == (0.11, (1.0, 0.0, 0.0), 0.002)
    assert port.position_m == (0.33, -0.03, 0.02)
    narrow = ports.decide(0, PortChoice(find="ring", radii_m=(0.04, 0.06)), None)
    assert narrow.answer.startswith("ring of radius 0.050 m")
    assert ports.decide(1, PortChoice(find="flat"), None).accepted
    assert ports.ports()[1].radius_m is None


def test_a_ring_that_will_not_do_states_why() -> None:
    ports = with_rings(BEHIND_PANEL, INWARD, ROUGH)
    answer = ports.decide(0, PortChoice(find="ring"), None).answer
    assert answer.startswith("none of 3 places will do; ring of radius 0.080 m about")
    for reason in ("within the corridor", "it faces the middle", "normal known to 3.4 degrees"):
        assert reason in answer
    assert ports.decide(0, PortChoice(find="ring", radii_m=(0.2, 0.3)), None) == PortDecision(
        False, "no ring of 0.2 to 0.3 m; radii of those found: 0.080, 0.110, 0.090 m"
    )
    assert ports.ports() == ()
    none = with_rings().decide(0, PortChoice(find="ring"), None)
    assert not none.accepted
    assert none.answer.startswith("no ring: 0 ellipses in 0 images")


def test_the_port_of_a_ring_moves_with_the_landmarks_about_it_and_keeps_its_normal() -> None:
    ports = with_rings(ON_BUS)
    assert ports.decide(0, PortChoice(find="ring"), None).accepted
    shift = np.array([0.01, -0.02, 0.015])
    ports.follow(points_of(np.eye(3), shift, seed=6))
    (moved,) = ports.ports()
    assert np.linalg.norm(moved.position_m - ON_BUS.centre_m - shift) < 0.002
    assert moved.axis == (1.0, 0.0, 0.0)
    assert moved.number == 1
