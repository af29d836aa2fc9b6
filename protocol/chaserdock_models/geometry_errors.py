# SPDX-License-Identifier: Apache-2.0
"""Describe the errors of a known mesh by independent parameters, for trackers and for the
controller.

Each parameter has a standard deviation, and displaces every vertex by a known vector per standard
deviation. There is a rotation of each joint about each body axis, the scale of what is not on a
joint, and the visible border of solar panels, whose grid of cells a known mesh does not have.
Trackers estimate the parameters with the pose; the controller fuses them.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from . import rotations
from .arrays import Array
from .meshes import MeshPart, TriangleMesh, with_geometry_errors
from .targets import box_around

_RIM_SIGMA_M = 0.001
"""Standard deviation (m) of where the visible border of solar panels lies. The grid of cells, which
the mesh does not have, displaces it by tenths of a millimetre; 1 mm lets images estimate that.
"""


@dataclass(frozen=True)
class GeometryParameter:
    """One parameter of a mesh's errors.

    ``name``: such as ``panel_left x`` (a joint and an axis), ``scale`` or ``rim``. ``sigma``: its
    prior standard deviation; rad for a joint, relative for the scale, m for the rim.
    """

    name: str
    sigma: float


def geometry_parameters(
    mesh: TriangleMesh, joint_sigma_rad: float, scale_sigma: float
) -> tuple[GeometryParameter, ...]:
    """Return the parameters of a mesh, in the order of `error_modes`.

    Leaves out those whose standard deviation is zero; the rim alone is no parameter.
    """
    turns = (
        [f"{joint} {axis}" for joint in mesh.joints for axis in "xyz"]
        if joint_sigma_rad > 0.0
        else []
    )
    parameters = [GeometryParameter(name, joint_sigma_rad) for name in turns]
    if scale_sigma > 0.0:
        parameters.append(GeometryParameter("scale", scale_sigma))
    if parameters and any(_has_rim(part) for part in mesh.parts):
        parameters.append(GeometryParameter("rim", _RIM_SIGMA_M))
    return tuple(parameters)


def error_modes(mesh: TriangleMesh, joint_sigma_rad: float, scale_sigma: float) -> Array:
    """Return the displacements (k, n, 3), m, of all vertices by one standard deviation of each
    parameter.
    """
    known = _vertices(mesh.parts)
    modes = []
    for parameter in geometry_parameters(mesh, joint_sigma_rad, scale_sigma):
        name, _, axis = parameter.name.rpartition(" ")
        if parameter.name == "rim":
            modes.append(np.concatenate([_rim(part) for part in mesh.parts]))
        elif name:
            turn = {name: parameter.sigma * np.eye(3)["xyz".index(axis)]}
            modes.append(_vertices(with_geometry_errors(mesh, 0.0, turn).parts) - known)
        else:
            modes.append(_vertices(with_geometry_errors(mesh, parameter.sigma, {}).parts) - known)
    return np.array(modes).reshape(len(modes), len(known), 3)


def _vertices(parts: Iterable[MeshPart]) -> Array:
    return np.concatenate([part.vertices_m for part in parts])


def _has_rim(part: MeshPart) -> bool:
    return part.material.texture == "cells" and bool(part.joint)


def _rim(part: MeshPart) -> Array:
    """Return the displacements (n, 3) of the vertices of a panel, outwards in its plane."""
    if not _has_rim(part):
        return np.zeros_like(part.vertices_m)
    around = box_around(part)
    axes, half = rotations.to_matrix(around.q_wxyz), np.array(around.size_m) / 2.0
    local = (part.vertices_m - np.array(around.position_m)) @ axes
    return _RIM_SIGMA_M * (np.sign(local) * (half > half.min())) @ axes.T
