# SPDX-License-Identifier: Apache-2.0
"""The lens for the kernels, and frames of markers in which a strong lens distorts little."""

from __future__ import annotations

from ctypes import Structure, c_double
from dataclasses import dataclass

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from numpy.typing import NDArray

from .native import LIBRARY

LEAST_STRETCH = 1.3
"""Ideal pixels per pixel of the image from which on a lens counts as strong (chosen): the corner
fit is as good with and without a frame from 1.1 to 1.6."""


@LIBRARY.structure("Lens")
class NativeLens(Structure):
    """`Lens` of native/lens.h."""

    _fields_ = [
        ("kind", c_double), ("valid_square", c_double), ("k", c_double * 14), ("tilt", c_double * 9)
    ]  # fmt: skip


def native_lens(camera: Camera) -> NativeLens:
    """Return the lens of a camera for the kernels."""
    kind, valid_square, *rest = camera.lens.native
    return NativeLens(kind, valid_square, (c_double * 14)(*rest[:14]), (c_double * 9)(*rest[14:]))


def strong_stretch(camera: Camera, ideal_px: Array) -> Array:
    """Return `Camera.stretch` where it is strong, and 1 elsewhere."""
    stretch = camera.stretch(ideal_px)
    return np.where(stretch > LEAST_STRETCH, stretch, 1.0)


@dataclass(frozen=True)
class MarkerFrames:
    """Coordinates of n markers on planes across their lines of sight: at a marker's centre one unit
    is one pixel of the image, along both axes.

    ``to_ray`` (n, 3, 3): from (x, y, 1) to a ray. ``framed`` (n,): markers where the lens is
    strong. ``stretch`` (n,): ideal pixels per unit there, 1 for the others, which keep ideal
    pixels.
    """

    camera: Camera
    to_ray: Array
    framed: NDArray[np.uint8]
    stretch: Array

    @staticmethod
    def of(camera: Camera, corners_ideal_px: Array) -> MarkerFrames:
        """Return the frames of markers with corners (n, 4, 2)."""
        n = len(corners_ideal_px)
        to_ray, framed = np.zeros((n, 3, 3)), np.zeros(n, dtype=np.uint8)
        if not camera.distorts or not n:
            return MarkerFrames(camera, to_ray, framed, np.ones(n))
        centres = corners_ideal_px.mean(axis=1)
        stretch = strong_stretch(camera, centres)
        framed[stretch > 1.0] = 1
        for k in np.flatnonzero(framed):
            x, y = camera.normalized(centres[k])
            ahead = np.array([x, y, 1.0]) / np.sqrt(x * x + y * y + 1.0)
            right = np.cross([0.0, 1.0, 0.0], ahead)
            right /= np.linalg.norm(right)
            axes = np.column_stack([right, np.cross(ahead, right)])
            # Of ideal pixels by a shift on the plane, then of pixels of the image.
            focal = np.array([[camera.fx_px], [camera.fy_px]])
            moved = focal * (axes[:2] - np.outer([x, y], axes[2])) / ahead[2]
            moved = camera.distortion_jacobian(centres[k]) @ moved
            to_ray[k] = np.column_stack([axes @ np.linalg.inv(moved), ahead])
        return MarkerFrames(camera, to_ray, framed, stretch)

    def into(self, ideal_px: Array) -> Array:
        """Convert corners (n, 4, 2) from ideal pixels."""
        out = ideal_px.copy()
        for k in np.flatnonzero(self.framed):
            at = self.camera.normalized(ideal_px[k])
            w = np.column_stack([at, np.ones(len(at))]) @ np.linalg.inv(self.to_ray[k]).T
            out[k] = w[:, :2] / w[:, 2:]
        return out

    def out_of(self, corners: Array) -> Array:
        """Convert corners (n, 4, 2) to ideal pixels."""
        out = corners.copy()
        c = self.camera
        for k in np.flatnonzero(self.framed):
            ray = np.column_stack([corners[k], np.ones(len(corners[k]))]) @ self.to_ray[k].T
            out[k] = ray[:, :2] / ray[:, 2:] * (c.fx_px, c.fy_px) + (c.cx_px, c.cy_px)
        return out

    def whitening_of(self, whitening: Array, corners: Array) -> Array:
        """Convert the whitening (n, 8, 8) of errors of ``corners`` (n, 4, 2) to that of errors in
        ideal pixels.
        """
        out = whitening.copy()
        focal = np.array([[self.camera.fx_px], [self.camera.fy_px]])
        for k in np.flatnonzero(self.framed):
            for c, (x, y) in enumerate(corners[k]):
                ray = self.to_ray[k] @ (x, y, 1.0)
                by = self.to_ray[k, :2, :2] - np.outer(ray[:2] / ray[2], self.to_ray[k, 2, :2])
                out[k, :, 2 * c : 2 * c + 2] @= np.linalg.inv(focal * by / ray[2])
        return out
