# SPDX-License-Identifier: Apache-2.0
"""Find the target's pose in an image without a prior.

The target's region in the image stands out by its brightness or, in front of the Earth, by its
sharp edges. Silhouettes of the tracker mesh, from attitudes spread over all rotations and
normalized to one size, are compared with it. The best are compared by how well some light explains
their grey levels, and refined by the tracker.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from numpy.typing import NDArray

from ..refine import PoseInCamera
from .alignment import Alignment, Pyramid
from .lighting import appearance, light_steps, points_on, rate_suns
from .mesh import ShadowMaps, TrackerMesh, spread_directions
from .rendering import Lighting, PixelWindow, render
from .steps import Steps, result_of
from .tracking import is_valid, levels_of, pose_steps, rough_prior_steps, turn_between


@dataclass(frozen=True)
class AcquisitionParameters:
    """Parameters of a search without a prior, tuned by benchmarks/perception.py (``shape``).

    Five of five views are acquired with these; comments state what half and twice a value change.
    """

    # Silhouettes at each distance, about 17 degrees apart. Half: 5 acquired, in twice the time, as
    # more starts fail; twice: 5, with 3.4 instead of 1.6 s to prepare.
    templates: int = 3000
    # Side of a silhouette, px. Half: 4 acquired; twice: 5, with twice the time to prepare.
    side_px: int = 40
    # Root mean square distance of a normalized silhouette's pixels from its centre, px: with it a
    # long one fits into ``side_px``.
    spread_px: float = 8.0
    # Distances of the far and the near templates, in radii of the target: perspective changes near
    # silhouettes.
    distances_radii: tuple[float, float] = (6.0, 2.2)
    # Distance, in radii, below which near templates are used: the middle of both on a logarithmic
    # scale.
    near_radii: float = 3.6
    # Attitudes kept by their silhouettes. Half and twice: the same poses.
    by_silhouette: int = 250
    # Of these, attitudes kept by how well light explains the grey levels. Half: the same poses;
    # twice: 1.5 times the time.
    by_light: int = 24
    # Most of these that are refined in full. Half and twice: the same poses.
    full: int = 6
    # Points of a silhouette by which directions of the sun are rated. Half and twice: the same
    # poses.
    template_points: int = 100
    # Directions of the sun for which they are rated, 20 degrees apart. Half and twice: the same
    # poses.
    template_suns: int = 100
    # Weight of the mean squared residual of grey levels; twice the share of the silhouette that
    # differs is added to it. Half and twice: the same poses.
    by_light_weight: float = 0.1
    # Finest level of the pyramid at which appearances are compared: half resolution, where noise
    # hardly counts.
    appearance_level: int = 1
    # Least slope of edges that clouds do not have, grey levels per pixel: over dark and over bright
    # parts of the Earth.
    sharp_per_px: tuple[float, float] = (1.5, 4.0)
    # Of a silhouette that leaves the image, assumed shifts of the centre towards the side where it
    # leaves it, in rms radii of the visible part,
    cut_shifts: tuple[float, ...] = (0.3, 0.6)
    # and assumed rms radii, relative to the visible part's.
    cut_sizes: tuple[float, ...] = (1.0, 1.2, 1.4, 1.6)
    # Common share above which two regions are one, and only one is searched.
    same_region: float = 0.8
    # Least area of a region, px: silhouettes of ``side_px`` cannot be told apart below it. Half and
    # twice: the same poses.
    min_area_px: int = 60
    # Least brightness of a target above the median of the image, grey levels: twice the noise of
    # dark pixels. Half and twice: 5 acquired.
    min_contrast: float = 5.0
    # Difference of scores below which poses explain the image about equally well. Half and twice:
    # the same poses.
    ambiguous_score: float = 0.04
    # Rotation below which two poses are one: half the distance of the templates. Half and twice:
    # the same poses.
    distinct_rad: float = math.radians(8.0)
    # Once a pose has been found, coarse poses are not refined whose score is lower than its own by
    # this.
    worse_start: float = 0.2
    # Attitudes that are rated in one step: as many as its expected CPU time below allows.
    rated_at_once: int = 25
    # Places at which silhouettes are compared in one step, likewise.
    fitted_at_once: int = 9
    # Pixels by which a region's place is computed; more change it by less than a pixel. Half and
    # twice: 5 acquired, in the same time.
    region_points: int = 10_000
    # Expected CPU time, ms, to find the region of the target. Measured, as the following three.
    region_ms: float = 10.0
    # Expected CPU time, ms, to compare the region with the silhouettes at ``fitted_at_once``
    # places.
    silhouettes_ms: float = 20.0
    # Expected CPU time, ms, to rate suns for ``rated_at_once`` attitudes.
    rate_ms: float = 10.0
    # Expected CPU time, ms, to compare a synthetic view with the image.
    appearance_ms: float = 10.0


_SEARCH = AcquisitionParameters()

MIN_APPEARANCE = 0.85
"""Gate of an acquisition: least correlation of the synthetic view with the image."""

Found = tuple[Alignment, Lighting]
"""A pose that passes the gate, and its light."""


@dataclass(frozen=True)
class _Templates:
    """n views of the mesh, normalized to one size.

    ``rotations`` (n, 3, 3): TRF to camera. ``masks`` (n, pixels): silhouettes, float32. ``owners``
    (n, pixels): triangles, -1 for none. ``spread`` (n,): rms radius of each silhouette, and
    ``centre`` (n, 2): its centre, in tangents of angles. ``distance_m``: of the views.
    """

    rotations: Array
    masks: NDArray[np.float32]
    owners: NDArray[np.int16]
    spread: Array
    centre: Array
    distance_m: float


@dataclass(frozen=True)
class _SilhouetteFit:
    """A region of the image compared with n templates.

    ``middle`` (2,), ``spread``: assumed centre and rms radius, tangents of angles. ``mask``,
    ``grey`` (pixels,): the region on the grid of the templates. ``overlap`` (n,): common share of
    both silhouettes, 0 to 1.
    """

    middle: Array
    spread: float
    mask: NDArray[np.float32]
    grey: Array
    overlap: Array


def spread_rotations(n: int) -> Array:
    """Return ``n`` quaternions (n, 4) spread evenly over all rotations: super-Fibonacci spirals (M.
    Alexa, CVPR 2022).
    """
    s = np.arange(n) + 0.5
    r, big = np.sqrt(s / n), np.sqrt(1.0 - s / n)
    a, b = 2.0 * math.pi * s / math.sqrt(2.0), 2.0 * math.pi * s / 1.533751168755204288118041
    return np.stack([r * np.sin(a), r * np.cos(a), big * np.sin(b), big * np.cos(b)], axis=1)


class Acquisition:
    """Search for one target in the images of one camera.

    The templates are rendered when they are first needed.
    """

    def __init__(self, camera: Camera, mesh: TrackerMesh) -> None:
        self._camera, self._mesh = camera, mesh
        self._templates: tuple[_Templates, ...] = ()
        # Templates are compared without cast shadows.
        towards = spread_directions(_SEARCH.template_suns)
        self._suns = ShadowMaps(
            towards,
            np.zeros((_SEARCH.template_suns, 12)),
            np.zeros((_SEARCH.template_suns, 0, 0), np.float32),
        )

    def prepare(self) -> None:
        """Render the templates unless that has been done; takes about two seconds."""
        if not self._templates:
            self._templates = tuple(
                _make_templates(self._mesh, radii) for radii in _SEARCH.distances_radii
            )

    def find(self, image: NDArray[np.uint8]) -> tuple[Found, ...]:
        """Return the alignments that pass the gate with their light, best first.

        Several, if they explain the image about equally well.
        """
        return result_of(self.search(Pyramid(image, self._camera)))

    def search(self, pyramid: Pyramid) -> Steps[tuple[Found, ...]]:
        """Do what `find` does, in steps."""
        yield _SEARCH.region_ms
        level = pyramid.level(0)
        found: tuple[Found, ...] = ()
        bright = _brightest_region(level)
        if bright is None:
            return ()
        # In front of the Earth the brightest region is the Earth itself, which leaves the image.
        behind = _touches_border(bright)
        if not behind:
            found = yield from self._search_in(pyramid, bright)
        searched = [] if behind else [bright]
        for slope in (*_SEARCH.sharp_per_px, *([None] if behind else [])):
            if found:
                break
            yield _SEARCH.region_ms
            region = bright if slope is None else _sharp_region(level, slope)
            if region is None or any(
                _overlap(region, other) > _SEARCH.same_region for other in searched
            ):
                continue
            searched.append(region)
            found = yield from self._search_in(pyramid, region)
        return found

    def _search_in(
        self, pyramid: Pyramid, region: NDArray[np.uint8] | None
    ) -> Steps[tuple[Found, ...]]:
        """Do what `search` does, for a target that covers ``region`` (h, w)."""
        if region is None:
            return ()
        candidates = yield from self._candidates(pyramid, region)

        coarse: list[Alignment] = []
        for pose in candidates:
            levels = levels_of(pyramid, self._mesh, pose)
            if not levels:
                continue
            light = yield from light_steps(pyramid, self._mesh, pose, levels[0])
            if light is not None:
                aligned = yield from pose_steps(pyramid, self._mesh, pose, light, levels[:1])
                coarse += [aligned] if aligned is not None else []

        coarse.sort(key=lambda a: -a.score)
        fine: list[Found] = []
        tried: list[PoseInCamera] = []
        least = 0.0
        for start in coarse:
            if len(tried) == _SEARCH.full or start.score < least:
                break
            if any(turn_between(start.pose, other) < _SEARCH.distinct_rad for other in tried):
                continue
            tried.append(start.pose)
            refined = yield from rough_prior_steps(pyramid, self._mesh, start.pose)
            if refined is None or not is_valid(refined[0]):
                continue
            if any(turn_between(refined[0].pose, a.pose) < _SEARCH.distinct_rad for a, _ in fine):
                continue
            yield _SEARCH.appearance_ms
            if self._looks_right(pyramid, *refined):
                least = max(least, start.score - _SEARCH.worse_start)
                fine.append(refined)

        fine.sort(key=lambda found: -found[0].score)
        return tuple(f for f in fine if f[0].score > fine[0][0].score - _SEARCH.ambiguous_score)

    def _looks_right(self, pyramid: Pyramid, found: Alignment, light: Lighting) -> bool:
        levels = levels_of(pyramid, self._mesh, found.pose)
        level = next((k for k in levels[::-1] if k >= _SEARCH.appearance_level), levels[0])
        return appearance(pyramid, self._mesh, found.pose, level, light) >= MIN_APPEARANCE

    def _candidates(self, pyramid: Pyramid, region: NDArray[np.uint8]) -> Steps[list[PoseInCamera]]:
        """Return coarse poses of a target that covers ``region`` (h, w), the most likely first."""
        yield _SEARCH.silhouettes_ms
        self.prepare()
        camera = self._camera
        y, x = np.nonzero(region)
        y, x = (axis[:: max(1, len(axis) // _SEARCH.region_points)] for axis in (y, x))
        px = camera.undistort(np.column_stack([x, y]).astype(float))
        ideal = (px - (camera.cx_px, camera.cy_px)) / (camera.fx_px, camera.fy_px)
        ideal = ideal[np.isfinite(ideal).all(axis=1)]
        # Work in the axes of a camera that looks at the centre of the region.
        centre = np.append(ideal.mean(axis=0), 1.0)
        towards = _look_at(centre)
        rays = np.column_stack([ideal, np.ones(len(ideal))]) @ towards.T
        flat = rays[:, :2] / rays[:, 2:]
        middle = flat.mean(axis=0)
        spread = math.sqrt(float(((flat - middle) ** 2).sum(axis=1).mean()))
        t = self._templates_at(spread)
        places = self._places(region, towards, middle, spread)
        fits: list[_SilhouetteFit] = []
        for first in range(0, len(places), _SEARCH.fitted_at_once):
            if first:
                yield _SEARCH.silhouettes_ms
            fits += self._fits(
                t, pyramid, region, towards, places[first : first + _SEARCH.fitted_at_once]
            )
        overlaps = np.array([fit.overlap for fit in fits])
        chosen = overlaps.argmax(axis=0)
        likely = np.argsort(-overlaps.max(axis=0))[: _SEARCH.by_silhouette]
        errors: list[float] = []
        for some in np.array_split(likely, _SEARCH.by_silhouette // _SEARCH.rated_at_once):
            yield _SEARCH.rate_ms
            errors += [self._unexplained(t, int(i), fits[chosen[i]]) for i in some]
        poses = []
        for i in likely[np.argsort(errors)[: _SEARCH.by_light]]:
            fit = fits[chosen[i]]
            # The same silhouette seen from another distance: sizes are inversely proportional to
            # it.
            ratio = t.spread[i] / fit.spread
            aside = fit.middle - t.centre[i] / ratio
            position = t.distance_m * ratio * np.append(aside, 1.0)
            poses.append(PoseInCamera(towards.T @ position, towards.T @ t.rotations[i]))
        return poses

    def _templates_at(self, spread: float) -> _Templates:
        """Return the templates for a silhouette of this rms radius, the tangent of an angle."""
        far, near = self._templates
        distance_m = far.distance_m * float(np.median(far.spread)) / spread
        return near if distance_m < _SEARCH.near_radii * self._mesh.radius_m else far

    def _places(
        self, region: NDArray[np.uint8], towards: Array, middle: Array, spread: float
    ) -> list[tuple[Array, float]]:
        """Return possible centres (2,) and rms radii of the target's silhouette that a region
        shows.

        One for a region within the image; several for one that leaves it, as the hidden part is
        assumed.
        """
        if not _touches_border(region):
            return [(middle, spread)]
        centres = [middle]
        for side in _border_sides(region):
            outwards = (towards @ np.append(side, 0.0))[:2]
            centres += [middle + shift * spread * outwards for shift in _SEARCH.cut_shifts]
        return [(centre, size * spread) for centre in centres for size in _SEARCH.cut_sizes]

    def _fits(
        self, t: _Templates, pyramid: Pyramid, region: NDArray[np.uint8], towards: Array,
        places: list[tuple[Array, float]],
    ) -> list[_SilhouetteFit]:  # fmt: skip
        """Compare a region with the silhouettes, inside the image, for each of ``places``.

        A place is the centre (2,) and the rms radius of the silhouette, tangents of angles.
        """
        seen = [self._normalized(pyramid, region, towards, *place) for place in places]
        masks = np.array([mask for mask, _, _ in seen])
        # One matrix product for all places, as reading the templates takes the most time.
        product = t.masks @ np.concatenate([masks, [visible for _, _, visible in seen]]).T
        common, inside = product[:, : len(places)].T, product[:, len(places) :].T
        overlaps = common / np.maximum(inside + masks.sum(axis=1, keepdims=True) - common, 1.0)
        return [
            _SilhouetteFit(middle, spread, mask, grey, overlap)
            for (middle, spread), (mask, grey, _), overlap in zip(
                places, seen, overlaps, strict=True
            )
        ]

    def _normalized(
        self,
        pyramid: Pyramid,
        region: NDArray[np.uint8],
        towards: Array,
        middle: Array,
        spread: float,
    ) -> tuple[NDArray[np.float32], Array, NDArray[np.float32]]:
        """Return the region, the image and the inside of the image on the grid of the templates.

        Each (pixels,): mask, grey levels, mask.
        """
        step = spread / _SEARCH.spread_px
        axis = (np.arange(_SEARCH.side_px) - (_SEARCH.side_px - 1) / 2.0) * step
        u, v = np.meshgrid(axis + middle[0], axis + middle[1])
        rays = np.stack([u, v, np.ones_like(u)], axis=-1) @ towards
        px = self._camera.project(rays).astype(np.float32)
        # Use the level whose pixels have about the area of a pixel of the template.
        level = max(0, min(4, int(math.log2(max(step * self._camera.fx_px, 1.0)))))
        scale = 0.5**level
        at = (px + 0.5) * scale - 0.5
        grid = pyramid.level(level)
        grey = cv2.remap(grid, at[..., 0], at[..., 1], cv2.INTER_LINEAR)
        soft = cv2.resize(
            255 * region, (grid.shape[1], grid.shape[0]), interpolation=cv2.INTER_AREA
        )
        mask = cv2.remap(soft, at[..., 0], at[..., 1], cv2.INTER_LINEAR) > 127
        last = np.array([region.shape[1] - 1, region.shape[0] - 1])
        visible = ((px >= 0.0) & (px <= last)).all(axis=-1)
        return (
            (mask & visible).ravel().astype(np.float32),
            np.asarray(grey, dtype=float).ravel(),
            visible.ravel().astype(np.float32),
        )

    def _unexplained(self, t: _Templates, i: int, fit: _SilhouetteFit) -> float:
        """Return the error of a template: grey levels that no light explains, plus differing
        silhouette.
        """
        inside = np.flatnonzero((t.owners[i] >= 0) & (fit.mask > 0.0))
        inside = inside[:: max(1, len(inside) // _SEARCH.template_points)]
        if len(inside) < 30:
            return math.inf
        owners, nowhere = t.owners[i][inside], np.zeros((len(inside), 3))
        points = points_on(
            self._mesh, owners, nowhere, -t.rotations[i][2], fit.grey[inside], t.rotations[i]
        )
        return float(rate_suns(points, self._suns)[:, 0].min()) * _SEARCH.by_light_weight + 2.0 * (
            1.0 - fit.overlap[i]
        )


def _brightest_region(image: NDArray[np.float32]) -> NDArray[np.uint8] | None:
    """Return the mask (h, w) of the largest connected region brighter than the background,
    or None.
    """
    level = float(np.median(image)) + _SEARCH.min_contrast
    smooth = cv2.GaussianBlur(image, (0, 0), 1.0)
    bright = cv2.morphologyEx(
        (smooth > level).astype(np.uint8), cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)
    )
    return _largest_region(bright)


def _border_sides(region: NDArray[np.uint8]) -> list[tuple[float, float]]:
    """Return the directions (right, down) of the image's sides that a mask (h, w) reaches.

    Includes the corner between two reached sides.
    """
    edges = (region[:, 0], region[:, -1], region[0], region[-1])
    sides = ((-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0))
    reached = [side for side, edge in zip(sides, edges, strict=True) if edge.any()]
    across, along = ([side for side in reached if side[k] != 0.0] for k in (0, 1))
    return reached + [(0.7 * a[0], 0.7 * b[1]) for a in across for b in along]


def _touches_border(region: NDArray[np.uint8]) -> bool:
    """Return whether a mask (h, w) reaches the border of the image."""
    return bool(_border_sides(region))


def _overlap(a: NDArray[np.uint8], b: NDArray[np.uint8]) -> float:
    """Return the common share of two masks (h, w), 0 to 1."""
    return float(np.count_nonzero(a & b)) / max(float(np.count_nonzero(a | b)), 1.0)


def _largest_region(mask: NDArray[Any]) -> NDArray[np.uint8] | None:
    """Return the largest connected region of a mask (h, w), as a mask; None if it is too small."""
    count, labels, statistics, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    if count < 2:
        return None
    largest = 1 + int(np.argmax(statistics[1:, cv2.CC_STAT_AREA]))
    if statistics[largest, cv2.CC_STAT_AREA] < _SEARCH.min_area_px:
        return None
    return (labels == largest).astype(np.uint8)


def _sharp_region(image: NDArray[np.float32], slope: float) -> NDArray[np.uint8] | None:
    """Return the mask (h, w) of the largest region within sharp edges, or None.

    ``slope``: least slope of an edge, grey levels per pixel. The Earth has no sharp edges but its
    limb, which is a thin line.
    """
    smooth = cv2.GaussianBlur(image, (0, 0), 1.2)
    gx, gy = (
        cv2.Sobel(smooth, cv2.CV_32F, 1, 0, scale=0.125),
        cv2.Sobel(smooth, cv2.CV_32F, 0, 1, scale=0.125),
    )
    edges = (cv2.magnitude(gx, gy) > slope).astype(np.uint8)
    closed = cv2.morphologyEx(
        edges, cv2.MORPH_CLOSE, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (11, 11))
    )
    outlines, _ = cv2.findContours(closed, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    filled = np.zeros_like(edges)
    cv2.drawContours(filled, outlines, -1, 1, cv2.FILLED)
    opened = cv2.morphologyEx(
        filled, cv2.MORPH_OPEN, cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (7, 7))
    )
    # Edges are found up to a pixel outside of the target: shrink by one.
    return _largest_region(cv2.erode(opened, np.ones((3, 3), np.uint8)))


def _look_at(ray: Array) -> Array:
    """Return the rotation (3, 3) from IRF to axes whose z points along ``ray``, of smallest
    angle.
    """
    z = ray / np.linalg.norm(ray)
    axis = np.cross(z, [0.0, 0.0, 1.0])
    sine = float(np.linalg.norm(axis))
    angle = math.atan2(sine, float(z[2]))
    return rotations.to_matrix(rotations.exp(axis * (angle / sine if sine > 1e-12 else 0.0)))


def _make_templates(mesh: TrackerMesh, radii: float) -> _Templates:
    quaternions = spread_rotations(_SEARCH.templates)
    distance = radii * mesh.radius_m
    light = Lighting(np.array([0.0, 0.0, -1.0]), shadows=False)
    masks = np.zeros((_SEARCH.templates, _SEARCH.side_px**2), dtype=np.float32)
    owners = np.full((_SEARCH.templates, _SEARCH.side_px**2), -1, dtype=np.int16)

    turns, spread, centre = (
        np.empty((_SEARCH.templates, 3, 3)),
        np.empty(_SEARCH.templates),
        np.empty((_SEARCH.templates, 2)),
    )
    middle, whole = (_SEARCH.side_px - 1) / 2.0, 0.45 * _SEARCH.side_px * math.sqrt(radii**2 - 1.0)

    for i, q in enumerate(quaternions):
        pose = PoseInCamera(np.array([0.0, 0.0, distance]), rotations.to_matrix(q))
        view = render(
            mesh,
            pose,
            PixelWindow(_SEARCH.side_px, _SEARCH.side_px, (whole, whole, middle, middle)),
            light,
        )
        y, x = np.nonzero(view.coverage > 0.5)
        flat = np.column_stack([x - middle, y - middle]) / whole
        centre[i] = flat.mean(axis=0)
        spread[i] = math.sqrt(float(((flat - centre[i]) ** 2).sum(axis=1).mean()))

        # Render the view again, centred and scaled to the common size.
        focal = _SEARCH.spread_px / spread[i]
        lens = (focal, focal, middle - focal * centre[i, 0], middle - focal * centre[i, 1])
        view = render(
            mesh, pose, PixelWindow(_SEARCH.side_px, _SEARCH.side_px, lens), light, samples=1
        )
        masks[i], owners[i], turns[i] = view.coverage.ravel(), view.owner.ravel(), pose.rotation
    return _Templates(turns, masks, owners, spread, centre, distance)
