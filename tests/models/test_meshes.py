# SPDX-License-Identifier: Apache-2.0
"""Meshes and shipped satellites: closed surfaces, mass properties, geometry errors, boxes around
parts.
"""

from __future__ import annotations

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.meshes import (
    Material,
    MeshPart,
    TriangleMesh,
    mass_properties,
    moved,
    open_edges,
    triangle_soup,
    volume_m3,
    with_geometry_errors,
    without_parts,
)
from chaserdock_models.satellites import FINE_M, box, lathe, satellite, satellite_names
from chaserdock_models.targets import box_around, target_model

GREY = Material("grey")


@pytest.mark.parametrize("name", satellite_names())
@pytest.mark.parametrize("tolerance_m", [FINE_M, 2e-3])
def test_parts_are_closed_and_counter_clockwise(name: str, tolerance_m: float) -> None:
    mesh = satellite(name, tolerance_m)
    assert [p.name for p in mesh.parts if open_edges(p) or not volume_m3(p) > 0.0] == []
    assert len(set(mesh.part_names)) == len(mesh.parts)
    assert {p.joint for p in mesh.parts if p.joint} == set(mesh.joints)
    soup = triangle_soup(mesh)
    flat = np.cross(
        soup.corners_m[:, 1] - soup.corners_m[:, 0], soup.corners_m[:, 2] - soup.corners_m[:, 0]
    )
    assert np.linalg.norm(flat, axis=1).min() > 0.0
    np.testing.assert_allclose(np.linalg.norm(soup.normals, axis=2), 1.0, atol=1e-12)
    assert np.einsum("ijk,ik->ij", soup.normals, flat).min() > 0.0


