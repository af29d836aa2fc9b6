"""Corners of markers from lines fitted to their sides, in undistorted coordinates.

Contours and corner filters put the corners of a black square inwards of where they are; the centroid of the
grey level's gradient across a side does not. In the distorted picture a side is a curve, so samples are laid
out on ideal pixels and looked up where the lens puts them.

Where the white border is only a few pixels wide, blur mixes the side with the border's outer edge and draws
the centroid inwards (0.2 px at 1.5 px of border). There the profile of a blurred strip of known width is
fitted instead.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from chaserdock_protocol.camera import Camera
from chaserdock_protocol.rotations import Array
from numpy.typing import NDArray


@dataclass(frozen=True)
class _Pass:
    rows: int  # samples along a side
    taps: int  # samples across it
    reach_px: float  # half length across, at most
    reweighted: int  # times that outlying rows are given less weight


_PASSES = (_Pass(8, 11, 3.5, 1), _Pass(20, 13, 2.75, 2))
# The ends of a side are left out: there the neighbouring side's gradient leaks in.
_FIRST, _LAST = 0.1, 0.9
# Reach across a side is also bounded by this share of a cell, but is never less than so many pixels.
_REACH_CELLS, _REACH_LEAST_PX = 0.45, 1.25
_MIN_CONTRAST = 8.0  # grey levels over the side, for a row to count
_MIN_ROWS_SHARE = 0.4
_MAX_MOVE_PX = 4.0

# Strips: borders narrower than this; sigma of an edge (pixel, lens and sampling together) and, as a standard
# deviation of its logarithm, how well that is known; samples beyond the outer edge; Gauss-Newton steps.
_STRIP_PX = 4.0
_EDGE_SIGMA_PX, _EDGE_SIGMA_SPREAD = 0.75, 0.15
_STRIP_BEYOND_PX = 0.8
_STRIP_ROWS, _STRIP_TAPS, _STRIP_STEPS = 20, 15, 4
# Corners of markers with cells or borders of few pixels are less certain: relative sigma
# sqrt(1 + (this / width)^2), from the errors found in rendered pictures.
_UNCERTAIN_PX = 2.0


@dataclass(frozen=True)
class Refined:
    """``corners_px`` (n, 4, 2), ideal pixels; ``good`` (n,): markers with four good sides (the corners of the
    others are as they were); ``relative_sigma`` (n,): uncertainty against that of a large marker's, 1 or more.
    """

    corners_px: Array
    good: NDArray[np.bool_]
    relative_sigma: Array


@dataclass(frozen=True)
class _Sides:
    """Sides of n quads: ``start`` (n, 4, 2), ``vector`` to the end, unit ``normal`` outwards, and ``extent``
    (n, 4): size of the quad across each side, pixels."""

    start: Array
    vector: Array
    normal: Array
    extent: Array

    def one_by_one(self, quad: NDArray[np.intp], side: NDArray[np.intp]) -> _Sides:
        """Chosen sides (k,), each as if it were the only one (k, 1) of its quad."""
        chosen = (quad, side)
        start, vector = self.start[chosen][:, None], self.vector[chosen][:, None]
        return _Sides(start, vector, self.normal[chosen][:, None], self.extent[chosen][:, None])


def refine(
    image: NDArray[np.uint8], camera: Camera, corners_ideal_px: Array, cells: int, margin_share: Array
) -> Refined:
    """Corners from lines fitted along the sides of the black squares.

    ``image``: the grey picture as taken, distorted. ``corners_ideal_px`` (n, 4, 2), ideal pixels: where they
    are to within two pixels or so, clockwise as seen. ``cells``: number of cells along a side, the black
    border included. ``margin_share`` (n,): width of the white border over the side of the marker.
    """
    corners = np.asarray(corners_ideal_px, dtype=float)
    good = np.ones(len(corners), dtype=bool)
    if not len(corners):
        return Refined(corners.copy(), good, np.ones(0))
    refined = corners
    for settings in _PASSES:
        refined, fitted = _centroid_pass(image, camera, refined, cells, settings)
        good &= fitted
    moved = np.abs(refined - corners).max(axis=(1, 2))
    good &= moved < _MAX_MOVE_PX
    refined = np.where(good[:, None, None], refined, corners)

    sides = _sides(refined)
    width = sides.extent * margin_share[:, None]
    quad, side = np.nonzero((width < _STRIP_PX) & good[:, None])
    if len(quad):
        shift = np.zeros_like(width)
        shift[quad, side] = _strip_shift(
            image, camera, sides.one_by_one(quad, side), cells, width[quad, side]
        )
        refined, crossing = _corners_of(sides, shift, shift, good)
        good &= crossing
    finest = sides.extent.min(axis=1) * np.minimum(margin_share, 1.0 / cells)
    sigma = np.sqrt(1.0 + (_UNCERTAIN_PX / np.maximum(finest, 0.1)) ** 2)
    return Refined(refined, good, sigma)


def _sides(corners: Array) -> _Sides:
    vector = corners[:, (1, 2, 3, 0)] - corners
    length = np.maximum(np.sqrt((vector**2).sum(axis=-1)), 1e-6)
    normal = np.stack([vector[..., 1], -vector[..., 0]], axis=-1) / length[..., None]
    middle = corners.mean(axis=1, keepdims=True)
    extent = 2.0 * np.abs(((corners + 0.5 * vector - middle) * normal).sum(axis=-1))
    return _Sides(corners, vector, normal, extent)


def _profiles(
    image: NDArray[np.uint8], camera: Camera, sides: _Sides, along: Array, across: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Grey levels (n, 4, rows, taps) at ``along`` (rows,) of the sides and ``across`` (n, 4, taps) pixels out
    of them, and which rows (n, 4, rows) lie inside the picture."""
    base = sides.start[:, :, None, :] + along[:, None] * sides.vector[:, :, None, :]
    x = base[..., 0, None] + (sides.normal[..., 0, None] * across)[:, :, None, :]
    y = base[..., 1, None] + (sides.normal[..., 1, None] * across)[:, :, None, :]
    if camera.distortion:
        px = camera.distort(np.stack([x, y], axis=-1))
        x, y = px[..., 0], px[..., 1]
    height, width = image.shape
    # Rows are straight enough for their ends to tell.
    ends_x, ends_y = x[..., (0, -1)], y[..., (0, -1)]
    inside = ((ends_x >= 0) & (ends_x <= width - 1) & (ends_y >= 0) & (ends_y <= height - 1)).all(axis=-1)
    flat = (-1, across.shape[-1])
    levels = cv2.remap(
        image,
        x.reshape(flat).astype(np.float32),
        y.reshape(flat).astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    )
    return np.asarray(levels).astype(float).reshape(x.shape), inside


