# SPDX-License-Identifier: Apache-2.0
"""Find the target's pose in an image without a prior.

Silhouettes of the tracker mesh from attitudes spread over all rotations, normalized to one size, are compared with the image's
brightest region; the best are compared by how well some light explains their grey levels, and refined by the tracker.
The target must stand out from its background by its brightness: not in front of the Earth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from numpy.typing import NDArray

from ..refine import PoseInCamera
from .alignment import Alignment, Pyramid
from .lighting import appearance, fit_light, light_at
from .mesh import TrackerMesh
from .rendering import Lighting, PixelWindow, render
from .tracking import is_valid, levels_of, refine_pose, turn_between

_TEMPLATES, _SIDE_PX = 3000, 40
_SPREAD_PX = 8.0
"""Root mean square distance of a normalized silhouette's pixels from their centre."""
_DISTANCE_RADII = 6.0
_BY_SILHOUETTE, _BY_LIGHT, _FULL = 250, 24, 4
MIN_APPEARANCE = 0.9
"""Gate of an acquisition: a smaller correlation of the synthetic view with the image rejects a pose."""
_MIN_AREA_PX, _MIN_CONTRAST = 60, 5.0
_AMBIGUOUS_SCORE, _DISTINCT_RAD = 0.04, math.radians(8.0)


@dataclass(frozen=True)
class _Templates:
    """n normalized views: ``rotations`` (n, 3, 3); ``masks`` (n, pixels) float32; ``owners`` (n, pixels) triangles or -1; of each
    silhouette: ``spread`` (n,) rms radius and ``centre`` (n, 2), in units of the tangent of the angle at the distance."""

    rotations: Array
    masks: NDArray[np.float32]
    owners: NDArray[np.int16]
    spread: Array
    centre: Array
    distance_m: float


def spread_rotations(n: int) -> Array:
    """Return ``n`` quaternions (n, 4) spread evenly over all rotations: super-Fibonacci spirals (M. Alexa, CVPR 2022)."""
    s = np.arange(n) + 0.5
    r, big = np.sqrt(s / n), np.sqrt(1.0 - s / n)
    a, b = 2.0 * math.pi * s / math.sqrt(2.0), 2.0 * math.pi * s / 1.533751168755204288118041
    return np.stack([r * np.sin(a), r * np.cos(a), big * np.sin(b), big * np.cos(b)], axis=1)


