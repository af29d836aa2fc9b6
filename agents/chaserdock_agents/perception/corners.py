"""Corners of markers from lines fitted to their sides, in undistorted coordinates.

Contours and corner filters put the corners of a black square inwards of where they are; the centroid of the
grey level's gradient across a side does not. In the distorted picture a side is a curve, so samples are laid
out on ideal pixels and looked up where the lens puts them.

Where the white border is only a few pixels wide, blur mixes the side with the border's outer edge and draws
the centroid inwards (0.2 px at 1.5 px of border). There the profile of a blurred strip of known width is
fitted instead.

Points are complex numbers x + iy here, which halves the number of calls into NumPy: with a handful of
markers in a picture these calls are the cost.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from chaserdock_protocol.camera import Camera
from chaserdock_protocol.rotations import Array
from numpy.typing import NDArray

Points = NDArray[np.complex128]

# The ends of a side are left out: there the neighbouring side's gradient leaks in.
_FIRST, _LAST = 0.1, 0.9


class _Pass:
    """Settings of one pass of centroids, and what follows from them: ``along`` (rows,) places of the rows on
    the side, from -0.5 to 0.5; ``moments`` (3, rows) their powers; ``taps`` (taps,) places across, from -1 to
    1; ``centroid`` (taps - 1, 2): what sums up rises between taps and their first moment."""

    def __init__(self, rows: int, taps: int, reach_px: float, reweighted: int):
        self.rows = rows  # samples along a side
        self.reach_px = reach_px  # half length across, at most
        self.reweighted = reweighted  # times that outlying rows are given less weight
        self.along = np.linspace(_FIRST, _LAST, rows) - 0.5
        self.moments = np.stack([np.ones(rows), self.along, self.along**2])
        self.taps = np.linspace(-1.0, 1.0, taps)
        self.centroid = np.stack([np.ones(taps - 1), 0.5 * (self.taps[1:] + self.taps[:-1])], axis=-1)


_PASSES = (_Pass(8, 11, 3.5, 1), _Pass(20, 13, 2.75, 2))
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
_STRIP_ALONG = np.linspace(_FIRST, _LAST, _STRIP_ROWS) - 0.5
_STRIP_ACROSS = np.linspace(0.0, 1.0, _STRIP_TAPS)
_STRIP_RIDGE = 1e-6 * np.eye(5)
# Corners of markers with cells or borders of few pixels are less certain: relative sigma
# sqrt(1 + (this / width)^2), from the errors found in rendered pictures.
_UNCERTAIN_PX = 2.0

_SQUARE = np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]], dtype=np.float32)
_NEXT, _BEFORE = np.array([1, 2, 3, 0]), np.array([3, 0, 1, 2])


@dataclass(frozen=True)
class Refined:
    """``corners_px`` (n, 4, 2), ideal pixels; ``good`` (n,): markers with four good sides (the corners of the
    others are as they were); ``relative_sigma`` (n,): uncertainty against that of a large marker's, 1 or more.
    """

    corners_px: Array
    good: NDArray[np.bool_]
    relative_sigma: Array

    def with_others(self, which: NDArray[np.bool_], others: Refined) -> Refined:
        """These, with ``others`` in the place of the markers ``which`` (n,)."""
        corners, good, sigma = self.corners_px.copy(), self.good.copy(), self.relative_sigma.copy()
        corners[which], good[which], sigma[which] = others.corners_px, others.good, others.relative_sigma
        return Refined(corners, good, sigma)


def inside_border(corners_px: Array, margin_share: Array) -> Array:
    """Corners (n, 4, 2) of the black squares, where ``corners_px`` are the outer ones of their white borders,
    ``margin_share`` (n,) of the squares' sides wide."""
    inner = [
        cv2.perspectiveTransform(
            _SQUARE[None] / (1.0 + 2.0 * share), cv2.getPerspectiveTransform(_SQUARE, quad.astype(np.float32))
        )[0]
        for quad, share in zip(corners_px, margin_share.tolist(), strict=True)
    ]
    return np.array(inner, dtype=float).reshape(-1, 4, 2)


