# SPDX-License-Identifier: Apache-2.0
"""OBJ, STL, PLY, OFF and COLLADA as people have them; files of all installed packages are read or
refused in one line.
"""

from __future__ import annotations

import importlib.util
import os
import site
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from chaserdock_models.meshes import mass_properties, volume_m3
from chaserdock_protocol.scenario import ScenarioError
from chaserdock_protocol.scenario.mesh_files import read_mesh
from chaserdock_protocol.scenario.surface import SUFFIXES
from chaserdock_world.physics.collision_hulls import collision_hulls
from gltf_samples import png, refusal

BOX = trimesh.creation.box((1.0, 0.8, 0.6))


def vertex_lines() -> list[str]:
    return ["v {:g} {:g} {:g}".format(*row) for row in BOX.vertices.tolist()]


def obj(tmp_path: Path, lines: list[str], mtl: str = "", name: str = "m") -> Path:
    (tmp_path / f"{name}.obj").write_text("\n".join(lines) + "\n")
    if mtl:
        (tmp_path / f"{name}.mtl").write_text(mtl)
    return tmp_path / f"{name}.obj"


def faces(rows: np.ndarray, end: str = "") -> list[str]:
    return ["f " + " ".join(f"{k + 1}{end}" for k in row) for row in rows.tolist()]


def test_coordinates_of_a_texture_without_image_are_no_material(tmp_path: Path) -> None:
    bare = obj(tmp_path, [*vertex_lines(), "vt 0 0", *faces(BOX.faces, "/1")])
    lost = obj(
        tmp_path,
        ["mtllib lost.mtl", *vertex_lines(), "vt 0 0", "usemtl x", *faces(BOX.faces, "/1")],
        name="lost",
    )
    head = "ply\nformat ascii 1.0\nelement vertex 4\n"
    head += "".join(f"property float {k}\n" for k in ("x", "y", "z", "s", "t"))
    head += "element face 4\nproperty list uchar int vertex_indices\nend_header\n"
    body = "0 0 0 0 0\n1 0 0 1 0\n0 1 0 0 1\n0 0 1 1 1\n3 0 2 1\n3 0 1 3\n3 0 3 2\n3 1 2 3\n"
    (tmp_path / "uv.ply").write_text(head + body)
    for path in (bare, lost, tmp_path / "uv.ply"):
        found = read_mesh(path)
        material = found.mesh.parts[0].material
        assert (material.diffuse, material.specular) == (0.5, 0.0)
        assert any(
            "no material; it is drawn in uniform grey of reflectance 0.5" in n for n in found.notes
        )
    assert "refers to 'lost.mtl': no such file; drawn without it" in read_mesh(lost).notes


def test_material_files_say_what_they_say(tmp_path: Path) -> None:
    mtl = "newmtl a\nKd 0.2 0.2 0.2\nnewmtl b\nKd 0.123\nKs 0.1 0.1 0.1\nNs 50\nnewmtl c\nd 1\n"
    lines = ["mtllib m.mtl"]
    for k, name in enumerate("abc"):
        lines += [f"o {name}_body", *(f"v {x + 2 * k:g} {y:g} {z:g}" for x, y, z in BOX.vertices)]
        lines += [f"usemtl {name}", *faces(BOX.faces + 8 * k)]
    found = read_mesh(obj(tmp_path, lines, mtl))
    read = {p.name: p.material for p in found.mesh.parts}
    assert (read["a_body"].diffuse, read["a_body"].specular) == (0.2, 0.0)
    b = read["b_body"]
    assert (b.diffuse, b.specular, b.shininess) == (0.123, 0.1, 50.0)
    assert (read["c_body"].diffuse, read["c_body"].specular) == (0.5, 0.0)
    assert [n for n in found.notes if "has no diffuse colour" in n]


def test_object_of_two_materials_is_their_mean(tmp_path: Path) -> None:
    mtl = "newmtl a\nKd 0.2 0.2 0.2\nnewmtl b\nKd 0.8 0.8 0.8\n"
    rows = np.abs(BOX.face_normals[:, 2]) > 0.5
    lines = ["mtllib m.mtl", "o body", *vertex_lines(), "usemtl a", *faces(BOX.faces[rows])]
    found = read_mesh(obj(tmp_path, [*lines, "usemtl b", *faces(BOX.faces[~rows])], mtl))
    (part,) = found.mesh.parts
    assert part.material.diffuse == pytest.approx((0.2 * 1.6 + 0.8 * 2.16) / 3.76, abs=1e-3)
    assert any("joined" in note for note in found.notes)


