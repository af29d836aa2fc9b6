# SPDX-License-Identifier: Apache-2.0
"""Find motions of the target, from nothing, that may explain how its points move in images.

Each track that two images share must satisfy their epipolar constraint. It needs no depths, so all
starts are refined at once by Gauss-Newton on nine unknowns, from rates in all directions. Several
cameras with known places make the scale observable, and settle what one camera that sees a plane
cannot.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array

from .types import ConstantRates, ImageTracks


@dataclass(frozen=True)
class StartTuning:
    """Numbers of the search, with units and reasons."""

    directions: int = 32
    """Directions of the rate: 35 degrees apart, and 60 degrees off converges."""
    rates_rad_s: tuple[float, ...] = (0.02, 0.06)
    """First magnitudes, 1.1 and 3.4 deg/s: five times as fast or slow converges."""
    steps: int = 14
    """Gauss-Newton steps of all starts: converged ones stand still after eight."""
    robust_px: float = 1.5
    """Residual with half weight: odometry of grade `lab` turns an image by 0.7 px."""
    pair_tracks: int = 150
    """Tracks taken of each pair of images, evenly of all."""
    least_tracks: int = 30
    """Tracks in common that a pair of images needs."""
    least_motion_px: float = 4.0
    """Median motion of the tracks over the window below which the target's turn cannot be told
    from noise."""
    position_sigma_m: float = 0.2
    velocity_sigma_m_s: float = 0.03
    """Standard deviations of the guesses: the middle of what is seen, and the chasers' own
    velocity."""
    apart: float = 0.08
    """Share of the larger rate within which two motions count as one."""
    kept: int = 4
    """Motions returned: further ones have three times the cost of the best."""


@dataclass(frozen=True, eq=False)
class _Pair:
    """Tracks (k, 3) as rays in two images of a chaser."""

    first: ImageTracks
    last: ImageTracks
    a: Array
    b: Array


def shared(first: ImageTracks, last: ImageTracks) -> tuple[Array, Array]:
    """Return the rays (k, 2) of tracks that two images share, in either."""
    _, i, j = np.intersect1d(first.ids, last.ids, assume_unique=True, return_indices=True)
    return first.rays[i], last.rays[j]


def middle_of_lines(images: Sequence[ImageTracks]) -> Array | None:
    """Return the point (3,), WRF, nearest to the lines of sight to the middles of the points of
    several images; None if these are parallel.
    """
    matrix, vector = np.zeros((3, 3)), np.zeros(3)
    for image in images:
        if not len(image.ids):
            continue
        ray = image.rotation @ np.append(np.median(image.rays, axis=0), 1.0)
        ray /= np.linalg.norm(ray)
        across = np.eye(3) - np.outer(ray, ray)
        matrix += across
        vector += across @ image.position_w_m
    if np.linalg.eigvalsh(matrix)[0] < _PARALLEL * max(len(images), 1):
        return None
    return np.asarray(np.linalg.solve(matrix, vector), dtype=float)


_PARALLEL = 0.01
"""Information per image along the lines of sight that are parallel to 6 degrees."""


def motion_px(windows: Sequence[Sequence[ImageTracks]], focal_px: float) -> float:
    """Return the median motion, px, of tracks from their first to their last image in the chasers'
    windows.
    """
    moved = [np.zeros(0)]
    for images in windows:
        ids = np.concatenate([image.ids for image in images])
        rays = np.concatenate([image.rays for image in images])
        _, first = np.unique(ids, return_index=True)
        _, last = np.unique(ids[::-1], return_index=True)
        moved.append(focal_px * np.linalg.norm(rays[::-1][last] - rays[first], axis=1))
    every = np.concatenate(moved)
    return float(np.median(every)) if len(every) else 0.0


def candidate_motions(
    windows: Sequence[Sequence[ImageTracks]],
    focal_px: float,
    position_w_m: Array,
    velocity_m_s: Array,
    time_s: float,
    tuning: StartTuning | None = None,
) -> list[tuple[float, ConstantRates]]:
    """Return motions, best first, with the mean robust cost (px^2) of each.

    ``windows``: images of each chaser, by time. ``position_w_m`` at ``time_s`` and
    ``velocity_m_s``: guesses. Empty if no two images share enough tracks.
    """
    tuning = tuning or StartTuning()
    pairs = [pair for images in windows for pair in _pairs(images, tuning)]
    if not pairs:
        return []
    guess = np.concatenate([position_w_m, velocity_m_s, np.zeros(3)])
    starts = np.repeat(guess[None], tuning.directions * len(tuning.rates_rad_s), axis=0)
    starts[:, 6:] = np.concatenate([r * _directions(tuning.directions) for r in tuning.rates_rad_s])
    found = _refined(starts, pairs, guess, focal_px, time_s, tuning)
    cost = _cost(_sampson(found, pairs, focal_px, time_s), tuning.robust_px).mean(axis=1)
    out: list[tuple[float, ConstantRates]] = []
    for k in np.argsort(cost, kind="stable").tolist():
        p, v, w = np.split(found[k], 3)
        if not np.isfinite(found[k]).all() or any(_alike(w, m.omega_rad_s, tuning) for _, m in out):
            continue
        out.append((float(cost[k]), ConstantRates(time_s, p, v, w)))
        if len(out) == tuning.kept:
            break
    return out


def _alike(a: Array, b: Array, tuning: StartTuning) -> bool:
    size = max(float(np.linalg.norm(a)), float(np.linalg.norm(b)))
    return float(np.linalg.norm(a - b)) < tuning.apart * size


def _directions(count: int) -> Array:
    """Return unit vectors (n, 3) spread evenly over the sphere (Fibonacci)."""
    k = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * k / count, np.pi * (1.0 + 5.0**0.5) * k
    r = np.sqrt(1.0 - z * z)
    return np.column_stack([r * np.cos(turn), r * np.sin(turn), z])


def _pairs(images: Sequence[ImageTracks], tuning: StartTuning) -> list[_Pair]:
    if len(images) < 3:
        return []
    last, middle = len(images) - 1, len(images) // 2
    out = []
    for i, j in ((0, last), (0, middle), (middle, last)):
        a, b = shared(images[i], images[j])
        if len(a) < tuning.least_tracks:
            continue
        chosen = np.unique(np.linspace(0, len(a) - 1, tuning.pair_tracks).round().astype(int))
        one = np.ones((len(chosen), 1))
        out.append(
            _Pair(images[i], images[j], np.hstack([a[chosen], one]), np.hstack([b[chosen], one]))
        )
    return out


def _sampson(x: Array, pairs: Sequence[_Pair], focal_px: float, time_s: float) -> Array:
    """Return the signed distances (h, k), px, of all tracks from their epipolar constraint, for
    unknowns (h, 9).
    """
    out = []
    for pair in pairs:
        a, b = pair.first, pair.last
        to_a, to_b = a.time_s - time_s, b.time_s - time_s
        turn = rotations.to_matrix(rotations.exp(x[:, 6:] * (to_b - to_a)))
        p_a, p_b = x[:, :3] + x[:, 3:6] * to_a, x[:, :3] + x[:, 3:6] * to_b
        offset = p_b - b.position_w_m + np.einsum("hij,hj->hi", turn, a.position_w_m - p_a)
        shift = offset @ b.rotation
        shift = shift / np.maximum(np.linalg.norm(shift, axis=1, keepdims=True), 1e-12)
        e = rotations.skew(shift) @ (b.rotation.T @ turn @ a.rotation)
        left = np.einsum("hij,kj->hki", e, pair.a)
        right = np.einsum("hji,kj->hki", e, pair.b)
        off = np.einsum("ki,hki->hk", pair.b, left)
        scale = (left[..., :2] ** 2).sum(axis=2) + (right[..., :2] ** 2).sum(axis=2)
        out.append(focal_px * off / np.sqrt(np.maximum(scale, 1e-18)))
    return np.concatenate(out, axis=1)


def _cost(residual: Array, robust_px: float) -> Array:
    return robust_px**2 * np.log1p((residual / robust_px) ** 2)


def _refined(
    x: Array,
    pairs: Sequence[_Pair],
    guess: Array,
    focal_px: float,
    time_s: float,
    tuning: StartTuning,
) -> Array:
    """Return all unknowns (h, 9) after Levenberg-Marquardt steps, derivatives by differences."""
    sigma = np.repeat([tuning.position_sigma_m, tuning.velocity_sigma_m_s, 1.0], 3)
    step = np.repeat([1e-4, 1e-5, 1e-5], 3)
    damping = np.full(len(x), 1e-2)

    def total(at: Array, residual: Array) -> Array:
        prior = (((at - guess) / sigma) ** 2).sum(axis=1)
        return _cost(residual, tuning.robust_px).sum(axis=1) + prior

    residual = _sampson(x, pairs, focal_px, time_s)
    cost = total(x, residual)
    for _ in range(tuning.steps):
        varied = (x[:, None] + np.diag(step)).reshape(-1, len(guess))
        beside = _sampson(varied, pairs, focal_px, time_s).reshape(len(x), len(guess), -1)
        j = (beside - residual[:, None]) / step[:, None]
        weight = 1.0 / (1.0 + (residual / tuning.robust_px) ** 2)
        weighted = j * weight[:, None]
        normal = weighted @ j.transpose(0, 2, 1) + np.diag(1.0 / sigma**2)
        vector = np.einsum("hik,hk->hi", weighted, residual) + (x - guess) / sigma**2
        diagonal = np.einsum("hii->hi", normal)
        damped = normal + np.eye(len(guess)) * (damping[:, None] * diagonal)[:, None, :]
        candidate = x - np.linalg.solve(damped, vector[:, :, None])[:, :, 0]
        reached = _sampson(candidate, pairs, focal_px, time_s)
        new = total(candidate, reached)
        better = new < cost
        x = np.where(better[:, None], candidate, x)
        residual = np.where(better[:, None], reached, residual)
        cost = np.where(better, new, cost)
        damping = np.clip(np.where(better, damping / 5.0, damping * 5.0), 1e-9, 1e6)
    return x
