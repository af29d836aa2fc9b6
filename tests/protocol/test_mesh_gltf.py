# SPDX-License-Identifier: Apache-2.0
"""GlTF files by the specification: quantization, sparse values, materials, extensions, and damage
that is refused in one line.
"""

from __future__ import annotations

import base64
import contextlib
import io
import os
import re
import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chaserdock_models.meshes import TriangleMesh, volume_m3
from chaserdock_protocol.scenario import ScenarioError, mesh_sources
from chaserdock_protocol.scenario.mesh_files import MeshFile, read_mesh
from gltf_samples import BOX_M, GltfSample, box, png, refusal

DIELECTRIC: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 1.0}


def size_m(mesh: TriangleMesh) -> list[float]:
    low, high = mesh.bounds_m()
    return (high - low).tolist()


@pytest.mark.parametrize("kind", ["i1", "u1", "i2", "u2"])
@pytest.mark.parametrize("normalized", [True, False])
def test_quantized_positions_have_the_size_of_their_node(
    tmp_path: Path, kind: str, normalized: bool
) -> None:
    """KHR_mesh_quantization, as gltfpack (whole numbers) and glTF-Transform (fractions) write."""
    most = np.iinfo(kind).max
    sample = GltfSample()
    vertices = box()[0] + (0.5 if kind[0] == "u" else 0.0)
    shared = vertices * (1.0 if kind[0] == "u" else 2.0)
    stored = np.round(shared * most).astype(kind)
    stride = -(-3 * stored.itemsize // 4) * 4
    position = sample.add(stored, stride=stride, normalized=normalized)
    sample.primitive["attributes"]["POSITION"] = position
    factor = float(np.ptp(vertices[:, 0]) / np.ptp(shared[:, 0])) / (1 if normalized else most)
    sample.tree["nodes"][0]["scale"] = [factor] * 3
    sample.tree["extensionsRequired"] = ["KHR_mesh_quantization"]
    mesh = read_mesh(sample.write(tmp_path / "q.glb")).mesh
    assert size_m(mesh) == pytest.approx(BOX_M, abs=1.1 / most)


def material_of(tmp_path: Path, sample: GltfSample) -> tuple[float, float, float]:
    m = read_mesh(sample.write(tmp_path / "m.glb")).mesh.parts[0].material
    return m.diffuse, m.specular, m.shininess


@pytest.mark.parametrize(
    ("pbr", "expected"),
    [
        ({}, (0.5, 0.8, 1.0)),
        (DIELECTRIC, (1.0, 0.04, 1.0)),
        ({"baseColorFactor": [0.5, 0.5, 0.5, 1.0]}, (0.25, 0.4, 1.0)),
        ({"baseColorFactor": [0.5, 0.5, 0.5, 1.0], "metallicFactor": 0.0}, (0.5, 0.04, 1.0)),
        ({"baseColorFactor": [0.123, 0.123, 0.123, 1.0], **DIELECTRIC}, (0.123, 0.04, 1.0)),
        ({"metallicFactor": 0.0, "roughnessFactor": 0.5}, (1.0, 0.04, 30.0)),
    ],
)
def test_factors_have_the_defaults_of_the_specification(
    tmp_path: Path, pbr: dict[str, Any], expected: tuple[float, float, float]
) -> None:
    sample = GltfSample({"name": "m", "pbrMetallicRoughness": pbr})
    assert material_of(tmp_path, sample) == pytest.approx(expected, abs=1e-4)


def test_no_material_is_the_default_material_with_a_note(tmp_path: Path) -> None:
    for sample in (GltfSample(), GltfSample({"name": "bare"})):
        assert material_of(tmp_path, sample) == pytest.approx((0.5, 0.8, 1.0))
    found = read_mesh(GltfSample().write(tmp_path / "m.glb"))
    assert "white rough metal" in found.notes[0]


def test_textures_are_srgb_and_multiply_linear_factors(tmp_path: Path) -> None:
    sample = GltfSample({"name": "m", "pbrMetallicRoughness": dict(DIELECTRIC)})
    pbr = sample.tree["materials"][0]["pbrMetallicRoughness"]
    pbr["baseColorTexture"] = sample.image(png((188, 188, 188)))
    assert material_of(tmp_path, sample)[0] == pytest.approx(0.50, abs=0.005)
    pbr["baseColorFactor"] = [0.5, 0.5, 0.5, 1.0]
    sample.tree.pop("buffers")
    assert material_of(tmp_path, sample)[0] == pytest.approx(0.25, abs=0.003)


def test_mean_of_a_texture_is_that_of_its_light(tmp_path: Path) -> None:
    """Half black and half white reflect one half, not the 0.21 of a grey of 128."""
    from PIL import Image

    halves = Image.new("L", (8, 8), 0)
    halves.paste(255, (0, 0, 8, 4))
    for mode in ("L", "RGB", "P", "RGBA", "I;16", "1"):
        picture = halves.point(lambda v: 257 * v, "I").convert(mode) if mode == "I;16" else None
        out = io.BytesIO()
        (picture or halves.convert(mode)).save(out, "PNG")
        sample = GltfSample({"pbrMetallicRoughness": dict(DIELECTRIC)})
        pbr = sample.tree["materials"][0]["pbrMetallicRoughness"]
        pbr["baseColorTexture"] = sample.image(out.getvalue())
        assert material_of(tmp_path, sample)[0] == pytest.approx(0.5, abs=1e-3), mode


def test_metallic_roughness_texture_is_linear(tmp_path: Path) -> None:
    sample = GltfSample({"pbrMetallicRoughness": {}})
    pbr = sample.tree["materials"][0]["pbrMetallicRoughness"]
    pbr["metallicRoughnessTexture"] = sample.image(png((0, 128, 0)))
    assert material_of(tmp_path, sample) == pytest.approx((1.0, 0.04, 29.5), abs=0.5)


@pytest.mark.parametrize(
    ("rows", "normalized"),
    [
        (np.full((8, 3), 0.25, dtype="f4"), False),
        (np.full((8, 4), 64, dtype="u1"), True),
        (np.full((8, 3), 16384, dtype="u2"), True),
    ],
)
def test_vertex_colours_multiply_the_base_colour(
    tmp_path: Path, rows: Any, normalized: bool
) -> None:
    pbr = {"baseColorFactor": [0.5, 0.5, 0.5, 1.0], **DIELECTRIC}
    sample = GltfSample({"pbrMetallicRoughness": pbr})
    sample.primitive["attributes"]["COLOR_0"] = sample.add(rows, normalized=normalized)
    assert material_of(tmp_path, sample)[0] == pytest.approx(0.125, abs=0.001)


def test_specular_glossiness_and_unlit(tmp_path: Path) -> None:
    given = {"diffuseFactor": [0.3] * 3 + [1], "specularFactor": [0.2] * 3, "glossinessFactor": 0.0}
    sample = GltfSample({"extensions": {"KHR_materials_pbrSpecularGlossiness": given}})
    assert material_of(tmp_path, sample) == pytest.approx((0.3, 0.2, 20.0))
    plain = {"pbrMetallicRoughness": {"baseColorFactor": [0.4, 0.4, 0.4, 1.0]}}
    sample = GltfSample({**plain, "extensions": {"KHR_materials_unlit": {}}})
    assert material_of(tmp_path, sample) == pytest.approx((0.4, 0.04, 1.0))


@pytest.mark.parametrize(
    ("name", "remedy"),
    [
        ("KHR_draco_mesh_compression", "without Draco compression"),
        ("KHR_texture_basisu", "PNG or JPEG textures in place of KTX2"),
        ("EXT_meshopt_compression", "without meshopt compression"),
        ("VENDOR_shape", "export it without this extension"),
    ],
)
def test_required_extensions_are_refused_by_name(tmp_path: Path, name: str, remedy: str) -> None:
    sample = GltfSample()
    sample.tree["extensionsRequired"] = [name]
    text = refusal(sample.write(tmp_path / "x.glb"))
    assert f"its extension {name} is not supported; " in text
    assert remedy in text


def test_extensions_without_influence_on_the_shape_may_be_required(tmp_path: Path) -> None:
    sample = GltfSample()
    sample.tree["extensionsRequired"] = ["KHR_texture_transform", "KHR_materials_ior"]
    assert size_m(read_mesh(sample.write(tmp_path / "x.glb")).mesh) == pytest.approx(BOX_M)


def test_compressed_content_that_is_not_marked_as_required_is_refused(tmp_path: Path) -> None:
    sample = GltfSample()
    sample.primitive["extensions"] = {"KHR_draco_mesh_compression": {"bufferView": 0}}
    assert read_mesh(sample.write(tmp_path / "fallback.glb")).mesh.triangle_count == 12
    del sample.tree["accessors"][0]["bufferView"]
    assert "KHR_draco_mesh_compression" in refusal(sample.write(tmp_path / "x.glb"))
    ktx = GltfSample({"pbrMetallicRoughness": {}})
    pbr = ktx.tree["materials"][0]["pbrMetallicRoughness"]
    pbr["baseColorTexture"] = ktx.image(b"\xabKTX 20\xbb\r\n\x1a\n")
    assert "KHR_texture_basisu is not supported" in refusal(ktx.write(tmp_path / "k.glb"))
    ktx.tree["textures"] = [{"extensions": {"KHR_texture_basisu": {"source": 0}}}]
    assert "KHR_texture_basisu is not supported" in refusal(ktx.write(tmp_path / "k.glb"))


def test_sparse_accessor_replaces_rows(tmp_path: Path) -> None:
    sample = GltfSample()
    vertices = box()[0].astype("f4")
    far = np.flatnonzero(vertices[:, 0] > 0)
    moved = vertices[far] + np.array([0.5, 0, 0], dtype="f4")
    accessor = sample.tree["accessors"][0]
    accessor["sparse"] = {
        "count": len(far),
        "indices": {"bufferView": sample.view(far.astype("u1").tobytes()), "componentType": 5121},
        "values": {"bufferView": sample.view(moved.tobytes())},
    }
    assert size_m(read_mesh(sample.write(tmp_path / "s.glb")).mesh)[0] == pytest.approx(1.5)


def test_strips_fans_and_plain_triangles(tmp_path: Path) -> None:
    vertices, triangles = box()
    plain = GltfSample()
    plain.primitive["attributes"]["POSITION"] = plain.add(
        vertices[triangles].reshape(-1, 3).astype("f4")
    )
    del plain.primitive["indices"]
    tetra = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], dtype="f4")
    strip = GltfSample()
    position = strip.add(tetra)
    strip.tree["meshes"][0]["primitives"] = [
        {"attributes": {"POSITION": position}, "mode": 5,
         "indices": strip.add(np.array([[0], [2], [1], [3], [0], [2]], dtype="u1"))},
    ]  # fmt: skip
    fan = GltfSample()
    position = fan.add(tetra)
    fan.tree["meshes"][0]["primitives"] = [
        {"attributes": {"POSITION": position}, "mode": 6,
         "indices": fan.add(np.array([[3], [0], [1], [2], [0]], dtype="u1"))},
        {"attributes": {"POSITION": position},
         "indices": fan.add(np.array([[0], [2], [1]], dtype="u1"))},
    ]  # fmt: skip
    for sample, volume in ((plain, 0.48), (strip, 1 / 6), (fan, 1 / 6)):
        mesh = read_mesh(sample.write(tmp_path / "s.glb")).mesh
        assert sum(map(volume_m3, mesh.parts)) == pytest.approx(volume, rel=1e-5)
        assert len(mesh.parts) == 1


