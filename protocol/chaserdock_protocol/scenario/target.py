"""A target of one's own: cuboids, a mesh, and the markers on them. In a scenario or in a file (docs/cameras.md)."""

from __future__ import annotations

import math
import re
from typing import Annotated, Literal

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.targets import Box, Marker, TargetModel, face_extent, face_rotation
from pydantic import AfterValidator, Field, model_validator

from .fields import NotNegative, Number, Positive, PositiveVector, Section, UnitQuaternion, Vector

FACE_NAMES = ("+x", "-x", "+y", "-y", "+z", "-z")
_FAMILIES = {
    "DICT_ARUCO_ORIGINAL": 1024,
    "DICT_APRILTAG_16h5": 30,
    "DICT_APRILTAG_25h9": 35,
    "DICT_APRILTAG_36h10": 2320,
    "DICT_APRILTAG_36h11": 587,
}
# A marker lies in a face when it is no further from it than this.
_FLAT_M = 1e-6


def dictionary_size(name: str) -> int:
    """Number of markers in OpenCV's ArUco dictionary of that name; raises ValueError for an unknown one."""
    plain = re.fullmatch(r"DICT_[4567]X[4567]_(50|100|250|1000)", name)
    if plain is not None and name[5] == name[7]:
        return int(plain[1])
    if name in _FAMILIES:
        return _FAMILIES[name]
    raise ValueError(
        f"unknown ArUco dictionary {name!r}; known: DICT_4X4_50 … DICT_7X7_1000, {', '.join(_FAMILIES)}"
    )


def _known(name: str) -> str:
    dictionary_size(name)
    return name


class Cuboid(Section):
    """A cuboid of the target: edges, centre and attitude in TRF; ``shade``: reflectance, 0 black to 1 white."""

    size_m: PositiveVector
    position_m: Vector = (0.0, 0.0, 0.0)
    q_wxyz: UnitQuaternion = (1.0, 0.0, 0.0, 0.0)
    shade: Annotated[float, Field(ge=0, le=1)] = 0.6

    def box(self) -> Box:
        return Box(self.size_m, self.position_m, self.q_wxyz, self.shade)


class MarkerSection(Section):
    """A marker: either on a ``face`` of a ``cuboid`` (by number), ``at_m`` right of and above its middle, or with
    its pose in TRF: ``position_m`` and ``q_wxyz`` (x to its right, y up, z out of it)."""

    id: Annotated[int, Field(ge=0)]
    side_m: Positive
    face: Literal["+x", "-x", "+y", "-y", "+z", "-z"] | None = None
    cuboid: Annotated[int, Field(ge=0)] = 0
    at_m: tuple[Number, Number] = (0.0, 0.0)
    position_m: Vector | None = None
    q_wxyz: UnitQuaternion | None = None

    @model_validator(mode="after")
    def _one_way(self) -> MarkerSection:
        if (self.face is None) == (self.position_m is None):
            raise ValueError("give either face (with at_m) or position_m with q_wxyz")
        if (self.position_m is None) != (self.q_wxyz is None):
            raise ValueError("position_m and q_wxyz go together")
        return self

    def marker(self, cuboids: tuple[Cuboid, ...]) -> Marker:
        if self.position_m is not None and self.q_wxyz is not None:
            return Marker(self.id, self.side_m, self.position_m, self.q_wxyz)
        cuboid, face = cuboids[self.cuboid], FACE_NAMES.index(str(self.face))
        q = rotations.multiply(cuboid.q_wxyz, face_rotation(face))
        out = rotations.rotate(q, [*self.at_m, face_extent(cuboid.size_m, face)[2]])
        x, y, z = (out + cuboid.position_m).tolist()
        qw, qx, qy, qz = q.tolist()
        return Marker(self.id, self.side_m, (x, y, z), (qw, qx, qy, qz))


