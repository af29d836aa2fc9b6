# SPDX-License-Identifier: Apache-2.0
"""Read mesh files: GLB and glTF, and OBJ, STL, PLY, OFF and COLLADA through trimesh.

Every problem is one line that says what would be right. A part is a primitive of a node of the file
with its material. What the format cannot say (texture, density, joints) is in the extras of nodes
and scene under ``EXTRAS``, as `chaserdock target --mesh` writes them.
"""

from __future__ import annotations

import importlib.util
import io
import logging
import re
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from chaserdock_models import decimation
from chaserdock_models.arrays import Array, IntArray, Vector3
from chaserdock_models.mesh_repair import joined, repaired, welded
from chaserdock_models.meshes import (
    Material,
    MeshPart,
    TriangleMesh,
    hole_m,
    open_edges,
    unshared_edges,
    volume_m3,
)
from pydantic import ValidationError

from .errors import ScenarioError
from .mesh_gltf import Solid, parse_gltf
from .mesh_materials import channel_means, grey_of, metallic_roughness, phong
from .mesh_sources import (
    MeshFileError,
    ReferencedFiles,
    check_counts,
    check_triangles,
    plain_name,
    printable,
    read_bytes,
)
from .surface import MAX_PARTS, MAX_TRIANGLES, SUFFIXES, Surface, SurfaceJoint, SurfaceMaterial

EXTRAS = "chaserdock"
"""Key of a node's extras, and of a scene's, with what the format itself cannot say."""
_SMALLEST_M, _LARGEST_M = 0.02, 50.0
"""Sizes of a target: from a pocket satellite to half a space station. Others are a wrong unit."""
_WELD_SHARE = 1e-7
"""Vertices nearer than this share of the size are one: the rounding of single precision, in which
most formats store them."""
_SMALLEST_M3 = 1e-12
"""Least volume of a part: a cube of 0.1 mm. Less is a sheet and rounding."""
_UNITS = (
    (1e-3, "millimetres"),
    (1e-2, "centimetres"),
    (0.0254, "inches"),
    (0.3048, "feet"),
    (1000.0, "kilometres"),
)


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
    try:
        return _read(path, scale, np.array(origin_m))
    except MeshFileError as error:
        raise ScenarioError(f"{path}: {error}") from None


def _read(path: Path, scale: float, origin_m: Array) -> MeshFile:
    with np.errstate(over="ignore", invalid="ignore"):  # of foreign numbers, checked here
        solids, joints, notes = _load(path)
        if not solids:
            raise MeshFileError("contains no triangles; a target needs closed surfaces")
        placed = [replace(s, vertices=scale * s.vertices - origin_m) for s in solids]
        for solid in placed:
            _check_numbers(solid)
    _check_size(placed, scale, origin_m)
    parts = _with_unique_names([_part(solid) for solid in placed])
    low, high = TriangleMesh("", tuple(parts), {}).bounds_m()
    parts, changes = joined(parts, _grain_m(high - low))
    notes.extend(changes)
    joints = {
        name: tuple((scale * np.array(at) - origin_m).tolist()) for name, at in joints.items()
    }
    parts = [_closed(part, notes) for part in parts]
    mesh = TriangleMesh(path.stem, tuple(parts), joints)
    before = mesh.triangle_count
    mesh, deviation_m = decimation.limited(mesh, MAX_TRIANGLES)
    if before > MAX_TRIANGLES:
        notes.append(
            f"decimated from {before:,} to {mesh.triangle_count:,} triangles; largest deviation "
            f"{1e3 * deviation_m:.2f} mm"
        )
        if mesh.triangle_count > 2 * MAX_TRIANGLES:
            raise MeshFileError(
                f"{before:,} triangles in many parts or with many handles; simplify it "
                f"to {MAX_TRIANGLES:,}"
            )
    return MeshFile(mesh, tuple(notes), deviation_m)


Content = tuple[list[Solid], dict[str, Vector3], list[str]]
"""Solids of a file in its unit, positions of its joints, and notes."""