@dataclass(frozen=True)
class _Sides:
    """Sides, of any shape (...): ``start``, ``vector`` to the end, unit ``normal`` outwards, and ``extent``:
    size of the quad across each side, pixels."""

    start: Points
    vector: Points
    normal: Points
    extent: Array

    def chosen(self, which: NDArray[np.bool_]) -> _Sides:
        """The sides (k,) where ``which`` (...) is true."""
        return _Sides(self.start[which], self.vector[which], self.normal[which], self.extent[which])


def refine(
    image: NDArray[np.uint8], camera: Camera, corners_ideal_px: Array, cells: int, margin_share: Array
) -> Refined:
    """Corners from lines fitted along the sides of the black squares.

    ``image``: the grey picture as taken, distorted. ``corners_ideal_px`` (n, 4, 2), ideal pixels: where they
    are to within two pixels or so, clockwise as seen. ``cells``: number of cells along a side, the black
    border included. ``margin_share`` (n,): width of the white border over the side of the marker.
    """
    given = np.array(corners_ideal_px, dtype=float, order="C")
    if not len(given):
        return Refined(given, np.ones(0, dtype=bool), np.ones(0))
    corners = given.view(np.complex128)[..., 0]
    refined, good = corners, np.ones(len(corners), dtype=bool)
    for settings in _PASSES:
        refined, fitted = _centroid_pass(image, camera, refined, cells, settings)
        good &= fitted
    moved = refined - corners
    good &= np.maximum(np.abs(moved.real), np.abs(moved.imag)).max(axis=1) < _MAX_MOVE_PX
    refined = np.where(good[:, None], refined, corners)

    sides = _sides(refined)
    width = sides.extent * margin_share[:, None]
    narrow = (width < _STRIP_PX) & good[:, None]
    if narrow.any():
        shift = np.zeros_like(width)
        shift[narrow] = _strip_shift(image, camera, sides.chosen(narrow), cells, width[narrow])
        refined, crossing = _corners_of(sides, shift, shift, good)
        good &= crossing
    finest = sides.extent.min(axis=1) * np.minimum(margin_share, 1.0 / cells)
    sigma = np.sqrt(1.0 + (_UNCERTAIN_PX / np.maximum(finest, 0.1)) ** 2)
    return Refined(refined.view(float).reshape(given.shape), good, sigma)


def _sides(corners: Points) -> _Sides:
    vector = corners.take(_NEXT, axis=1) - corners
    normal = vector * -1j
    normal /= np.maximum(np.abs(vector), 1e-6)
    middle = 0.25 * np.add.reduce(corners, axis=1, keepdims=True)
    across = (corners + 0.5 * vector - middle) * normal.conj()
    return _Sides(corners, vector, normal, 2.0 * np.abs(across.real))


def _profiles(
    image: NDArray[np.uint8], camera: Camera, sides: _Sides, along: Array, across: Array
) -> tuple[Array, NDArray[np.bool_]]:
    """Grey levels (k, rows, taps) at ``along`` (rows,) of the sides (k,), -0.5 to 0.5, and ``across`` (k, taps)
    pixels out of them, and which rows (k, rows) lie inside the picture."""
    base = (sides.start + 0.5 * sides.vector)[:, None] + along * sides.vector[:, None]
    at = base[:, :, None] + (sides.normal[:, None] * across)[:, None, :]
    if camera.distortion:
        px = camera.distort(at.view(float).reshape(*at.shape, 2))
        at = px.view(np.complex128)[..., 0]
    height, width = image.shape
    # Rows are straight enough for their ends to tell.
    last = at.shape[2] - 1
    x, y = at.real[..., ::last], at.imag[..., ::last]
    inside = (x >= 0.0) & (x <= width - 1) & (y >= 0.0) & (y <= height - 1)
    return _bilinear(image, at), inside[..., 0] & inside[..., 1]


