# SPDX-License-Identifier: Apache-2.0
"""Custom targets: cuboids, an optional mesh, and markers, in a scenario or in a target file
(docs/cameras.md).
"""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import Annotated, Literal

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.meshes import TriangleMesh
from chaserdock_models.satellites import FINE_M, satellite, satellite_names
from chaserdock_models.targets import (
    DEFAULT_DICTIONARY,
    Box,
    Marker,
    TargetModel,
    face_extent,
    face_rotation,
    mesh_target,
)
from pydantic import AfterValidator, Field, model_validator

from .fields import (
    Fraction,
    Index,
    NotNegative,
    Number,
    Oriented,
    Positive,
    PositiveVector,
    Section,
    UnitQuaternion,
    Vector,
)
from .surface import Surface

FACE_NAMES = ("+x", "-x", "+y", "-y", "+z", "-z")
_FAMILIES = {
    "DICT_ARUCO_ORIGINAL": 1024,
    "DICT_APRILTAG_16h5": 30,
    "DICT_APRILTAG_25h9": 35,
    "DICT_APRILTAG_36h10": 2320,
    "DICT_APRILTAG_36h11": 587,
}
# Largest distance of a marker from the face that it lies on.
_FLAT_M = 1e-6


def dictionary_size(name: str) -> int:
    """Return the number of markers in an ArUco dictionary of OpenCV. Raises ValueError for an
    unknown name.
    """
    plain = re.fullmatch(r"DICT_[4567]X[4567]_(50|100|250|1000)", name)
    if plain is not None and name[5] == name[7]:
        return int(plain[1])
    if name in _FAMILIES:
        return _FAMILIES[name]
    raise ValueError(
        f"unknown ArUco dictionary {name!r}; known: DICT_4X4_50 … DICT_7X7_1000, "
        f"{', '.join(_FAMILIES)}"
    )


def _check_dictionary(name: str) -> str:
    dictionary_size(name)
    return name


class Cuboid(Oriented):
    """A cuboid of the target."""

    size_m: PositiveVector = Field(description="Edges, m.")
    position_m: Vector = Field(default=(0.0, 0.0, 0.0), description="Centre (TRF), m.")
    q_wxyz: UnitQuaternion = Field(
        default=(1.0, 0.0, 0.0, 0.0),
        description="Attitude, cuboid to TRF: unit quaternion, scalar first.",
    )
    shade: Fraction = Field(default=0.6, description="Reflectance: 0 is black, 1 is white.")

    def box(self) -> Box:
        return Box(self.size_m, self.position_m, self.q_wxyz, self.shade)


