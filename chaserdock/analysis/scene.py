# SPDX-License-Identifier: Apache-2.0
"""Bodies of a mission as coloured faces in body axes, for 3-D replay, video and viewer."""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.meshes import TriangleMesh
from chaserdock_models.satellites import satellite
from chaserdock_models.targets import Box, Marker, TargetModel, face_extent, face_rotation
from chaserdock_protocol.scenario import FlightScenario
from numpy.typing import NDArray

Grey = int
"""Grey level when fully lit, 0 black to 255 white."""

_PROBE_WIDTH_M = 0.012
"""Width (m) of the drawn probe; for display only, wide enough to be seen."""
_LONGEST_PIECE_M = 0.06
"""Longest piece (m) of the drawn probe. A long thin box is divided, so that the depths of the
pieces' centres order faces correctly.
"""
_LONGEST_EDGE_M = 0.12
"""Longest edge (m) of a drawn triangle, for the same reason. Smaller: fewer errors of order, more
triangles to draw.
"""
_PLATE_M = 0.03
"""Thickness (m) below which a part of a mesh counts as a plate: that of solar panels and antennas,
not of bodies.
"""
_LIFT_M = 0.08
"""Distance (m) by which the broad faces of a plate count as closer, so that they are drawn after
what is behind them, where depths of centres alone err. Larger: plates cover what is in front of
them.
"""
_WIDEST_RAD = math.radians(75.0)
"""Largest angle of the drawn field of view from the optical axis: a pyramid cannot show more."""
_FACET_M = 0.02
"""Largest deviation of the drawn facets of a satellite from its curved surfaces."""


@dataclass(frozen=True)
class Face:
    """A flat quadrangle ``corners_m`` (4, 3) in body axes with outward ``normal``. ``decals`` are
    painted on it in order.

    A triangle repeats its last corner. ``lift_m``: distance by which the face counts as closer when
    faces are ordered by depth, so that a thin part on a larger face is not hidden.
    """

    corners_m: Array
    normal: Array
    grey: Grey
    decals: tuple[tuple[Array, Grey], ...] = ()
    lift_m: float = 0.0


@dataclass(frozen=True)
class Scene:
    """Faces of the target (TRF) and of a chaser (CRF), and the far corners (4, 3) of the camera
    frustum in CRF.
    """

    target: tuple[Face, ...]
    chaser: tuple[Face, ...]
    camera_origin_m: Array
    camera_corners_m: Array


