# SPDX-License-Identifier: Apache-2.0
"""Store the content of a mesh file in a scenario: vertices and triangles as compressed text,
materials, joints.

Processes without the file receive it in this form; the flight software's version has fewer
triangles (`FlightTarget.as_known`).
"""

from __future__ import annotations

import base64
import binascii
import zlib
from functools import lru_cache
from typing import Literal

import numpy as np
from chaserdock_models.meshes import Material, MeshPart, TriangleMesh
from numpy.typing import NDArray
from pydantic import Field, model_validator

from .fields import Fraction, Name, NotNegative, Positive, Section, Vector

SUFFIXES = (".glb", ".gltf", ".obj", ".stl", ".ply", ".off", ".dae")
"""Endings of mesh files that can be read."""
MAX_PARTS = 256
"""Parts of a mesh: each has collision hulls of its own, which physics compares in pairs."""
MAX_TRIANGLES = 20_000
"""Triangles of a mesh that is drawn; files with more are decimated when they are read."""
_MAX_BYTES = 64_000_000
"""Size of unpacked numbers: far above those of `MAX_TRIANGLES`, to stop a decompression bomb."""


def _packed(values: NDArray[np.generic]) -> str:
    return base64.b64encode(zlib.compress(values.tobytes(), 6)).decode()


def _unpacked(text: str, kind: str) -> NDArray[np.generic]:
    """Return packed numbers in rows of three. Raises ValueError."""
    try:
        unpacker = zlib.decompressobj()
        data = unpacker.decompress(base64.b64decode(text, validate=True), _MAX_BYTES)
    except (binascii.Error, zlib.error) as error:
        raise ValueError(f"not the compressed numbers of a mesh: {error}") from None
    if not unpacker.eof or len(data) % 12:
        raise ValueError("not the compressed numbers of a mesh: too long, or not in rows of three")
    return np.frombuffer(data, dtype=kind).reshape(-1, 3)


class SurfaceMaterial(Section):
    """Optical properties of a part, and its density over that of the other parts."""

    name: str = Field(default="grey", max_length=64, description="Name of the material.")
    diffuse: Fraction = Field(default=0.5, description="Diffuse reflectance.")
    specular: Fraction = Field(default=0.0, description="Specular reflectance.")
    shininess: float = Field(
        default=20.0,
        gt=0,
        le=1000,
        allow_inf_nan=False,
        description="Blinn's exponent of the highlight.",
    )
    texture: Literal["", "insulation", "cells"] = Field(
        default="",
        description="`insulation`: wrinkled foil. `cells`: grid of solar cells. Empty: uniform.",
    )
    relative_density: Positive = Field(
        default=1.0, description="Density over that of the other parts, for mass properties."
    )

    def material(self) -> Material:
        return Material(
            self.name,
            self.diffuse,
            self.specular,
            self.shininess,
            self.texture,
            self.relative_density,
        )

    @classmethod
    def of(cls, m: Material) -> SurfaceMaterial:
        return cls(
            name=m.name,
            diffuse=m.diffuse,
            specular=m.specular,
            shininess=m.shininess,
            texture=m.texture,
            relative_density=m.relative_density,
        )


class SurfacePart(Section):
    """A closed surface of one material."""

    name: Name = Field(description="Name of the part.")
    material: SurfaceMaterial = SurfaceMaterial()
    joint: str = Field(
        default="",
        pattern=r"^([A-Za-z0-9][A-Za-z0-9._-]{0,63})?$",
        description="Joint that the part moves with; empty: fixed.",
    )
    vertices: str = Field(
        description="Vertices (TRF), m: rows x, y, z, 32-bit floats, compressed by zlib, base64."
    )
    triangles: str = Field(
        description="Vertices of each triangle, counter-clockwise from outside: rows of 32-bit "
        "integers, compressed by zlib, base64."
    )

    def part(self) -> MeshPart:
        """Return the part. Raises ValueError."""
        vertices = _unpacked(self.vertices, "<f4").astype(float)
        triangles = _unpacked(self.triangles, "<u4").astype(np.int64)
        if (
            not len(triangles)
            or not np.all(np.isfinite(vertices))
            or triangles.max() >= len(vertices)
        ):
            raise ValueError(f"{self.name}: triangles of vertices that do not exist, or none")
        return MeshPart(self.name, self.material.material(), vertices, triangles, self.joint)


class SurfaceJoint(Section):
    """A joint that parts move with."""

    name: Name = Field(description="Name of the joint.")
    position_m: Vector = Field(description="Its position (TRF), m.")


class Surface(Section):
    """A mesh as read from a file. Written by the program, not by hand."""

    file: str = Field(description="File that it was read from.")
    scale: Positive = Field(default=1.0, description="`mesh_scale` that it was read with.")
    origin_m: Vector = Field(
        default=(0.0, 0.0, 0.0), description="`mesh_origin_m` that it was read with."
    )
    deviation_m: NotNegative = Field(
        default=0.0, description="Largest deviation from the surface of the file, m."
    )
    known: bool = Field(
        default=False,
        description="Whether it is what the flight software knows: simplified, without missing "
        "parts.",
    )
    parts: tuple[SurfacePart, ...] = Field(min_length=1, max_length=MAX_PARTS)
    joints: tuple[SurfaceJoint, ...] = Field(default=(), max_length=MAX_PARTS)

    @model_validator(mode="after")
    def _check_mesh(self) -> Surface:
        mesh = self.mesh("check")
        if mesh.triangle_count > 2 * MAX_TRIANGLES:
            raise ValueError(
                f"{mesh.triangle_count} triangles; at most {2 * MAX_TRIANGLES} are allowed"
            )
        if unknown := {p.joint for p in self.parts if p.joint} - set(mesh.joints):
            raise ValueError(f"parts move with a joint {unknown.pop()!r} that is not defined")
        return self

    def mesh(self, name: str) -> TriangleMesh:
        """Return the mesh."""
        return _mesh_of(name, self.parts, self.joints)

    @classmethod
    def of(
        cls,
        mesh: TriangleMesh,
        file: str,
        scale: float = 1.0,
        origin_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
        deviation_m: float = 0.0,
        known: bool = False,
    ) -> Surface:
        """Return a mesh in this form; its vertices are rounded to 32 bits."""
        return cls(
            file=file,
            scale=scale,
            origin_m=origin_m,
            deviation_m=deviation_m,
            known=known,
            parts=tuple(
                SurfacePart(
                    name=p.name,
                    material=SurfaceMaterial.of(p.material),
                    joint=p.joint,
                    vertices=_packed(p.vertices_m.astype("<f4")),
                    triangles=_packed(p.triangles.astype("<u4")),
                )
                for p in mesh.parts
            ),
            joints=tuple(
                SurfaceJoint(name=name, position_m=at) for name, at in mesh.joints.items()
            ),
        )


@lru_cache(maxsize=16)
def _mesh_of(
    name: str, parts: tuple[SurfacePart, ...], joints: tuple[SurfaceJoint, ...]
) -> TriangleMesh:
    return TriangleMesh(
        name, tuple(p.part() for p in parts), {j.name: j.position_m for j in joints}
    )