def _bilinear(image: NDArray[np.uint8], at: Points) -> Array:
    """Grey levels at points x + iy, pixels; beyond the picture those of its border.

    Not cv2.remap: it takes coordinates in steps of 1/32 pixel. The detector's corners are whole pixels, so that many
    points lie just where one step ends, and the last bits of the arithmetic (another SIMD level) would decide.
    """
    height, width = image.shape
    x = np.minimum(np.maximum(at.real, 0.0), width - 1.0)
    y = np.minimum(np.maximum(at.imag, 0.0), height - 1.0)
    column = np.minimum(x.astype(np.intp), width - 2)
    row = np.minimum(y.astype(np.intp), height - 2)
    x -= column
    y -= row
    flat = image.reshape(-1)
    corner = row * width + column
    upper = flat.take(corner) * (1.0 - x) + flat.take(corner + 1) * x
    corner += width
    lower = flat.take(corner) * (1.0 - x) + flat.take(corner + 1) * x
    return upper + (lower - upper) * y


def _reach(sides: _Sides, cells: int, most_px: float) -> Array:
    return np.minimum(np.maximum(_REACH_CELLS / cells * sides.extent, _REACH_LEAST_PX), most_px)


def _centroid_pass(
    image: NDArray[np.uint8], camera: Camera, corners: Points, cells: int, settings: _Pass
) -> tuple[Points, NDArray[np.bool_]]:
    quads = _sides(corners)
    sides = _Sides(quads.start.ravel(), quads.vector.ravel(), quads.normal.ravel(), quads.extent.ravel())
    reach = _reach(sides, cells, settings.reach_px)[:, None]
    levels, inside = _profiles(image, camera, sides, settings.along, settings.taps * reach)
    rise = levels[..., 1:] - levels[..., :-1]
    sums = np.maximum(rise, 0.0, out=rise).reshape(-1, rise.shape[-1]) @ settings.centroid
    total = sums[:, 0].reshape(inside.shape)
    offset = sums[:, 1].reshape(inside.shape) / np.maximum(total, 1e-6) * reach
    usable = inside & (total > _MIN_CONTRAST)
    count = np.add.reduce(usable, axis=1)
    enough = (count >= _MIN_ROWS_SHARE * settings.rows).reshape(corners.shape).all(axis=1)

    level, slope = _fit_lines(settings.moments, offset, usable.astype(float))
    for _ in range(settings.reweighted):
        residual = np.abs(offset - (level[:, None] + slope[:, None] * settings.along))
        scale = np.maximum(1.4826 * _masked_median(residual, usable, count), 0.02)
        weight = np.maximum(1.0 - (residual / (4.0 * scale)[:, None]) ** 2, 0.0) ** 2 * usable  # Tukey
        level, slope = _fit_lines(settings.moments, offset, weight)
    level, half = level.reshape(corners.shape), 0.5 * slope.reshape(corners.shape)
    return _corners_of(quads, level - half, level + half, enough)


def _strip_shift(
    image: NDArray[np.uint8], camera: Camera, sides: _Sides, cells: int, border_px: Array
) -> Array:
    """How far out (k,) sides (k,) have to be moved, from the profile of a blurred strip of known width.

    Model: b + a Phi((s - e) / sigma) - d Phi((s - e - m) / sigma), with Phi the normal distribution function
    and m the border's width; b, a, d, e by least squares, sigma with a prior.
    """
    most = _PASSES[-1].reach_px
    inner = _reach(sides, cells, most)
    outer = np.minimum(border_px + _STRIP_BEYOND_PX, most)
    s = (outer + inner)[:, None] * _STRIP_ACROSS - inner[:, None]
    levels, inside = _profiles(image, camera, sides, _STRIP_ALONG, s)
    weight = inside / np.maximum(np.add.reduce(inside, axis=1), 1)[:, None]
    profile = (weight[:, None, :] @ levels)[:, 0]

    # Distances of the samples from both edges, in pixels where e = 0.
    from_edges = np.stack([s, s - border_px[:, None]], axis=1)
    shift = np.zeros(len(s))  # e
    log_sigma = np.full(len(s), np.log(_EDGE_SIGMA_PX))
    # Levels are weighed as if they had an error of 2: sets the prior of sigma against the data.
    prior = (2.0 / _EDGE_SIGMA_SPREAD) ** 2
    # Rows: 1, Phi at either edge, and the profile less what these explain; the model's derivatives by e and
    # log sigma.
    rows = np.ones((len(s), 6, s.shape[1]))
    basis = rows[:, :3]
    for _ in range(_STRIP_STEPS):
        sigma = np.exp(log_sigma)
        z = (from_edges - shift[:, None, None]) / sigma[:, None, None]
        density = _normal_pdf(z)
        rows[:, 1:3] = _normal_cdf(z, density)
        rows[:, 5] = profile
        products = basis @ rows.swapaxes(1, 2)
        # b, a and -d
        linear = np.linalg.solve(products[..., :3] + _STRIP_RIDGE[:3, :3], products[..., 5:]).swapaxes(1, 2)
        rows[:, 5] -= (linear @ basis)[:, 0]
        heights = -linear[:, :, 1:]
        rows[:, 3] = (heights @ density)[:, 0] / sigma[:, None]
        density *= z
        rows[:, 4] = (heights @ density)[:, 0]
        products = rows[:, :5] @ rows.swapaxes(1, 2)
        normal, right = products[..., :5] + _STRIP_RIDGE, products[..., 5:]
        normal[:, 4, 4] += prior
        right[:, 4, 0] += prior * (np.log(_EDGE_SIGMA_PX) - log_sigma)
        step = np.asarray(np.linalg.solve(normal, right), dtype=float)
        shift = _limited(shift + _limited(step[:, 3, 0], 0.4), 1.0)
        log_sigma = log_sigma + _limited(step[:, 4, 0], 0.2)
    return shift