def filled_runs(row: NDArray[np.bool_]) -> list[list[int]]:
    """Return begin and end of each run of filled cells of a row (N,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], row, [False]]).astype(int)))
    return edges.reshape(-1, 2).tolist()


def marker_decals(model: TargetModel, marker: Marker) -> tuple[tuple[Array, Grey], ...]:
    """Return the quadrangles (4, 3), TRF, of a marker: white border, black square, then the white
    cells row by row.
    """
    table = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, model.dictionary))
    n = table.markerSize + 2
    cells = np.asarray(cv2.aruco.generateImageMarker(table, marker.id, n, borderBits=1)) > 0
    top_left, top_right, _, bottom_left = marker.corners_trf_m()
    right, down = top_right - top_left, bottom_left - top_left

    def quad(x0: float, y0: float, x1: float, y1: float) -> Array:
        return np.array(
            [top_left + x * right + y * down for x, y in ((x0, y0), (x1, y0), (x1, y1), (x0, y1))]
        )

    margin = model.white_margin_m / marker.side_m
    out = [(quad(-margin, -margin, 1 + margin, 1 + margin), 242), (quad(0, 0, 1, 1), 13)]
    for row in range(n):
        for first, last in filled_runs(cells[row]):
            out.append((quad(first / n, row / n, last / n, (row + 1) / n), 242))
    return tuple(out)


def box_faces(box: Box, model: TargetModel | None = None) -> list[Face]:
    """Return the six faces of a box in its parent's axes. ``model``: include the markers on
    them.
    """
    out = []
    for index in range(6):
        q = rotations.multiply(box.q_wxyz, face_rotation(index))
        width, height, depth = face_extent(box.size_m, index)
        flat = [
            [x * width / 2, y * height / 2, depth] for x, y in ((-1, 1), (1, 1), (1, -1), (-1, -1))
        ]
        normal = rotations.rotate(q, (0.0, 0.0, 1.0))
        # White borders may extend under neighbouring markers: all borders come first.
        borders: list[tuple[Array, Grey]] = []
        prints: list[tuple[Array, Grey]] = []
        for marker in model.markers if model else ():
            offset = np.array(marker.position_trf_m) - box.position_m
            if (
                model
                and abs(offset @ normal - depth) < 1e-6
                and marker.normal_trf() @ normal > 0.999
            ):
                border, *printed = marker_decals(model, marker)
                borders.append(border)
                prints += printed
        corners = rotations.rotate(q, np.array(flat)) + box.position_m
        out.append(Face(corners, normal, round(255 * box.shade), (*borders, *prints)))
    return out


def _divided(triangles: Array) -> Array:
    """Divide triangles (N, 3, 3) at the middle of their longest edge until none is longer than
    _LONGEST_EDGE_M.
    """
    done = []
    while len(triangles):
        edges = np.linalg.norm(np.roll(triangles, -1, axis=1) - triangles, axis=2)
        short = edges.max(axis=1) <= _LONGEST_EDGE_M
        done.append(triangles[short])
        # Rotate the corners of each other triangle so that its longest edge lies between the first
        # two.
        first = edges[~short].argmax(axis=1)[:, None]
        a, b, c = np.moveaxis(
            np.take_along_axis(triangles[~short], ((first + np.arange(3)) % 3)[..., None], axis=1),
            1,
            0,
        )
        middle = 0.5 * (a + b)
        triangles = np.concatenate(
            [np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)]
        )
    return np.concatenate(done)


def mesh_faces(mesh: TriangleMesh) -> list[Face]:
    """Return the triangles of a mesh as faces."""
    out = []
    for part in mesh.parts:
        extent_m = np.ptp(part.vertices_m, axis=0)
        thin = int(extent_m.argmin())
        plate = extent_m[thin] < _PLATE_M
        corners = _divided(part.vertices_m[part.triangles])
        normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        doubled_areas = np.linalg.norm(normals, axis=1)
        # Dark materials are shiny; with their diffuse part alone they would be black on black
        # space.
        material = part.material
        grey = round(255 * min(1.0, 0.15 + material.diffuse + 0.3 * material.specular))
        for three, normal, area in zip(corners, normals, doubled_areas, strict=True):
            if area > 0.0:
                broad = plate and abs(normal[thin]) > 0.9 * area
                out.append(
                    Face(three[[0, 1, 2, 2]], normal / area, grey, lift_m=_LIFT_M if broad else 0.0)
                )
    return out


def _probe(front_m: float, reach_m: float) -> list[Face]:
    pieces = max(1, round((reach_m - front_m) / _LONGEST_PIECE_M))
    length = (reach_m - front_m) / pieces
    size = (length, _PROBE_WIDTH_M, _PROBE_WIDTH_M)
    return [
        face
        for k in range(pieces)
        for face in box_faces(Box(size, (front_m + (k + 0.5) * length, 0.0, 0.0), shade=0.55))
    ]


def scene_of(scenario: FlightScenario, view_m: float = 0.22) -> Scene:
    """Return the faces of a scenario's bodies; ``view_m``: length of the drawn camera frustum."""
    model = scenario.target_model()
    body = scenario.chaser
    front = body.size_m[0] / 2.0
    chaser = (
        mesh_faces(satellite(body.mesh, _FACET_M))
        if body.mesh
        else box_faces(Box(body.size_m, shade=0.42))
    )

    mesh = scenario.target.nominal_mesh(_FACET_M)
    target = (
        [face for box in model.boxes for face in box_faces(box, model)]
        if mesh is None
        else mesh_faces(mesh)
    )

    if body.probe_reach_m > front:
        chaser += _probe(front, body.probe_reach_m)

    camera = scenario.camera_model()
    left, top, right, bottom = (math.tan(min(a, _WIDEST_RAD)) for a in camera.angles_to_borders())
    rays = [
        [x * view_m, y * view_m, view_m]
        for x, y in ((-left, -top), (right, -top), (right, bottom), (-left, bottom))
    ]

    origin = np.array(camera.position_crf_m)
    corners = rotations.rotate(camera.q_crf_irf_wxyz, np.array(rays)) + origin
    return Scene(
        target=tuple(target),
        chaser=tuple(chaser),
        camera_origin_m=origin,
        camera_corners_m=corners,
    )