def test_body_of_two_materials_becomes_one_part(tmp_path: Path) -> None:
    sample = GltfSample(
        {"name": "a", "pbrMetallicRoughness": {"baseColorFactor": [0.2] * 3 + [1], **DIELECTRIC}}
    )
    sample.tree["materials"].append(
        {"name": "b", "pbrMetallicRoughness": {"baseColorFactor": [0.8] * 3 + [1], **DIELECTRIC}}
    )
    position, triangles = sample.primitive["attributes"]["POSITION"], box()[1]
    up = np.abs(box()[0][triangles][:, :, 2].sum(axis=1)) > 0.8  # +Z and -Z: 1.6 of 3.76 m^2
    sample.tree["meshes"][0]["primitives"] = [
        {"attributes": {"POSITION": position}, "material": k,
         "indices": sample.add(triangles[rows].astype("u2").reshape(-1, 1))}
        for k, rows in enumerate((up, ~up))
    ]  # fmt: skip
    found = read_mesh(sample.write(tmp_path / "two.glb"))
    assert [p.name for p in found.mesh.parts] == ["bus_0"]
    share = 1.6 / 3.76
    assert found.mesh.parts[0].material.diffuse == pytest.approx(
        0.2 * share + 0.8 * (1 - share), abs=1e-3
    )
    assert any("closed only together; joined" in note for note in found.notes)


