# SPDX-License-Identifier: Apache-2.0
"""Read mesh files (GLB, glTF, OBJ, STL, PLY) through trimesh.

Every problem is one line that says what would be right. A part is a node of the file with its
material. What the format cannot say (texture, density, joints) is in the extras of nodes and scene
under ``EXTRAS``, as `chaserdock target --mesh` writes them.
"""

from __future__ import annotations

import logging
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from chaserdock_models import decimation
from chaserdock_models.arrays import Array, IntArray, Vector3
from chaserdock_models.meshes import Material, MeshPart, TriangleMesh, hole_m, open_edges, volume_m3
from pydantic import ValidationError

from .errors import ScenarioError
from .surface import MAX_PARTS, MAX_TRIANGLES, SUFFIXES, Surface, SurfaceJoint, SurfaceMaterial

EXTRAS = "chaserdock"
"""Key of a node's extras, and of a scene's, with what the format itself cannot say."""
_SMALLEST_M, _LARGEST_M = 0.02, 50.0
"""Sizes of a target: from a pocket satellite to half a space station. Others are a wrong unit."""
_MOST_READ = 5_000_000
"""Triangles of a file, 250 for each that is drawn: bounds time and memory of reading it."""
_WELD_SHARE = 1e-7
"""Vertices nearer than this share of the size are one: the rounding of single precision, in which
most formats store them."""
_UNITS = ((1e-3, "millimetres"), (1e-2, "centimetres"), (0.0254, "inches"), (1000.0, "kilometres"))


@dataclass(frozen=True)
class MeshFile:
    """A mesh that was read.

    ``notes``: what was changed or assumed. ``deviation_m``: by decimation.
    """

    mesh: TriangleMesh
    notes: tuple[str, ...]
    deviation_m: float


def read_surface(path: Path, scale: float = 1.0, origin_m: Vector3 = (0.0, 0.0, 0.0)) -> Surface:
    """Return a mesh file as part of a scenario. Raises ScenarioError."""
    found = read_mesh(path, scale, origin_m)
    return Surface.of(found.mesh, str(path), scale, origin_m, found.deviation_m)


def read_mesh(path: Path, scale: float = 1.0, origin_m: Vector3 = (0.0, 0.0, 0.0)) -> MeshFile:
    """Read a mesh file.

    ``scale``: factor from the file's unit to metres. ``origin_m``: point of the file that becomes
    the origin. Raises ScenarioError with one line for a file that is not a mesh, is not closed, or
    has an absurd size.
    """
    scene, notes = _load(path), []
    parts = [
        _part(path, *solid, notes) for solid in _solids(scene, scale, np.array(origin_m), notes)
    ]
    if not parts:
        raise ScenarioError(f"{path}: contains no triangles; a target needs closed surfaces")
    if len(parts) > MAX_PARTS:
        raise ScenarioError(f"{path}: has {len(parts)} parts; join them to at most {MAX_PARTS}")

    parts = _with_unique_names(parts)
    mesh = TriangleMesh(path.stem, tuple(parts), _joints(path, scene, scale, np.array(origin_m)))
    _check_size(path, mesh, scale)
    if mesh.triangle_count > _MOST_READ:
        raise ScenarioError(
            f"{path}: has {mesh.triangle_count:,} triangles; simplify it to at most {_MOST_READ:,}"
        )

    mesh = replace(mesh, parts=tuple(_closed(path, part, notes) for part in mesh.parts))
    before = mesh.triangle_count
    mesh, deviation_m = decimation.limited(mesh, MAX_TRIANGLES)
    if before > MAX_TRIANGLES:
        notes.append(
            f"decimated from {before:,} to {mesh.triangle_count:,} triangles; largest deviation "
            f"{1e3 * deviation_m:.2f} mm"
        )
        if mesh.triangle_count > 2 * MAX_TRIANGLES:
            raise ScenarioError(
                f"{path}: {before:,} triangles in many parts or with many handles; simplify it "
                f"to {MAX_TRIANGLES:,}"
            )
    return MeshFile(mesh, tuple(notes), deviation_m)


def _load(path: Path) -> Any:
    """Return the trimesh scene of a file. Raises ScenarioError."""
    import trimesh

    if path.suffix.lower() not in SUFFIXES:
        raise ScenarioError(f"{path}: not a mesh file; its name must end in {', '.join(SUFFIXES)}")
    if not path.is_file():
        raise ScenarioError(f"{path}: no such mesh file")
    trimesh.util.log.setLevel(logging.CRITICAL)
    suffix = path.suffix.lower()
    options: dict[str, Any] = (
        {"split_objects": True, "group_material": False} if suffix == ".obj" else {}
    )
    try:
        if suffix == ".glb" and path.read_bytes()[:4] != b"glTF":
            raise ValueError("it does not begin with 'glTF'")
        return trimesh.load_scene(path, process=False, **options)
    except Exception as error:  # readers of foreign formats raise whatever they stumble over
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0]
        raise ScenarioError(
            f"{path}: not a {path.suffix[1:].upper()} mesh: {reason[:200]}"
        ) from None


