# SPDX-License-Identifier: Apache-2.0
"""Repair surfaces from files.

Triangles that disagree with their neighbours or face inwards are turned, those that exist twice are
dropped, and parts that are closed only together are joined.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from .arrays import Array, BoolArray, IntArray
from .meshes import Material, MeshPart, open_edges, unshared_edges

_MOST_SURFACES = 2_000
"""Surfaces of a part of which each is compared with each: bounds the time of a few seconds."""
_PROBES = 5
"""Vertices of a surface that are tested for lying inside another one; most of them decide."""


def repaired(part: MeshPart) -> tuple[MeshPart, tuple[str, ...]]:
    """Return a part with its triangles counter-clockwise, and what was changed.

    What has holes stays as it is, except that triangles agree with their neighbours.
    """
    part, notes = _single(part)
    if open_edges(part):
        part, turned = _agreeing(part)
        if turned:
            notes = (*notes, f"{turned} triangles disagreed with their neighbours and are turned")
    if open_edges(part):
        return part, notes
    part, note = _outwards(part)
    return part, (*notes, *note)


def joined(parts: list[MeshPart], grain_m: float) -> tuple[list[MeshPart], tuple[str, ...]]:
    """Join parts that are closed only together, as exporters write a body of several materials.

    Vertices within ``grain_m`` are one. The material is the mean by area; the name that of the
    first. Returns the parts and what was changed; parts that stay open are as before.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    open_parts = [k for k, part in enumerate(parts) if unshared_edges(part)]
    if len(open_parts) < 2:
        return parts, ()
    points = np.concatenate([parts[k].vertices_m for k in open_parts])
    owner = np.repeat(np.arange(len(open_parts)), [len(parts[k].vertices_m) for k in open_parts])
    place = welded(points, grain_m)[1]
    held = coo_array((np.ones(len(owner), dtype=bool), (owner, place))).tocsr()
    _, group = connected_components(held @ held.T, directed=False)
    notes, dropped = [], set[int]()
    out = list(parts)
    for number in np.unique(group).tolist():
        members = [parts[open_parts[k]] for k in np.flatnonzero(group == number)]
        if len(members) < 2 or len({part.joint for part in members}) > 1:
            continue
        whole = _union(members, grain_m)
        if open_edges(repaired(whole)[0]):
            continue
        at = [open_parts[k] for k in np.flatnonzero(group == number)]
        out[at[0]] = whole
        dropped.update(at[1:])
        names = ", ".join(part.name for part in members[:4])
        more = f" and {len(members) - 4} more" if len(members) > 4 else ""
        notes.append(
            f"{names}{more}: closed only together; joined, with the mean of their materials"
        )
    return [part for k, part in enumerate(out) if k not in dropped], tuple(notes)


def _union(parts: list[MeshPart], grain_m: float) -> MeshPart:
    """Return parts as one, with their mean material by area."""
    starts = np.cumsum([0, *(len(part.vertices_m) for part in parts)])
    first, place = welded(np.concatenate([part.vertices_m for part in parts]), grain_m)
    corners = [part.triangles + at for part, at in zip(parts, starts, strict=False)]
    triangles = place[np.concatenate(corners)]
    distinct = (triangles != np.roll(triangles, 1, axis=1)).all(axis=1)
    area = np.array([_areas(part).sum() for part in parts])
    share = area / max(area.sum(), 1e-30)
    materials = [part.material for part in parts]

    def mean(values: list[float]) -> float:
        return round(float(share @ values), 4)

    material = Material(
        materials[0].name if len({m.name for m in materials}) == 1 else "mean of several",
        mean([m.diffuse for m in materials]),
        mean([m.specular for m in materials]),
        mean([m.shininess for m in materials]),
    )
    vertices = np.concatenate([part.vertices_m for part in parts])[first]
    return MeshPart(parts[0].name, material, vertices, triangles[distinct], parts[0].joint)


def welded(vertices: Array, grain_m: float) -> tuple[IntArray, IntArray]:
    """Join vertices (n, 3) of one place: the first of each (k,), and the place (n,) of each."""
    cells = np.round((vertices - vertices.min(axis=0)) / grain_m).astype(np.int64)
    _, first, place = np.unique(cells, axis=0, return_index=True, return_inverse=True)
    return first, place.reshape(-1)


def _single(part: MeshPart) -> tuple[MeshPart, tuple[str, ...]]:
    """Keep one of the triangles that have the same corners if that leaves a closed surface."""
    _, uses = _edges(part)
    if uses.max(initial=0) <= 2:
        return part, ()
    _, first = np.unique(np.sort(part.triangles, axis=1), axis=0, return_index=True)
    dropped = len(part.triangles) - len(first)
    if not dropped:
        return part, ()
    fewer, _ = _agreeing(replace(part, triangles=part.triangles[np.sort(first)]))
    if open_edges(fewer):
        return part, ()
    return fewer, (f"{dropped} triangles existed twice, of which one is kept",)


def _edges(part: MeshPart) -> tuple[IntArray, IntArray]:
    """Return the edges of triangles.

    The number of the edge (3 m,) of each side of each triangle, and the sides (n,) of each edge.
    """
    ends = np.concatenate([part.triangles[:, [k, (k + 1) % 3]] for k in range(3)])
    keys = ends.min(axis=1) * len(part.vertices_m) + ends.max(axis=1)
    _, where, uses = np.unique(keys, return_inverse=True, return_counts=True)
    return where.reshape(-1), uses


