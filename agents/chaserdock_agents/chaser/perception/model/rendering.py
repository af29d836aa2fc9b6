# SPDX-License-Identifier: Apache-2.0
"""Render synthetic views of the tracker mesh, by native/mesh.c."""

from __future__ import annotations

from ctypes import c_double, c_int64
from dataclasses import dataclass

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.native import address
from numpy.typing import NDArray

from ..native import function
from ..refine import PoseInCamera
from .mesh import TrackerMesh

_SHADOW_TEXELS = 512
"""Side of a view's shadow map, texels: 2 mm on a target of 1 m. Median error of poses: 0.106 % of
the range; half: 0.079; twice: 0.105 %.
"""
_NO_SHADOW = np.zeros(1, dtype=np.float32)


@dataclass(frozen=True)
class Lighting:
    """Light on the target, up to an unknown common factor.

    ``to_sun_irf`` (3,): unit vector to the sun in IRF; None: the only directed light is the lamp at
    the lens. ``direct`` and ``ambient``: shares of the directed light and of light from all
    directions. ``shadows``: whether the target casts shadows on itself. ``weak``: a sun that lights
    little of what is visible.
    """

    to_sun_irf: Array | None
    direct: float = 0.8
    ambient: float = 0.2
    shadows: bool = True
    weak: bool = False


@dataclass(frozen=True)
class PixelWindow:
    """A rectangle of the grid of ideal pixels of an image level.

    Pinhole camera (fx, fy, cx, cy), px, relative to its first pixel.
    """

    height: int
    width: int
    lens: tuple[float, float, float, float]


@dataclass(frozen=True)
class SyntheticView:
    """A rendering; each array is (h, w).

    ``grey``: reflectance times light times coverage. ``coverage``: share of the pixel that the
    target covers. ``nearest``: inverse depth, 1/m, 0 for none. ``owner``: triangle, -1 for none.
    """

    grey: NDArray[np.float32]
    coverage: NDArray[np.float32]
    nearest: NDArray[np.float32]
    owner: NDArray[np.int32]


def pose_array(pose: PoseInCamera) -> Array:
    """Return a pose as kernels take it (12,): position (3) and rotation (3, 3)."""
    return np.concatenate([pose.position, pose.rotation.ravel()])


def render(
    mesh: TrackerMesh, pose: PoseInCamera, window: PixelWindow, light: Lighting, samples: int = 2
) -> SyntheticView:
    """Render ``mesh`` with ``samples`` by ``samples`` samples per pixel."""
    vertices, triangles, normals, surfaces = mesh.contiguous
    h, w = window.height, window.width
    shape = (h, w)
    view = SyntheticView(
        np.empty(shape, np.float32),
        np.empty(shape, np.float32),
        np.empty(shape, np.float32),
        np.empty(shape, np.int32),
    )

    at = pose_array(pose)
    if light.to_sun_irf is None:
        lamp_distance = max(float(np.linalg.norm(pose.position)), 1e-3)
        settings = (0.0, 0.0, 1.0, light.direct * lamp_distance**2, light.ambient, 1.0)
        shadow_settings, depth = (0.0,) * 12, _NO_SHADOW
    else:
        settings = (*light.to_sun_irf, light.direct, light.ambient, 0.0)
        shadow_settings, depth = (0.0,) * 12, _NO_SHADOW
        if light.shadows:
            maps = mesh.shadow_maps((pose.rotation.T @ light.to_sun_irf)[None], _SHADOW_TEXELS)
            shadow_settings, depth = tuple(maps.settings[0].tolist()), maps.depths

    facing, work = (
        np.empty((len(triangles), 3)),
        np.empty(3 * samples * samples * h * w, np.float32),
    )
    function("render_mesh")(
        (c_double * 4)(*window.lens), c_int64(h), c_int64(w), c_int64(samples), address(at),
        address(vertices), address(triangles), address(normals), address(surfaces),
        c_int64(len(triangles)),
        (c_double * 6)(*settings), (c_double * 12)(*shadow_settings), address(depth),
        address(view.grey), address(view.coverage), address(view.nearest), address(view.owner),
        address(facing), address(work),
    )  # fmt: skip
    return view
