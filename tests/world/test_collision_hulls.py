# SPDX-License-Identifier: Apache-2.0
"""Convex pieces for collisions: solid where the mesh is, open where it is hollow."""

from __future__ import annotations

import numpy as np
import pybullet
import pytest
import trimesh
from chaserdock_models.meshes import Material, MeshPart, TriangleMesh
from chaserdock_models.satellites import box, lathe, satellite
from chaserdock_world.physics.bullet_engine import BulletEngine
from chaserdock_world.physics.collision_hulls import (
    MOST_PIECES,
    collision_hulls,
    connected_surfaces,
)
from chaserdock_world.physics.simulation import TARGET, Physics
from scipy.spatial import ConvexHull
from world_cases import scenario

GREY = Material("grey")


def pieces(*parts: MeshPart) -> list[np.ndarray]:
    return collision_hulls(TriangleMesh("m", parts, {}))


def test_convex_parts_stay_whole() -> None:
    turned = box("b", GREY, (0.4, 0.2, 0.1), (0.1, 0.0, 0.0), (0.3, 0.2, -0.4))
    (hull,) = pieces(turned)
    assert ConvexHull(hull).volume == pytest.approx(0.4 * 0.2 * 0.1, rel=1e-6)
    cylinder = lathe(
        "c", GREY, ((0, 0), (0.1, 0), (0.1, 0.3), (0, 0.3)), (0, 0, 0), (0.2, 0.3, 1), 1e-3
    )
    solid = trimesh.creation.icosphere(5, 0.2)
    ball = MeshPart("ball", GREY, np.asarray(solid.vertices), np.asarray(solid.faces))
    assert [len(pieces(part)) for part in (cylinder, ball)] == [1, 1]
    assert ConvexHull(pieces(ball)[0]).volume == pytest.approx(4 / 3 * np.pi * 0.2**3, rel=0.05)


def test_surfaces_of_one_part_are_separated() -> None:
    a, b = box("a", GREY, (0.1, 0.1, 0.1), (0, 0, 0)), box("b", GREY, (0.1, 0.1, 0.1), (0.5, 0, 0))
    both = MeshPart(
        "p",
        GREY,
        np.vstack([a.vertices_m, b.vertices_m]),
        np.vstack([a.triangles, b.triangles + 8]),
    )
    assert [len(s.vertices_m) for s in connected_surfaces(both)] == [8, 8]
    assert sum(ConvexHull(h).volume for h in pieces(both)) == pytest.approx(2e-3)


def test_ring_becomes_arcs() -> None:
    ring = lathe(
        "r", GREY, ((0.118, 0), (0.13, 0), (0.13, 0.03), (0.118, 0.03)), (0, 0, 0), (0, 0, 1), 2e-4
    )
    arcs = pieces(ring)
    assert 8 <= len(arcs) <= MOST_PIECES
    true = np.pi * (0.13**2 - 0.118**2) * 0.03
    assert true * 0.98 < sum(ConvexHull(h).volume for h in arcs) < 1.6 * true


@pytest.mark.slow
def test_rays_find_the_ring_and_pass_through_it() -> None:
    """Bullet's shape of ``geo_servicer``: its adapter ring is hollow around the nozzle."""
    physics = Physics(
        scenario(
            target={"model": "geo_servicer", "knowledge": {"panel_deg": 0.0, "scale_share": 0.0}},
            perception={"name": "model"},
            chasers=[{"position_m": [-3.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}],
        )
    )
    engine, state = physics._engine, physics.state(TARGET)
    assert isinstance(engine, BulletEngine)
    ring = next(p for p in satellite("geo_servicer").parts if p.name == "adapter_ring").vertices_m
    low, high = ring.min(axis=0), ring.max(axis=0)
    _, y0, z0 = (low + high) / 2
    assert np.abs(state.q_wxyz - (1, 0, 0, 0)).max() < 1e-12
    for radius, depth in ((0.085, high[0]), (0.124, low[0])):
        for angle in np.linspace(0.0, 2.0 * np.pi, 12, endpoint=False):
            y, z = y0 + radius * np.cos(angle), z0 + radius * np.sin(angle)
            at = np.array([[-1.0, y, z], [1.0, y, z]]) + state.position_m
            hit = pybullet.rayTest(*at.tolist(), physicsClientId=engine._client)[0]
            assert hit[3][0] - state.position_m[0] == pytest.approx(
                depth, abs=2e-3
            )  # Bullet's margin is 1 mm