class Geometry(Section):
    """What the target looks like: ``cuboids`` (also what is collided with), ``markers`` of one ``dictionary`` with a
    white border ``white_margin_m`` wide, and optionally a ``mesh`` file, drawn in the place of the cuboids by the
    renderer ``pybullet`` alone."""

    dictionary: Annotated[str, AfterValidator(_known)]
    white_margin_m: NotNegative = 0.005
    cuboids: Annotated[tuple[Cuboid, ...], Field(min_length=1, max_length=64)]
    markers: Annotated[tuple[MarkerSection, ...], Field(min_length=1, max_length=1000)]
    mesh: str = ""
    mesh_scale: Positive = 1.0

    @model_validator(mode="after")
    def _possible(self) -> Geometry:
        size = dictionary_size(self.dictionary)
        seen: dict[int, int] = {}
        for k, m in enumerate(self.markers):
            if m.id >= size:
                raise ValueError(f"markers.{k}.id: {self.dictionary} has markers 0 to {size - 1}, not {m.id}")
            if m.id in seen:
                raise ValueError(
                    f"markers.{k}.id: {m.id} is also that of markers.{seen[m.id]}; each must be one of its own"
                )
            seen[m.id] = k
            if m.cuboid >= len(self.cuboids):
                raise ValueError(
                    f"markers.{k}.cuboid: there is no cuboid {m.cuboid}; this target has 0 to {len(self.cuboids) - 1}"
                )
        if not self.mesh:
            for k, m in enumerate(self.markers):
                _check_on_a_face(k, m.marker(self.cuboids), self.cuboids)
        _check_apart(tuple(m.marker(self.cuboids) for m in self.markers))
        return self

    def model(self, name: str) -> TargetModel:
        """The target; ``size_m`` is that of the smallest cuboid about the origin of TRF that holds it."""
        boxes = tuple(c.box() for c in self.cuboids)
        markers = tuple(m.marker(self.cuboids) for m in self.markers)
        reach = np.max(
            [_reach(b) for b in boxes] + [np.abs(m.corners_trf_m()).max(axis=0) for m in markers], axis=0
        )
        x, y, z = (2.0 * reach).tolist()
        return TargetModel(
            name, boxes, markers, self.dictionary, (x, y, z), self.white_margin_m, self.mesh, self.mesh_scale
        )


def _reach(box: Box) -> rotations.Array:
    """Largest absolute coordinates (3,) in TRF of a box."""
    return np.abs(box.position_m) + np.abs(rotations.to_matrix(box.q_wxyz)) @ np.array(box.size_m) / 2.0


def _check_on_a_face(number: int, marker: Marker, cuboids: tuple[Cuboid, ...]) -> None:
    """Raises ValueError unless the marker lies within a face, its edges along the face's."""
    corners = marker.corners_trf_m()
    for cuboid in cuboids:
        local = rotations.rotate_inverse(cuboid.q_wxyz, corners - np.array(cuboid.position_m))
        normal = rotations.rotate_inverse(cuboid.q_wxyz, marker.normal_trf())
        axis = int(np.argmax(np.abs(normal)))
        half = np.array(cuboid.size_m) / 2.0
        flat = np.abs(local[:, axis] - math.copysign(half[axis], normal[axis])).max() < _FLAT_M
        if flat and abs(normal[axis]) > 1.0 - 1e-9:
            edge = np.abs(local[1] - local[0]) / marker.side_m
            if edge.max() < 1.0 - 1e-6:
                raise ValueError(f"markers.{number}: its edges must be parallel to those of its face")
            if np.any(np.abs(local) > half + _FLAT_M):
                raise ValueError(f"markers.{number}: reaches beyond its face")
            return
    raise ValueError(
        f"markers.{number}: must lie on a face of a cuboid (without a mesh, there alone it is seen)"
    )


def _check_apart(markers: tuple[Marker, ...]) -> None:
    """Raises ValueError when two markers that face the same way in one plane overlap."""
    for i, a in enumerate(markers):
        for k in range(i):
            b = markers[k]
            local = rotations.rotate_inverse(
                a.q_trf_marker_wxyz, b.corners_trf_m() - np.array(a.position_trf_m)
            )
            if np.abs(local[:, 2]).max() > _FLAT_M or a.normal_trf() @ b.normal_trf() < 0.0:
                continue
            low, high = local[:, :2].min(axis=0), local[:, :2].max(axis=0)
            if np.all(low < a.side_m / 2.0 - 1e-9) and np.all(high > 1e-9 - a.side_m / 2.0):
                raise ValueError(f"markers.{i}: overlaps markers.{k}")
