# SPDX-License-Identifier: Apache-2.0
"""Estimate the light on the target from the image, so that sun, eclipse and lamp need no ephemeris.

By Lambert's law the grey level of a lit surface is reflectance (a + n's), linear in the ambient level a and in s, the direction to
the sun times its level. Both follow from least squares over the pixels of a predicted view. Surfaces turned away have n's = 0,
and pixels in cast shadows are outliers.
"""

from __future__ import annotations

import cv2
import numpy as np
from chaserdock_models.arrays import Array

from ..refine import PoseInCamera
from .alignment import Pyramid, image_window, in_grey_levels, window_of
from .mesh import TrackerMesh
from .rendering import Lighting, render

_MOST_PIXELS = 3000
_RIDGE = 1e-6
_ROUNDS = 4
_AMBIENT_SHARES = (0.03, 0.1, 0.2, 0.35, 0.6)
"""Trials of the ambient level, as shares of the level of the brightest surfaces."""


def light_at(
    pyramid: Pyramid, mesh: TrackerMesh, pose: PoseInCamera, level: int, thorough: bool = True
) -> Lighting | None:
    """Return the light, in grey levels, that the image shows on a target at ``pose``; None if too little of it is in view.

    Where three sides or less are visible, the ambient level is not observable from them: with ``thorough`` several ones are
    tried, and the one whose rendering, with cast shadows, fits best is taken.
    """
    found = window_of(pyramid, level, mesh, pose)
    if found is None:
        return None
    window, left, top = found
    patch = image_window(pyramid, level, window, left, top)
    view = render(mesh, pose, window, Lighting(np.array([0.0, 0.0, -1.0]), shadows=False), samples=1)
    pixels = np.flatnonzero(view.coverage.ravel() > 0.99)
    if len(pixels) < 50:
        return None
    pixels = pixels[:: max(1, len(pixels) // _MOST_PIXELS)]
    owners = view.owner.ravel()[pixels]
    _, _, normals, reflectance = mesh.contiguous
    normal = normals[owners].mean(axis=1) @ pose.rotation.T
    grey = patch.ravel()[pixels].astype(float)
    if not thorough:
        return fit_light(reflectance[owners], normal, grey)
    brightest = float(np.percentile(grey / np.maximum(reflectance[owners], 0.02), 95))
    best: tuple[float, Lighting] | None = None
    for share in _AMBIENT_SHARES:
        light = fit_light(reflectance[owners], normal, grey, share * brightest)
        if light is None:
            continue
        shaded = render(mesh, pose, window, light, samples=1).grey.ravel()[pixels]
        # Limited, so that wrong reflectances and texture do not decide.
        misfit = float(np.minimum(np.abs(shaded - grey), 0.2 * brightest).mean())
        if best is None or misfit < best[0]:
            best = misfit, light
    return best[1] if best else None


def fit_light(
    reflectance: Array, normals: Array, grey: Array, ambient: float | None = None
) -> Lighting | None:
    """Return the light from n pixels: reflectance (n,), unit normals (n, 3), grey levels (n,); ``ambient``: level, if known."""
    lit, weight = np.ones(len(grey)), np.ones(len(grey))
    level: float = ambient or 0.0
    sun: Array = np.zeros(3)
    for _ in range(_ROUNDS):
        columns = reflectance[:, None] * np.column_stack([np.ones(len(grey)), normals * lit[:, None]])
        known = columns[:, 0] * level if ambient is not None else np.zeros(len(grey))
        used = columns[:, 1:] if ambient is not None else columns
        matrix = used.T @ (used * weight[:, None])
        matrix[np.diag_indices(len(matrix))] += _RIDGE * np.trace(matrix) + 1e-12
        solution = np.linalg.solve(matrix, used.T @ (weight * (grey - known)))
        sun = np.asarray(solution[-3:], dtype=np.float64)
        level = ambient if ambient is not None else float(solution[0])
        residual = np.abs(grey - known - used @ solution)
        scale = max(1.4826 * float(np.median(residual)), 1.0)
        weight = 1.0 / (1.0 + (residual / (2.0 * scale)) ** 2)
        lit = (normals @ sun > 0.0).astype(float)
    direct = float(np.linalg.norm(sun))
    level = max(level, 0.02 * direct)
    if not (level + direct > 1e-3 and np.isfinite(level + direct)):
        return None
    return Lighting(sun / direct if direct > 0.0 else np.array([0.0, 0.0, -1.0]), direct, level)


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
