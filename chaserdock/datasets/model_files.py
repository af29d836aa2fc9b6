# SPDX-License-Identifier: Apache-2.0
"""Model files of BOP datasets: ASCII PLY in millimetres with normals, and ``models_info.json``."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from chaserdock_models.meshes import TriangleMesh, triangle_soup
from chaserdock_protocol.output_files import write_atomically

from .json_files import numbers, read_object, write_json
from .shapes import diameter_of
from .types import DatasetError, TargetShape

OBJECT = 1
"""Object number of the target in datasets that we write."""


def write_models(mesh: TriangleMesh, shape: TargetShape, folder: Path) -> None:
    """Write the model of the target, without markers, and its entry in ``models_info.json`` into a
    new folder. Raises OSError.
    """
    folder.mkdir(parents=True)
    _write_ply(mesh, folder / f"obj_{OBJECT:06d}.ply")
    write_json(folder / "models_info.json", {str(OBJECT): _info(shape)})


def _write_ply(mesh: TriangleMesh, path: Path) -> None:
    soup = triangle_soup(mesh)
    rows = (
        np.round(np.concatenate([1e3 * soup.corners_m, soup.normals], axis=2).reshape(-1, 6), 6)
        + 0.0
    )
    vertices, index = np.unique(rows, axis=0, return_inverse=True)
    triangles = index.reshape(-1, 3)
    head = [
        "ply", "format ascii 1.0", f"comment {mesh.name}, millimetres", "element vertex "
            f"{len(vertices)}",
        *(f"property float {name}" for name in ("x", "y", "z", "nx", "ny", "nz")), "element "
            f"face {len(triangles)}",
        "property list uchar int vertex_indices", "end_header",
    ]  # fmt: skip
    lines = [" ".join(f"{v:.6g}" for v in row) for row in vertices.tolist()]
    faces = [f"3 {a} {b} {c}" for a, b, c in triangles.tolist()]
    write_atomically(path, "\n".join([*head, *lines, *faces]) + "\n")


def _info(shape: TargetShape) -> dict[str, Any]:
    low, high = 1e3 * shape.points_m.min(axis=0), 1e3 * shape.points_m.max(axis=0)
    info: dict[str, Any] = {"diameter": round(1e3 * shape.diameter_m, 6)}
    info |= {f"min_{axis}": round(v, 6) for axis, v in zip("xyz", low.tolist(), strict=True)}
    info |= {
        f"size_{axis}": round(v, 6) for axis, v in zip("xyz", (high - low).tolist(), strict=True)
    }
    if len(shape.symmetries):
        transforms = np.zeros((len(shape.symmetries), 4, 4))
        transforms[:, :3, :3], transforms[:, 3, 3] = shape.symmetries, 1.0
        info["symmetries_discrete"] = transforms.reshape(-1, 16).tolist()
    return info


def read_models(folder: Path, number: int | None = None) -> TargetShape:
    """Return the shape of a model of a folder, by its number; of the only one without. Raises
    DatasetError.
    """
    # Needs trimesh, which is slow to import.
    from chaserdock_protocol.scenario.mesh_files import trimesh_scene

    info_file = folder / "models_info.json"
    infos = read_object(info_file)
    if number is None and len(infos) != 1:
        raise DatasetError(
            f"{info_file}: has {len(infos)} objects; a dataset of one target has one"
        )
    key = next(iter(infos)) if number is None else str(number)
    if key not in infos:
        raise DatasetError(f"{info_file}: object {key} is missing")
    info = infos[key]
    if not key.isdigit() or not isinstance(info, dict):
        raise DatasetError(f"{info_file}: must map the number of an object to its properties")
    file = folder / f"obj_{int(key):06d}.ply"
    try:
        found = trimesh_scene(file).geometry.values()
        points = 1e-3 * np.concatenate([np.asarray(g.vertices, dtype=float) for g in found])
    except Exception as error:  # trimesh raises what its readers raise
        raise DatasetError(f"{file}: not a PLY model: {error}") from None
    if len(points) < 4 or not np.isfinite(points).all():
        raise DatasetError(f"{file}: must have 4 or more finite vertices")
    rows = info.get("symmetries_discrete") or []
    symmetries = numbers(
        info_file, {"symmetries_discrete": rows}, "symmetries_discrete", (len(rows), 4, 4)
    )
    continuous = bool(info.get("symmetries_continuous"))
    return TargetShape(points, diameter_of(points), symmetries[:, :3, :3], continuous)