def test_hole_is_counted() -> None:
    part = box("b", GREY, (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
    assert open_edges(part) == 0
    assert open_edges(MeshPart("b", GREY, part.vertices_m, part.triangles[1:])) == 3
    assert (
        open_edges(
            MeshPart(
                "b",
                GREY,
                part.vertices_m,
                np.vstack([part.triangles[1:], part.triangles[:1, ::-1]]),
            )
        )
        == 6
    )


def test_facets_stay_within_the_tolerance() -> None:
    for tolerance in (2e-4, 1e-3):
        part = lathe(
            "c", GREY, ((0, 0), (0.13, 0), (0.13, 0.1), (0, 0.1)), (0, 0, 0), (0, 0, 1), tolerance
        )
        middles = part.vertices_m[part.triangles[:, :2]].mean(axis=1)[:, :2]
        radii = np.linalg.norm(middles, axis=1)
        assert 0.13 - tolerance <= radii[radii > 0.1].min() < 0.13 - 0.5 * tolerance


def test_creases_are_sharp_and_curved_surfaces_smooth() -> None:
    part = lathe("c", GREY, ((0, 0), (0.1, 0), (0.1, 0.2), (0, 0.2)), (0, 0, 0), (0, 0, 1), 1e-4)
    soup = triangle_soup(TriangleMesh("m", (part,), {}))
    corners, normals = soup.corners_m.reshape(-1, 3), soup.normals.reshape(-1, 3)
    side = np.abs(normals[:, 2]) < 0.5
    radial = corners[side, :2] / 0.1
    assert np.abs(normals[side, :2] - radial).max() < 0.02
    np.testing.assert_allclose(np.abs(normals[~side, 2]), 1.0, atol=1e-12)


def test_mass_properties_of_a_displaced_cuboid_and_a_cylinder() -> None:
    turn = (0.3, -0.5, 0.2)
    cuboid = TriangleMesh("m", (box("b", GREY, (0.4, 0.2, 0.1), (0.1, -0.2, 0.3), turn),), {})
    centre, inertia = mass_properties(cuboid, 12.0)
    np.testing.assert_allclose(centre, (0.1, -0.2, 0.3), atol=1e-9)
    rotation = rotations.to_matrix(rotations.exp(np.array(turn)))
    expected = rotation @ np.diag([0.05, 0.17, 0.2]) @ rotation.T
    np.testing.assert_allclose(inertia, expected, atol=1e-8)
    round_ = lathe("c", GREY, ((0, 0), (0.1, 0), (0.1, 0.3), (0, 0.3)), (0, 0, 0), (0, 0, 1), 1e-6)
    centre, inertia = mass_properties(TriangleMesh("m", (round_,), {}), 2.0)
    np.testing.assert_allclose(centre, (0.0, 0.0, 0.15), atol=1e-9)
    across = 2.0 * (3 * 0.1**2 + 0.3**2) / 12
    np.testing.assert_allclose(inertia, np.diag([across, across, 0.01]), rtol=1e-4, atol=1e-9)


def test_denser_parts_attract_the_centre_of_mass() -> None:
    heavy = Material("heavy", relative_density=3.0)
    parts = (box("a", GREY, (1, 1, 1), (0, 0, 0)), box("b", heavy, (1, 1, 1), (2, 0, 0)))
    np.testing.assert_allclose(
        mass_properties(TriangleMesh("m", parts, {}), 1.0)[0], (1.5, 0, 0), atol=1e-9
    )


@pytest.mark.parametrize("name", ["geo_servicer", "cubesat_12u"])
def test_origin_is_the_centre_of_mass_at_every_tolerance(name: str) -> None:
    for tolerance in (FINE_M, 1e-3, 1e-2):
        mesh = satellite(name, tolerance)
        assert np.abs(mass_properties(mesh, 1.0)[0]).max() < (1e-4 if tolerance == FINE_M else 5e-4)
        bus = next(p for p in mesh.parts if p.name == "bus")
        np.testing.assert_array_equal(bus.vertices_m, satellite(name).parts[0].vertices_m)


def test_geometry_errors_scale_the_body_and_turn_the_joints() -> None:
    mesh = satellite("geo_servicer")
    turn = np.array([0.0, 0.0, 0.01])
    other = with_geometry_errors(mesh, 0.01, {"panel_north": turn})
    parts = {p.name: (p, q) for p, q in zip(mesh.parts, other.parts, strict=True)}
    before, after = parts["dish"]
    np.testing.assert_allclose(after.vertices_m, 1.01 * before.vertices_m)
    for joint, vector in (("panel_north", turn), ("panel_south", np.zeros(3))):
        at = np.array(mesh.joints[joint])
        before, after = parts[joint]
        expected = rotations.rotate(rotations.exp(vector), before.vertices_m - at) + 1.01 * at
        np.testing.assert_allclose(after.vertices_m, expected, atol=1e-12)
    same = with_geometry_errors(mesh, 0.0, {})
    for p, q in zip(mesh.parts, same.parts, strict=True):
        np.testing.assert_allclose(p.vertices_m, q.vertices_m, atol=1e-15)


def test_parts_are_left_out_by_name() -> None:
    mesh = satellite("geo_servicer")
    less = without_parts(mesh, ["dish", "dish_feed"])
    assert set(mesh.part_names) - set(less.part_names) == {"dish", "dish_feed"}
    with pytest.raises(ValueError, match="geo_servicer has no part 'mast'; its parts: bus, "):
        without_parts(mesh, ["mast"])
    with pytest.raises(ValueError, match="no part would be left"):
        without_parts(mesh, mesh.part_names)


def test_boxes_enclose_their_parts_tightly() -> None:
    for part in satellite("geo_servicer").parts:
        around = box_around(part)
        local = rotations.rotate_inverse(
            around.q_wxyz, part.vertices_m - np.array(around.position_m)
        )
        half = np.array(around.size_m) / 2.0
        np.testing.assert_allclose(local.max(axis=0), half, atol=1e-6)
        np.testing.assert_allclose(local.min(axis=0), -half, atol=1e-6)
    panel = next(p for p in satellite("geo_servicer").parts if p.name == "panel_north")
    assert sorted(np.round(box_around(panel).size_m, 6)) == [0.010, 0.22, 0.40]


def test_satellite_is_a_target_without_markers() -> None:
    model = target_model("geo_servicer")
    assert model.satellite == "geo_servicer"
    assert not model.markers
    low, high = satellite("geo_servicer").bounds_m()
    assert np.all(np.array(model.size_m) / 2.0 >= np.maximum(-low, high) - 1e-12)


def test_moved_scales_then_displaces() -> None:
    mesh = moved(satellite("chaser_body"), np.array([0.0, 0.0, 1.0]), np.array([2.0, 1.0, 1.0]))
    low, high = mesh.bounds_m()
    np.testing.assert_allclose(
        [low, high], [[-0.25, -0.125, 0.975], [0.25, 0.125, 1.025]], atol=1e-9
    )


def test_unknown_satellite_is_an_error() -> None:
    with pytest.raises(
        ValueError, match="unknown satellite 'x'; known: chaser_body, cubesat_12u, geo_servicer"
    ):
        satellite("x")
    with pytest.raises(ValueError, match="tolerance_m must be positive"):
        satellite("geo_servicer", 0.0)
