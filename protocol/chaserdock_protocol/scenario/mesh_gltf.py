# SPDX-License-Identifier: Apache-2.0
"""Read glTF 2.0 files (GLB, glTF) as the specification says, with every index and size checked.

Trimesh takes normalized integers for metres, leaves out sparse values, fans and deformations, names
parts at random and knows no default of a material; so this format is read here.
"""

from __future__ import annotations

import base64
import binascii
import json
import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any, TypeGuard

import numpy as np
from chaserdock_models.arrays import Array, IntArray
from chaserdock_models.meshes import Material
from numpy.typing import NDArray

from .mesh_materials import channel_means, grey_of, metallic_roughness, phong
from .mesh_sources import (
    MOST_TRIANGLES,
    MeshFileError,
    ReferencedFiles,
    check_triangles,
    open_image,
    plain_name,
    printable,
)

_REMEDIES = {
    "KHR_draco_mesh_compression": "export it without Draco compression",
    "EXT_meshopt_compression": "export it without meshopt compression (gltfpack without -c)",
    "KHR_meshopt_compression": "export it without meshopt compression (gltfpack without -c)",
    "KHR_texture_basisu": "export it with PNG or JPEG textures in place of KTX2",
    "EXT_mesh_gpu_instancing": "export each instance as a node of its own",
}
_SUPPORTED = {
    "KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp", "KHR_lights_punctual",
    "KHR_xmp_json_ld", "KHR_animation_pointer",
}  # fmt: skip
"""Extensions that a file may require; also all of KHR_materials_*."""
_COMPONENTS = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_POINTS_AND_LINES = (0, 1, 2, 3)
"""Modes of primitives without a surface; 4 are triangles, 5 strips and 6 fans."""
_STRIP, _FAN = 5, 6
"""Modes of primitives whose triangles share corners."""


@dataclass(frozen=True)
class Solid:
    """A primitive of a node: ``vertices`` (n, 3) in the file's unit and ``triangles`` (m, 3).

    ``extras``: those of the node or its mesh.
    """

    name: str
    vertices: Array
    triangles: IntArray
    material: Material
    extras: dict[str, Any]


