# SPDX-License-Identifier: Apache-2.0
"""Rings on a mapped target: ellipses in images, circles that several views confirm, and what is
none.
"""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from chaserdock_agents.chaser.perception.features import find_ellipses
from chaserdock_agents.mapper.rings import (
    CircleSights,
    Ring,
    RingTuning,
    circle_sights,
    circles_of,
    find_rings,
)
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from numpy.typing import NDArray
from unknown_cases import circle_points, ellipse_row, foil, ring_image

CAMERA = Camera.from_hfov(960, 540, np.deg2rad(60.0))
WHOLE = (0, 0, 960, 540)


# -- ellipses in an image --------------------------------------------------------------------------


@pytest.mark.parametrize("background", [foil(), np.full((540, 960), 80.0)], ids=["foil", "flat"])
def test_both_edges_of_a_ring_that_is_hidden_in_part_are_found(
    background: NDArray[np.float64],
) -> None:
    found = find_ellipses(ring_image(background), CAMERA, WHOLE)
    for longer, shorter in ((64.0, 41.5), (56.0, 33.5)):  # 8 px wide
        off = np.abs(found.axes_px - (longer, shorter)).max(axis=1)
        best = int(np.argmin(off))
        assert off[best] < 1.5
        assert np.linalg.norm(found.centres_px[best] - (479.75, 269.75)) < 1.0
        assert abs(found.angles_rad[best] - np.deg2rad(30.0)) < 0.05
        assert 0.6 <= found.coverage[best] < 1.0
    again = find_ellipses(ring_image(background), CAMERA, WHOLE)
    assert np.array_equal(found.rows(), again.rows())


def test_plates_cells_and_foil_have_no_ellipses() -> None:
    plates = foil()
    for x in range(100, 420, 24):
        cv2.line(plates, (x, 80), (x, 300), 200.0, 2)
    for y in range(80, 300, 24):
        cv2.line(plates, (100, y), (420, y), 200.0, 2)
    cv2.rectangle(plates, (500, 100), (800, 300), 230.0, -1)
    cv2.fillPoly(plates, [np.array([[550, 350], [820, 380], [700, 500], [560, 480]])], 20.0)
    image = np.clip(plates, 0, 255).astype(np.uint8)
    assert len(find_ellipses(image, CAMERA, WHOLE).centres_px) == 0
    assert len(find_ellipses(image, CAMERA, (0, 0, 0, 0)).centres_px) == 0


# -- circles by several views ----------------------------------------------------------------------


def looking(place: Array, turn_rad: float) -> Array:
    """Return a rotation (3, 3), IRF to TRF, of a camera at a place that looks near the origin."""
    z = -place / np.linalg.norm(place)
    x = np.cross(z, [0.3, -0.2, 0.9])
    x /= np.linalg.norm(x)
    tilt = rotations.to_matrix(rotations.exp([0.05, -0.03, turn_rad]))
    return np.column_stack([x, np.cross(z, x), z]) @ tilt


def imaged(
    circle: tuple[Array, Array, float], place: Array, axes: Array, noise_px: float, seed: int
) -> Array | None:
    """Return the row (6,) of the ellipse by which a camera sees a circle; None from behind."""
    centre, normal, _ = circle
    if (place - centre) @ normal < 0.35 * np.linalg.norm(place - centre):
        return None
    rim = circle_points(circle)
    px = CAMERA.project((rim - place) @ axes)
    # Edges of facets and of shading shift an ellipse as a whole, as single points do not.
    rng = np.random.default_rng(seed)
    middle = px.mean(axis=0)
    px = (
        middle
        + rng.normal(0.0, noise_px, 2)
        + (px - middle) * (1.0 + rng.normal(0.0, noise_px, 2) / np.ptp(px, axis=0))
    )
    return ellipse_row(px)


def test_an_ellipse_is_the_image_of_two_circles() -> None:
    normal = np.array([0.36, -0.48, -0.8])
    centre = np.array([0.1, -0.2, 2.0])
    row = imaged((centre, normal, 0.13), np.zeros(3), np.eye(3), 0.0, 0)
    assert row is not None
    sights = circle_sights(CAMERA, [(np.zeros(3), np.eye(3), row)])
    centres, normals = circles_of(sights.centres[0], sights.axes[0], float(sights.angles_rad[0]))
    assert np.allclose(np.linalg.norm(normals, axis=1), 1.0)
    best = int(np.argmax(normals @ normal))
    assert normals[best] @ normal > 1.0 - 1e-6
    assert np.allclose(0.13 * centres[best], centre, atol=2e-4)
    assert ((normals * centres).sum(axis=1) < 0.0).all()  # they face the camera


