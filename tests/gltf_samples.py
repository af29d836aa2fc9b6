# SPDX-License-Identifier: Apache-2.0
"""Small glTF files, written byte by byte, so that tests do not depend on a writer's choices."""

from __future__ import annotations

import io
import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from chaserdock_protocol.scenario import ScenarioError
from chaserdock_protocol.scenario.mesh_files import read_mesh
from numpy.typing import NDArray

BOX_M = (1.0, 0.8, 0.6)
KINDS = {"i1": 5120, "u1": 5121, "i2": 5122, "u2": 5123, "u4": 5125, "f4": 5126}
SHAPES = {1: "SCALAR", 2: "VEC2", 3: "VEC3", 4: "VEC4", 16: "MAT4"}


def box() -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return vertices (8, 3), m, and triangles (12, 3) of the sample body."""
    solid = trimesh.creation.box(BOX_M)
    return np.asarray(solid.vertices, dtype=float), np.asarray(solid.faces, dtype=np.int64)


def refusal(path: Path) -> str:
    """Return the one line with which a mesh file is refused; it names the file first."""
    with pytest.raises(ScenarioError) as caught:
        read_mesh(path)
    text = str(caught.value)
    assert text.startswith(str(path))
    assert "\n" not in text
    return text


class GltfSample:
    """A glTF file with one box, node "bus" and an optional material; tests alter its ``tree``."""

    def __init__(self, material: dict[str, Any] | None = None) -> None:
        self.binary = b""
        self.tree: dict[str, Any] = {
            "asset": {"version": "2.0"}, "scene": 0, "scenes": [{"nodes": [0]}],
            "nodes": [{"mesh": 0, "name": "bus"}], "accessors": [], "bufferViews": [],
        }  # fmt: skip
        vertices, triangles = box()
        self.primitive: dict[str, Any] = {
            "attributes": {"POSITION": self.add(vertices.astype("f4"))},
            "indices": self.add(triangles.astype("u2").reshape(-1, 1)),
        }
        self.tree["meshes"] = [{"primitives": [self.primitive]}]
        if material is not None:
            self.tree["materials"] = [material]
            self.primitive["material"] = 0

    def view(self, data: bytes, **more: Any) -> int:
        """Append bytes to the buffer; return the number of their view."""
        self.tree["bufferViews"].append(
            {"buffer": 0, "byteOffset": len(self.binary), "byteLength": len(data), **more}
        )
        self.binary += data + bytes(-len(data) % 4)
        return len(self.tree["bufferViews"]) - 1

    def add(self, rows: NDArray[Any], stride: int = 0, **more: Any) -> int:
        """Append an accessor with rows (n, width); return its number."""
        width, data = rows.shape[1], rows.tobytes()
        if stride:
            pad = stride - width * rows.itemsize
            data = b"".join(row.tobytes() + bytes(pad) for row in rows)
        view = self.view(data, **({"byteStride": stride} if stride else {}))
        self.tree["accessors"].append(
            {"bufferView": view, "componentType": KINDS[rows.dtype.str[1:]], "count": len(rows),
             "type": SHAPES[width], **more}
        )  # fmt: skip
        return len(self.tree["accessors"]) - 1

    def image(self, data: bytes) -> dict[str, Any]:
        """Append a texture of an image's bytes; return the reference to it."""
        self.tree.setdefault("images", []).append({"bufferView": self.view(data)})
        self.tree.setdefault("textures", []).append({"source": len(self.tree["images"]) - 1})
        return {"index": len(self.tree["textures"]) - 1}

    def write(self, path: Path) -> Path:
        """Write a GLB, or a glTF without its buffer, by the file's ending."""
        self.tree.setdefault("buffers", [{"byteLength": len(self.binary)}])
        text = json.dumps(self.tree).encode()
        if path.suffix == ".gltf":
            path.write_bytes(text)
            return path
        text += b" " * (-len(text) % 4)
        length = 28 + len(text) + len(self.binary)
        path.write_bytes(
            struct.pack("<4sII", b"glTF", 2, length)
            + struct.pack("<II", len(text), 0x4E4F534A) + text
            + struct.pack("<II", len(self.binary), 0x004E4942) + self.binary
        )  # fmt: skip
        return path


def png(rgb: tuple[int, int, int], size: int = 4) -> bytes:
    """Return a PNG of one colour."""
    from PIL import Image

    out = io.BytesIO()
    Image.new("RGB", (size, size), rgb).save(out, "PNG")
    return out.getvalue()