def test_textures_of_material_files_are_srgb_and_stay_in_the_folder(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    lines = ["mtllib m.mtl", *vertex_lines(), "vt 0 0", "usemtl a", *faces(BOX.faces, "/1")]
    (tmp_path / "grey.png").write_bytes(png((188, 188, 188)))
    (tmp_path / "in" / "grey.png").write_bytes(png((188, 188, 188)))
    (tmp_path / "in" / "broken.png").write_bytes(b"no image")
    os.mkfifo(tmp_path / "in" / "pipe.png")
    for name, diffuse, note in (
        ("grey.png", 0.50, "drawn as its mean, reflectance 0.50"),
        ("-s 1 1 1 grey.png", 0.50, "drawn as its mean, reflectance 0.50"),
        ("../grey.png", 0.3, "outside its folder"),
        ("pipe.png", 0.3, "not a regular file"),
        ("broken.png", 0.3, "not an image that can be read; use PNG or JPEG; drawn without it"),
        ("none.png", 0.3, "no such file; drawn without it"),
    ):
        mtl = f"newmtl a\nKd 0.3 0.3 0.3\nmap_Kd {name}\n"
        found = read_mesh(obj(tmp_path / "in", lines, mtl))
        assert found.mesh.parts[0].material.diffuse == pytest.approx(diffuse, abs=0.005), name
        assert any(note in n for n in found.notes), (name, found.notes)


def test_material_file_may_not_be_a_pipe(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "m.mtl")
    found = read_mesh(obj(tmp_path, ["mtllib m.mtl", *vertex_lines(), *faces(BOX.faces)]))
    assert any("refers to 'm.mtl': not a regular file" in note for note in found.notes)


def test_negative_indices_count_from_their_line(tmp_path: Path) -> None:
    lines = []
    for shift in (0.0, 3.0):
        lines += [f"v {x + shift:g} {y:g} {z:g}" for x, y, z in BOX.vertices.tolist()]
        lines += ["f " + " ".join(str(k - 8) for k in row) for row in BOX.faces.tolist()]
    mesh = read_mesh(obj(tmp_path, lines)).mesh
    np.testing.assert_allclose(np.ptp(mesh.bounds_m(), axis=0), [[4.0, 0.8, 0.6]][0], atol=1e-6)
    assert sum(map(volume_m3, mesh.parts)) == pytest.approx(0.96, rel=1e-6)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "not a OBJ mesh|does not exist"),
        (
            "a.obj",
            b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 0 1 2\n",
            "face with vertex 0, where the first is 1",
        ),
        ("a.obj", b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "not a number|not a OBJ mesh"),
        ("a.obj", b"v 0 0 0\nf 1 1 1\n", "is 0 m long"),
        ("a.obj", b"\x00\xff\xfe" * 50, "."),
        (
            "a.ply",
            b"ply\nformat ascii 1.0\nelement vertex 999999999\nend_header\n",
            "its head says",
        ),
        (
            "a.ply",
            b"ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\n"
            b"property float y\nproperty float z\nelement face 1\n"
            b"property list uchar int vertex_indices\nend_header\n"
            + struct.pack("<9fB3i", *range(9), 3, 0, 1, 7),
            "does not exist",
        ),
        ("a.ply", b"plyformat", "does not begin with 'ply' or has no 'end_header'"),
        ("a.off", b"OFF\n99999999999 1 0\n", "its head says 99999999999 of 'vertex'"),
        ("a.off", b"OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 5\n", "outside the range"),
        ("a.off", b"hello", "does not begin with 'OFF'"),
        ("a.stl", bytes(80) + struct.pack("<I", 4_000_000_000) + bytes(50), "4,000,000,000 tri"),
        ("a.stl", b"", "has 0 bytes; a binary STL has 84"),
        ("a.stl", bytes(84), "contains no triangles"),
        ("a.stl", b"solid x\nfacet normal 0 0 1\nouter loop\nvertex 0 0", "STL mesh|no triangles"),
        ("a.dae", b"<COLLADA/>", "pip install pycollada|not a DAE mesh"),
    ],
)
def test_damaged_files_are_refused(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    import re

    (tmp_path / name).write_bytes(content)
    text = refusal(tmp_path / name)
    assert re.search(message, text), text


@pytest.mark.parametrize("suffix", [".obj", ".stl", ".ply", ".off"])
def test_changed_bytes_never_end_in_a_traceback(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"x{suffix}"
    BOX.export(str(path))
    whole, rng = path.read_bytes(), np.random.default_rng(0)
    for _ in range(60):
        data = bytearray(whole)
        for at in rng.integers(0, len(data), 3):
            data[at] = rng.choice([0, 255, 32, 45, 57, 47, data[at] ^ 1])
        path.write_bytes(data)
        try:
            read_mesh(path)
        except ScenarioError as error:
            assert "\n" not in str(error)  # noqa: PT017


@pytest.mark.parametrize(
    ("factor", "hints"),
    [
        (
            1000.0,
            (
                "millimetres, mesh_scale = 0.001 makes it 1 m",
                "inches, mesh_scale = 0.0254 makes it 25.4 m",
            ),
        ),
        (
            100.0,
            (
                "centimetres, mesh_scale = 0.01 makes it 1 m",
                "feet, mesh_scale = 0.3048 makes it 30.5 m",
            ),
        ),
        (0.001, ("kilometres, mesh_scale = 1000 makes it 1 m",)),
    ],
)
def test_size_in_other_units_gets_each_that_fits(
    tmp_path: Path, factor: float, hints: tuple[str, ...]
) -> None:
    solid = BOX.copy()
    solid.apply_scale(factor)
    solid.export(str(tmp_path / "b.stl"))
    text = refusal(tmp_path / "b.stl")
    assert all(hint in text for hint in hints), text
    scale = float(hints[0].split("mesh_scale = ")[1].split()[0])
    assert np.ptp(read_mesh(tmp_path / "b.stl", scale).mesh.bounds_m(), axis=0)[0] == pytest.approx(
        1
    )


def test_mesh_far_from_its_origin_is_refused_with_the_offset(tmp_path: Path) -> None:
    solid = BOX.copy()
    solid.apply_translation([4000.0, 0.0, -250.0])
    solid.export(str(tmp_path / "far.ply"))
    text = refusal(tmp_path / "far.ply")
    assert "lies 4008 m from its origin; mesh_origin_m = [4000, 0, -250]" in text
    low, high = read_mesh(tmp_path / "far.ply", 1.0, (4000.0, 0.0, -250.0)).mesh.bounds_m()
    np.testing.assert_allclose(high - low, [1.0, 0.8, 0.6], atol=1e-3)


@pytest.mark.skipif(importlib.util.find_spec("collada") is None, reason="needs pycollada")
def test_collada_has_the_unit_that_it_states(tmp_path: Path) -> None:
    solid = BOX.copy()
    solid.apply_scale(100.0)
    exported: Any = solid.export(file_type="dae")
    text = exported.decode()
    unit = '<unit name="centimeter" meter="0.01"/>'
    text = text.replace("<up_axis>", f"{unit}<up_axis>")
    (tmp_path / "cm.dae").write_text(text)
    mesh = read_mesh(tmp_path / "cm.dae").mesh
    np.testing.assert_allclose(np.ptp(mesh.bounds_m(), axis=0), [1.0, 0.8, 0.6], atol=1e-6)


def shipped() -> list[Path]:
    """Return all mesh files of installed packages."""
    return sorted(
        path
        for folder in site.getsitepackages()
        for path in Path(folder).rglob("*")
        if path.suffix.lower() in SUFFIXES
    )


def read_or_refused(path: Path) -> bool:
    """Return whether a file is read; another end than by one clear line fails."""
    try:
        found = read_mesh(path)
    except ScenarioError as error:
        text = str(error)
        assert text.startswith(str(path))
        assert "\n" not in text
        assert "Error" not in text
        assert ";" in text
        return False
    assert collision_hulls(found.mesh)
    assert np.isfinite(mass_properties(found.mesh, 1.0)[1]).all()
    return True


def test_small_samples_of_the_physics_engine_are_read_or_refused() -> None:
    folder = Path(pytest.importorskip("pybullet_data").getDataPath())
    small = [path for path in folder.glob("*.*") if path.stat().st_size < 5_000]
    samples = sorted(path for path in small if path.suffix.lower() in SUFFIXES)
    read = [read_or_refused(path) for path in samples]
    assert any(read)


@pytest.mark.slow(1)
@pytest.mark.parametrize("quarter", range(4))
def test_all_samples_of_installed_packages_are_read_or_refused(quarter: int) -> None:
    for path in shipped()[quarter::4]:
        read_or_refused(path)