Solid = tuple[str, Array, IntArray, Any]
"""Name, vertices (n, 3) in m, triangles (m, 3), and trimesh's geometry of a node."""


def _solids(scene: Any, scale: float, origin_m: Array, notes: list[str]) -> Iterator[Solid]:
    order = {name: k for k, name in enumerate(scene.geometry)}
    placed = [(node, *scene.graph[node]) for node in scene.graph.nodes_geometry]
    for node, transform, name in sorted(placed, key=lambda row: (order[row[2]], row[0])):
        geometry = scene.geometry[name]
        if not hasattr(geometry, "faces"):
            notes.append(f"{node}: points or lines are ignored")
            continue
        if not len(geometry.faces):
            continue
        vertices = (
            np.asarray(geometry.vertices, dtype=float) @ transform[:3, :3].T + transform[:3, 3]
        )
        triangles = np.asarray(geometry.faces, dtype=np.int64)
        if np.linalg.det(transform[:3, :3]) < 0.0:
            triangles = triangles[:, ::-1]
        yield str(node), scale * vertices - origin_m, triangles, geometry


def _part(
    path: Path, name: str, vertices: Array, triangles: IntArray, geometry: Any, notes: list[str]
) -> MeshPart:
    """Return a node as a part with welded vertices. Raises ScenarioError."""
    plain = re.sub(r"[^A-Za-z0-9._-]", "_", name).lstrip("._-")[:60] or "part"
    if not np.all(np.isfinite(vertices)):
        raise ScenarioError(f"{path}: part {plain!r} has a vertex that is not a number")
    vertices, triangles = _welded(vertices, triangles)
    extras = geometry.metadata.get(EXTRAS) if isinstance(geometry.metadata, dict) else None
    if extras is None:
        return MeshPart(plain, _material(plain, geometry, notes), vertices, triangles)
    try:
        material = SurfaceMaterial.model_validate(extras.get("material", {})).material()
    except (ValidationError, AttributeError):
        raise ScenarioError(
            f"{path}: part {plain!r}: its extras {EXTRAS!r} must be as `chaserdock target "
            "--mesh` writes them"
        ) from None
    return MeshPart(plain, material, vertices, triangles, str(extras.get("joint", "")))


def _welded(vertices: Array, triangles: IntArray) -> tuple[Array, IntArray]:
    """Join vertices at one place, and drop triangles without area.

    Files split vertices at creases. Coordinates are rounded to 32 bits.
    """
    vertices = vertices.astype(np.float32).astype(float)
    grain = max(float(np.ptp(vertices, axis=0).max()) * _WELD_SHARE, 1e-12)
    _, first, where = np.unique(
        np.round(vertices / grain).astype(np.int64), axis=0, return_index=True, return_inverse=True
    )
    triangles = where.reshape(-1)[triangles]
    distinct = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    return vertices[first], triangles[distinct]


def _with_unique_names(parts: list[MeshPart]) -> list[MeshPart]:
    used: dict[str, int] = {}
    out = []
    for part in parts:
        used[part.name] = used.get(part.name, 0) + 1
        number = used[part.name]
        out.append(part if number == 1 else replace(part, name=f"{part.name}_{number}"))
    return out


def _joints(path: Path, scene: Any, scale: float, origin_m: Array) -> dict[str, Vector3]:
    extras = scene.metadata.get(EXTRAS, {}) if isinstance(scene.metadata, dict) else {}
    try:
        joints = [
            SurfaceJoint(name=k, position_m=tuple(at)) for k, at in extras.get("joints", {}).items()
        ]
    except (ValidationError, AttributeError, TypeError):
        raise ScenarioError(
            f"{path}: its extras {EXTRAS!r} must be as `chaserdock target --mesh` writes them"
        ) from None
    return {j.name: tuple((scale * np.array(j.position_m) - origin_m).tolist()) for j in joints}


