# SPDX-License-Identifier: Apache-2.0
"""Docking targets: their boxes, meshes and ArUco markers.

Marker axes: x to the marker's right, y up, z out of the face, origin at the marker's centre.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache, partial

import numpy as np

from . import rotations
from .arrays import Array, Quaternion, Vector3
from .meshes import MeshPart, TriangleMesh
from .satellites import satellite

# The six faces of a box in the order of the marker ids: outward normal, and up direction of the
# markers.
FACES: tuple[tuple[Vector3, Vector3], ...] = (
    ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    ((-1.0, 0.0, 0.0), (0.0, 0.0, 1.0)),
    ((0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    ((0.0, -1.0, 0.0), (0.0, 0.0, 1.0)),
    ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0)),
    ((0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
)


@dataclass(frozen=True)
class Box:
    """A cuboid: edge lengths ``size_m``, centre and attitude in the frame of the body it belongs
    to.

    ``shade``: reflectance, 0 (black) to 1 (white).
    """

    size_m: Vector3
    position_m: Vector3 = (0.0, 0.0, 0.0)
    q_wxyz: Quaternion = (1.0, 0.0, 0.0, 0.0)
    shade: float = 0.5


DEFAULT_DICTIONARY = "DICT_4X4_50"
"""Dictionary of targets without markers."""


@lru_cache
def cuboid_corners(size_m: Vector3) -> Array:
    """Return the corners (8, 3) of a cuboid about the origin, z changing fastest; read-only."""
    corners = (
        np.array([[x, y, z] for x in (-0.5, 0.5) for y in (-0.5, 0.5) for z in (-0.5, 0.5)])
        * size_m
    )
    corners.setflags(write=False)
    return corners


@dataclass(frozen=True)
class Marker:
    """A square ArUco marker; ``side_m``: edge of its black square; ``q_trf_marker_wxyz``: marker ->
    TRF.
    """

    id: int
    side_m: float
    position_trf_m: Vector3
    q_trf_marker_wxyz: Quaternion

    def corners_trf_m(self) -> Array:
        """Return the corners (4, 3) in TRF: top left, top right, bottom right, bottom left of the
        upright marker.
        """
        h = self.side_m / 2.0
        corners = np.array([[-h, h, 0.0], [h, h, 0.0], [h, -h, 0.0], [-h, -h, 0.0]])
        return rotations.rotate(self.q_trf_marker_wxyz, corners) + self.position_trf_m

    def normal_trf(self) -> Array:
        """Return the outward unit normal (3,) of the marker in TRF."""
        return rotations.rotate(self.q_trf_marker_wxyz, (0.0, 0.0, 1.0))


@dataclass(frozen=True)
class TargetModel:
    """A target: ``boxes`` in TRF, ``markers`` of the OpenCV ``dictionary``, overall ``size_m``.

    ``white_margin_m``: width of the white border printed around every marker, under its neighbours.
    ``satellite``: name of the mesh that is drawn instead of the boxes; empty for none. ``hulls``:
    whether the boxes enclose the parts of that mesh; then collisions use convex pieces of these,
    otherwise the boxes.
    """

    name: str
    boxes: tuple[Box, ...]
    markers: tuple[Marker, ...]
    dictionary: str
    size_m: Vector3
    white_margin_m: float
    satellite: str = ""
    hulls: bool = False

    def marker(self, marker_id: int) -> Marker | None:
        """Return the marker with that id, or None."""
        return next((m for m in self.markers if m.id == marker_id), None)


def face_rotation(face: int) -> Array:
    """Return the rotation (4,) from the axes of face ``face`` (0..5; x right, y up, z outward) to
    the box's axes.
    """
    normal, up = (np.array(v) for v in FACES[face])
    return rotations.from_matrix(np.stack([np.cross(up, normal), up, normal], axis=-1))


def face_extent(size_m: Vector3, face: int) -> tuple[float, float, float]:
    """Return width (right), height (up) and distance from the box's centre of face ``face``,
    metres.
    """
    right, up, out = (
        np.abs(axis) @ np.array(size_m) for axis in rotations.to_matrix(face_rotation(face)).T
    )
    return float(right), float(up), float(out) / 2.0


def _on_face(size_m: Vector3, face: int, right_m: float, up_m: float) -> tuple[Vector3, Quaternion]:
    q = face_rotation(face)
    x, y, z = rotations.rotate(q, (right_m, up_m, face_extent(size_m, face)[2])).tolist()
    qw, qx, qy, qz = q.tolist()
    return (x, y, z), (qw, qx, qy, qz)


def _paper() -> TargetModel:
    size = (0.10, 0.10, 0.20)
    markers = tuple(Marker(face, 0.09, *_on_face(size, face, 0.0, 0.0)) for face in range(6))
    return TargetModel("paper", (Box(size, shade=0.6),), markers, "DICT_5X5_50", size, 0.005)


# Edge length, and right and up coordinate of the centre, of the twelve markers on a face of the
# servicer and the client.
_SERVICER_LAYOUT: tuple[Vector3, ...] = (
    (0.108, -0.086, 0.086),
    (0.108, 0.086, 0.086),
    (0.108, 0.086, -0.086),
    (0.108, -0.086, -0.086),
    (0.036, -0.086, 0.0),
    (0.036, 0.086, 0.0),
    (0.036, 0.0, 0.086),
    (0.036, 0.0, -0.086),
    (0.021, -0.016, 0.016),
    (0.021, 0.016, 0.016),
    (0.021, 0.016, -0.016),
    (0.021, -0.016, -0.016),
)


def _with_clusters(name: str, size: Vector3) -> TargetModel:
    """Return a cuboid with the cluster of twelve markers in the middle of each face."""
    markers = tuple(
        Marker(12 * face + k, side, *_on_face(size, face, right, up))
        for face in range(6)
        for k, (side, right, up) in enumerate(_SERVICER_LAYOUT)
    )
    return TargetModel(name, (Box(size, shade=0.6),), markers, "DICT_4X4_100", size, 0.032)


def box_around(part: MeshPart) -> Box:
    """Return the smaller of the cuboids around a part along the body's axes and along the part's
    principal axes.
    """
    vertices = part.vertices_m
    _, principal = np.linalg.eigh(np.cov(vertices.T))
    principal[:, 2] *= np.sign(np.linalg.det(principal))
    candidates = []
    for axes in (np.eye(3), principal):
        local = vertices @ axes
        low, high = local.min(axis=0), local.max(axis=0)
        candidates.append((float(np.prod(high - low)), axes, axes @ (low + high) / 2.0, high - low))
    along_body, along_part = candidates
    # Principal axes of a cube are arbitrary, and its volume along them can only be equal or larger.
    _, axes, centre, size = (
        along_part if along_part[0] < along_body[0] * (1.0 - 1e-6) else along_body
    )
    x, y, z = np.round(centre, 9).tolist()
    a, b, c = np.round(size, 9).tolist()
    qw, qx, qy, qz = rotations.from_matrix(axes).tolist()
    return Box((a, b, c), (x, y, z), (qw, qx, qy, qz), part.material.diffuse)


def mesh_boxes(mesh: TriangleMesh) -> tuple[Box, ...]:
    """Return a cuboid around each part of a mesh."""
    return tuple(box_around(part) for part in mesh.parts)


@lru_cache
def mesh_target(mesh: TriangleMesh) -> TargetModel:
    """Return a target without markers that is shaped like a mesh, and has its name."""
    low, high = mesh.bounds_m()
    x, y, z = (2.0 * np.maximum(-low, high)).tolist()
    return TargetModel(
        mesh.name,
        mesh_boxes(mesh),
        (),
        DEFAULT_DICTIONARY,
        (x, y, z),
        0.0,
        satellite=mesh.name,
        hulls=True,
    )


def _of_satellite(name: str) -> TargetModel:
    return mesh_target(satellite(name))


_MODELS: dict[str, Callable[[], TargetModel]] = {
    "paper": _paper,
    "servicer": partial(_with_clusters, "servicer", (0.40, 0.32, 0.32)),
    "client": partial(_with_clusters, "client", (1.0, 0.9, 0.8)),
    "cubesat_12u": partial(_of_satellite, "cubesat_12u"),
    "geo_servicer": partial(_of_satellite, "geo_servicer"),
}


UNKNOWN_TARGET = "unknown"
"""Name of a target of which neither shape nor markers are known."""
_UNKNOWN_SIZE_M = 1.0
"""Edge that is stated for it; no flight software uses it while the motion has constant rates."""


def target_names() -> tuple[str, ...]:
    """Return the names of the built-in targets that have a shape."""
    return tuple(sorted(_MODELS))


@lru_cache
def target_model(name: str) -> TargetModel:
    """Return the built-in target ``name``, or the unknown one, which is empty. Raises ValueError,
    listing the known names, for any other.
    """
    if name == UNKNOWN_TARGET:
        a = _UNKNOWN_SIZE_M
        return TargetModel(name, (), (), DEFAULT_DICTIONARY, (a, a, a), 0.0)
    if name not in _MODELS:
        raise ValueError(f"unknown target {name!r}; known: {', '.join(sorted(_MODELS))}")
    return _MODELS[name]()


def clear_margin_m(model: TargetModel, marker: Marker) -> float:
    """Return the width of the white border along the sides of a marker.

    It ends at the nearest of neighbouring marker, white paint and edge of the face.
    """
    q_marker_trf = rotations.conjugate(marker.q_trf_marker_wxyz)
    half = marker.side_m / 2.0
    clear = model.white_margin_m
    positions = np.array([other.position_trf_m for other in model.markers])
    depths = rotations.rotate(q_marker_trf, positions - np.array(marker.position_trf_m))[:, 2]
    for i in np.flatnonzero(np.abs(depths) < 1e-6):
        other = model.markers[i]
        corners = rotations.rotate(
            q_marker_trf, other.corners_trf_m() - np.array(marker.position_trf_m)
        )
        if other.id != marker.id and np.all(np.abs(corners[:, 2]) < 1e-6):
            gaps = np.maximum(corners[:, :2].min(axis=0) - half, -half - corners[:, :2].max(axis=0))
            if gaps.min() < 0.0:  # beside a side, not diagonally off a corner
                clear = min(clear, float(gaps.max()))
    for box in model.boxes:
        q_marker_box = rotations.multiply(q_marker_trf, box.q_wxyz)
        centre = rotations.rotate(q_marker_trf, np.array(box.position_m) - marker.position_trf_m)
        reach = np.abs(rotations.to_matrix(q_marker_box)) @ np.array(box.size_m) / 2.0
        if abs(centre[2] + reach[2]) < 1e-6:  # the marker lies on this box
            clear = min(clear, float((reach[:2] - np.abs(centre[:2])).min()) - half)
    return clear