class MarkerSection(Oriented):
    """A fiducial marker: on a `face` of a `cuboid`, or at a pose in TRF. Its x points right, y up,
    z out of it.
    """

    id: Index = Field(description="Number of the marker in its dictionary.")
    side_m: Positive = Field(description="Edge of the black square, m.")
    face: Literal["+x", "-x", "+y", "-y", "+z", "-z"] | None = Field(
        default=None, description="Face of the cuboid that the marker lies on."
    )
    cuboid: Index = Field(default=0, description="Number of the cuboid that has the face, from 0.")
    at_m: tuple[Number, Number] = Field(
        default=(0.0, 0.0), description="Position on the face: right of its middle and above it, m."
    )
    position_m: Vector | None = Field(
        default=None, description="Centre (TRF), m, in place of `face`; with an attitude."
    )
    q_wxyz: UnitQuaternion | None = Field(
        default=None,
        description="Attitude, marker to TRF: unit quaternion, scalar first. With `position_m`.",
    )

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
    """Shape and markers of a custom target; also the content of a target file."""

    dictionary: Annotated[str, AfterValidator(_check_dictionary)] = Field(
        default=DEFAULT_DICTIONARY,
        description="OpenCV's name of the ArUco dictionary, such as `DICT_4X4_50`. Needed with "
        "markers.",
    )
    white_margin_m: NotNegative = Field(
        default=0.005, description="Width of the white border around each marker, m."
    )
    cuboids: tuple[Cuboid, ...] = Field(
        default=(),
        max_length=64,
        description="Body of the target; also used for collisions. Needed without a mesh; with "
        "one, collisions use convex pieces of the mesh if there are none.",
    )
    markers: tuple[MarkerSection, ...] = Field(
        default=(),
        max_length=1000,
        description="Markers, which may not overlap. Needed without a mesh.",
    )
    mesh: str = Field(
        default="",
        description="Mesh that is drawn in place of the cuboids: path of a file (GLB, glTF, OBJ, "
        "STL, PLY, OFF, COLLADA), relative to the file that names it, or name of a shipped "
        "satellite.",
    )
    mesh_scale: Positive = Field(
        default=1.0, description="Factor from the mesh's unit of length to m."
    )
    mesh_origin_m: Vector = Field(
        default=(0.0, 0.0, 0.0),
        description="Point of the mesh, scaled, that becomes the origin of TRF, m.",
    )
    surface: Surface | None = Field(
        default=None,
        description="Content of the mesh file. Written by the program when it reads the file.",
    )

    @model_validator(mode="after")
    def _check_markers(self) -> Geometry:
        for key in () if self.mesh else ("cuboids", "markers"):
            if not getattr(self, key):
                raise ValueError(f"{key}: is empty; only a target with a mesh needs none")
        if self.markers and "dictionary" not in self.model_fields_set:
            raise ValueError("dictionary: is missing; markers need it")
        size, last = dictionary_size(self.dictionary), len(self.cuboids) - 1
        first_use: dict[int, int] = {}
        for k, m in enumerate(self.markers):
            if m.id >= size:
                raise ValueError(
                    f"markers.{k}.id: {self.dictionary} has markers 0 to {size - 1}, not {m.id}"
                )
            if m.id in first_use:
                raise ValueError(
                    f"markers.{k}.id: {m.id} is already used by markers.{first_use[m.id]}"
                )
            first_use[m.id] = k
            if m.face is not None and m.cuboid > last:
                have = f"this target has 0 to {last}" if last >= 0 else "give position_m and q_wxyz"
                raise ValueError(f"markers.{k}.cuboid: there is no cuboid {m.cuboid}; {have}")
            if not self.mesh:
                _check_on_a_face(k, m.marker(self.cuboids), self.cuboids)
        _check_apart(tuple(m.marker(self.cuboids) for m in self.markers))
        return self

    def model(self, name: str) -> TargetModel:
        """Return the target model; its ``size_m`` is that of the smallest cuboid centred in TRF
        that contains it.
        """
        mesh = self.nominal_mesh(name)
        boxes = tuple(c.box() for c in self.cuboids) or (
            () if mesh is None else mesh_target(mesh).boxes
        )
        markers = tuple(m.marker(self.cuboids) for m in self.markers)
        reach = np.max(
            [_reach(b) for b in boxes]
            + [np.abs(m.corners_trf_m()).max(axis=0) for m in markers]
            + ([] if mesh is None else [np.abs(mesh.bounds_m()).max(axis=0)]),
            axis=0,
        )
        x, y, z = (2.0 * reach).tolist()
        return TargetModel(
            name,
            boxes,
            markers,
            self.dictionary,
            (x, y, z),
            self.white_margin_m,
            "" if mesh is None else name,
            mesh is not None and not self.cuboids,
        )

    def nominal_mesh(self, name: str, tolerance_m: float = FINE_M) -> TriangleMesh | None:
        """Return the mesh as it was designed; None without one. ``tolerance_m``: of curved surfaces
        of a shipped satellite.
        """
        if self.surface is not None:
            return self.surface.mesh(name)
        if self.mesh in satellite_names():
            return replace(satellite(self.mesh, tolerance_m), name=name)
        return None


def _reach(box: Box) -> Array:
    """Return the largest absolute coordinates (3,) of a box in TRF."""
    return (
        np.abs(box.position_m)
        + np.abs(rotations.to_matrix(box.q_wxyz)) @ np.array(box.size_m) / 2.0
    )


def _check_on_a_face(number: int, marker: Marker, cuboids: tuple[Cuboid, ...]) -> None:
    """Raise ValueError unless the marker lies within a face, its edges parallel to those of the
    face.
    """
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
                raise ValueError(
                    f"markers.{number}: its edges must be parallel to those of its face"
                )
            if np.any(np.abs(local) > half + _FLAT_M):
                raise ValueError(f"markers.{number}: reaches beyond its face")
            return
    raise ValueError(
        f"markers.{number}: must lie on a face of a cuboid, unless the target has a mesh"
    )


def _check_apart(markers: tuple[Marker, ...]) -> None:
    """Raise ValueError when two markers in one plane that face the same way overlap."""
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