def _centroid_pass(
    image: NDArray[np.uint8], camera: Camera, corners: Array, cells: int, settings: _Pass
) -> tuple[Array, NDArray[np.bool_]]:
    sides = _sides(corners)
    along = np.linspace(_FIRST, _LAST, settings.rows)
    taps = np.linspace(-1.0, 1.0, settings.taps)
    reach = np.clip(_REACH_CELLS / cells * sides.extent, _REACH_LEAST_PX, settings.reach_px)
    levels, inside = _profiles(image, camera, sides, along, taps * reach[..., None])
    rise = np.maximum(levels[..., 1:] - levels[..., :-1], 0.0)
    total = rise.sum(axis=-1)
    offset = (rise @ (0.5 * (taps[1:] + taps[:-1]))) / np.maximum(total, 1e-6) * reach[..., None]
    usable = (inside & (total > _MIN_CONTRAST)).astype(float)
    enough = usable.sum(axis=-1) >= _MIN_ROWS_SHARE * settings.rows

    along = along - 0.5
    weight = usable
    level, slope = _fit_lines(along, offset, weight)
    for _ in range(settings.reweighted):
        residual = np.abs(offset - level[..., None] - slope[..., None] * along)
        scale = np.maximum(1.4826 * _masked_median(residual, usable), 0.02)
        weight = usable * np.maximum(1.0 - (residual / (4.0 * scale[..., None])) ** 2, 0.0) ** 2  # Tukey
        level, slope = _fit_lines(along, offset, weight)
    return _corners_of(sides, level - 0.5 * slope, level + 0.5 * slope, np.all(enough, axis=1))


