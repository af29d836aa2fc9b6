# SPDX-License-Identifier: Apache-2.0
"""The renderers against Embree: grey levels, silhouettes and shadow edges of a shipped satellite
with highlights, and of a cuboid.
"""

from __future__ import annotations

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.meshes import TriangleMesh
from chaserdock_models.satellites import satellite
from chaserdock_models.targets import Box, TargetModel
from chaserdock_world.rendering.background import Light
from chaserdock_world.rendering.mesh_renderer import mesh_of_boxes
from chaserdock_world.rendering.rasterizer import Renderer

pytest.importorskip("embreex", reason="embreex (development requirement) is not installed")

from embree_images import compare, displacements


@pytest.mark.slow
def test_image_equals_that_of_embree() -> None:
    camera = Camera.from_hfov(240, 160, np.deg2rad(60.0))
    q = rotations.normalize((0.3, 0.8, 0.45, 0.25))
    light = Light((0.5, -0.6, -0.7), 0.8, 0.2)
    grey, silhouette, shadow = compare(
        satellite("geo_servicer"), camera, np.array([0.05, 0.0, 0.8]), q, light, 5
    )
    assert grey < 1.5
    assert len(silhouette) > 20
    assert np.abs(silhouette).max() < 0.1
    assert len(shadow) >= 5
    assert np.abs(shadow).mean() < 0.15
    assert np.percentile(np.abs(shadow), 95) < 0.3


@pytest.mark.parametrize("seed", range(3))
def test_cuboid_equals_that_of_embree_but_for_a_quarter_of_a_pixel(seed: int) -> None:
    """Faces without markers are filled with their outline (docs/markerless.md)."""
    size_m, generator = (0.3, 0.4, 0.2), np.random.default_rng(seed)
    camera = Camera.from_hfov(240, 160, np.deg2rad(60.0))
    position = np.array([*generator.uniform(-0.1, 0.1, 2), generator.uniform(0.8, 1.2)])
    q = rotations.normalize(generator.normal(size=4))
    light = Light((0.5, -0.6, -0.7), 0.8, 0.2)

    def draw(mesh: TriangleMesh, camera: Camera, position: Array, q: Array, light: Light) -> Array:
        shade = mesh.parts[0].material.diffuse
        model = TargetModel("box", (Box(size_m, shade=shade),), (), "DICT_4X4_50", size_m, 0.0)
        image = Renderer(camera, model).render(
            np.zeros(3), rotations.IDENTITY, position, q, (), light
        )
        return image.astype(float)

    mesh = mesh_of_boxes([Box(size_m, shade=0.7)])
    grey, silhouette, _ = compare(mesh, camera, position, q, light, 5, draw)
    assert grey < 1.0
    assert len(silhouette) > 10
    assert 0.0 < silhouette.mean() < 0.3
    assert np.abs(silhouette).max() < 0.4


def test_displacement_of_an_edge_is_measured() -> None:
    columns = np.arange(60.0)
    traced = np.tile(np.clip(columns - 29.3, 0.0, 1.0), (48, 1))
    drawn = np.tile(np.clip(columns - 29.1, 0.0, 1.0), (48, 1))
    found = displacements(drawn, traced, np.ones_like(traced, dtype=bool))
    assert len(found) == 4
    np.testing.assert_allclose(found, 0.2, atol=0.01)