def _load(path: Path) -> Content:
    """Return the content of a file. Raises MeshFileError."""
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise MeshFileError(f"not a mesh file; its name must end in {', '.join(SUFFIXES)}")
    data = read_bytes(path)
    files = ReferencedFiles(path)
    try:
        check_counts(data, suffix)
        if suffix in (".glb", ".gltf"):
            gltf = parse_gltf(data, files, binary=suffix == ".glb")
            solids = _few(gltf.solids())
            return solids, _joints(gltf.scene), gltf.notes
        notes: list[str] = []
        solids = _few(_solids(_trimesh_scene(data, suffix, files), suffix, notes))
        notes += [f"{reason}; drawn without it" for reason in dict.fromkeys(files.refused)]
        return solids, {}, notes
    except _Refused as error:
        raise MeshFileError(str(error)) from None
    except Exception as error:  # readers of foreign formats raise whatever they stumble over
        reason = (str(error).strip().splitlines() or [type(error).__name__])[0][:200]
        remedy = "" if ";" in reason else "; export it anew"
        raise MeshFileError(f"not a {suffix[1:].upper()} mesh: {reason}{remedy}") from None


class _Refused(Exception):
    """A mesh that was read and cannot be a target; the text is for a person."""


def _few(solids: Iterator[Solid]) -> list[Solid]:
    """Return the solids of a file. Raises _Refused for too many."""
    out: list[Solid] = []
    for solid in solids:
        out.append(solid)
        if len(out) > MAX_PARTS:
            raise _Refused(f"has more than {MAX_PARTS} parts; join them to at most {MAX_PARTS}")
    return out


def trimesh_scene(path: Path) -> Any:
    """Return the scene of a file as trimesh reads it, checked at the boundary.

    Raises MeshFileError, and what trimesh raises.
    """
    data = read_bytes(path)
    check_counts(data, path.suffix.lower())
    return _trimesh_scene(data, path.suffix.lower(), ReferencedFiles(path))


def _trimesh_scene(data: bytes, suffix: str, files: ReferencedFiles) -> Any:
    import trimesh

    options: dict[str, Any] = {}
    if suffix == ".obj":
        data = _absolute_indices(data)
        options = {"split_objects": True, "group_material": True}
    if suffix == ".dae":
        if importlib.util.find_spec("collada") is None:
            raise _Refused("COLLADA needs another package: pip install pycollada; or export a GLB")
        if b"<!DOCTYPE" in data or b"<!ENTITY" in data or data.startswith(b"PK"):
            raise _Refused("COLLADA with a document type, or in an archive; export a GLB instead")
    trimesh.util.log.setLevel(logging.CRITICAL)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of foreign numbers; what is read is checked
        resolver: Any = files  # of trimesh's resolvers, loaders use `get` and `file_name` only
        return trimesh.load_scene(
            io.BytesIO(data), file_type=suffix[1:], resolver=resolver, process=False, **options
        )


def _absolute_indices(data: bytes) -> bytes:
    """Return an OBJ file whose faces count from the start. Raises MeshFileError for an index of 0.

    Negative indices count back from the line of the face; trimesh counts from the end of the file.
    """
    if re.search(rb"^[ \t]*f[ \t](?:.*[ \t])?0+(?:[/ \t\r]|$)", data, re.MULTILINE):
        raise MeshFileError("has a face with vertex 0, where the first is 1; export it anew")
    if not re.search(rb"^[ \t]*f[ \t].*-\d", data, re.MULTILINE):
        return data
    seen = {b"v": 0, b"vt": 0, b"vn": 0}
    kinds = (b"v", b"vt", b"vn")
    lines = []
    for line in data.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines():
        words = line.split()
        if words and words[0] in seen:
            seen[words[0]] += 1
        elif words and words[0] == b"f" and b"-" in line:
            corners = [
                b"/".join(
                    b"%d" % (int(n) + seen[kind] + 1) if n.startswith(b"-") else n
                    for n, kind in zip(corner.split(b"/"), kinds, strict=False)
                )
                for corner in words[1:]
            ]
            line = b" ".join([b"f", *corners])
        lines.append(line)
    return b"\n".join(lines)


def _solids(scene: Any, suffix: str, notes: list[str]) -> Iterator[Solid]:
    """Yield the nodes of a scene of trimesh. Raises MeshFileError."""
    order = {name: k for k, name in enumerate(scene.geometry)}
    placed = [(node, *scene.graph[node]) for node in scene.graph.nodes_geometry]
    check_triangles(sum(len(getattr(scene.geometry[g], "faces", ())) for *_, g in placed))
    names = _object_names(scene) if suffix == ".obj" else {}
    for node, transform, name in sorted(placed, key=lambda row: (order[row[2]], row[0])):
        geometry, plain = scene.geometry[name], plain_name(names.get(name, str(node)))
        if not hasattr(geometry, "faces"):
            notes.append(f"{plain}: points or lines are ignored")
            continue
        if not len(geometry.faces):
            continue
        vertices = np.asarray(geometry.vertices, dtype=float)
        triangles = np.asarray(geometry.faces, dtype=np.int64)
        if triangles.min() < 0 or triangles.max() >= len(vertices):
            raise MeshFileError(
                f"part {plain!r} has a triangle of a vertex that does not exist; export it anew"
            )
        if suffix == ".dae":
            vertices = vertices * _stated_unit_m(geometry)
        vertices = vertices @ transform[:3, :3].T + transform[:3, 3]
        if np.linalg.det(transform[:3, :3]) < 0.0:
            triangles = triangles[:, ::-1]
        yield Solid(plain, vertices, triangles, _material(plain, geometry, notes), {})


