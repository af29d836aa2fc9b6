# SPDX-License-Identifier: Apache-2.0
"""Repair of surfaces: what is turned, joined or dropped is stated, and volumes come out right."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from chaserdock_models.mesh_repair import joined, repaired
from chaserdock_models.meshes import Material, MeshPart, open_edges, volume_m3
from chaserdock_protocol.scenario import ScenarioError
from chaserdock_protocol.scenario.mesh_files import MeshFile, read_mesh

BOX = trimesh.creation.box((1.0, 0.8, 0.6))


def part_of(solid: trimesh.Trimesh) -> MeshPart:
    return MeshPart("p", Material("grey"), np.array(solid.vertices), np.array(solid.faces))


def shuffled(solid: trimesh.Trimesh, share: float, seed: int) -> trimesh.Trimesh:
    """Return a solid with a share of its triangles turned."""
    faces = np.array(solid.faces)
    turned = np.random.default_rng(seed).random(len(faces)) < share
    faces[turned] = faces[turned][:, ::-1]
    return trimesh.Trimesh(solid.vertices, faces, process=False)


def together(*solids: trimesh.Trimesh) -> trimesh.Trimesh:
    starts = np.cumsum([0, *(len(s.vertices) for s in solids)])
    return trimesh.Trimesh(
        np.concatenate([s.vertices for s in solids]),
        np.concatenate([s.faces + k for s, k in zip(solids, starts, strict=False)]),
        process=False,
    )


def inverted(solid: trimesh.Trimesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(solid.vertices, np.array(solid.faces)[:, ::-1], process=False)


def beside(solid: trimesh.Trimesh, offset_m: float) -> trimesh.Trimesh:
    return trimesh.Trimesh(solid.vertices + np.array([offset_m, 0, 0]), solid.faces, process=False)


def read(tmp_path: Path, solid: trimesh.Trimesh, suffix: str = ".stl") -> MeshFile:
    path = tmp_path / f"solid{suffix}"
    solid.export(str(path))
    return read_mesh(path)


@pytest.mark.parametrize("suffix", [".stl", ".obj", ".ply", ".off", ".glb"])
@pytest.mark.parametrize("share", [0.2, 0.5, 0.9])
def test_inconsistent_winding_is_repaired(tmp_path: Path, suffix: str, share: float) -> None:
    for seed, solid in enumerate((BOX, trimesh.creation.torus(0.5, 0.1, 16, 8))):
        found = read(tmp_path, shuffled(solid, share, seed), suffix)
        assert volume_m3(found.mesh.parts[0]) == pytest.approx(solid.volume, rel=1e-5)
        assert open_edges(found.mesh.parts[0]) == 0
        assert any("disagreed with their neighbours and are turned" in n for n in found.notes)


def test_the_number_of_turned_triangles_is_that_of_the_smaller_share() -> None:
    faces = np.array(BOX.faces)
    faces[[2, 5, 7]] = faces[[2, 5, 7]][:, ::-1]
    part, notes = repaired(part_of(trimesh.Trimesh(BOX.vertices, faces, process=False)))
    assert notes == ("3 triangles disagreed with their neighbours and are turned",)
    np.testing.assert_array_equal(
        np.sort(part.triangles, axis=1), np.sort(np.array(BOX.faces), axis=1)
    )


def test_sound_surfaces_are_not_touched() -> None:
    hollow = together(BOX, inverted(trimesh.creation.icosphere(2, 0.2)))
    for solid in (BOX, hollow, trimesh.creation.annulus(0.2, 0.3, 0.1)):
        part = part_of(solid)
        found, notes = repaired(part)
        assert notes == ()
        np.testing.assert_array_equal(found.triangles, part.triangles)


def test_one_inverted_body_of_several_is_turned() -> None:
    for first, second in ((BOX, inverted(beside(BOX, 2.0))), (inverted(BOX), beside(BOX, 2.0))):
        part, notes = repaired(part_of(together(first, second)))
        assert volume_m3(part) == pytest.approx(0.96)
        assert notes == ("the triangles of 1 of its 2 surfaces were clockwise and are turned",)


def test_cavities_stay_cavities() -> None:
    cavity = inverted(trimesh.creation.icosphere(2, 0.2))
    volume = 0.48 - abs(cavity.volume)
    for solid, count in (
        (together(BOX, cavity), 0),
        (inverted(together(BOX, cavity)), 1),
        (together(inverted(together(BOX, cavity)), beside(BOX, 3.0)), 1),
    ):
        part, notes = repaired(part_of(solid))
        assert volume_m3(part) % 0.48 == pytest.approx(volume)
        assert len(notes) == count


def test_body_in_the_bend_of_another_is_no_cavity() -> None:
    ring = trimesh.creation.annulus(0.4, 0.5, 0.1)
    part, _ = repaired(part_of(together(ring, inverted(trimesh.creation.icosphere(1, 0.05)))))
    assert volume_m3(part) > ring.volume


def test_triangles_that_exist_twice_are_dropped() -> None:
    for second in (BOX, inverted(BOX)):
        part, notes = repaired(
            part_of(trimesh.Trimesh(BOX.vertices, [*BOX.faces, *second.faces], process=False))
        )
        assert volume_m3(part) == pytest.approx(0.48)
        assert notes == ("12 triangles existed twice, of which one is kept",)


def test_fins_without_thickness_on_a_body_are_kept() -> None:
    """Both sides of a fin are needed, or its rim would be a hole."""
    vertices = [*BOX.vertices.tolist(), [0.0, 0.0, 2.0]]
    a, b = BOX.edges_unique[0].tolist()
    fin = [[a, b, 8], [b, a, 8]]
    part = part_of(trimesh.Trimesh(vertices, [*BOX.faces.tolist(), *fin], process=False))
    found, notes = repaired(part)
    assert (len(found.triangles), notes) == (14, ())


def test_parts_are_joined_only_if_that_closes_them() -> None:
    whole = part_of(BOX)
    rows = np.arange(12)
    pieces = [
        MeshPart(name, Material(name, grey), whole.vertices_m, whole.triangles[rows % 2 == k])
        for k, (name, grey) in enumerate((("a", 0.2), ("b", 0.6)))
    ]
    other = MeshPart("c", Material("c"), whole.vertices_m + 5.0, whole.triangles)
    parts, notes = joined([*pieces, other], 1e-7)
    assert [p.name for p in parts] == ["a", "c"]
    assert open_edges(parts[0]) == 0
    share = BOX.area_faces[1::2].sum() / BOX.area
    assert parts[0].material.diffuse == pytest.approx(0.2 + 0.4 * share, abs=1e-4)
    assert notes == ("a, b: closed only together; joined, with the mean of their materials",)
    holed = MeshPart("b", Material("b"), whole.vertices_m, whole.triangles[1:-2:2])
    assert joined([pieces[0], holed, other], 1e-7) == ([pieces[0], holed, other], ())


def test_what_has_no_inside_is_refused_by_its_reason(tmp_path: Path) -> None:
    wall = trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, -1]],
        [[0, 1, 2], [0, 1, 3], [0, 2, 3], [1, 2, 3], [0, 1, 4], [0, 2, 4], [1, 2, 4]],
        process=False,
    )
    with pytest.raises(ScenarioError, match="more than two triangles meet or a surface has one"):
        read(tmp_path, wall)
    for missing in (1, 5):
        solid = shuffled(trimesh.Trimesh(BOX.vertices, BOX.faces[missing:], process=False), 0.5, 1)
        with pytest.raises(ScenarioError, match=r"has a hole: \d+ open edges, one near"):
            read(tmp_path, solid)
    rows, columns, u = 24, 12, np.linspace(0, 2 * np.pi, 24, endpoint=False)
    v = (np.linspace(0, 2 * np.pi, 12, endpoint=False) + np.pi / 12)[None, :]
    u = u[:, None]
    radius = 2 + np.cos(u / 2) * np.sin(v) - np.sin(u / 2) * np.sin(2 * v)
    klein = np.stack(
        [radius * np.cos(u), radius * np.sin(u),
         np.sin(u / 2) * np.sin(v) + np.cos(u / 2) * np.sin(2 * v)], axis=2
    ).reshape(-1, 3)  # fmt: skip
    faces = []
    for i in range(rows):
        for j in range(columns):
            k, m = (i + 1) % rows, (j + 1) % columns
            right, far = (j, m) if k else (columns - 1 - j, columns - 1 - m)
            a, b, c, d = i * columns + j, i * columns + m, k * columns + far, k * columns + right
            faces += [[a, b, c], [a, c, d]]
    with pytest.raises(ScenarioError, match="a surface has one side; make it manifold"):
        read(tmp_path, trimesh.Trimesh(klein, faces, process=False))
