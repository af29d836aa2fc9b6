# SPDX-License-Identifier: Apache-2.0
"""Build markers as meshes: thin plates whose cells are triangles, as sharp as any other edge."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import IntArray
from chaserdock_models.meshes import Material, MeshPart, TriangleMesh
from chaserdock_models.targets import Marker, TargetModel

from .textures import BLACK, WHITE, marker_cells

ABOVE_M = 2e-4
"""Height, m, of a marker's front above its plane, so that the surface below does not hide it."""
_BELOW_M = 1e-3
"""Depth, m, of a marker's back below its plane, so that no gap shows beside it on a curved surface.
"""
_PAPER = {
    True: Material("white print", diffuse=WHITE),
    False: Material("black print", diffuse=BLACK),
}


def with_markers(mesh: TriangleMesh, model: TargetModel) -> TriangleMesh:
    """Return a mesh with the markers of a target on it."""
    return replace(
        mesh, parts=(*mesh.parts, *(part for m in model.markers for part in marker_parts(model, m)))
    )


def marker_parts(model: TargetModel, marker: Marker) -> tuple[MeshPart, MeshPart]:
    """Return the two parts of a marker, which together are closed.

    White: border, sides and back as well. Black: cells only.
    """
    cells = marker_cells(model.dictionary, marker.id) > 0
    edges = np.linspace(-0.5, 0.5, len(cells) + 1) * marker.side_m
    white = np.flipud(cells)  # row 0 of the cells is on top
    if model.white_margin_m > 0.0:
        reach = marker.side_m / 2.0 + model.white_margin_m
        edges = np.concatenate([[-reach], edges, [reach]])
        white = np.pad(white, 1, constant_values=True)

    n = len(edges)
    y, x = np.meshgrid(edges, edges, indexing="ij")
    front = np.stack([x, y, np.full_like(x, ABOVE_M)], axis=-1).reshape(-1, 3)
    vertices = np.concatenate([front, front - [0.0, 0.0, ABOVE_M + _BELOW_M]])
    at = rotations.rotate(marker.q_trf_marker_wxyz, vertices) + np.array(marker.position_trf_m)

    corner = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    quads = np.stack([corner, corner + 1, corner + n + 1, corner + n], axis=1)
    rim = np.concatenate(
        [
            np.arange(n - 1),
            n - 1 + n * np.arange(n - 1),
            n * n - 1 - np.arange(n - 1),
            n * (n - 1) - n * np.arange(n - 1),
        ]
    )
    ahead = np.roll(rim, -1)
    sides = np.stack([ahead, rim, rim + n * n, ahead + n * n], axis=1)
    back = quads[:, ::-1] + n * n

    name = f"marker_{marker.id}"
    return (
        MeshPart(
            f"{name}_white",
            _PAPER[True],
            at,
            _halves(np.concatenate([quads[white.ravel()], sides, back])),
        ),
        MeshPart(f"{name}_black", _PAPER[False], at, _halves(quads[~white.ravel()])),
    )


def _halves(quads: IntArray) -> IntArray:
    """Return two triangles of each quadrangle (m, 4)."""
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
