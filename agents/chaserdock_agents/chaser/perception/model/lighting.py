# SPDX-License-Identifier: Apache-2.0
"""Estimate the light on the target from the image, so that sun, eclipse and lamp need no ephemeris.

Each of several hundred directions of the sun is rated by how well its light explains the grey levels of points on the target,
with cast shadows and highlights (native/light.c). The best one is refined between its neighbours.
"""

from __future__ import annotations

import math
from ctypes import c_double, c_int64
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.native import address
from numpy.typing import NDArray

from ..native import function
from ..refine import PoseInCamera
from .alignment import Pyramid, image_window, in_grey_levels, window_of
from .mesh import ShadowMaps, TrackerMesh, spread_directions
from .rendering import Lighting, PixelWindow, render

_MOST_POINTS, _FEWEST_POINTS = 600, 40
_EVERY_POINT = 3
"""Of the points, those that rate directions all around."""
_LEAST_AMBIENT = 0.02
"""Least ambient level as a share of the directed one."""
_GREY_NOISE = 3.0
_NEIGHBOURS_RAD, _FINE_TEXELS = (0.12, 0.05), 96
_COMPARED, _DISTINCT_RAD = 8, 0.35
"""Number of directions that are compared by synthetic views, and their least distance."""
_LIKELY = 0.08
"""Increase of the mean squared residual, as a share of its least, at which a direction weighs 1/e in the mean of the likely ones."""

_EVEN_RESIDUAL, _CLEARLY = 0.15, 0.95
"""Mean squared residual, in standard deviations, below which light from everywhere explains the points: of 40 sunlit views the least
was 0.45, of views without sun on what is visible the most 0.17. Ratio of residuals below which a sun explains a view better."""
_COMPARED_SUNS = np.array([d for d in spread_directions(60) if d[2] > -0.1 or d[2] < -0.9])
"""Directions (n, 3) in IRF, behind the target or of a lamp beside the lens, of which synthetic views are compared."""
_COMPARED_FINELY = 3
"""Number of these that are compared at a finer level."""


@dataclass(frozen=True)
class LitPoints:
    """n points as native/light.c takes them, ``rows`` (n, 14), seen at the attitude ``rotation`` (3, 3), TRF to IRF."""

    rows: Array
    rotation: Array


def light_at(
    pyramid: Pyramid,
    mesh: TrackerMesh,
    pose: PoseInCamera,
    level: int,
    previous: Lighting | None = None,
    by_view: bool = False,
) -> Lighting | None:
    """Return the light, in grey levels, that the image shows on a target at ``pose``; None if too little of it is in view.

    With ``previous``, only directions near that light are tried. With ``by_view``, a synthetic view in each of several likely
    lights decides: on few textured faces, directions far apart explain the points about equally well, but not the shadows' edges.
    """
    points = lit_points(pyramid, mesh, pose, level)
    if points is None:
        return None
    even = even_light(mesh, points)
    if even is not None:
        return light_by_view(pyramid, mesh, pose, level, even, previous)
    if previous is None and by_view:
        lights = likely_lights(mesh, points)
        previous = max(lights, key=lambda light: appearance(pyramid, mesh, pose, level, light))
    return fit_light(mesh, points, previous)


def even_light(mesh: TrackerMesh, points: LitPoints) -> Lighting | None:
    """Return light from everywhere if that alone explains the points within their noise and texture, as of a target that shows
    its shaded side: a sun that explains them better would be one of noise, and cast shadows that are not there."""
    rows = points.rows.copy()
    rows[:, 3:6] = 0.0  # without normals, the sun has no effect
    anywhere = ShadowMaps(np.eye(3)[:1], np.zeros((1, 12)), np.zeros((1, 0, 0), np.float32))
    residual, ambient, _ = rate_suns(LitPoints(rows, points.rotation), anywhere)[0].tolist()
    return Lighting(None, 0.0, ambient) if residual < _EVEN_RESIDUAL and ambient > 1e-3 else None


def light_by_view(
    pyramid: Pyramid, mesh: TrackerMesh, pose: PoseInCamera, level: int, even: Lighting, previous: Lighting | None
) -> Lighting:  # fmt: skip
    """Return the light of a target whose points ``even`` explains, light from everywhere: on a side in the shade a sun behind the
    target brightens no more than rims, which are no points.

    Synthetic views in several directions of the sun, near that of ``previous`` if it has one, are compared with the image; the
    levels follow by least squares. Returns ``even`` if no sun explains the image clearly better.
    """
    coarse, fine = (_ComparedView.at(pyramid, mesh, pose, k) for k in (level, max(level - 1, 0)))
    if coarse is None or fine is None:
        return even
    if previous is not None and previous.to_sun_irf is not None:
        fine, nearest = coarse, previous.to_sun_irf
        found = [(*fine.rate(nearest), nearest)]
    else:
        rated = [coarse.rate(to_sun)[0] for to_sun in _COMPARED_SUNS]
        best = _COMPARED_SUNS[np.argsort(rated)[:_COMPARED_FINELY]]
        found = [(*fine.rate(to_sun), to_sun) for to_sun in (*best, *_around(best[0], 0.25)[1::2])]
        nearest = min(found, key=lambda f: f[0])[3]
    found += [(*fine.rate(to_sun), to_sun) for to_sun in _around(nearest, 0.12)[1::2]]
    residual, ambient, direct, to_sun = min(found, key=lambda f: f[0])
    if residual > _CLEARLY * fine.residual:
        return even
    return Lighting(to_sun, direct, ambient, weak=True)


