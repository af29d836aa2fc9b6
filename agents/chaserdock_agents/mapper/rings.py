# SPDX-License-Identifier: Apache-2.0
"""Find circles on a mapped target, such as the rim of an apogee nozzle or of an adapter ring, from
the ellipses that cameras see.

Landmarks do not tell a ring: its smooth edges have no corners. An ellipse is the image of two
circles (J. Chen, H. Wu and T. Wada, "Camera calibration with two arbitrary coplanar circles", ECCV
2004), at a distance in proportion to their radius. Two views from different sides give radius and
centre; a circle is found if further views confirm it. Pure functions; TRF, SI units.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from chaserdock_models.arrays import Array, IntArray
from chaserdock_models.camera import Camera
from numpy.typing import NDArray


@dataclass(frozen=True)
class RingTuning:
    """Numbers of the search, with units and reasons."""

    radii_m: tuple[float, float] = (0.03, 0.6)
    """Radii of a ring: below are thrusters and holes, of 12 px at 2 m; above it a ring of a body
    that a chaser of 0.25 m does not dock to by its middle."""
    gap_m: float = 0.015
    """Greatest distance between the lines of sight to the centre of a pair: 3 px at 2 m from each
    camera, and the map's own error."""
    radius_share: float = 0.12
    """Greatest difference between the radii of a pair: 3 px of an axis of 25 px."""
    normal_rad: float = 0.45
    """Greatest angle between the normals of a pair: in a view along the axis 2 px of 50 make it."""
    baseline_rad: float = 0.15
    """Least angle between the lines of sight of a pair: less tells no distance."""
    support_px: float = 1.5
    """Greatest RMS distance between an ellipse and the image of a circle that it confirms."""
    least_images: int = 5
    """Images that must confirm a circle: the two of its pair and three of chance 1 in 100 each."""
    least_spread_rad: float = 0.35
    """Least angle between two of the directions from which it is seen: a shadow, or the corner of
    a box, looks round from one side."""
    edge_m: float = 0.02
    """Circles whose centres and radii differ by less are edges of one ring: 5 px at 2 m, beside
    which an ellipse of one edge passes for the other."""
    most_pairs: int = 2000
    """Pairs that are tried, those whose lines of sight are nearest: bounds time and memory."""
    steps: int = 8
    """Gauss-Newton steps of the adjustment: it converges in three to five."""