RINGS = (
    (np.array([-0.22, 0.03, -0.05]), np.array([-0.96, 0.28, 0.0]), 0.13),
    (np.array([0.1, 0.05, 0.27]), np.array([0.36, 0.48, 0.8]), 0.06),
)
"""Two rings in general position."""


def views(
    seed: int, circles: tuple[tuple[Array, Array, float], ...] = RINGS, false: int = 3
) -> CircleSights:
    """Return the ellipses of 40 images from a tilted turn of two cameras, ``false`` others in each:
    shadows, corners and texture, which are nowhere twice.
    """
    rng = np.random.default_rng(seed)
    images = []
    for k, angle in enumerate(np.linspace(0.0, 2.0 * np.pi, 20, endpoint=False)):
        for side in (0.0, 1.05):
            place = 2.0 * np.array([np.cos(angle + side), np.sin(angle + side), 0.3 - 0.6 * side])
            axes = looking(place, 0.7 * k)
            rows = [imaged(c, place, axes, 0.5, int(rng.integers(1 << 30))) for c in circles]
            longer = rng.uniform(10.0, 70.0, false)
            others = np.column_stack(
                [
                    rng.uniform(350.0, 610.0, false), rng.uniform(140.0, 400.0, false), longer,
                    longer * rng.uniform(0.25, 1.0, false), rng.uniform(0.0, np.pi, false),
                    np.full(false, 0.7),
                ]
            )  # fmt: skip
            # The map is some millimetres wrong where the camera was.
            lens = place + rng.normal(0.0, 0.002, 3)
            images.append((lens, axes, np.array([*(r for r in rows if r is not None), *others])))
    return circle_sights(CAMERA, images)


def is_true(ring: Ring, circles: tuple[tuple[Array, Array, float], ...] = RINGS) -> bool:
    return any(
        np.linalg.norm(ring.centre_m - c) < 0.01 and ring.normal @ n > 0.998 and
        abs(ring.radius_m - r) < 0.004
        for c, n, r in circles
    )  # fmt: skip


def test_rings_are_found_and_nothing_else_is() -> None:
    squares = []
    for seed in range(6):
        rings = find_rings(views(seed))
        assert len(rings) == len(RINGS)
        assert all(is_true(r) for r in rings)
        for ring in rings:
            _, normal, _ = min(RINGS, key=lambda c, at=ring.centre_m: np.linalg.norm(c[0] - at))
            off = np.linalg.norm(np.cross(ring.normal, normal))
            squares.append((off / ring.normal_sigma_rad) ** 2)
            assert ring.residual_px < 1.0
    assert np.mean(squares) < 2.5  # two axes, of which the worse one is stated


def test_ellipses_that_several_views_do_not_confirm_are_no_ring() -> None:
    assert all(find_rings(views(seed, circles=(), false=5)) == () for seed in range(6))
    assert find_rings(CircleSights.none()) == ()
    # All from one side: a highlight or a shadow could look so.
    near = [
        (place, axes, row)
        for shift in (0.0, 0.02, 0.04, 0.06, 0.08, 0.1)
        for place in [np.array([-2.0, shift, 0.1])]
        for axes in [looking(place, 0.0)]
        for row in [imaged(RINGS[0], place, axes, 0.0, 0)]
        if row is not None
    ]
    assert len(near) == 6
    tuning = RingTuning(baseline_rad=0.001)
    assert find_rings(circle_sights(CAMERA, near), tuning) == ()


def test_the_edges_of_one_ring_are_one_place() -> None:
    centre, normal, radius = RINGS[0]
    edges = ((centre, normal, radius), (centre + 0.01 * normal, normal, radius - 0.012))
    rings = find_rings(views(1, circles=edges))
    assert len(rings) == 1
    assert np.linalg.norm(rings[0].centre_m - centre) < 0.015
    assert len(find_rings(views(1, circles=edges), RingTuning(edge_m=0.0))) > 1


def test_rings_outside_the_limits_are_left_out() -> None:
    assert len(find_rings(views(0), RingTuning(radii_m=(0.1, 0.3)))) == 1
    assert find_rings(views(0), RingTuning(radii_m=(0.3, 0.6))) == ()