def test_morph_targets_and_skins_deform(tmp_path: Path) -> None:
    sample = GltfSample()
    grown = (0.5 * box()[0]).astype("f4")
    sample.primitive["targets"] = [{"POSITION": sample.add(grown)}]
    sample.tree["meshes"][0]["weights"] = [1.0]
    mesh = read_mesh(sample.write(tmp_path / "m.glb")).mesh
    assert size_m(mesh) == pytest.approx([1.5 * v for v in BOX_M])
    skinned = GltfSample()
    skinned.tree["nodes"] = [
        {"mesh": 0, "skin": 0, "name": "bus", "translation": [30, 0, 0]},
        {"name": "bone", "translation": [0, 0.25, 0], "scale": [2, 2, 2]},
    ]
    skinned.tree["scenes"] = [{"nodes": [0, 1]}]
    inverse = np.eye(4, dtype="f4").reshape(1, 16)
    skinned.tree["skins"] = [{"joints": [1], "inverseBindMatrices": skinned.add(inverse)}]
    attributes = skinned.primitive["attributes"]
    attributes["JOINTS_0"] = skinned.add(np.zeros((8, 4), dtype="u1"))
    weights = np.tile(np.array([1, 0, 0, 0], dtype="f4"), (8, 1))
    attributes["WEIGHTS_0"] = skinned.add(weights)
    mesh = read_mesh(skinned.write(tmp_path / "s.glb")).mesh
    np.testing.assert_allclose(mesh.bounds_m(), [[-1, -0.55, -0.6], [1, 1.05, 0.6]], atol=1e-6)