def _object_names(scene: Any) -> dict[str, str]:
    """Return the names of objects (OBJ) of one material, by the names of their geometries.

    Trimesh appends the name of the material.
    """
    bases: dict[str, list[str]] = {}
    for name, geometry in scene.geometry.items():
        material = getattr(getattr(geometry.visual, "material", None), "name", None)
        base = name.removesuffix(f"_{material}") if material else name
        bases.setdefault(base or name, []).append(name)
    return {names[0]: base for base, names in bases.items() if len(names) == 1}


def _check_numbers(solid: Solid) -> None:
    """Raise MeshFileError for a vertex that is not a number in 32 bits, as it is stored."""
    if not np.isfinite(solid.vertices.astype(np.float32)).all():
        raise MeshFileError(
            f"part {solid.name!r} has a vertex that is not a number; export it anew"
        )


def _part(solid: Solid) -> MeshPart:
    """Return a solid as a part with welded vertices. Raises MeshFileError."""
    vertices, triangles = _welded(solid.vertices, solid.triangles)
    extras = solid.extras.get(EXTRAS)
    if extras is None:
        return MeshPart(solid.name, solid.material, vertices, triangles)
    try:
        material = SurfaceMaterial.model_validate(extras.get("material", {})).material()
    except (ValidationError, AttributeError):
        raise MeshFileError(
            f"part {solid.name!r}: its extras {EXTRAS!r} must be as `chaserdock target "
            "--mesh` writes them"
        ) from None
    return MeshPart(solid.name, material, vertices, triangles, str(extras.get("joint", "")))


def _welded(vertices: Array, triangles: IntArray) -> tuple[Array, IntArray]:
    """Join vertices at one place, and drop triangles without area.

    Files split vertices at creases. Coordinates are rounded to 32 bits.
    """
    vertices = vertices.astype(np.float32).astype(float)
    first, place = welded(vertices, _grain_m(np.ptp(vertices, axis=0)))
    triangles = place[triangles]
    distinct = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    return vertices[first], triangles[distinct]


def _grain_m(size_m: Array) -> float:
    return max(float(size_m.max()) * _WELD_SHARE, 1e-12)


def _with_unique_names(parts: list[MeshPart]) -> list[MeshPart]:
    taken = {part.name for part in parts}
    used: set[str] = set()
    out = []
    for part in parts:
        name, number = part.name, 1
        while name in used or (number > 1 and name in taken):
            number += 1
            name = f"{part.name}_{number}"
        used.add(name)
        out.append(replace(part, name=name))
    return out


def _joints(scene: dict[str, Any]) -> dict[str, Vector3]:
    """Return the positions of joints in a scene's extras, in the file's unit. Raises _Refused."""
    extras = scene.get("extras")
    held = extras.get(EXTRAS, {}) if isinstance(extras, dict) else {}
    try:
        joints = [
            SurfaceJoint(name=k, position_m=tuple(at)) for k, at in held.get("joints", {}).items()
        ]
    except (ValidationError, AttributeError, TypeError):
        raise _Refused(
            f"its extras {EXTRAS!r} must be as `chaserdock target --mesh` writes them"
        ) from None
    return {joint.name: joint.position_m for joint in joints}


