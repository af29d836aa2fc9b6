# SPDX-License-Identifier: Apache-2.0
"""Mesh files as targets: what is read, what is refused with which line, and what the flight
software receives of them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh
from chaserdock_models.decimation import deviation_m, limited, simplified
from chaserdock_models.meshes import Material, MeshPart, TriangleMesh, mass_properties, open_edges
from chaserdock_models.satellites import satellite
from chaserdock_protocol.scenario import (
    Scenario,
    ScenarioError,
    flight_scenario,
    parse_scenario,
    scenario_from_json,
)
from chaserdock_protocol.scenario.mesh_files import read_mesh
from scenario_samples import good

from chaserdock.targets.mesh_writer import write_mesh

MODEL = 'perception.name="model"'


def with_file(path: Path, *overrides: str) -> Scenario:
    return parse_scenario(good(), "test", (f'target.model="{path}"', MODEL, *overrides))


def ball(subdivisions: int, radius_m: float = 0.3) -> trimesh.Trimesh:
    return trimesh.creation.icosphere(subdivisions, radius_m)


def part_of(solid: trimesh.Trimesh) -> MeshPart:
    return MeshPart("ball", Material("grey"), np.asarray(solid.vertices), np.asarray(solid.faces))


def test_shipped_satellites_survive_a_file(tmp_path: Path) -> None:
    for name in ("geo_servicer", "cubesat_12u"):
        write_mesh(satellite(name, 2e-3), tmp_path / f"{name}.glb")
        found, mesh = read_mesh(tmp_path / f"{name}.glb"), satellite(name, 2e-3)
        assert found.notes == ()
        read = {p.name: p for p in found.mesh.parts}
        assert set(read) == set(mesh.part_names)
        for part in mesh.parts:
            assert (read[part.name].material, read[part.name].joint) == (part.material, part.joint)
            assert deviation_m(part, read[part.name]) < 1e-6
        assert found.mesh.joints.keys() == mesh.joints.keys()
        for joint, at in mesh.joints.items():
            assert found.mesh.joints[joint] == pytest.approx(at)


def test_obj_keeps_objects_and_plain_materials(tmp_path: Path) -> None:
    write_mesh(satellite("geo_servicer", 2e-3), tmp_path / "geo.obj")
    read = {p.name: p for p in read_mesh(tmp_path / "geo.obj").mesh.parts}
    assert set(read) == set(satellite("geo_servicer").part_names)
    assert read["dish"].material.diffuse == pytest.approx(0.8, abs=0.003)
    assert read["nozzle"].material.shininess == pytest.approx(18.0)


def test_units_origin_and_mirrored_nodes(tmp_path: Path) -> None:
    scene = trimesh.Scene()
    mirror = np.diag([-1000.0, 1000.0, 1000.0, 1.0])
    mirror[0, 3] = 500.0
    scene.add_geometry(trimesh.creation.box((0.4, 0.2, 0.1)), transform=mirror)
    scene.export(str(tmp_path / "mm.glb"))
    with pytest.raises(
        ScenarioError,
        match=r"is 400 m long; .* if it is in millimetres, mesh_scale = 0\.001 makes it 0\.4 m",
    ):
        read_mesh(tmp_path / "mm.glb")
    mesh = read_mesh(tmp_path / "mm.glb", 1e-3, (0.5, 0.0, 0.0)).mesh
    np.testing.assert_allclose(mesh.bounds_m(), [[-0.2, -0.1, -0.05], [0.2, 0.1, 0.05]], atol=1e-6)
    assert mass_properties(mesh, 1.0)[0] == pytest.approx([0, 0, 0], abs=1e-6)


def test_defects_are_one_line(tmp_path: Path) -> None:
    holed = ball(2)
    holed.update_faces(np.arange(len(holed.faces)) > 3)
    holed.export(str(tmp_path / "holed.glb"))
    trimesh.Trimesh(
        [[0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 1]], process=False
    ).export(str(tmp_path / "flat.stl"))
    (tmp_path / "text.glb").write_bytes(b"hello")
    (tmp_path / "text.obj").write_text("hello\n")
    (tmp_path / "cut.glb").write_bytes(b"glTF\x02\x00\x00\x00\xff\xff")
    for name, message in (
        (
            "holed.glb",
            r"part '\w+' has a hole: \d+ open edges, one near \(.*\) m; close its surface",
        ),
        ("flat.stl", "encloses no volume; give it a thickness"),
        ("text.glb", "not a GLB mesh: it does not begin with 'glTF'"),
        ("text.obj", "contains no triangles"),
        ("cut.glb", "not a GLB mesh"),
        ("none.glb", "no such file"),
        ("mesh.step", r"its name must end in \.glb, \.gltf, \.obj, \.stl, \.ply"),
    ):
        with pytest.raises(ScenarioError, match=message) as caught:
            read_mesh(tmp_path / name)
        assert str(caught.value).startswith(str(tmp_path / name))
        assert "\n" not in str(caught.value)


def test_inverted_and_uncoloured_surfaces_are_accepted_with_a_note(tmp_path: Path) -> None:
    solid = ball(2)
    solid.invert()
    solid.export(str(tmp_path / "ball.stl"))
    found = read_mesh(tmp_path / "ball.stl")
    assert any("were clockwise and are turned" in note for note in found.notes)
    assert any("no material; it is drawn in uniform grey" in note for note in found.notes)
    assert mass_properties(found.mesh, 1.0)[1][0, 0] == pytest.approx(0.4 * 0.3**2, rel=0.03)


def test_large_meshes_are_decimated_with_their_deviation(tmp_path: Path) -> None:
    ball(6).export(str(tmp_path / "ball.glb"))
    found = read_mesh(tmp_path / "ball.glb")
    assert 15_000 < found.mesh.triangle_count < 21_000
    assert any(
        "decimated from 81,920 to " in note and "largest deviation" in note for note in found.notes
    )
    middles = np.linalg.norm(
        found.mesh.parts[0].vertices_m[found.mesh.parts[0].triangles].mean(axis=1), axis=1
    )
    assert 0.0 < 0.5 * (0.3 - middles.min()) < found.deviation_m < 2.0 * (0.3 - middles.min())


def test_simplification_keeps_its_tolerance() -> None:
    mesh = TriangleMesh("m", (part_of(ball(4)),), {})
    few, deviation = limited(mesh, 500)
    assert few.triangle_count < 600
    assert deviation == pytest.approx(deviation_m(mesh.parts[0], few.parts[0]))
    less = simplified(mesh, 0.003)
    assert less.triangle_count < 0.5 * mesh.triangle_count
    assert open_edges(less.parts[0]) == 0
    assert np.abs(np.linalg.norm(less.parts[0].vertices_m, axis=1) - 0.3).max() < 0.003


def test_distance_of_displaced_boxes_is_exact() -> None:
    a, b = trimesh.creation.box((0.4, 0.3, 0.2)), trimesh.creation.box((0.4, 0.3, 0.2))
    b.apply_translation((0.0, 0.0, 0.013))
    assert deviation_m(part_of(a), part_of(b)) == pytest.approx(0.013)


@pytest.fixture(scope="module")
def servicer_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("mesh") / "own-servicer.glb"
    write_mesh(satellite("geo_servicer", 1e-3), path)
    return path


@pytest.mark.slow
def test_flight_software_receives_the_simplified_surface_only(servicer_file: Path) -> None:
    scenario = with_file(
        servicer_file,
        'target.knowledge.missing=["dish"]',
        "target.knowledge.simplification_m=0.004",
        "target.mass_kg=9.0",
    )
    flight = flight_scenario(scenario)
    known, nominal = flight.target.known_mesh(), scenario.target.nominal_mesh()
    assert known is not None
    assert nominal is not None
    assert flight.target.nominal_mesh() is known
    assert set(nominal.part_names) - set(known.part_names) == {"dish"}
    assert known.triangle_count < 0.6 * nominal.triangle_count
    by_name = {p.name: p for p in nominal.parts}
    assert max(deviation_m(by_name[p.name], p) for p in known.parts) < 0.004 + 1e-6
    assert "dish" not in {p.name for p in flight.target.geometry.surface.parts}  # type: ignore[union-attr]
    np.testing.assert_allclose(flight.target.inertia_tensor, scenario.target.inertia_tensor)
    np.testing.assert_allclose(scenario.target.inertia_tensor, mass_properties(nominal, 9.0)[1])
    assert known.joints.keys() == {"panel_north", "panel_south"}


def test_scenario_does_not_need_the_file_any_more(servicer_file: Path, tmp_path: Path) -> None:
    copy = tmp_path / "copy.glb"
    copy.write_bytes(servicer_file.read_bytes())
    scenario = with_file(copy)
    copy.unlink()
    again = scenario_from_json(scenario.model_dump_json(), "x")
    assert again == scenario
    assert again.target.model == "copy"


@pytest.mark.slow
def test_markers_lie_on_shipped_and_own_meshes(servicer_file: Path) -> None:
    marker = "{id=3, side_m=0.1, position_m=[0.21, 0.0, 0.0], q_wxyz=[0.5, 0.5, 0.5, 0.5]}"
    for mesh in (str(servicer_file), "geo_servicer"):
        geometry = (
            f'target.geometry={{dictionary="DICT_4X4_50", mesh="{mesh}", markers=[{marker}]}}'
        )
        coarse = "target.knowledge.simplification_m=0.02"
        scenario = parse_scenario(good(), "test", (geometry, 'target.model="marked"', coarse))
        model = scenario.target_model()
        assert [m.id for m in model.markers] == [3]
        assert (model.satellite, model.hulls) == ("marked", True)
        assert scenario.target.nominal_mesh() is not None
        assert flight_scenario(scenario).target_model().markers == model.markers


@pytest.mark.parametrize(
    ("override", "message"),
    [
        (
            'target.geometry={mesh="geo_servicer", markers=[{id=1, side_m=0.1, face="+x"}]}',
            "dictionary: is missing",
        ),
        ('target.geometry={dictionary="DICT_4X4_50", markers=[]}', "cuboids: is empty"),
        ('target.geometry={mesh="nowhere.glb"}', r"nowhere\.glb: no such file"),
        (
            'target.geometry={dictionary="DICT_4X4_50", mesh="geo_servicer", '
            'markers=[{id=1, side_m=0.1, face="+x"}]}',
            "no cuboid 0; give position_m and q_wxyz",
        ),
    ],
)
def test_invalid_geometry_is_one_line(override: str, message: str) -> None:
    with pytest.raises(ScenarioError, match=message) as caught:
        parse_scenario(good(), "test", (override, 'target.model="own"'))
    assert "\n" not in str(caught.value)


def test_centre_of_mass_is_checked(servicer_file: Path) -> None:
    free = 'target.motion="torque_free"'
    with_file(servicer_file, free)
    with pytest.raises(
        ScenarioError, match=r"that of the mesh is \(0\.3, .*mesh_origin_m = \["
    ) as caught:
        with_file(servicer_file, free, "target.geometry.mesh_origin_m=[-0.3, 0.0, 0.0]")
    assert "\n" not in str(caught.value)