def test_names_do_not_change_between_readings(tmp_path: Path) -> None:
    sample = GltfSample({"name": "m"})
    sample.tree["meshes"][0]["primitives"] = [sample.primitive, sample.primitive]
    sample.tree["nodes"] = [{"mesh": 0, "name": "bus"}, {"mesh": 0, "name": "bus", "camera": 0}]
    sample.tree["scenes"] = [{"nodes": [0, 1]}]
    path = sample.write(tmp_path / "n.glb")
    names = [[p.name for p in read_mesh(path).mesh.parts] for _ in range(2)]
    assert names[0] == names[1] == ["bus_0", "bus_1", "bus_0_2", "bus_1_2"]


def test_scenes_without_a_default_and_nested_nodes(tmp_path: Path) -> None:
    sample = GltfSample()
    del sample.tree["scene"], sample.tree["scenes"]
    half = float(np.sqrt(0.5))
    sample.tree["nodes"] = [
        {"mesh": 0},
        {"children": [0], "rotation": [0, 0, half, half], "translation": [1, 2, 3]},
    ]
    mesh = read_mesh(sample.write(tmp_path / "n.glb")).mesh
    np.testing.assert_allclose(mesh.bounds_m(), [[0.6, 1.5, 2.7], [1.4, 2.5, 3.3]], atol=1e-6)


PRIMITIVE = ("meshes", 0, "primitives", 0)
PBR = ("materials", 0, "pbrMetallicRoughness")