def _material(name: str, geometry: Any, notes: list[str]) -> Material:
    """Return the material of a geometry of trimesh; a texture is averaged to one grey."""
    visual = geometry.visual
    given = getattr(visual, "material", None)
    image = getattr(given, "baseColorTexture", None) or getattr(given, "image", None)
    is_pbr = hasattr(given, "baseColorFactor")  # how trimesh holds the colours of COLLADA
    # Where a file has no material, trimesh makes up one whose image has no format.
    if given is None or (image is not None and not image.format):
        if getattr(visual, "kind", None) in ("vertex", "face"):
            colours = visual.vertex_colors if visual.kind == "vertex" else visual.face_colors
            return Material("vertex colours", _grey_of_bytes(colours))
        notes.append(f"{name}: no material; it is drawn in uniform grey of reflectance 0.5")
        return Material("grey")
    label = printable(str(given.name or "material"))
    share = None
    if image is not None:
        share = grey_of(channel_means(image, is_srgb=True)[None])
        notes.append(f"{name}: its image texture is drawn as its mean, reflectance {share:.2f}")
    if is_pbr:
        factor = given.baseColorFactor
        grey = 1.0 if factor is None else _grey_of_bytes(factor)
        grey *= 1.0 if share is None else share
        rough = given.roughnessFactor
        return metallic_roughness(label, grey, 0.0, 1.0 if rough is None else float(rough))
    diffuse = _grey_of_mtl(given, "kd") if share is None else share
    if diffuse is None:
        notes.append(f"{name}: {label!r} has no diffuse colour; its reflectance is taken as 0.5")
    gloss = float(np.ravel(given.kwargs.get("ns", 0.0))[0])
    return phong(
        label, 0.5 if diffuse is None else diffuse, _grey_of_mtl(given, "ks") or 0.0, gloss
    )


def _grey_of_mtl(given: Any, key: str) -> float | None:
    """Return the luminance of a colour of a material file; one number is grey."""
    value = given.kwargs.get(key)
    return None if value is None else grey_of(np.broadcast_to(np.array(value, dtype=float), (1, 3)))


def _stated_unit_m(geometry: Any) -> float:
    """Return the unit, m, of a geometry of trimesh from COLLADA: "0.01 * meters"."""
    found = re.match(r"([\d.eE+-]+) \* meters", str(geometry.metadata.get("units", "")))
    return float(found[1]) if found else 1.0


def _grey_of_bytes(colours: Any) -> float:
    """Return the luminance of colours (n, 3 or 4) or (3 or 4,) of 8 bits, linear."""
    return grey_of(np.atleast_2d(np.asarray(colours, dtype=float))[:, :3] / 255.0)


def _check_size(solids: list[Solid], scale: float, origin_m: Array) -> None:
    """Raise MeshFileError for a mesh of a size or at a distance that no target has."""
    low = np.min([s.vertices[s.triangles].min(axis=(0, 1)) for s in solids], axis=0)
    high = np.max([s.vertices[s.triangles].max(axis=(0, 1)) for s in solids], axis=0)
    size = float((high - low).max())
    if not _SMALLEST_M <= size <= _LARGEST_M:
        fitting = [
            f"in {unit}, mesh_scale = {scale * factor:g} makes it {size * factor:.3g} m"
            for factor, unit in _UNITS
            if _SMALLEST_M <= size * factor <= _LARGEST_M
        ]
        hint = f"; if it is {'; if '.join(fitting)}" if fitting else ""
        raise MeshFileError(
            f"is {size:.4g} m long; a target measures {_SMALLEST_M} to {_LARGEST_M:g} m{hint}"
        )
    if max(np.abs(low).max(), np.abs(high).max()) > 2.0 * _LARGEST_M:
        middle = ", ".join(f"{v:.4g}" for v in (low + high) / 2.0 + origin_m)
        raise MeshFileError(
            f"lies {np.linalg.norm((low + high) / 2.0):.4g} m from its origin; "
            f"mesh_origin_m = [{middle}] puts its middle there"
        )


def _closed(part: MeshPart, notes: list[str]) -> MeshPart:
    """Return a part with its triangles counter-clockwise.

    Raises MeshFileError for one that is not closed.
    """
    part, changes = repaired(part)
    at = hole_m(part)
    if at is not None:
        x, y, z = at.tolist()
        where = f"{open_edges(part)} open edges, one near ({x:.3f}, {y:.3f}, {z:.3f}) m"
        if unshared_edges(part):
            raise MeshFileError(
                f"part {part.name!r} has a hole: {where}; "
                "close its surface (a sheet needs a thickness)"
            )
        raise MeshFileError(
            f"part {part.name!r} has no inside: {where}, where more than two triangles meet or a "
            "surface has one side; make it manifold"
        )
    if not volume_m3(part) > _SMALLEST_M3:
        raise MeshFileError(f"part {part.name!r} encloses no volume; give it a thickness")
    notes.extend(f"{part.name}: {change}" for change in changes)
    return part