class Acquisition:
    """Searches for one target in the images of one camera. The templates are rendered when they are first needed."""

    def __init__(self, camera: Camera, mesh: TrackerMesh) -> None:
        self._camera, self._mesh = camera, mesh
        self._templates: _Templates | None = None

    def prepare(self) -> None:
        """Render the templates, if that has not been done; takes about a second."""
        if self._templates is None:
            self._templates = _make_templates(self._mesh)

    def find(self, image: NDArray[np.uint8]) -> tuple[Alignment, ...]:
        """Return the alignments that pass the gate, best first; several if they explain the image about equally well."""
        pyramid = Pyramid(image, self._camera)
        candidates = self._candidates(pyramid)
        coarse: list[tuple[Alignment, Lighting]] = []
        for pose in candidates:
            levels = levels_of(pyramid, self._mesh, pose)
            light = light_at(pyramid, self._mesh, pose, levels[0], thorough=False) if levels else None
            found = refine_pose(pyramid, self._mesh, pose, light, levels[:1]) if light else None
            if found is not None and light is not None:
                coarse.append((found, light))
        coarse.sort(key=lambda item: -item[0].score)
        fine: list[Alignment] = []
        for start, light in coarse:
            if len(fine) == _FULL:
                break
            if any(turn_between(start.pose, other.pose) < _DISTINCT_RAD for other in fine):
                continue
            levels = levels_of(pyramid, self._mesh, start.pose)
            light = light_at(pyramid, self._mesh, start.pose, levels[0]) or light
            found = refine_pose(pyramid, self._mesh, start.pose, light, levels)
            if not is_valid(found) or any(turn_between(found.pose, o.pose) < _DISTINCT_RAD for o in fine):
                continue
            light = light_at(pyramid, self._mesh, found.pose, levels[0]) or light
            if appearance(pyramid, self._mesh, found.pose, levels[-1], light) >= MIN_APPEARANCE:
                fine.append(found)
        fine.sort(key=lambda a: -a.score)
        return tuple(a for a in fine if a.score > fine[0].score - _AMBIGUOUS_SCORE)

    def _candidates(self, pyramid: Pyramid) -> list[PoseInCamera]:
        """Return coarse poses, the most likely first."""
        region = _brightest_region(pyramid.level(0))
        if region is None:
            return []
        self.prepare()
        assert self._templates is not None
        t, camera = self._templates, self._camera
        y, x = np.nonzero(region)
        px = camera.undistort(np.column_stack([x, y]).astype(float))
        ideal = (px - (camera.cx_px, camera.cy_px)) / (camera.fx_px, camera.fy_px)
        ideal = ideal[np.isfinite(ideal).all(axis=1)]
        # In the axes of a camera that looks at the centre of the region.
        centre = np.append(ideal.mean(axis=0), 1.0)
        towards = _look_at(centre)
        rays = np.column_stack([ideal, np.ones(len(ideal))]) @ towards.T
        flat = rays[:, :2] / rays[:, 2:]
        middle = flat.mean(axis=0)
        spread = math.sqrt(float(((flat - middle) ** 2).sum(axis=1).mean()))
        mask, grey = self._normalized(pyramid, region, towards, middle, spread)
        common = t.masks @ mask
        union = t.masks.sum(axis=1) + mask.sum() - common
        likely = np.argsort(-common / union)[:_BY_SILHOUETTE]
        errors = [self._unexplained(int(i), mask, grey, common[i] / union[i]) for i in likely]
        poses = []
        for i in likely[np.argsort(errors)[:_BY_LIGHT]]:
            # The same silhouette at another distance: sizes are inversely proportional to it.
            ratio = t.spread[i] / spread
            aside = middle - t.centre[i] / ratio
            position = t.distance_m * ratio * np.append(aside, 1.0)
            poses.append(PoseInCamera(towards.T @ position, towards.T @ t.rotations[i]))
        return poses

    def _normalized(
        self, pyramid: Pyramid, region: NDArray[np.uint8], towards: Array, middle: Array, spread: float
    ) -> tuple[NDArray[np.float32], Array]:
        """Return the region's mask and the image on the grid of the templates, each (pixels,)."""
        step = spread / _SPREAD_PX
        axis = (np.arange(_SIDE_PX) - (_SIDE_PX - 1) / 2.0) * step
        u, v = np.meshgrid(axis + middle[0], axis + middle[1])
        rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ towards
        px = self._camera.project(rays).astype(np.float32)
        # Averaged over about the area of a pixel of the template.
        level = max(0, min(4, int(math.log2(max(step * self._camera.fx_px, 1.0)))))
        scale = 0.5**level
        at = (px + 0.5) * scale - 0.5
        grey = cv2.remap(pyramid.level(level), at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        soft = cv2.GaussianBlur(region * np.float32(255.0), (0, 0), max(0.3, 0.4 / scale))
        mask = cv2.remap(soft, px[..., 0], px[..., 1], cv2.INTER_LINEAR) > 127.0
        return mask.ravel().astype(np.float32), np.asarray(grey, dtype=float).ravel()

    def _unexplained(self, i: int, mask: NDArray[np.float32], grey: Array, overlap: float) -> float:
        """Return the share of the grey levels' variance that no light explains, plus that of the silhouette."""
        t = self._templates
        assert t is not None
        inside = (t.owners[i] >= 0) & (mask > 0.0)
        _, _, normals, reflectance = self._mesh.contiguous
        owners = t.owners[i][inside]
        normal = normals[owners].mean(axis=1) @ t.rotations[i].T
        light = fit_light(reflectance[owners], normal, grey[inside]) if inside.sum() > 30 else None
        if light is None or light.to_sun_irf is None:
            return math.inf
        lambert = np.maximum(normal @ light.to_sun_irf, 0.0)
        residual = np.abs(grey[inside] - reflectance[owners] * (light.ambient + light.direct * lambert))
        return float(residual.mean() / max(grey[inside].mean(), 1.0)) + 2.0 * (1.0 - overlap)


def _brightest_region(image: NDArray[np.float32]) -> NDArray[np.uint8] | None:
    """Return the mask (h, w) of what is brighter than the background, in one connected region; None without any."""
    level = float(np.median(image)) + _MIN_CONTRAST
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    bright = cv2.morphologyEx((smooth > level).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8))
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(bright, connectivity=8)
    if count < 2:
        return None
    largest = 1 + int(np.argmax(statistics[1:, cv2.CC_STAT_AREA]))
    if statistics[largest, cv2.CC_STAT_AREA] < _MIN_AREA_PX:
        return None
    return (labels == largest).astype(np.uint8)


def _look_at(ray: Array) -> Array:
    """Return the rotation (3, 3) from IRF to axes whose z points along ``ray``, by the smallest turn."""
    z = ray / np.linalg.norm(ray)
    axis = np.cross(z, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    angle = math.atan2(sine, float(z[2]))
    return rotations.to_matrix(rotations.exp(axis * (angle / sine if sine > 1e-12 else 0.0)))


def _make_templates(mesh: TrackerMesh) -> _Templates:
    quaternions = spread_rotations(_TEMPLATES)
    distance = _DISTANCE_RADII * mesh.radius_m
    light = Lighting(np.array([0.0, 0.0, -1.0]), shadows=False)
    masks = np.zeros((_TEMPLATES, _SIDE_PX**2), dtype=np.float32)
    owners = np.full((_TEMPLATES, _SIDE_PX**2), -1, dtype=np.int16)
    turns, spread, centre = np.empty((_TEMPLATES, 3, 3)), np.empty(_TEMPLATES), np.empty((_TEMPLATES, 2))
    middle, whole = (_SIDE_PX - 1) / 2.0, 0.45 * _SIDE_PX * _DISTANCE_RADII
    for i, q in enumerate(quaternions):
        pose = PoseInCamera(np.array([0.0, 0.0, distance]), rotations.to_matrix(q))
        view = render(mesh, pose, PixelWindow(_SIDE_PX, _SIDE_PX, (whole, whole, middle, middle)), light)
        y, x = np.nonzero(view.coverage > 0.5)
        flat = np.column_stack([x - middle, y - middle]) / whole
        centre[i] = flat.mean(axis=0)
        spread[i] = math.sqrt(float(((flat - centre[i]) ** 2).sum(axis=1).mean()))
        focal = _SPREAD_PX / spread[i]
        lens = (focal, focal, middle - focal * centre[i, 0], middle - focal * centre[i, 1])
        view = render(mesh, pose, PixelWindow(_SIDE_PX, _SIDE_PX, lens), light, samples=1)
        masks[i], owners[i], turns[i] = view.coverage.ravel(), view.owner.ravel(), pose.rotation
    return _Templates(turns, masks, owners, spread, centre, distance)