@dataclass
class Gltf:
    """A glTF file: its JSON ``tree``, its ``buffers``, and ``notes`` about what was assumed."""

    tree: dict[str, Any]
    binary: bytes | None
    files: ReferencedFiles
    notes: list[str] = field(default_factory=list)
    _read: dict[Any, Any] = field(default_factory=dict)

    @property
    def scene(self) -> dict[str, Any]:
        """The scene that is shown, or one of all roots. Raises MeshFileError."""
        if self.tree.get("scenes"):
            return self._item("scenes", self.tree.get("scene", 0))
        nodes = self._list("nodes")
        children = {k for node in nodes for k in _of(node, "children", list, [])}
        return {"nodes": [k for k in range(len(nodes)) if k not in children]}

    def solids(self) -> Iterator[Solid]:
        """Yield the primitives of the scene, in the order of its nodes. Raises MeshFileError."""
        placed = self._placed()
        triangles = 0
        for number, transform in placed.items():
            node = self._item("nodes", number)
            if "mesh" not in node:
                continue
            mesh = self._item("meshes", node["mesh"])
            base = plain_name(str(node.get("name") or mesh.get("name") or f"node{number}"))
            primitives = _of(mesh, "primitives", list)
            if "skin" in node:
                transform = np.eye(4)
            for k, primitive in enumerate(primitives):
                name = base if len(primitives) == 1 else f"{base}_{k}"
                if primitive.get("mode", 4) in _POINTS_AND_LINES:
                    self.notes.append(f"{name}: points or lines are ignored")
                    continue
                vertices = self._positions(primitive, node, mesh, placed)
                corners = self._triangles(primitive, len(vertices))
                triangles += len(corners)
                check_triangles(triangles)
                if not len(corners):
                    continue
                used, corners = np.unique(corners, return_inverse=True)
                corners = corners.reshape(-1, 3)
                if np.linalg.det(transform[:3, :3]) < 0.0:
                    corners = corners[:, ::-1]
                vertices = vertices[used] @ transform[:3, :3].T + transform[:3, 3]
                extras = next((x for x in (node.get("extras"), mesh.get("extras")) if x), {})
                material = self._material(name, primitive)
                yield Solid(name, vertices, corners, material, _dict_or_empty(extras))

    def _placed(self) -> dict[int, Array]:
        """Return the transform (4, 4) to the scene of each node in it. Raises MeshFileError."""
        placed: dict[int, Array] = {}
        waiting = [(k, np.eye(4)) for k in reversed(_of(self.scene, "nodes", list, []))]
        while waiting:
            number, parent = waiting.pop()
            node = self._item("nodes", number)
            if number in placed:
                raise MeshFileError(
                    f"node {number} has two parents or is its own; export it as a tree"
                )
            placed[number] = parent @ _transform(node, number)
            children = _of(node, "children", list, [])
            waiting += [(k, placed[number]) for k in reversed(children)]
            if "EXT_mesh_gpu_instancing" in _of(node, "extensions", dict, {}):
                raise MeshFileError(_unsupported("EXT_mesh_gpu_instancing"))
        return placed

    def _positions(self, primitive: Any, node: Any, mesh: Any, placed: dict[int, Array]) -> Array:
        """Return the vertices (n, 3) of a primitive, deformed by morph targets and skin."""
        attributes = _of(primitive, "attributes", dict)
        if "POSITION" not in attributes:
            raise MeshFileError("has a primitive without POSITION")
        self._refuse_compressed(primitive, attributes["POSITION"])
        vertices = self.accessor(attributes["POSITION"], 3)
        targets = _of(primitive, "targets", list, [])
        weights = node.get("weights", mesh.get("weights", []))
        for weight, target in zip(weights, targets, strict=False):
            if weight and "POSITION" in target:
                vertices = vertices + weight * self._like(target["POSITION"], 3, vertices)
        if "skin" not in node or "JOINTS_0" not in attributes:
            return vertices
        skin = self._item("skins", node["skin"])
        joints = _of(skin, "joints", list)
        if any(k not in placed for k in joints):
            raise MeshFileError("has a skin whose joints are not in the scene; apply its armature")
        moves = np.array([placed[k] for k in joints])
        if "inverseBindMatrices" in skin:
            inverse = self.accessor(skin["inverseBindMatrices"], 16).reshape(-1, 4, 4)
            if len(inverse) < len(joints):
                raise MeshFileError("has a skin with fewer matrices than joints")
            moves = moves @ inverse[: len(joints)].transpose(0, 2, 1)
        where = self._like(attributes["JOINTS_0"], 4, vertices).astype(np.int64)
        share = self._like(attributes.get("WEIGHTS_0"), 4, vertices)
        if where.max(initial=0) >= len(joints):
            raise MeshFileError("has a vertex of a joint that does not exist")
        long = np.concatenate([vertices, np.ones((len(vertices), 1))], axis=1)
        return np.einsum("nk,nkij,nj->ni", share, moves[where], long)[:, :3]

    def _like(self, number: Any, width: int, vertices: Array) -> Array:
        found = self.accessor(number, width)
        if len(found) != len(vertices):
            raise MeshFileError(
                f"accessor {number} has {len(found)} rows for {len(vertices)} vertices"
            )
        return found

    def _refuse_compressed(self, primitive: Any, position: Any) -> None:
        held = _of(primitive, "extensions", dict, {})
        accessor = self._item("accessors", position)
        if "KHR_draco_mesh_compression" in held and "bufferView" not in accessor:
            raise MeshFileError(_unsupported("KHR_draco_mesh_compression"))

    def _triangles(self, primitive: Any, vertices: int) -> IntArray:
        """Return the triangles (m, 3) of a primitive. Raises MeshFileError."""
        given = primitive.get("indices")
        corners = np.arange(vertices) if given is None else self.indices(given)
        if corners.max(initial=-1) >= vertices:
            raise MeshFileError(
                f"has a triangle with vertex {corners.max()}, of {vertices} vertices; "
                "export it anew"
            )
        mode = primitive.get("mode", 4)
        if mode == _STRIP:
            rows = np.stack([corners[:-2], corners[1:-1], corners[2:]], axis=1)
            rows[1::2] = rows[1::2, [1, 0, 2]]
            return rows
        if mode == _FAN:
            first = np.broadcast_to(corners[:1], max(len(corners) - 2, 0))
            return np.stack([first, corners[1:-1], corners[2:]], axis=1)
        if mode != 4 or len(corners) % 3:
            raise MeshFileError(f"has a primitive of {len(corners)} corners, mode {mode!r}")
        return corners.reshape(-1, 3)

    def accessor(self, number: Any, width: int) -> Array:
        """Return the rows (n, width) of an accessor; normalized integers as fractions.

        Raises MeshFileError.
        """
        key = ("accessor", number, width)
        if key not in self._read:
            held = self._item("accessors", number)
            rows = self._rows(held, number, width)
            out = rows.astype(float)
            if held.get("normalized") and rows.dtype.kind != "f":
                out = np.maximum(out / np.iinfo(rows.dtype).max, -1.0)
            self._read[key] = out
        return self._read[key]

    def indices(self, number: Any) -> IntArray:
        """Return the whole numbers (n,) of an accessor. Raises MeshFileError."""
        rows = self._rows(self._item("accessors", number), number, 1)
        if rows.dtype.kind != "u":
            raise MeshFileError(f"accessor {number} has numbers of vertices that are not whole")
        return rows[:, 0].astype(np.int64)

    def _rows(self, held: Any, number: Any, width: int) -> NDArray[Any]:
        """Return the rows (n, width) of an accessor as they are stored. Raises MeshFileError."""
        kind = _COMPONENTS.get(held.get("componentType"))
        columns = _WIDTHS.get(held.get("type", ""))
        count = held.get("count")
        if kind is None or columns is None or not _is_whole(count):
            raise MeshFileError(f"accessor {number} has no valid componentType, type and count")
        if columns != width:
            raise MeshFileError(f"accessor {number} has {columns} columns in place of {width}")
        if count > 3 * MOST_TRIANGLES:
            raise MeshFileError(f"accessor {number} has {count:,} rows; simplify the mesh")
        rows = np.zeros((count, columns), dtype=kind)
        if "bufferView" in held:
            rows = self._view_rows(held, count, kind, columns, number)
        return self._sparse(rows, held["sparse"], number) if "sparse" in held else rows

    def _sparse(self, rows: NDArray[Any], sparse: Any, number: Any) -> NDArray[Any]:
        """Return rows with the sparse values of their accessor. Raises MeshFileError."""
        where, values = _of(sparse, "indices", dict), _of(sparse, "values", dict)
        count, kind = sparse.get("count"), _COMPONENTS.get(where.get("componentType", 0), "")
        if not _is_whole(count) or "u" not in kind or count > len(rows):
            raise MeshFileError(
                f"accessor {number} has sparse values without valid count and indices"
            )
        index = self._view_rows(where, count, kind, 1, number)[:, 0].astype(np.int64)
        if index.max(initial=-1) >= len(rows):
            raise MeshFileError(f"accessor {number} has sparse values of rows that do not exist")
        out = rows.copy()
        out[index] = self._view_rows(values, count, rows.dtype.str, rows.shape[1], number)
        return out

    def _view_rows(
        self, held: Any, count: int, kind: str, columns: int, number: Any
    ) -> NDArray[Any]:
        """Return the rows (count, columns) that an object refers to. Raises MeshFileError."""
        data, stride = self._view(held.get("bufferView"))
        at, size = held.get("byteOffset", 0), columns * np.dtype(kind).itemsize
        stride = stride or size
        if (
            not _is_whole(at)
            or stride < size
            or (count and at + (count - 1) * stride + size > len(data))
        ):
            raise MeshFileError(f"accessor {number} exceeds its buffer; the file is cut or damaged")
        if not count:
            return np.zeros((0, columns), dtype=kind)
        block = np.ndarray((count, size), np.uint8, data, at, (stride, 1))
        return np.ascontiguousarray(block).view(kind)

    def _view(self, number: Any) -> tuple[bytes, int]:
        """Return the bytes of a buffer view and its stride, 0 if rows follow each other."""
        view = self._item("bufferViews", number)
        if "EXT_meshopt_compression" in _of(view, "extensions", dict, {}):
            buffer = self._item("buffers", view.get("buffer"))
            if "uri" not in buffer and (view.get("buffer") != 0 or self.binary is None):
                raise MeshFileError(_unsupported("EXT_meshopt_compression"))
        data = self._buffer(view.get("buffer"))
        at, length, stride = (
            view.get("byteOffset", 0),
            view.get("byteLength"),
            view.get("byteStride", 0),
        )
        if not (_is_whole(at) and _is_whole(length) and _is_whole(stride)):
            raise MeshFileError(f"buffer view {number} has no valid byteOffset and byteLength")
        if at + length > len(data):
            raise MeshFileError(
                f"buffer view {number} exceeds its buffer; the file is cut or damaged"
            )
        return data[at : at + length], stride

    def _buffer(self, number: Any) -> bytes:
        key = ("buffer", number)
        if key not in self._read:
            held = self._item("buffers", number)
            if "uri" in held:
                data = self._uri(held["uri"])
            elif number == 0 and self.binary is not None:
                data = self.binary
            else:
                raise MeshFileError(f"buffer {number} has no content; the file is cut or damaged")
            length = held.get("byteLength")
            if not _is_whole(length) or len(data) < length:
                raise MeshFileError(
                    f"buffer {number} has {len(data)} of {length} bytes; the file is cut or damaged"
                )
            self._read[key] = data
        return self._read[key]

    def _uri(self, uri: Any) -> bytes:
        if not isinstance(uri, str):
            raise MeshFileError("has a uri that is not a text")
        if not uri.startswith("data:"):
            return self.files.read_uri(uri)
        head, comma, text = uri.partition(",")
        if not comma or not head.endswith(";base64"):
            raise MeshFileError("has data in its JSON that is not base64")
        try:
            return base64.b64decode(text, validate=True)
        except (binascii.Error, ValueError) as error:
            raise MeshFileError(f"has data in its JSON that is not base64: {error}") from None

    def _material(self, name: str, primitive: Any) -> Material:
        """Return the material of a primitive, with the defaults of the specification."""
        if "material" in primitive:
            number = primitive["material"]
            given = self._item("materials", number)
            label = printable(str(given.get("name") or f"material {number}"))
        else:
            given, label = {}, "glTF default"
            self.notes.append(
                f"{name}: no material; it is drawn as the format's default, a white rough metal"
            )
        share = self._vertex_colour(name, primitive)
        extensions = _of(given, "extensions", dict, {})
        if "KHR_materials_pbrSpecularGlossiness" in extensions:
            return self._specular(label, extensions["KHR_materials_pbrSpecularGlossiness"], share)
        pbr = _of(given, "pbrMetallicRoughness", dict, {})
        grey = share * self._grey(name, pbr, "baseColorFactor", "baseColorTexture")
        metallic, roughness = _number(pbr, "metallicFactor"), _number(pbr, "roughnessFactor")
        if "KHR_materials_unlit" in extensions:
            metallic, roughness = 0.0, 1.0
        elif "metallicRoughnessTexture" in pbr:
            means = channel_means(self._texture(pbr["metallicRoughnessTexture"]), is_srgb=False)
            metallic, roughness = metallic * means[2], roughness * means[1]
        return metallic_roughness(label, min(grey, 1.0), metallic, roughness)

    def _specular(self, label: str, given: Any, share: float) -> Material:
        diffuse = share * self._grey(label, given, "diffuseFactor", "diffuseTexture")
        specular = grey_of(_colour(given, "specularFactor")[None])
        rough = max(1.0 - _number(given, "glossinessFactor"), 0.1)
        return phong(label, round(min(diffuse, 1.0), 4), specular, min(2.0 / rough**4 - 2.0, 200.0))

    def _grey(self, name: str, given: Any, factor: str, texture: str) -> float:
        colour = _colour(given, factor)
        if texture not in given:
            return grey_of(colour[None])
        means = channel_means(self._texture(given[texture]), is_srgb=True)
        grey = grey_of((colour * means)[None])
        self.notes.append(f"{name}: its image texture is drawn as its mean, reflectance {grey:.2f}")
        return grey

    def _vertex_colour(self, name: str, primitive: Any) -> float:
        """Return the mean of colours of vertices, which multiply the base colour."""
        number = _of(primitive, "attributes", dict).get("COLOR_0")
        if number is None:
            return 1.0
        width = 4 if self._item("accessors", number).get("type") == "VEC4" else 3
        colours = self.accessor(number, width)
        if not len(colours):
            return 1.0
        grey = grey_of(colours[:, :3])
        self.notes.append(f"{name}: its vertex colours are drawn as their mean, {grey:.2f}")
        return grey

    def _texture(self, held: Any) -> Any:
        """Return the image of a texture. Raises MeshFileError."""
        texture = self._item("textures", _of(held, "index", int))
        extensions = _of(texture, "extensions", dict, {})
        source = texture.get("source", _of(extensions, "EXT_texture_webp", dict, {}).get("source"))
        if source is None:
            raise MeshFileError(_unsupported(next(iter(extensions), "texture without an image")))
        key = ("image", source)
        if key not in self._read:
            image = self._item("images", source)
            data = (
                self._uri(image["uri"])
                if "uri" in image
                else self._view(image.get("bufferView"))[0]
            )
            if data.startswith(b"\xabKTX 20"):
                raise MeshFileError(_unsupported("KHR_texture_basisu"))
            self._read[key] = open_image(data, f"image {source}")
        return self._read[key]

    def _list(self, key: str) -> list[Any]:
        return _of(self.tree, key, list, [])

    def _item(self, key: str, number: Any) -> dict[str, Any]:
        """Return an element of a list of the file. Raises MeshFileError."""
        rows = self._list(key)
        if not _is_whole(number) or number >= len(rows) or not isinstance(rows[number], dict):
            raise MeshFileError(f"refers to {key}[{number}], of {len(rows)}; export it anew")
        return rows[number]