def _limited(values: Array, most: float) -> Array:
    return np.minimum(np.maximum(values, -most), most)


def _normal_pdf(z: Array) -> Array:
    return np.exp(-0.5 * z * z) * (1.0 / np.sqrt(2.0 * np.pi))


def _normal_cdf(z: Array, density: Array) -> Array:
    """Normal distribution function, to 1e-7 (Abramowitz and Stegun 26.2.17); ``density``: its derivative."""
    t = 1.0 / (1.0 + 0.2316419 * np.abs(z))
    poly = t * 1.330274429
    for coefficient in (-1.821255978, 1.781477937, -0.356563782, 0.319381530):
        poly += coefficient
        poly *= t
    poly *= density
    return np.where(z >= 0.0, 1.0 - poly, poly)


def _fit_lines(moments: Array, offset: Array, weight: Array) -> tuple[Array, Array]:
    """Weighted least squares of offset = level + slope * along, over the last axis; ``moments`` (3, rows): 1,
    along and its square."""
    s0, s1, s2 = moments @ weight.T
    t0, t1 = moments[:2] @ (weight * offset).T
    s0 = np.maximum(s0, 1e-9)
    mean = s1 / s0
    slope = (t1 - mean * t0) / np.maximum(s2 - mean * s1, 1e-9)
    return t0 / s0 - slope * mean, slope


def _masked_median(values: Array, mask: NDArray[np.bool_], count: NDArray[np.intp]) -> Array:
    """Upper median (k,) of ``values`` (k, rows) where ``mask`` is true, ``count`` (k,) times; 0 if nowhere."""
    ordered = np.where(mask, values, np.inf)
    ordered.sort(axis=1)
    return np.where(count > 0, ordered[np.arange(len(count)), count // 2 * (count > 0)], 0.0)


def _corners_of(
    sides: _Sides, at_start: Array, at_end: Array, good: NDArray[np.bool_]
) -> tuple[Points, NDArray[np.bool_]]:
    """Corners (n, 4) where neighbouring sides (n, 4) cross once moved outwards by ``at_start`` and ``at_end``
    (n, 4) pixels at their ends; as they were where not ``good``, or where sides are nearly parallel."""
    low = sides.start + sides.normal * at_start
    vector = sides.vector + sides.normal * (at_end - at_start)
    low_before, before = low.take(_BEFORE, axis=1), vector.take(_BEFORE, axis=1)
    # The imaginary part of conj(a) b is the cross product.
    cross = (before.conj() * vector).imag
    crossing = np.abs(cross) > 0.05 * np.abs(before) * np.abs(vector)
    t = ((low - low_before).conj() * vector).imag / np.where(crossing, cross, 1.0)
    points = low_before + t * before
    good = good & (crossing & np.isfinite(points)).all(axis=1)
    return np.where(good[:, None], points, sides.start), good
