# SPDX-License-Identifier: Apache-2.0
"""Find ellipses in grey images: the rims of rings, nozzles and other circles on a target.

Smooth arcs of edges propose ellipses; one is kept if edges run along most of its circumference,
across the direction of the grey levels' gradient, and fit it closely.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_protocol.messages import MAX_ELLIPSES
from numpy.typing import NDArray


@dataclass(frozen=True)
class EllipseTuning:
    """Numbers of the search, with units and reasons."""

    blur_px: float = 1.2
    """Standard deviation of the smoothing before edges are sought: a crinkle of foil is as wide."""
    weak: float = 20.0
    strong: float = 50.0
    """Gradients of Canny's hysteresis in the equalized image, grey levels a pixel by Sobel: a dark
    ring on foil in shadow has 60."""
    chord_px: int = 7
    """Half the length over which the direction of an edge is taken."""
    corner_rad: float = 0.6
    """Turn within twice ``chord_px`` at which an edge is cut: a circle of 12 px radius turns so."""
    least_arc: int = 24
    """Points of an arc that may propose an ellipse: a third of a circle of 12 px radius."""
    most_arcs: int = 120
    """Arcs that are tried, the longest: bounds the time."""
    axes_px: tuple[float, float] = (8.0, 220.0)
    """Half axes: the shorter must not be shorter, the longer not longer than this. 8 px are 4 cm at
    2 m in an image of 960 px and 60 degrees."""
    near_px: float = 1.6
    """Edges so far from an ellipse belong to it: two standard deviations of an edge on facets."""
    across: float = 0.9
    """Least cosine between the gradient and the normal of the ellipse."""
    sectors: int = 36
    """Parts of the circumference that have an edge or not."""
    coverage: float = 0.6
    """Least share of parts that have one: a nozzle or its shadow hides a third of a ring."""
    residual_px: float = 0.9
    """Greatest RMS distance of the edges."""
    same_px: float = 3.0
    """Ellipses whose centres and half axes differ by less are one."""


@dataclass(frozen=True, eq=False)
class ImageEllipses:
    """Ellipses of an image, ideal pixels: ``centres_px`` (n, 2), ``axes_px`` (n, 2), half axes, the
    longer one first, ``angles_rad`` (n,) from +x to the longer one, and the share of their
    circumference that has an edge, ``coverage`` (n,).
    """

    centres_px: Array
    axes_px: Array
    angles_rad: Array
    coverage: Array

    def rows(self) -> Array:
        """Return the six numbers of each ellipse (n, 6), in the order above."""
        return np.column_stack([self.centres_px, self.axes_px, self.angles_rad, self.coverage])


def region_around(camera: Camera, px: Array) -> tuple[int, int, int, int]:
    """Return left, top, right and bottom, px, of the part of an image around ideal pixels (n, 2) of
    the target's points: an edge has none, and is near others.
    """
    if not len(px):
        return 0, 0, 0, 0
    at, size = camera.distort(px), (camera.width_px, camera.height_px)
    left, top = np.maximum(at.min(axis=0) - _MARGIN_PX, 0.0)
    right, bottom = np.minimum(at.max(axis=0) + _MARGIN_PX, size)
    return int(left), int(top), int(right), int(bottom)


_MARGIN_PX = 60
"""Margin around the target's points: a nozzle of 15 cm at 2 m that shows no corner."""


def find_ellipses(
    image: NDArray[np.uint8],
    camera: Camera,
    region: tuple[int, int, int, int],
    tuning: EllipseTuning | None = None,
) -> ImageEllipses:
    """Return the ellipses in a part of a grey image (h, w); ``region``: left, top, right, bottom,
    px. Equal images give equal ellipses.
    """
    tuning = tuning or EllipseTuning()
    left, top, right, bottom = region
    part = np.ascontiguousarray(image[top:bottom, left:right])
    if min(part.shape, default=0) < 2 * tuning.axes_px[0]:
        return _none()
    part = cv2.createCLAHE(3.0, (4, 4)).apply(part)
    smooth = cv2.GaussianBlur(part, (0, 0), tuning.blur_px)
    dx, dy = (cv2.Sobel(smooth, cv2.CV_16S, i, 1 - i) for i in (1, 0))
    edges = np.asarray(
        cv2.Canny(dx, dy, tuning.weak, tuning.strong, L2gradient=True), dtype=np.uint8
    )
    rows, columns = np.nonzero(edges)
    if len(rows) < tuning.least_arc:
        return _none()
    normals = np.column_stack([dx[rows, columns], dy[rows, columns]]).astype(float)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    distorted = np.column_stack([columns + left, rows + top]).astype(float)
    points = camera.undistort(distorted)
    found: list[tuple[float, ...]] = []
    for arc in arcs_of(edges, tuning)[: tuning.most_arcs]:
        at = camera.undistort(arc + np.array([left, top]))
        if any(_explains(e, at, tuning) for e in found):
            continue
        started = _fitted(at, tuning)
        if started is not None and (grown := _grown(started, points, normals, tuning)) is not None:
            found.append(grown)
    found.sort(key=lambda e: (-e[5], *e))
    kept: list[tuple[float, ...]] = []
    for one in found:
        if all(np.abs(np.subtract(one[:4], k[:4])).max() > tuning.same_px for k in kept):
            kept.append(one)
    rows_ = np.array(kept[:MAX_ELLIPSES]).reshape(-1, 6)
    return ImageEllipses(rows_[:, :2], rows_[:, 2:4], rows_[:, 4], rows_[:, 5])