def parse_gltf(data: bytes, files: ReferencedFiles, binary: bool) -> Gltf:
    """Return the content of a GLB (``binary``) or glTF file. Raises MeshFileError."""
    chunk = None
    if binary:
        data, chunk = _chunks(data)
    try:
        tree = json.loads(data.decode("utf-8-sig"))
    except RecursionError:
        raise MeshFileError("its JSON is nested too deeply") from None
    except ValueError as error:
        raise MeshFileError(f"its JSON is not valid: {error}") from None
    if not isinstance(tree, dict):
        raise MeshFileError("its JSON is not an object")
    version = str(_of(tree, "asset", dict, {}).get("version", "1"))
    if version.split(".")[0] != "2":
        raise MeshFileError(f"it is glTF {version[:10]}; convert it to glTF 2.0")
    for name in _of(tree, "extensionsRequired", list, []):
        if name not in _SUPPORTED and not str(name).startswith("KHR_materials_"):
            raise MeshFileError(_unsupported(str(name)[:80]))
    return Gltf(tree, chunk, files)


def _chunks(data: bytes) -> tuple[bytes, bytes | None]:
    """Return the JSON of a GLB file, and its binary chunk if it has one. Raises MeshFileError."""
    if data[:4] != b"glTF":
        raise MeshFileError("it does not begin with 'glTF'")
    if len(data) < 20:
        raise MeshFileError("the file is cut or damaged")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        raise MeshFileError(f"it is glTF {version}; convert it to glTF 2.0")
    if length > len(data):
        raise MeshFileError(f"it has {len(data)} of {length} bytes; the file is cut or damaged")
    found: list[tuple[int, bytes]] = []
    at = 12
    while at + 8 <= length:
        size, kind = struct.unpack_from("<II", data, at)
        if at + 8 + size > length:
            raise MeshFileError("a chunk exceeds the file; it is cut or damaged")
        found.append((kind, data[at + 8 : at + 8 + size]))
        at += 8 + size
    if not found or found[0][0] != 0x4E4F534A:
        raise MeshFileError("its first chunk is not JSON")
    return found[0][1], next((body for kind, body in found[1:] if kind == 0x004E4942), None)