def _neighbours(part: MeshPart) -> tuple[IntArray, IntArray, BoolArray]:
    """Return the pairs of triangles (k,), (k,) that share an edge, and whether they disagree (k,).

    Those that disagree pass the edge in the same direction. Edges of more than two sides count not.
    """
    edge, uses = _edges(part)
    sides = np.flatnonzero(uses[edge] == 2)
    pairs = sides[np.argsort(edge[sides], kind="stable")].reshape(-1, 2)
    m = len(part.triangles)
    start = np.concatenate([part.triangles[:, k] for k in range(3)])
    return pairs[:, 0] % m, pairs[:, 1] % m, start[pairs[:, 0]] == start[pairs[:, 1]]


def _agreeing(part: MeshPart) -> tuple[MeshPart, int]:
    """Turn triangles until neighbours agree, of each surface those with the smaller area.

    Each triangle is two nodes of a graph, as it is and turned, connected with those of its
    neighbours that agree: one of the two connected components of a surface is a consistent choice.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    m = len(part.triangles)
    a, b, disagree = _neighbours(part)
    other = np.where(disagree, b + m, b)
    other_turned = np.where(disagree, b, b + m)
    rows, columns = np.concatenate([a, a + m]), np.concatenate([other, other_turned])
    graph = coo_array((np.ones(len(rows), dtype=bool), (rows, columns)), shape=(2 * m, 2 * m))
    count, label = connected_components(graph, directed=False)
    kept, turned = label[:m], label[m:]
    area = _areas(part)
    weight = np.bincount(kept, weights=area, minlength=count)
    flip = (weight[turned] > weight[kept]) | ((weight[turned] == weight[kept]) & (turned < kept))
    return _turned(part, flip), int(flip.sum())


def _turned(part: MeshPart, flip: BoolArray) -> MeshPart:
    triangles = np.where(flip[:, None], part.triangles[:, ::-1], part.triangles)
    return replace(part, triangles=triangles)


def _areas(part: MeshPart) -> Array:
    a, b, c = np.moveaxis(part.vertices_m[part.triangles], 1, 0)
    return np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _surfaces(part: MeshPart) -> tuple[int, IntArray]:
    """Return the number of surfaces that are connected by edges, and that of each triangle (m,)."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    m = len(part.triangles)
    a, b, _ = _neighbours(part)
    graph = coo_array((np.ones(len(a), dtype=bool), (a, b)), shape=(m, m))
    return connected_components(graph, directed=False)


def _outwards(part: MeshPart) -> tuple[MeshPart, tuple[str, ...]]:
    """Turn surfaces that face inwards, unless they bound a cavity of another one."""
    count, label = _surfaces(part)
    a, b, c = np.moveaxis(part.vertices_m[part.triangles] - part.vertices_m.mean(axis=0), 1, 0)
    six = np.einsum("ij,ij->i", a, np.cross(b, c))
    volume = np.bincount(label, weights=six, minlength=count)
    if not (volume < 0.0).any():
        return part, ()
    if count > _MOST_SURFACES:
        inwards = np.full(count, volume.sum() < 0.0)
    else:
        inwards = volume[_outermost(part, count, label, np.abs(volume))] < 0.0
    if not inwards.any():
        return part, ()
    what = (
        "its triangles were"
        if inwards.all()
        else f"the triangles of {inwards.sum()} of its {count} surfaces were"
    )
    return _turned(part, inwards[label]), (f"{what} clockwise and are turned",)


def _outermost(part: MeshPart, count: int, label: IntArray, size: Array) -> IntArray:
    """Return the number (n,) of the largest surface that each surface lies inside, or its own."""
    order = np.argsort(label, kind="stable")
    groups = np.split(part.triangles[order], np.cumsum(np.bincount(label, minlength=count))[:-1])
    low = np.array([part.vertices_m[g].min(axis=(0, 1)) for g in groups])
    high = np.array([part.vertices_m[g].max(axis=(0, 1)) for g in groups])
    out = np.arange(count)
    for k, group in enumerate(groups):
        around = np.flatnonzero((low <= low[k]).all(axis=1) & (high >= high[k]).all(axis=1))
        used = np.unique(group)
        probes = part.vertices_m[used[:: max(1, len(used) // _PROBES)][:_PROBES]]
        for j in around[np.argsort(-size[around])].tolist():
            if j == k or size[j] <= size[k]:
                break
            if np.median([_turns_around(p, part.vertices_m[groups[j]]) for p in probes]) > 0.5:
                out[k] = j
                break
    return out


def _turns_around(point: Array, corners: Array) -> float:
    """Return how often a surface of triangles (m, 3, 3) encloses a point (3,): 0 outside.

    A. van Oosterom, J. Strackee: The Solid Angle of a Plane Triangle, 1983.
    """
    a, b, c = np.moveaxis(corners - point, 1, 0)
    x, y, z = (np.linalg.norm(v, axis=1) for v in (a, b, c))
    dots = (np.einsum("ij,ij->i", *pair) for pair in ((a, b), (b, c), (c, a)))
    ab, bc, ca = dots
    below = x * y * z + ab * z + bc * x + ca * y
    angle = 2.0 * np.arctan2(np.einsum("ij,ij->i", a, np.cross(b, c)), below)
    return abs(float(angle.sum())) / (4.0 * np.pi)