def _strip_shift(
    image: NDArray[np.uint8], camera: Camera, sides: _Sides, cells: int, border_px: Array
) -> Array:
    """How far out (k,) sides (k, 1) have to be moved, from the profile of a blurred strip of known width.

    Model: b + a Phi((s - e) / sigma) - d Phi((s - e - m) / sigma), with Phi the normal distribution function
    and m the border's width; b, a, d, e by least squares, sigma with a prior.
    """
    width = border_px[:, None, None]  # m
    inner = np.clip(_REACH_CELLS / cells * sides.extent, _REACH_LEAST_PX, _PASSES[-1].reach_px)
    outer = np.minimum(width[..., 0] + _STRIP_BEYOND_PX, _PASSES[-1].reach_px)
    s = (outer + inner)[..., None] * np.linspace(0.0, 1.0, _STRIP_TAPS) - inner[..., None]
    along = np.linspace(_FIRST, _LAST, _STRIP_ROWS)
    levels, inside = _profiles(image, camera, sides, along, s)
    weight = inside.astype(float) / np.maximum(inside.sum(axis=-1, keepdims=True), 1)
    profile = (weight[:, :, None, :] @ levels)[:, :, 0, :]

    shift = np.zeros_like(inner)  # e
    log_sigma = np.full_like(inner, np.log(_EDGE_SIGMA_PX))
    # Levels are weighed as if they had an error of 2: sets the prior of sigma against the data.
    prior = (2.0 / _EDGE_SIGMA_SPREAD) ** 2
    ridge = 1e-6 * np.eye(5)
    for _ in range(_STRIP_STEPS):
        sigma = np.exp(log_sigma)[..., None]
        z1 = (s - shift[..., None]) / sigma
        z2 = z1 - width / sigma
        basis = np.stack([np.ones_like(s), _normal_cdf(z1), -_normal_cdf(z2)], axis=-1)
        turned = np.swapaxes(basis, -1, -2)
        linear = np.linalg.solve(turned @ basis + ridge[:3, :3], turned @ profile[..., None])
        residual = profile - (basis @ linear)[..., 0]
        slope1, slope2 = -linear[..., 1, :] * _normal_pdf(z1), linear[..., 2, :] * _normal_pdf(z2)
        by_shift = (slope1 + slope2) / sigma
        by_log_sigma = slope1 * z1 + slope2 * z2
        jacobian = np.concatenate([basis, by_shift[..., None], by_log_sigma[..., None]], axis=-1)
        turned = np.swapaxes(jacobian, -1, -2)
        normal = turned @ jacobian + ridge
        right = (turned @ residual[..., None])[..., 0]
        normal[..., 4, 4] += prior
        right[..., 4] += prior * (np.log(_EDGE_SIGMA_PX) - log_sigma)
        step = np.linalg.solve(normal, right[..., None])[..., 0]
        shift = np.clip(shift + np.clip(step[..., 3], -0.4, 0.4), -1.0, 1.0)
        log_sigma = log_sigma + np.clip(step[..., 4], -0.2, 0.2)
    return shift[:, 0]


def _normal_pdf(z: Array) -> Array:
    return np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi)


def _normal_cdf(z: Array) -> Array:
    """Normal distribution function, to 1e-7 (Abramowitz and Stegun 26.2.17)."""
    t = 1.0 / (1.0 + 0.2316419 * np.abs(z))
    poly = t * (0.319381530 + t * (-0.356563782 + t * (1.781477937 + t * (-1.821255978 + t * 1.330274429))))
    tail = _normal_pdf(z) * poly
    return np.where(z >= 0.0, 1.0 - tail, tail)


def _fit_lines(along: Array, offset: Array, weight: Array) -> tuple[Array, Array]:
    """Weighted least squares of offset = level + slope * along, over the last axis."""
    s0 = np.maximum(weight.sum(axis=-1), 1e-9)
    mean = (weight @ along) / s0
    centred = along - mean[..., None]
    weighted = weight * centred
    level = (weight * offset).sum(axis=-1) / s0
    slope = (weighted * offset).sum(axis=-1) / np.maximum((weighted * centred).sum(axis=-1), 1e-9)
    return level - slope * mean, slope


def _masked_median(values: Array, mask: Array) -> Array:
    ordered = np.sort(np.where(mask > 0.0, values, np.inf), axis=-1)
    middle = np.minimum(mask.sum(axis=-1).astype(int) // 2, values.shape[-1] - 1)
    found = np.take_along_axis(ordered, middle[..., None], axis=-1)[..., 0]
    return np.where(np.isfinite(found), found, 0.0)


def _corners_of(
    sides: _Sides, at_start: Array, at_end: Array, good: NDArray[np.bool_]
) -> tuple[Array, NDArray[np.bool_]]:
    """Corners (n, 4, 2) where neighbouring sides cross once moved outwards by ``at_start`` and ``at_end``
    (n, 4) pixels at their ends; as they were where not ``good``, or where sides are nearly parallel."""
    low = sides.start + sides.normal * at_start[..., None]
    vector = sides.vector + sides.normal * (at_end - at_start)[..., None]
    before = (3, 0, 1, 2)
    da, gap = vector[:, before], low - low[:, before]
    cross = da[..., 0] * vector[..., 1] - da[..., 1] * vector[..., 0]
    lengths = np.sqrt((da**2).sum(axis=-1) * (vector**2).sum(axis=-1))
    crossing = np.abs(cross) > 0.05 * lengths
    t = (gap[..., 0] * vector[..., 1] - gap[..., 1] * vector[..., 0]) / np.where(crossing, cross, 1.0)
    points = low[:, before] + t[..., None] * da
    good = good & np.all(crossing, axis=1) & np.all(np.isfinite(points), axis=(1, 2))
    return np.where(good[:, None, None], points, sides.start), good