def _none() -> ImageEllipses:
    return ImageEllipses(np.zeros((0, 2)), np.zeros((0, 2)), np.zeros(0), np.zeros(0))


def arcs_of(edges: NDArray[np.uint8], tuning: EllipseTuning) -> list[Array]:
    """Return the smooth arcs (k, 2), x and y, of an edge image, the longest first."""
    chains, _ = cv2.findContours(edges, cv2.RETR_LIST, cv2.CHAIN_APPROX_NONE)
    arcs: list[Array] = []
    k = tuning.chord_px
    for chain in chains:
        at = chain.reshape(-1, 2).astype(float)
        if len(at) < tuning.least_arc + 2 * k:
            continue
        ahead, behind = np.roll(at, -k, axis=0) - at, at - np.roll(at, k, axis=0)
        turn = np.abs(
            np.arctan2(
                behind[:, 0] * ahead[:, 1] - behind[:, 1] * ahead[:, 0],
                (behind * ahead).sum(axis=1),
            )
        )
        cuts = np.r_[0, np.flatnonzero(turn > tuning.corner_rad), len(at)]
        long = np.flatnonzero(np.diff(cuts) >= tuning.least_arc)
        arcs += [at[cuts[i] : cuts[i + 1]] for i in long.tolist()]
    arcs.sort(key=lambda a: (-len(a), *a[0]))
    return arcs


_Ellipse = tuple[float, float, float, float, float]
"""Centre x and y, half axes, the longer one first, angle of the longer one."""


def _fitted(points: Array, tuning: EllipseTuning) -> _Ellipse | None:
    """Return the ellipse of points (k, 2), None if its axes are not in the limits."""
    (x, y), (width, height), degrees = cv2.fitEllipseDirect(points.astype(np.float32))
    a, b, angle = width / 2.0, height / 2.0, np.deg2rad(degrees)
    if b > a:
        a, b, angle = b, a, angle + np.pi / 2.0
    least, most = tuning.axes_px
    if not (least <= b and a <= most and np.isfinite([x, y, a, b]).all()):
        return None
    return float(x), float(y), float(a), float(b), float(angle % np.pi)


def _offsets(ellipse: _Ellipse, points: Array) -> tuple[Array, Array, Array]:
    """Return distances (k,) of points from an ellipse, to first order, its normals (k, 2) there,
    and eccentric anomalies (k,).
    """
    x, y, a, b, angle = ellipse
    cos, sin = np.cos(angle), np.sin(angle)
    off = points - (x, y)
    u, v = (off[:, 0] * cos + off[:, 1] * sin) / a, (off[:, 1] * cos - off[:, 0] * sin) / b
    slope_u, slope_v = u / a, v / b
    length = np.maximum(np.hypot(slope_u, slope_v), 1e-12)
    distance = (u * u + v * v - 1.0) / (2.0 * length)
    nu, nv = slope_u / length, slope_v / length
    normals = np.column_stack([nu * cos - nv * sin, nu * sin + nv * cos])
    return distance, normals, np.arctan2(v, u)


def _grown(
    start: _Ellipse, points: Array, normals: Array, tuning: EllipseTuning
) -> tuple[float, ...] | None:
    """Return an ellipse by all edges near it, with its coverage; None if they do not confirm it."""
    ellipse = start
    for width_px in (2.0 * tuning.near_px, tuning.near_px):
        near, _, coverage = _near(ellipse, points, normals, width_px, tuning)
        if coverage < 0.5 * tuning.coverage:
            return None
        fitted = _fitted(points[near], tuning)
        if fitted is None:
            return None
        ellipse = fitted
    near, distance, coverage = _near(ellipse, points, normals, tuning.near_px, tuning)
    if coverage < tuning.coverage:
        return None
    if float(np.sqrt(np.mean(distance[near] ** 2))) > tuning.residual_px:
        return None
    return (*ellipse, coverage)


def _near(
    ellipse: _Ellipse, points: Array, normals: Array, width_px: float, tuning: EllipseTuning
) -> tuple[NDArray[np.bool_], Array, float]:
    """Return which edges (k,) run along an ellipse, their distances (k,) and its coverage."""
    distance, across, anomaly = _offsets(ellipse, points)
    near = np.abs(distance) < width_px
    near[near] = np.abs((across[near] * normals[near]).sum(axis=1)) > tuning.across
    return near, distance, _coverage(anomaly[near], tuning)


def _explains(ellipse: tuple[float, ...], arc: Array, tuning: EllipseTuning) -> bool:
    """Return whether an arc (k, 2) is part of an ellipse that was found."""
    x, y, a, b, angle, _ = ellipse
    return float(np.abs(_offsets((x, y, a, b, angle), arc[::_EVERY])[0]).max()) < tuning.near_px


_EVERY = 4
"""Of so many points of an arc one is compared with an ellipse: arcs are smooth."""


def _coverage(anomaly: Array, tuning: EllipseTuning) -> float:
    sector = np.floor((anomaly + np.pi) / (2.0 * np.pi) * tuning.sectors).astype(int)
    return len(np.unique(sector % tuning.sectors)) / tuning.sectors