@pytest.mark.parametrize(
    ("keys", "value", "message"),
    [
        ((*PRIMITIVE, "indices"), 77, r"refers to accessors\[77\], of 2"),
        ((*PRIMITIVE, "indices"), -1, r"refers to accessors\[-1\]"),
        ((*PRIMITIVE, "attributes"), {}, "without POSITION"),
        ((*PRIMITIVE, "mode"), 9, "mode 9"),
        (PRIMITIVE, 7, "int"),
        (("accessors", 0, "count"), 10**12, "1,000,000,000,000 rows; simplify"),
        (
            ("accessors", 0),
            {"componentType": 5126, "type": "VEC3", "count": 10**10},
            "10,000,000,000 rows; simplify",
        ),
        (("accessors", 0, "byteOffset"), -4, "exceeds its buffer"),
        (("accessors", 0, "type"), "VEC2", "2 columns in place of 3"),
        (("accessors", 0, "count"), 2, "triangle with vertex 7, of 2 vertices"),
        (("accessors", 1, "componentType"), 5122, "not whole"),
        (("bufferViews", 0, "byteLength"), 10**9, "buffer view 0 exceeds its buffer"),
        (("nodes",), [{"mesh": 0, "children": [0]}], "two parents or is its own"),
        (("nodes",), [{"children": [1, 1]}, {"mesh": 0}], "two parents or is its own"),
        (("nodes", 0, "translation"), [1e300, 1e300, 1e308], "vertex that is not a number"),
        (("nodes", 0, "scale"), "large", "transform that is not one"),
        (("nodes", 0, "extensions"), {"EXT_mesh_gpu_instancing": {}}, "export each instance"),
        (("meshes",), {"0": 1}, "needs 'meshes' as list"),
        (("asset", "version"), "1.0", "convert it to glTF 2.0"),
        ((*PBR, "baseColorTexture"), {"index": 3}, r"refers to textures\[3\]"),
        ((*PBR, "metallicFactor"), "much", "metallicFactor is not a number"),
        ((*PBR, "baseColorFactor"), ["a"], "baseColorFactor is not a colour"),
        (("scenes", 0, "extras"), {"chaserdock": {"joints": 1}}, "as `chaserdock target --mesh`"),
        (("nodes", 0, "extras"), {"chaserdock": 1}, "as `chaserdock target --mesh`"),
    ],
)
def test_damage_is_refused_in_one_line(
    tmp_path: Path, keys: tuple[str | int, ...], value: Any, message: str
) -> None:
    sample = GltfSample({"name": "m", "pbrMetallicRoughness": {}})
    place: Any = sample.tree
    for key in keys[:-1]:
        place = place[key]
    place[keys[-1]] = value
    text = refusal(sample.write(tmp_path / "bad.glb"))
    assert re.search(message, text), text


def test_content_without_bounds_is_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    sample = GltfSample({"name": "m", "pbrMetallicRoughness": {}})
    sample.tree["meshes"][0]["primitives"] = [sample.primitive] * 400
    assert "more than 256 parts; join them" in refusal(sample.write(tmp_path / "parts.glb"))
    sample.tree["meshes"][0]["primitives"] = [sample.primitive] * 100
    monkeypatch.setattr(mesh_sources, "MOST_TRIANGLES", 1000)
    text = refusal(sample.write(tmp_path / "triangles.glb"))
    assert "has 1,008 or more triangles; simplify it to at most 1,000" in text
    monkeypatch.undo()
    lost = GltfSample()
    nowhere = lost.add(np.full((8, 3), np.nan, dtype="f4"))
    lost.primitive["attributes"]["POSITION"] = nowhere
    assert "vertex that is not a number" in refusal(lost.write(tmp_path / "nan.glb"))
    deep = tmp_path / "deep.gltf"
    deep.write_text('{"asset":' + "[" * 100_000)
    assert "nested too deeply" in refusal(deep)


def test_cut_files_are_refused(tmp_path: Path) -> None:
    whole = GltfSample().write(tmp_path / "w.glb").read_bytes()
    for length in [*range(0, 40, 3), *range(40, len(whole), 97), len(whole) - 1]:
        (tmp_path / "cut.glb").write_bytes(whole[:length])
        refusal(tmp_path / "cut.glb")


def test_changed_bytes_never_end_in_a_traceback(tmp_path: Path) -> None:
    sample = GltfSample({"name": "m", "pbrMetallicRoughness": {"baseColorFactor": [0.5] * 4}})
    pbr = sample.tree["materials"][0]["pbrMetallicRoughness"]
    pbr["baseColorTexture"] = sample.image(png((9, 9, 9)))
    whole = sample.write(tmp_path / "w.glb").read_bytes()
    rng = np.random.default_rng(0)
    path = tmp_path / "x.glb"
    for _ in range(100):
        data = bytearray(whole)
        for at in rng.integers(0, len(data), 3):
            data[at] = rng.choice([0, 255, 34, 45, 49, 91, 125, data[at] ^ 1])
        path.write_bytes(data)
        with contextlib.suppress(ScenarioError):
            read_mesh(path)


