# SPDX-License-Identifier: Apache-2.0
"""Estimate the light on the target from the image, without an ephemeris for sun, eclipse and lamp.

Each of several hundred directions of the sun is rated by how well its light explains the grey
levels of points on the target, with cast shadows and highlights (native/light.c). The best one is
refined between its neighbours.
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
from .alignment import Pyramid, area_px, image_window, in_grey_levels, window_of
from .mesh import ShadowMaps, TrackerMesh
from .rendering import Lighting, PixelWindow, SyntheticView, render
from .steps import LIGHT_MS, LIKELY_MS, SUNS_MS, VIEWS_MS, Steps, compared_ms


@dataclass(frozen=True)
class LightParameters:
    """Parameters of the search for the light, tuned by benchmarks/perception.py (``shape``).

    Comments state the median error of poses at half and at twice a value; 0.106 % of the range with
    these.
    """

    # Most points by which the light is estimated: the time grows with them.
    most_points: int = 600
    # Fewest points away from edges by which the light is estimated. Half and twice: the same poses.
    fewest_points: int = 40
    # Step between the points by which directions all around are rated.
    every_point: int = 3
    # Least ambient level as a share of the directed one.
    least_ambient: float = 0.02
    # Standard deviation of a grey level by noise and facets, in addition to texture. Half: 0.098;
    # twice: 0.114 %.
    grey_noise: float = 3.0
    # Angles, rad, at which eight neighbours of a direction are tried: two thirds and a quarter of
    # the distance of the directions all around. Half: 0.124; twice: 0.102 %.
    neighbours_rad: tuple[float, ...] = (0.12, 0.05)
    # Side of these neighbours' shadow maps, texels. Half: 0.102; twice: 0.091 %.
    fine_texels: int = 96
    # Number of likely directions that are compared by synthetic views,
    compared: int = 8
    # and their least distance, rad.
    distinct_rad: float = 0.35
    # Increase of the mean squared residual, over its least value, at which the weight of a
    # direction in the mean of the likely ones is 1/e.
    likely: float = 0.08
    # Mean squared residual, in standard deviations, below which light from everywhere explains the
    # points: of 40 sunlit views the least was 0.45, of views without sun on what is visible the
    # most 0.17.
    even_residual: float = 0.15
    # Ratio of residuals below which a sun explains a view clearly better than light from
    # everywhere.
    clearly: float = 0.95
    # Synthetic views are compared for suns behind the target, whose direction has a larger z in IRF
    # than this,
    least_behind: float = -0.1
    # and for a lamp beside the lens, with a smaller z than this.
    least_in_front: float = -0.9
    # Number of these directions that are compared at a finer level.
    compared_finely: int = 3


_LIGHT = LightParameters()


@dataclass(frozen=True)
class LitPoints:
    """n points of the target as native/light.c takes them.

    ``rows`` (n, 14). ``rotation`` (3, 3): attitude at which they are seen, TRF to IRF.
    """

    rows: Array
    rotation: Array


def light_steps(
    pyramid: Pyramid,
    mesh: TrackerMesh,
    pose: PoseInCamera,
    level: int,
    previous: Lighting | None = None,
    by_view: bool = False,
) -> Steps[Lighting | None]:
    """Return, in steps, the light on a target at ``pose`` in grey levels of the image.

    None if too little of the target is in view. With ``previous``, only directions near that light
    are tried. With ``by_view``, a synthetic view in each of several likely lights decides: on few
    textured faces, directions far apart explain the points about equally well, but not the shadows'
    edges.
    """
    yield LIGHT_MS
    points = lit_points(pyramid, mesh, pose, level)
    if points is None:
        return None
    even = even_light(mesh, points)
    if even is not None:
        return (yield from _view_steps(pyramid, mesh, pose, level, even, previous))
    if previous is None and by_view:
        yield LIKELY_MS
        lights = likely_lights(mesh, points)
        yield VIEWS_MS
        previous = max(lights, key=lambda light: appearance(pyramid, mesh, pose, level, light))
    found = fit_light(mesh, points, previous)
    if previous is None or not previous.weak:
        return found
    # A sun that explains points in the shade little better than even light may only explain their
    # noise.
    yield 2.0 * compared_ms(area_px(pyramid, level, mesh, pose))
    lights = [light for light in (found, previous) if light is not None]
    return max(lights, key=lambda light: appearance(pyramid, mesh, pose, level, light))


def even_light(mesh: TrackerMesh, points: LitPoints) -> Lighting | None:
    """Return light from everywhere if it alone explains the points within noise and texture, or
    None.

    This is so for a target that shows its shaded side. A sun that explains the points better would
    explain noise, and cast shadows that are not there.
    """
    rows = points.rows.copy()
    rows[:, 3:6] = 0.0  # without normals, the sun has no effect
    anywhere = ShadowMaps(np.eye(3)[:1], np.zeros((1, 12)), np.zeros((1, 0, 0), np.float32))
    residual, ambient, _ = rate_suns(LitPoints(rows, points.rotation), anywhere)[0].tolist()
    return (
        Lighting(None, 0.0, ambient) if residual < _LIGHT.even_residual and ambient > 1e-3 else None
    )


def _view_steps(
    pyramid: Pyramid, mesh: TrackerMesh, pose: PoseInCamera, level: int, even: Lighting,
    previous: Lighting | None
) -> Steps[Lighting]:  # fmt: skip
    """Return, in steps, the light of a target whose points ``even``, light from everywhere,
    explains.

    On a side in the shade a sun behind the target brightens only rims, which are no points. So
    synthetic views in several directions of the sun, near that of ``previous`` if it has one, are
    compared with the image; the levels follow by least squares. Returns ``even`` if no sun explains
    the image clearly better.
    """
    near = previous.to_sun_irf if previous is not None else None
    if near is None:
        yield SUNS_MS
        view = _ComparedView.at(pyramid, mesh, pose, level)
        if view is None:
            return even
        best, level = view.likely_suns(), max(level - 1, 0)
        tried = (*best, *_around(best[0], 0.25)[1::2])
    else:
        tried = (near,)
    one_ms = compared_ms(area_px(pyramid, level, mesh, pose))
    yield (1 + len(tried)) * one_ms
    view = _ComparedView.at(pyramid, mesh, pose, level)
    if view is None:
        return even
    found = [(*view.rate(to_sun), to_sun) for to_sun in tried]
    around = _around(min(found, key=lambda f: f[0])[3], 0.12)[1::2]
    yield len(around) * one_ms
    found += [(*view.rate(to_sun), to_sun) for to_sun in around]
    residual, ambient, direct, to_sun = min(found, key=lambda f: f[0])
    if residual > _LIGHT.clearly * view.residual:
        return even
    return Lighting(to_sun, direct, ambient, weak=True)


@dataclass(frozen=True)
class _ComparedView:
    """A view of a target at ``pose``, to be compared with the image in the light of several suns.

    n pixels are compared. ``pixels`` (h, w): which these are. ``grey`` (n,): the image without the
    background. ``ambient`` (n,): the view in light from everywhere. ``residual``: mean square
    without a sun.
    """

    mesh: TrackerMesh
    pose: PoseInCamera
    window: PixelWindow
    pixels: NDArray[np.bool_]
    grey: Array
    ambient: Array
    residual: float

    @classmethod
    def at(
        cls, pyramid: Pyramid, mesh: TrackerMesh, pose: PoseInCamera, level: int
    ) -> _ComparedView | None:
        """Return the view at a level; None if the target is out of view."""
        found = window_of(pyramid, level, mesh, pose)
        if found is None:
            return None
        window, left, top = found
        patch = image_window(pyramid, level, window, left, top)
        view = render(mesh, pose, window, Lighting(None, 0.0, 1.0))
        drawn, gain = in_grey_levels(view, patch)
        pixels = cv2.dilate(view.coverage, np.ones((5, 5))) > 0.0
        grey, ambient = (
            smooth(patch - (drawn - gain * view.grey))[pixels],
            smooth(view.grey)[pixels],
        )
        level_of = float(ambient @ grey) / max(float(ambient @ ambient), 1e-9)
        residual = float(np.mean((grey - level_of * ambient) ** 2))
        return cls(mesh, pose, window, pixels, grey, ambient, residual)

    def rate(self, to_sun: Array) -> tuple[float, float, float]:
        """Return mean squared residual, ambient and direct level with a sun in this direction (3,),
        IRF.
        """
        return self._fit(render(self.mesh, self.pose, self.window, Lighting(to_sun, 1.0, 0.0)).grey)

    def _fit(self, sunlit: NDArray[Any]) -> tuple[float, float, float]:
        """Return mean squared residual, ambient and direct level; ``sunlit`` (h, w): view in a sun
        of level 1.
        """
        columns = np.column_stack([self.ambient, smooth(sunlit)[self.pixels]])
        levels = np.linalg.solve(columns.T @ columns + 1e-9 * np.eye(2), columns.T @ self.grey)
        ambient, direct = np.maximum(levels, 0.0).tolist()
        return float(np.mean((self.grey - columns @ (ambient, direct)) ** 2)), ambient, direct

    def likely_suns(self) -> Array:
        """Return the directions (n, 3), IRF, of the few suns that explain the image best, best
        first.

        The view is rendered once. For each direction only light and shadow of its samples are
        computed, two by two in a pixel.
        """
        h, w = self.window.height, self.window.width
        fx, fy, cx, cy = self.window.lens
        fine = PixelWindow(2 * h, 2 * w, (2.0 * fx, 2.0 * fy, 2.0 * cx + 0.5, 2.0 * cy + 0.5))
        view = render(
            self.mesh, self.pose, fine, Lighting(None, 0.0, 1.0, shadows=False), samples=1
        )
        samples = np.flatnonzero(view.owner.ravel() >= 0)
        points = _points_in(self.mesh, self.pose, fine, view, samples)
        maps = self.mesh.few_suns
        towards = maps.to_sun_trf @ self.pose.rotation.T
        tried = np.flatnonzero(
            (towards[:, 2] > _LIGHT.least_behind) | (towards[:, 2] < _LIGHT.least_in_front)
        )
        sunlit, rated = np.zeros((2 * h, 2 * w), np.float32), []
        for k in tried:
            sunlit.ravel()[samples] = direct_light(points, maps, int(k))
            rated.append(self._fit(cv2.resize(sunlit, (w, h), interpolation=cv2.INTER_AREA))[0])
        return towards[tried[np.argsort(rated)[: _LIGHT.compared_finely]]]


def smooth(grey: NDArray[Any]) -> Array:
    """Smooth a view or image (h, w), so that neither noise nor the lens' point spread makes it
    differ.
    """
    return np.asarray(cv2.GaussianBlur(grey, (0, 0), 1.0), dtype=float)


def likely_lights(mesh: TrackerMesh, points: LitPoints) -> list[Lighting]:
    """Return the light of the likeliest directions, at least ``distinct_rad`` apart, likeliest
    first.
    """
    rated, towards = rate_suns(points, mesh.suns), mesh.suns.to_sun_trf
    chosen: list[int] = []
    for k in np.argsort(rated[:, 0]).tolist():
        if len(chosen) < _LIGHT.compared and all(
            towards[k] @ towards[other] < math.cos(_LIGHT.distinct_rad) for other in chosen
        ):
            chosen.append(k)
    return [
        Lighting(points.rotation @ towards[k], float(rated[k, 2]), float(rated[k, 1]))
        for k in chosen
    ]


def lit_points(
    pyramid: Pyramid,
    mesh: TrackerMesh,
    pose: PoseInCamera,
    level: int,
    most: int = _LIGHT.most_points,
) -> LitPoints | None:
    """Return points of the target away from edges with their grey levels, at most ``most``; None if
    few.
    """
    found = window_of(pyramid, level, mesh, pose)
    if found is None:
        return None
    window, left, top = found
    patch = image_window(pyramid, level, window, left, top)
    unlit = Lighting(None, 0.0, 1.0, shadows=False)
    view = render(mesh, pose, window, unlit, samples=1)
    covered = (view.coverage > 0.99).astype(np.uint8)
    for side in (5, 3, 1):
        # A slightly wrong pose mixes target and background beside edges of the outline.
        pixels = np.flatnonzero(cv2.erode(covered, np.ones((side, side), np.uint8)))
        if len(pixels) >= 4 * _LIGHT.fewest_points:
            break
    if len(pixels) < _LIGHT.fewest_points:
        return None
    pixels = pixels[np.linspace(0, len(pixels) - 1, min(most, len(pixels))).astype(np.int64)]
    return _points_in(mesh, pose, window, view, pixels, patch.ravel()[pixels].astype(float))


def _points_in(
    mesh: TrackerMesh, pose: PoseInCamera, window: PixelWindow, view: SyntheticView,
    pixels: NDArray[np.int64],
    grey: Array | float = 0.0,
) -> LitPoints:  # fmt: skip
    """Return the points of a view at ``pixels`` (n,), with their grey levels ``grey`` in
    the image.
    """
    row, column = np.divmod(pixels, window.width)
    fx, fy, cx, cy = window.lens
    rays = np.column_stack([(column - cx) / fx, (row - cy) / fy, np.ones(len(pixels))])
    at = rays / view.nearest.ravel()[pixels, None]
    to_camera = -(at / np.linalg.norm(at, axis=1, keepdims=True)) @ pose.rotation
    return points_on(
        mesh,
        view.owner.ravel()[pixels],
        (at - pose.position) @ pose.rotation,
        to_camera,
        grey,
        pose.rotation,
    )


def points_on(
    mesh: TrackerMesh, owners: NDArray[np.integer], at_trf: Array, to_camera_trf: Array,
    grey: Array | float, rotation: Array
) -> LitPoints:  # fmt: skip
    """Return n points on the mesh as ``LitPoints``.

    ``owners`` (n,): triangles. ``at_trf`` (n, 3): positions, TRF. ``to_camera_trf`` (n, 3): unit
    vectors to the camera, TRF. ``grey`` (n,): grey levels. ``rotation``: TRF to IRF.
    """
    rows = np.empty((len(owners), 14))
    rows[:, 0:3], rows[:, 3:6], rows[:, 6:9] = at_trf, mesh.mean_normals[owners], to_camera_trf
    rows[:, 9:12] = mesh.contiguous[3][owners]
    rows[:, 12] = grey
    rows[:, 13] = np.hypot(_LIGHT.grey_noise, mesh.texture_share[owners] * grey)
    return LitPoints(rows, rotation)


def rate_suns(points: LitPoints, maps: ShadowMaps) -> Array:
    """Return mean robust squared residual, ambient and direct level (k, 3) for k directions of the
    sun.
    """
    k, n = len(maps.to_sun_trf), len(points.rows)
    out, work = np.empty((k, 3)), np.empty(2 * n)
    function("rate_suns")(
        address(points.rows), c_int64(n), address(maps.to_sun_trf), address(maps.settings),
        address(maps.depths),
        c_int64(k), c_double(_LIGHT.least_ambient), address(out), address(work),
    )  # fmt: skip
    return out


def direct_light(points: LitPoints, maps: ShadowMaps, k: int) -> NDArray[np.float32]:
    """Return the light (n,) that points reflect of a sun of level 1 in direction ``k`` of
    ``maps``.
    """
    out = np.empty(len(points.rows), np.float32)
    function("direct_light")(
        address(points.rows), c_int64(len(out)), (c_double * 3)(*maps.to_sun_trf[k]),
        (c_double * 12)(*maps.settings[k]),
        address(maps.depths[k]), address(out),
    )  # fmt: skip
    return out


def fit_light(
    mesh: TrackerMesh, points: LitPoints, previous: Lighting | None = None
) -> Lighting | None:
    """Return the light that explains the points best; None for a dark image."""
    if previous is not None and previous.to_sun_irf is not None and not previous.weak:
        best = points.rotation.T @ previous.to_sun_irf
    else:
        few = LitPoints(np.ascontiguousarray(points.rows[:: _LIGHT.every_point]), points.rotation)
        best = _likely_direction(rate_suns(few, mesh.suns), mesh.suns)
    for angle in _LIGHT.neighbours_rad:
        maps = mesh.shadow_maps(_around(best, angle), _LIGHT.fine_texels)
        rated = rate_suns(points, maps)
        best = _likely_direction(rated, maps)
    _, ambient, direct = rate_suns(points, mesh.shadow_maps(best[None], _LIGHT.fine_texels))[
        0
    ].tolist()
    if not ambient + direct > 1e-3:
        return None
    return Lighting(points.rotation @ best, direct, ambient)


def _likely_direction(rated: Array, maps: ShadowMaps) -> Array:
    """Return the mean of the directions near the best one, weighted by likelihood."""
    k = int(np.argmin(rated[:, 0]))
    near = maps.to_sun_trf @ maps.to_sun_trf[k] > 0.9
    excess = (rated[near, 0] - rated[k, 0]) / max(float(rated[k, 0]), 1e-6)
    mean = np.exp(-excess / _LIGHT.likely) @ maps.to_sun_trf[near]
    return mean / np.linalg.norm(mean)


def _around(direction: Array, angle_rad: float) -> Array:
    """Return ``direction`` and eight unit vectors (9, 3) ``angle_rad`` away from it."""
    across = np.cross(direction, np.eye(3)[int(np.argmin(np.abs(direction)))])
    across /= np.linalg.norm(across)
    turns = np.arange(8) * np.pi / 4.0
    ring = np.cos(turns)[:, None] * across + np.sin(turns)[:, None] * np.cross(direction, across)
    return np.concatenate(
        [direction[None], np.cos(angle_rad) * direction + np.sin(angle_rad) * ring]
    )


def appearance(
    pyramid: Pyramid, mesh: TrackerMesh, pose: PoseInCamera, level: int, light: Lighting
) -> float:
    """Return the correlation, -1 to 1, of a synthetic view with the image.

    It is taken on the target and a border of two pixels.
    """
    found = window_of(pyramid, level, mesh, pose)
    if found is None:
        return -1.0
    window, left, top = found
    view = render(mesh, pose, window, light)
    patch = image_window(pyramid, level, window, left, top)
    synthetic, _ = in_grey_levels(view, patch)
    compared = cv2.dilate(view.coverage, np.ones((5, 5))) > 0.0
    # Equally smooth, so that noise and the lens' point spread do not count.
    a, b = (
        cv2.GaussianBlur(grey, (0, 0), 1.0)[compared].astype(float) for grey in (synthetic, patch)
    )
    a, b = a - a.mean(), b - b.mean()
    power = float(a @ a) * float(b @ b)
    return float(a @ b) / float(np.sqrt(power)) if power > 0.0 else -1.0