@dataclass(frozen=True)
class _ComparedView:
    """A view of a target at ``pose`` and the image there: n pixels of it without the background, ``grey`` (n,), and of the view in
    light from everywhere, ``ambient`` (n,); ``pixels`` (h, w): which these are; ``residual``: mean square without a sun."""

    mesh: TrackerMesh
    pose: PoseInCamera
    window: PixelWindow
    pixels: NDArray[np.bool_]
    grey: Array
    ambient: Array
    residual: float

    @classmethod
    def at(cls, pyramid: Pyramid, mesh: TrackerMesh, pose: PoseInCamera, level: int) -> _ComparedView | None:
        """Return the view at a level; None if the target is out of view."""
        found = window_of(pyramid, level, mesh, pose)
        if found is None:
            return None
        window, left, top = found
        patch = image_window(pyramid, level, window, left, top)
        view = render(mesh, pose, window, Lighting(None, 0.0, 1.0))
        drawn, gain = in_grey_levels(view, patch)
        pixels = cv2.dilate(view.coverage, np.ones((5, 5))) > 0.0
        grey, ambient = smooth(patch - (drawn - gain * view.grey))[pixels], smooth(view.grey)[pixels]
        level_of = float(ambient @ grey) / max(float(ambient @ ambient), 1e-9)
        residual = float(np.mean((grey - level_of * ambient) ** 2))
        return cls(mesh, pose, window, pixels, grey, ambient, residual)

    def rate(self, to_sun: Array) -> tuple[float, float, float]:
        """Return the mean squared residual with a sun in the direction (3,), IRF, the ambient and the direct level."""
        view = render(self.mesh, self.pose, self.window, Lighting(to_sun, 1.0, 0.0))
        columns = np.column_stack([self.ambient, smooth(view.grey)[self.pixels]])
        levels = np.linalg.solve(columns.T @ columns + 1e-9 * np.eye(2), columns.T @ self.grey)
        ambient, direct = np.maximum(levels, 0.0).tolist()
        return float(np.mean((self.grey - columns @ (ambient, direct)) ** 2)), ambient, direct


def smooth(grey: NDArray[Any]) -> Array:
    """Return a view or image (h, w) without noise, as equally smooth as others, so that the lens' point spread does not count."""
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), 1.0), dtype=float)


def likely_lights(mesh: TrackerMesh, points: LitPoints) -> list[Lighting]:
    """Return the light of the best directions that are at least ``_DISTINCT_RAD`` apart, likely ones first."""
    rated, towards = rate_suns(points, mesh.suns), mesh.suns.to_sun_trf
    chosen: list[int] = []
    for k in np.argsort(rated[:, 0]).tolist():
        if len(chosen) < _COMPARED and all(
            towards[k] @ towards[other] < math.cos(_DISTINCT_RAD) for other in chosen
        ):
            chosen.append(k)
    return [Lighting(points.rotation @ towards[k], float(rated[k, 2]), float(rated[k, 1])) for k in chosen]


def lit_points(
    pyramid: Pyramid, mesh: TrackerMesh, pose: PoseInCamera, level: int, most: int = _MOST_POINTS
) -> LitPoints | None:
    """Return at most ``most`` points of the target with their grey levels, away from edges; None if there are too few."""
    found = window_of(pyramid, level, mesh, pose)
    if found is None:
        return None
    window, left, top = found
    patch = image_window(pyramid, level, window, left, top)
    unlit = Lighting(None, 0.0, 1.0, shadows=False)
    view = render(mesh, pose, window, unlit, samples=1)
    covered = (view.coverage > 0.99).astype(np.uint8)
    for side in (5, 3, 1):
        # Beside edges of the outline a slightly wrong pose mixes target and background.
        pixels = np.flatnonzero(cv2.erode(covered, np.ones((side, side), np.uint8)))
        if len(pixels) >= 4 * _FEWEST_POINTS:
            break
    if len(pixels) < _FEWEST_POINTS:
        return None
    pixels = pixels[np.linspace(0, len(pixels) - 1, min(most, len(pixels))).astype(np.int64)]
    row, column = np.divmod(pixels, window.width)
    fx, fy, cx, cy = window.lens
    rays = np.column_stack([(column - cx) / fx, (row - cy) / fy, np.ones(len(pixels))])
    at = rays / view.nearest.ravel()[pixels, None]
    to_camera = -(at / np.linalg.norm(at, axis=1, keepdims=True)) @ pose.rotation
    grey = patch.ravel()[pixels].astype(float)
    return points_on(
        mesh, view.owner.ravel()[pixels], (at - pose.position) @ pose.rotation, to_camera, grey, pose.rotation
    )