def _unsupported(name: str) -> str:
    remedy = _REMEDIES.get(name, "export it without this extension")
    return f"its extension {name} is not supported; {remedy}"


def _transform(node: Any, number: int) -> Array:
    """Return the transform (4, 4) of a node to its parent. Raises MeshFileError."""
    out = np.eye(4)
    try:
        if "matrix" in node:
            out = np.array(node["matrix"], dtype=float).reshape(4, 4).T
        else:
            x, y, z, w = np.array(node.get("rotation", (0, 0, 0, 1)), dtype=float)
            turn = np.array([
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ])  # fmt: skip
            out[:3, :3] = turn * np.array(node.get("scale", (1, 1, 1)), dtype=float).reshape(3)
            out[:3, 3] = np.array(node.get("translation", (0, 0, 0)), dtype=float).reshape(3)
    except (TypeError, ValueError, OverflowError):
        raise MeshFileError(f"node {number} has a transform that is not one") from None
    if not np.isfinite(out).all():
        raise MeshFileError(f"node {number} has a transform that is not a number")
    return out


def _of(held: Any, key: str, kind: type, default: Any = None) -> Any:
    """Return a value of an object, of the right type. Raises MeshFileError."""
    if not isinstance(held, dict):
        raise MeshFileError(
            f"has a {type(held).__name__} where its JSON needs an object with {key!r}"
        )
    value = held.get(key, default)
    if not isinstance(value, kind):
        raise MeshFileError(f"its JSON needs {key!r} as {kind.__name__}")
    return value


def _dict_or_empty(value: Any) -> dict[str, Any]:
    return value if isinstance(value, dict) else {}


def _is_whole(value: Any) -> TypeGuard[int]:
    return isinstance(value, int) and not isinstance(value, bool) and value >= 0


def _number(held: Any, key: str) -> float:
    value = held.get(key, 1.0)
    if isinstance(value, bool) or not isinstance(value, (int, float)) or not np.isfinite(value):
        raise MeshFileError(f"its {key} is not a number")
    return float(value)


def _colour(held: Any, key: str) -> Array:
    """Return a colour (3,), white by default."""
    value = held.get(key, (1.0, 1.0, 1.0))
    try:
        out = np.array(value, dtype=float)[:3].reshape(3)
    except (TypeError, ValueError, IndexError):
        raise MeshFileError(f"its {key} is not a colour") from None
    return out
