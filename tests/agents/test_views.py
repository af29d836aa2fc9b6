# SPDX-License-Identifier: Apache-2.0
"""Appearance of markers by kernel equals NumPy's plain formulae bit for bit on every instruction
set.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from chaserdock_agents.chaser.perception import detect, pnp, views
from chaserdock_agents.chaser.perception.native import LIBRARY
from chaserdock_agents.chaser.perception.refine import PoseInCamera
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.native.build import X86_64
from chaserdock_models.targets import cuboid_corners, target_model

CAMERA = Camera.from_hfov(640, 480, 1.0)
MARGIN_PX = 8.0


@pytest.fixture(params=[number for number, _ in X86_64], autouse=True)
def _level(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if LIBRARY.level == 0 or request.param > LIBRARY.level:
        pytest.skip(f"this processor has no copy {request.param}")
    own = LIBRARY.function
    monkeypatch.setattr(
        views, "function", lambda name, result=None: own(name, result, at_level=request.param)
    )


def poses(count: int) -> list[PoseInCamera]:
    """Some far and in the image, some at its edge, some with the camera inside the target or it
    behind.
    """
    rng = np.random.default_rng(5)
    out = []
    for k in range(count):
        position = (
            rng.uniform([-0.5, -0.4, 0.3], [0.5, 0.4, 2.0]) if k % 4 else rng.uniform(-0.3, 0.3, 3)
        )
        out.append(
            PoseInCamera(position, rotations.to_matrix(rotations.normalize(rng.normal(size=4))))
        )
    return out


def seen_from(pose: PoseInCamera, table: pnp.MarkerTable) -> tuple[Array, Array, Array]:
    at = table.corners @ pose.rotation.T + pose.position
    centres = table.origins @ pose.rotation.T + pose.position
    return at, centres, table.rotations[:, :, 2] @ pose.rotation.T


@pytest.mark.parametrize("name", ["paper", "servicer"])
def test_errors_of_markers_and_points_are_those_of_numpy(name: str) -> None:
    table, rng = pnp.MarkerTable.of(target_model(name)), np.random.default_rng(1)
    infinite = 0
    for pose in poses(300):
        at, _, outwards = seen_from(pose, table)
        px = CAMERA.project_ideal(at)
        pixels = np.where(np.isfinite(px), px, 100.0) + rng.normal(0.0, 0.3, px.shape)
        square = ((px - pixels) ** 2).sum(axis=-1)
        error = np.sqrt(square).max(axis=-1)
        facing = (outwards * at[:, 0]).sum(axis=-1) < 0.0
        expected = np.where(np.isfinite(error) & facing, error, np.inf)
        found = views.marker_errors(CAMERA, table.corners, table.normals, pixels, pose)
        np.testing.assert_array_equal(found, expected)
        infinite += int(np.isinf(expected).sum())
        squares = views.squared_errors(
            CAMERA, table.corners.reshape(-1, 3), pixels.reshape(-1, 2), pose
        )
        np.testing.assert_array_equal(squares, square.ravel())
    assert 0 < infinite < 300 * len(table.ids)


@pytest.mark.parametrize("name", ["paper", "servicer"])
def test_markers_as_plain_as_one_are_those_of_numpy(name: str) -> None:
    table, counts = pnp.MarkerTable.of(target_model(name)), set[int]()
    frame = np.array([CAMERA.width_px, CAMERA.height_px]) - 1.0 - MARGIN_PX
    for number, pose in enumerate(poses(300)):
        row = number % len(table.ids)
        at, centres, normals = seen_from(pose, table)
        px = CAMERA.project_ideal(at)
        size = np.abs(px[:, (1, 2, 3, 0)] - px).max(axis=-1).min(axis=-1)
        inside = ((px > MARGIN_PX) & (px < frame)).all(axis=(1, 2))
        cosines = -(normals * centres).sum(axis=1) / np.linalg.norm(centres, axis=1)
        plain = (
            inside & (size >= 0.6 * size[row]) & (cosines >= max(0.3, 0.7 * float(cosines[row])))
        )
        plain[row] = False
        expected: tuple[int, Any] = int(plain.sum()), float(cosines[row])
        assert views.count_visible_markers(CAMERA, table.surface, row, pose, MARGIN_PX) == expected
        counts.add(expected[0])
    assert {0, 1} <= counts


def test_a_region_is_the_box_around_the_target_grown() -> None:
    model, some = target_model("paper"), 0
    for pose in poses(300):
        q = rotations.from_matrix(pose.rotation)
        points = cuboid_corners(model.size_m) @ rotations.to_matrix(q).T + pose.position
        px = CAMERA.project(points)
        found = detect.region_of(CAMERA, model, pose.position, q)
        if points[:, 2].min() < 0.02:
            assert found is None
            continue
        low, high = px.min(axis=0), px.max(axis=0)
        grow = 0.25 * (high - low) + 24.0
        left, top = np.maximum(np.floor(low - grow), 0).astype(int)
        right, bottom = np.minimum(np.ceil(high + grow) + 1, (640, 480)).astype(int)
        if found is None:
            assert (
                min(right - left, bottom - top) < 16
                or (right - left) * (bottom - top) > 0.7 * 640 * 480
            )
            continue
        assert found == (left, top, right, bottom)
        some += 1
    assert some > 50
    assert detect.region_of(CAMERA, model, [np.nan, 0.0, 1.0], rotations.IDENTITY) is None