def with_buffer(tmp_path: Path, uri: str) -> tuple[Path, bytes]:
    folder = tmp_path / "model"
    folder.mkdir(exist_ok=True)
    sample = GltfSample({"name": "m"})
    sample.tree["buffers"] = [{"byteLength": len(sample.binary), "uri": uri}]
    return sample.write(folder / "m.gltf"), sample.binary


def test_buffers_beside_the_file_are_read(tmp_path: Path) -> None:
    path, binary = with_buffer(tmp_path, "data%20of%20it.bin")
    (path.parent / "data of it.bin").write_bytes(binary)
    assert size_m(read_mesh(path).mesh) == pytest.approx(BOX_M)
    text = base64.b64encode(binary).decode()
    for head in ("data:application/octet-stream;base64,", "data:;base64,"):
        path, _ = with_buffer(tmp_path, head + text)
        assert size_m(read_mesh(path).mesh) == pytest.approx(BOX_M)


def test_buffers_that_are_no_files_beside_it_never_block(tmp_path: Path) -> None:
    path, binary = with_buffer(tmp_path, "pipe")
    os.mkfifo(path.parent / "pipe")
    assert "refers to 'pipe': not a regular file" in refusal(path)
    (path.parent / "zero").symlink_to("/dev/zero")
    (tmp_path / "outside.bin").write_bytes(binary)
    (path.parent / "link.bin").symlink_to(tmp_path / "outside.bin")
    for uri, message in (
        ("zero", "outside its folder"),
        ("/dev/zero", "outside its folder"),
        ("../outside.bin", "outside its folder"),
        ("%2e%2e/outside.bin", "outside its folder"),
        ("link.bin", "outside its folder"),
        ("https://example.org/a.bin", "put the file beside the mesh instead"),
        ("none.bin", "refers to 'none.bin': no such file"),
        (".", "not a regular file"),
        ("a\0b", "not the name of a file"),
        ("data:;base64,!!", "not base64"),
    ):
        assert message in refusal(with_buffer(tmp_path, uri)[0]), uri
    path, _ = with_buffer(tmp_path, "short.bin")
    (path.parent / "short.bin").write_bytes(binary[:-4])
    assert "the file is cut or damaged" in refusal(path)


def test_mesh_itself_may_not_be_a_pipe(tmp_path: Path) -> None:
    for suffix in (".glb", ".obj", ".stl", ".ply", ".off"):
        os.mkfifo(tmp_path / f"pipe{suffix}")
        assert "not a regular file" in refusal(tmp_path / f"pipe{suffix}")
    (tmp_path / "folder.glb").mkdir()
    assert "not a regular file" in refusal(tmp_path / "folder.glb")


def test_image_bomb_is_refused(tmp_path: Path) -> None:
    """A PNG of 60,000 x 60,000 pixels in its head; it is never unpacked."""
    data = bytearray(png((1, 1, 1)))
    data[16:24] = struct.pack(">II", 60_000, 60_000)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    sample = GltfSample({"pbrMetallicRoughness": {}})
    pbr = sample.tree["materials"][0]["pbrMetallicRoughness"]
    pbr["baseColorTexture"] = sample.image(bytes(data))
    assert "8192 x 8192" in refusal(sample.write(tmp_path / "bomb.glb"))
    data[16:24] = struct.pack(">II", 12_000, 12_000)
    data[29:33] = struct.pack(">I", zlib.crc32(data[12:29]))
    sample.tree["images"] = []
    sample.tree["textures"] = []
    pbr["baseColorTexture"] = sample.image(bytes(data))
    sample.tree.pop("buffers")
    assert "8192 x 8192" in refusal(sample.write(tmp_path / "bomb.glb"))


def test_notes_of_a_clean_file_are_none(tmp_path: Path) -> None:
    found: MeshFile = read_mesh(GltfSample({"name": "m"}).write(tmp_path / "m.glb"))
    assert found.notes == ()