def _material(name: str, geometry: Any, notes: list[str]) -> Material:
    """Return the material of a node without extras; textures are averaged to one grey."""
    visual = geometry.visual
    given = getattr(visual, "material", None)
    if given is None:
        if getattr(visual, "kind", None) in ("vertex", "face"):
            colours = visual.vertex_colors if visual.kind == "vertex" else visual.face_colors
            return Material(
                "vertex colours", _grey(np.asarray(colours, dtype=float)[:, :3] / 255.0)
            )
        notes.append(f"{name}: no material; it is drawn in uniform grey of reflectance 0.5")
        return Material("grey")

    label = str(getattr(given, "name", None) or "material")[:64]
    image = getattr(given, "baseColorTexture", None) or getattr(given, "image", None)
    share = 1.0
    if image is not None:
        share = _grey(np.asarray(image.convert("RGB"), dtype=float).reshape(-1, 3) / 255.0)
        notes.append(f"{name}: its image texture is drawn as its mean, reflectance {share:.2f}")
    else:
        notes.append(f"{name}: no texture; uniform surface of {label!r}") if not _has_colour(
            given
        ) else None

    if hasattr(given, "baseColorFactor"):
        return _of_pbr(label, given, share)
    diffuse = (
        share
        if image is not None
        else _grey(np.asarray(given.diffuse, dtype=float)[None, :3] / 255.0)
    )
    specular = _grey(np.asarray(given.specular, dtype=float)[None, :3] / 255.0)
    shininess = float(np.clip(given.glossiness or 20.0, 1.0, 1000.0))
    return Material(label, diffuse, specular, shininess)


def _has_colour(material: Any) -> bool:
    return (
        getattr(material, "baseColorFactor", None) is not None
        or getattr(material, "diffuse", None) is not None
    )


def _of_pbr(label: str, given: Any, share: float) -> Material:
    """Return the material of metallic-roughness shading.

    A metal reflects mostly in its highlight, whose exponent is 2 / r^4 - 2 at the roughness r.
    """
    factor = given.baseColorFactor
    grey = 1.0 if factor is None else _grey(np.asarray(factor, dtype=float)[None, :3] / 255.0)
    if factor is None and share == 1.0:
        grey = 0.5
    grey = float(np.clip(grey * share, 0.0, 1.0))
    metallic = float(
        np.clip(given.metallicFactor if given.metallicFactor is not None else 0.0, 0.0, 1.0)
    )
    roughness = float(
        np.clip(given.roughnessFactor if given.roughnessFactor is not None else 0.8, 0.1, 1.0)
    )
    shininess = float(np.clip(2.0 / roughness**4 - 2.0, 1.0, 200.0))
    diffuse, specular = (
        grey * (1.0 - 0.5 * metallic),
        0.04 * (1.0 - metallic) + 0.8 * grey * metallic,
    )
    return Material(label, round(diffuse, 4), round(specular, 4), round(shininess, 2))


def _grey(rgb: Array) -> float:
    """Return the mean luminance (ITU-R BT.709) of colours (n, 3), 0 to 1."""
    return round(float(np.clip((rgb @ (0.2126, 0.7152, 0.0722)).mean(), 0.0, 1.0)), 4)


def _check_size(path: Path, mesh: TriangleMesh, scale: float) -> None:
    low, high = mesh.bounds_m()
    size = float((high - low).max())
    if _SMALLEST_M <= size <= _LARGEST_M:
        return
    fitting = [
        f"if it is in {unit}, mesh_scale = {scale * factor:g} makes it {size * factor:.3g} m"
        for factor, unit in _UNITS
        if _SMALLEST_M <= size * factor <= _LARGEST_M
    ]
    hint = f"; {fitting[0]}" if fitting else ""
    raise ScenarioError(
        f"{path}: is {size:.4g} m long; a target measures {_SMALLEST_M} to {_LARGEST_M:g} m{hint}"
    )


def _closed(path: Path, part: MeshPart, notes: list[str]) -> MeshPart:
    """Return a part with its triangles counter-clockwise. Raises ScenarioError for one with
    holes.
    """
    if open_edges(part):
        part = _consistent(part)
    at = hole_m(part)
    if at is not None:
        x, y, z = at.tolist()
        raise ScenarioError(
            f"{path}: part {part.name!r} has a hole: {open_edges(part)} open edges, one near "
            f"({x:.3f}, {y:.3f}, {z:.3f}) m; "
            "close its surface (a sheet needs a thickness)"
        )
    volume = volume_m3(part)
    if not abs(volume) > 1e-12:
        raise ScenarioError(f"{path}: part {part.name!r} encloses no volume; give it a thickness")
    if volume < 0.0:
        notes.append(f"{part.name}: its triangles were clockwise and are turned")
        return replace(part, triangles=part.triangles[:, ::-1])
    return part


def _consistent(part: MeshPart) -> MeshPart:
    """Return a part whose triangles are turned to agree with their neighbours."""
    import trimesh

    solid = trimesh.Trimesh(part.vertices_m, part.triangles, process=False)
    trimesh.repair.fix_winding(solid)
    return replace(part, triangles=np.asarray(solid.faces, dtype=np.int64))