@dataclass(frozen=True, eq=False)
class CircleSights:
    """Ellipses of n images of the target: image (n,), optical centres (n, 3), TRF, rotations
    (n, 3, 3), IRF to TRF, centres (n, 2), half axes (n, 2), the longer one first, and angles (n,)
    of the longer one in normalized coordinates, and coverage (n,) by edges.

    ``focal_px``: of the camera. ``images``: number of those that were searched.
    """

    image: IntArray
    origins_m: Array
    rotations: Array
    centres: Array
    axes: Array
    angles_rad: Array
    coverage: Array
    focal_px: float = 1.0
    images: int = 0

    @classmethod
    def none(cls) -> CircleSights:
        """Return what shows no ellipse."""
        return cls(
            np.zeros(0, dtype=np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros((0, 2)),
            np.zeros((0, 2)), np.zeros(0), np.zeros(0),
        )  # fmt: skip

    def samples(self) -> Array:
        """Return directions (n, k, 3), TRF, to points of each ellipse."""
        turn = np.linspace(0.0, 2.0 * np.pi, _SAMPLES, endpoint=False)
        u = self.axes[:, :1] * np.cos(turn)
        v = self.axes[:, 1:] * np.sin(turn)
        cos, sin = np.cos(self.angles_rad)[:, None], np.sin(self.angles_rad)[:, None]
        x = self.centres[:, :1] + u * cos - v * sin
        y = self.centres[:, 1:] + u * sin + v * cos
        return np.einsum("nij,nkj->nki", self.rotations, np.stack([x, y, np.ones_like(x)], axis=2))


_SAMPLES = 16
"""Points of an ellipse that are compared: three times its unknowns."""


@dataclass(frozen=True, eq=False)
class Ring:
    """A circle on the target: centre (3,), outward unit normal (3,), radius; standard deviations of
    the centre and of the normal; RMS distance of the ellipses from its images, px, and in its
    plane, m; the share of its circumference with an edge, mean over the ``images`` that confirm it.
    """

    centre_m: Array
    normal: Array
    radius_m: float
    sigma_m: float
    normal_sigma_rad: float
    residual_px: float
    residual_m: float
    coverage: float
    images: int


def circles_of(centre: Array, axes: Array, angle_rad: float) -> tuple[Array, Array]:
    """Return centres (2, 3) and unit normals (2, 3) of the circles of radius 1 whose image is an
    ellipse, camera axes; normals point to the camera. Normalized coordinates.
    """
    cos, sin = math.cos(angle_rad), math.sin(angle_rad)
    turn = np.array([[cos, sin], [-sin, cos]])
    a = turn.T @ np.diag(1.0 / axes**2) @ turn
    cone = np.zeros((3, 3))
    cone[:2, :2] = a
    cone[:2, 2] = cone[2, :2] = -a @ centre
    cone[2, 2] = float(centre @ a @ centre) - 1.0
    values, vectors = np.linalg.eigh(cone)  # one is negative: that of the cone's axis
    third, second, first = values.tolist()
    axis_1, axis_3 = vectors[:, 2], vectors[:, 0]
    axis_3 = axis_3 if axis_3[2] > 0.0 else -axis_3
    tilt = math.sqrt(max(0.0, (first - second) / (first - third)))
    facing = math.sqrt((second - third) / (first - third))
    depth = math.sqrt(-first / third)
    aside = math.sqrt(-third / first)
    centres = np.array(
        [facing * depth * axis_3 + sign * tilt * aside * axis_1 for sign in (1.0, -1.0)]
    )
    normals = np.array([-facing * axis_3 + sign * tilt * axis_1 for sign in (1.0, -1.0)])
    return centres, normals


class _Circle(NamedTuple):
    """Centre (3,), unit normal (3,) and radius."""

    centre_m: Array
    normal: Array
    radius_m: float

    def moved(self, step: Array) -> _Circle:
        """Return the circle that differs by ``step`` (6,): centre, normal across itself, radius."""
        normal = self.normal + _across(self.normal) @ step[3:5]
        return _Circle(
            self.centre_m + step[:3], normal / np.linalg.norm(normal), self.radius_m + step[5]
        )


def _across(normal: Array) -> Array:
    """Return two unit vectors across a normal, (3, 2)."""
    _, _, v = np.linalg.svd(normal[None])
    return v[1:].T


def find_rings(sights: CircleSights, tuning: RingTuning | None = None) -> tuple[Ring, ...]:
    """Return the circles that several views confirm, those seen most first, one of each ring's
    edges.
    """
    tuning = tuning or RingTuning()
    if len(np.unique(sights.image)) < tuning.least_images:
        return ()
    directions = sights.samples()
    free = np.ones(len(sights.image), dtype=np.bool_)
    candidates = _candidates(sights, tuning)
    off_px = np.zeros((len(candidates), len(free)))
    for k, circle in enumerate(candidates):
        off_px[k] = _rms(_deviations(sights, directions, circle)[0])
    rings: list[Ring] = []
    while len(candidates):
        fits = (off_px < tuning.support_px) & free
        images = np.array([len(np.unique(sights.image[row])) for row in fits])
        if images.max() < tuning.least_images:
            break
        best = int(np.lexsort((np.where(fits, off_px, 0.0).sum(axis=1), -images))[0])
        found, support = _adjusted(sights, directions, candidates[best], free, tuning)
        if found is not None:
            rings.append(found)
        free &= ~(support | fits[best])
    rings.sort(key=lambda r: -r.images * r.coverage)
    kept: list[Ring] = []
    for ring in rings:
        if not any(_is_edge_of(ring, k, tuning) for k in kept):
            kept.append(ring)
    return tuple(kept)


def _is_edge_of(circle: Ring, ring: Ring, tuning: RingTuning) -> bool:
    """Return whether a circle is another edge of a ring, or a mixture of its edges."""
    return (
        float(np.linalg.norm(circle.centre_m - ring.centre_m)) < tuning.edge_m
        and abs(circle.radius_m - ring.radius_m) < tuning.edge_m
        and float(circle.normal @ ring.normal) > math.cos(tuning.normal_rad)
    )


def _candidates(sights: CircleSights, tuning: RingTuning) -> list[_Circle]:
    """Return circles by pairs of ellipses, those whose lines of sight are nearest first."""
    found = [
        circles_of(c, a, float(w))
        for c, a, w in zip(sights.centres, sights.axes, sights.angles_rad, strict=True)
    ]
    turned = np.repeat(sights.rotations, 2, axis=0)
    unit = np.einsum("kij,kj->ki", turned, np.concatenate([f[0] for f in found]))
    normal = np.einsum("kij,kj->ki", turned, np.concatenate([f[1] for f in found]))
    origin, image = np.repeat(sights.origins_m, 2, axis=0), np.repeat(sights.image, 2)
    far = np.linalg.norm(unit, axis=1)
    sight = unit / far[:, None]
    first, second = np.triu_indices(len(image), 1)
    cosine = np.einsum("ki,ki->k", sight[first], sight[second])
    alike = np.einsum("ki,ki->k", normal[first], normal[second])
    kept = (
        (image[first] != image[second])
        & (np.abs(cosine) < math.cos(tuning.baseline_rad))
        & (alike > math.cos(tuning.normal_rad))
    )
    first, second, cosine = first[kept], second[kept], cosine[kept]
    # Nearest points of two lines.
    between = origin[second] - origin[first]
    by_first = np.einsum("ki,ki->k", between, sight[first])
    by_second = np.einsum("ki,ki->k", between, sight[second])
    square = 1.0 - cosine**2
    depth_1 = (by_first - cosine * by_second) / square
    depth_2 = (cosine * by_first - by_second) / square
    at_1 = origin[first] + depth_1[:, None] * sight[first]
    at_2 = origin[second] + depth_2[:, None] * sight[second]
    gap = np.linalg.norm(at_1 - at_2, axis=1)
    radius_1, radius_2 = depth_1 / far[first], depth_2 / far[second]
    radius = 0.5 * (radius_1 + radius_2)
    low, high = tuning.radii_m
    good = (
        (depth_1 > 0.0)
        & (depth_2 > 0.0)
        & (gap < tuning.gap_m)
        & (np.abs(radius_1 - radius_2) < tuning.radius_share * radius)
        & (radius >= low)
        & (radius <= high)
    )
    order = np.flatnonzero(good)[np.argsort(gap[good], kind="stable")][: tuning.most_pairs]
    mean = normal[first[order]] + normal[second[order]]
    mean /= np.linalg.norm(mean, axis=1, keepdims=True)
    middle = 0.5 * (at_1 + at_2)[order]
    return [_Circle(*c) for c in zip(middle, mean, radius[order].tolist(), strict=True)]


def _deviations(sights: CircleSights, directions: Array, circle: _Circle) -> tuple[Array, Array]:
    """Return how far points of the ellipses, seen along ``directions`` (n, k, 3), are from a
    circle: in the image, (n, k), px, infinite from behind, and in its plane, (n, k), m.
    """
    down = directions @ circle.normal
    height = (circle.centre_m - sights.origins_m) @ circle.normal
    with np.errstate(divide="ignore", invalid="ignore"):
        scale = height[:, None] / down
        at = sights.origins_m[:, None] + scale[..., None] * directions - circle.centre_m
        off_m = np.linalg.norm(at, axis=2) - circle.radius_m
        # What a step in the plane is in the image: less, seen from aside.
        length = np.linalg.norm(directions, axis=2)
        px = off_m * np.abs(down) / length * sights.focal_px / np.abs(scale)
    facing = (height < 0.0)[:, None] & (scale > 0.0)
    return np.where(facing, px, np.inf), off_m


def _rms(off: Array) -> Array:
    return np.sqrt(np.mean(off**2, axis=-1))


def _adjusted(
    sights: CircleSights,
    directions: Array,
    start: _Circle,
    free: NDArray[np.bool_],
    tuning: RingTuning,
) -> tuple[Ring | None, NDArray[np.bool_]]:
    """Return the circle adjusted to all ellipses that fit it, and which these are, (n,); None if
    too few do, or from one side only.
    """
    circle, support, covariance = start, free, np.zeros((6, 6))
    for _ in range(tuning.steps):
        off_px = _rms(_deviations(sights, directions, circle)[0])
        support = _one_each(sights.image, off_px, free & (off_px < tuning.support_px))
        if support.sum() < tuning.least_images:
            return None, support
        residuals, jacobian = _linearized(sights, directions, circle, support)
        step = np.asarray(np.linalg.lstsq(jacobian, -residuals, rcond=None)[0], dtype=np.float64)
        # Points of one ellipse err together.
        freedom = int(support.sum()) - 2
        covariance = np.linalg.pinv(jacobian.T @ jacobian) * float(residuals @ residuals) / freedom
        circle = circle.moved(step)
    seen_from = sights.origins_m[support] - circle.centre_m
    seen_from /= np.linalg.norm(seen_from, axis=1, keepdims=True)
    spread_rad = math.acos(max(-1.0, min(1.0, float((seen_from @ seen_from.T).min()))))
    low, high = tuning.radii_m
    if not low <= circle.radius_m <= high or spread_rad < tuning.least_spread_rad:
        return None, support
    px, off_m = (part[support] for part in _deviations(sights, directions, circle))
    ring = Ring(
        circle.centre_m,
        circle.normal,
        float(circle.radius_m),
        math.sqrt(float(np.linalg.eigvalsh(covariance[:3, :3])[-1])),
        math.sqrt(float(np.linalg.eigvalsh(covariance[3:5, 3:5])[-1])),
        float(_rms(px.ravel())),
        float(_rms(off_m.ravel())),
        float(np.mean(sights.coverage[support])),
        int(support.sum()),
    )
    return ring, support


def _linearized(
    sights: CircleSights, directions: Array, circle: _Circle, support: NDArray[np.bool_]
) -> tuple[Array, Array]:
    """Return residuals (n,), px, of the supporting ellipses, and their derivatives (n, 6)."""
    steps = [np.zeros(6), *(_STEP * np.eye(6))]
    first, *others = (
        _deviations(sights, directions, circle.moved(s))[0][support].ravel() for s in steps
    )
    return first, np.column_stack([(other - first) / _STEP for other in others])


_STEP = 1e-5
"""Step of numerical derivatives, m and rad: 0.004 px."""


def _one_each(image: IntArray, off: Array, fits: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the best of the fitting ellipses of each image."""
    out = np.zeros(len(fits), dtype=np.bool_)
    order = np.flatnonzero(fits)[np.argsort(off[fits], kind="stable")]
    _, first = np.unique(image[order], return_index=True)
    out[order[first]] = True
    return out


def circle_sights(camera: Camera, images: list[tuple[Array, Array, Array]]) -> CircleSights:
    """Return the ellipses of images: of each the optical centre (3,) and rotation (3, 3), IRF to
    TRF, and rows (k, 6) of centre, half axes, px, angle, rad, and coverage.
    """
    rows = [np.asarray(e, dtype=float).reshape(-1, 6) for _, _, e in images]
    counts = [len(r) for r in rows]
    if not sum(counts):
        return replace(CircleSights.none(), images=len(images))
    every = np.concatenate(rows)
    # The image of an ellipse under another scale on each axis is one again.
    focal = np.array([camera.fx_px, camera.fy_px])
    cos, sin = np.cos(every[:, 4]), np.sin(every[:, 4])
    along = np.stack([cos, sin], axis=1), np.stack([-sin, cos], axis=1)
    spread = sum(
        (every[:, 2 + k] ** 2)[:, None, None] * np.einsum("ni,nj->nij", e, e)
        for k, e in enumerate(along)
    )
    squares, directions = np.linalg.eigh(spread / np.outer(focal, focal))
    return CircleSights(
        np.repeat(np.arange(len(images)), counts),
        np.repeat([o for o, _, _ in images], counts, axis=0),
        np.repeat([r for _, r, _ in images], counts, axis=0),
        camera.normalized(every[:, :2]),
        np.sqrt(squares[:, ::-1]),
        np.arctan2(directions[:, 1, 1], directions[:, 0, 1]),
        every[:, 5],
        camera.fx_px,
        len(images),
    )