def points_on(
    mesh: TrackerMesh, owners: NDArray[np.integer], at_trf: Array, to_camera_trf: Array, grey: Array, rotation: Array
) -> LitPoints:  # fmt: skip
    """Return n points on the triangles ``owners`` (n,), with grey levels (n,), at (n, 3), seen in directions (n, 3), all in TRF."""
    rows = np.empty((len(owners), 14))
    rows[:, 0:3], rows[:, 3:6], rows[:, 6:9] = at_trf, mesh.mean_normals[owners], to_camera_trf
    rows[:, 9:12] = mesh.contiguous[3][owners]
    rows[:, 12] = grey
    rows[:, 13] = np.hypot(_GREY_NOISE, mesh.texture_share[owners] * grey)
    return LitPoints(rows, rotation)


def rate_suns(points: LitPoints, maps: ShadowMaps) -> Array:
    """Return, for each of k directions of the sun, (k, 3): mean squared residual (robust), ambient and direct level."""
    k, n = len(maps.to_sun_trf), len(points.rows)
    out, work = np.empty((k, 3)), np.empty(2 * n)
    function("rate_suns")(
        address(points.rows), c_int64(n), address(maps.to_sun_trf), address(maps.settings), address(maps.depths),
        c_int64(k), c_double(_LEAST_AMBIENT), address(out), address(work),
    )  # fmt: skip
    return out


def fit_light(mesh: TrackerMesh, points: LitPoints, previous: Lighting | None = None) -> Lighting | None:
    """Return the light that explains the points best; None for a dark image."""
    if previous is not None and previous.to_sun_irf is not None and not previous.weak:
        best = points.rotation.T @ previous.to_sun_irf
    else:
        few = LitPoints(np.ascontiguousarray(points.rows[::_EVERY_POINT]), points.rotation)
        best = _likely_direction(rate_suns(few, mesh.suns), mesh.suns)
    for angle in _NEIGHBOURS_RAD:
        maps = mesh.shadow_maps(_around(best, angle), _FINE_TEXELS)
        rated = rate_suns(points, maps)
        best = _likely_direction(rated, maps)
    _, ambient, direct = rate_suns(points, mesh.shadow_maps(best[None], _FINE_TEXELS))[0].tolist()
    if not ambient + direct > 1e-3:
        return None
    return Lighting(points.rotation @ best, direct, ambient)


def _likely_direction(rated: Array, maps: ShadowMaps) -> Array:
    """Return the mean, weighted by likelihood, of the directions near the best one."""
    k = int(np.argmin(rated[:, 0]))
    near = maps.to_sun_trf @ maps.to_sun_trf[k] > 0.9
    excess = (rated[near, 0] - rated[k, 0]) / max(float(rated[k, 0]), 1e-6)
    mean = np.exp(-excess / _LIKELY) @ maps.to_sun_trf[near]
    return mean / np.linalg.norm(mean)


def _around(direction: Array, angle_rad: float) -> Array:
    """Return ``direction`` and eight unit vectors (9, 3) ``angle_rad`` away from it."""
    across = np.cross(direction, np.eye(3)[int(np.argmin(np.abs(direction)))])
    across /= np.linalg.norm(across)
    turns = np.arange(8) * np.pi / 4.0
    ring = np.cos(turns)[:, None] * across + np.sin(turns)[:, None] * np.cross(direction, across)
    return np.concatenate([direction[None], np.cos(angle_rad) * direction + np.sin(angle_rad) * ring])


def appearance(pyramid: Pyramid, mesh: TrackerMesh, pose: PoseInCamera, level: int, light: Lighting) -> float:
    """Return the correlation, -1 to 1, of a synthetic view with the image, on the target and a border of two pixels."""
    found = window_of(pyramid, level, mesh, pose)
    if found is None:
        return -1.0
    window, left, top = found
    view = render(mesh, pose, window, light)
    patch = image_window(pyramid, level, window, left, top)
    synthetic, _ = in_grey_levels(view, patch)
    compared = cv2.dilate(view.coverage, np.ones((5, 5))) > 0.0
    # Equally smooth, so that noise and the lens' point spread do not count.
    a, b = (cv2.GaussianBlur(grey, (0, 0), 1.0)[compared].astype(float) for grey in (synthetic, patch))
    a, b = a - a.mean(), b - b.mean()
    power = float(a @ a) * float(b @ b)
    return float(a @ b) / float(np.sqrt(power)) if power > 0.0 else -1.0
