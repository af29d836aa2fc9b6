# SPDX-License-Identifier: Apache-2.0
"""Pinhole camera with Brown-Conrady lens distortion, and its mounting on the chaser.

Pixel centres lie at integer coordinates: the image covers (-0.5, width - 0.5) x (-0.5, height -
0.5). "Ideal" pixels belong to the same camera matrix without lens distortion. The distortion model
and the order of its coefficients are those of OpenCV: D. C. Brown, "Decentering distortion of
lenses", 1966.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from . import rotations
from .arrays import Array

Q_CRF_IRF_FORWARD_WXYZ: tuple[float, float, float, float] = (0.5, -0.5, 0.5, -0.5)
"""Rotation IRF -> CRF of a camera that looks along +X with +Z up (z -> x, x -> -y, y -> -z)."""


@dataclass(frozen=True)
class Camera:
    """One camera and its mounting.

    ``width_px``, ``height_px``: image size. ``fx_px``, ``fy_px``, ``cx_px``, ``cy_px``: camera
    matrix. ``distortion``: (k1, k2, p1, p2[, k3]), dimensionless, or empty for none.
    ``position_crf_m``: optical centre in CRF. ``q_crf_irf_wxyz``: rotation IRF -> CRF. Raises
    ValueError for sizes or focal lengths that are not positive and a wrong number of coefficients.
    """

    width_px: int
    height_px: int
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...] = ()
    position_crf_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    q_crf_irf_wxyz: tuple[float, float, float, float] = Q_CRF_IRF_FORWARD_WXYZ

    def __post_init__(self) -> None:
        if self.width_px <= 0 or self.height_px <= 0:
            raise ValueError(f"image size must be positive: {self.width_px} x {self.height_px}")
        if not (self.fx_px > 0.0 and self.fy_px > 0.0):
            raise ValueError(f"focal lengths must be positive: {self.fx_px}, {self.fy_px}")
        if len(self.distortion) not in (0, 4, 5):
            raise ValueError(f"distortion takes 0, 4 or 5 coefficients, not {len(self.distortion)}")

    @classmethod
    def from_hfov(
        cls,
        width_px: int,
        height_px: int,
        hfov_rad: float,
        position_crf_m: tuple[float, float, float] = (0.0, 0.0, 0.0),
        distortion: tuple[float, ...] = (),
    ) -> Camera:
        """Create a forward-looking camera with square pixels and a horizontal field of view
        ``hfov_rad``.

        Raises ValueError for a field of view outside (0, pi).
        """
        if not 0.0 < hfov_rad < math.pi:
            raise ValueError(f"horizontal field of view must lie in (0, pi): {hfov_rad}")
        f = width_px / 2.0 / math.tan(hfov_rad / 2.0)
        cx, cy = (width_px - 1) / 2.0, (height_px - 1) / 2.0
        return cls(width_px, height_px, f, f, cx, cy, tuple(distortion), position_crf_m)

    def matrix(self) -> Array:
        """Return the camera matrix (3, 3)."""
        return self._matrix.copy()

    @cached_property
    def _matrix(self) -> Array:
        return np.array(
            [[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]]
        )

    @cached_property
    def _focal(self) -> Array:
        return np.array([self.fx_px, self.fy_px])

    @cached_property
    def _centre(self) -> Array:
        return np.array([self.cx_px, self.cy_px])

    def project(self, points_irf_m: ArrayLike) -> Array:
        """Project to pixels (..., 2), with lens distortion, points (..., 3) in IRF; NaN for points
        not in front.
        """
        return self.distort(self.project_ideal(points_irf_m))

    def project_ideal(self, points_irf_m: ArrayLike) -> Array:
        """Project to ideal pixels (..., 2) points (..., 3) in IRF; NaN for points not in front of
        the camera.
        """
        points = np.asarray(points_irf_m, dtype=float)
        z = np.where(points[..., 2:] > 0.0, points[..., 2:], np.nan)
        return points[..., :2] / z * self._focal + self._centre

    def distort(self, ideal_px: ArrayLike) -> Array:
        """Convert ideal pixels (..., 2) to pixels in the distorted image (..., 2)."""
        ideal_px = np.asarray(ideal_px, dtype=float)
        if not self.distortion:
            return ideal_px.copy()
        focal, centre = self._focal, self._centre
        return self._distort_normalized((ideal_px - centre) / focal) * focal + centre

    def undistort(self, px: ArrayLike) -> Array:
        """Convert pixels in the distorted image (..., 2) to ideal pixels (..., 2).

        Fixed-point iteration to convergence (1e-9 px). NaN where it does not converge, i.e. outside
        the part of the image in which the distortion is invertible.
        """
        px = np.asarray(px, dtype=float)
        if not self.distortion:
            return px.copy()
        focal, centre = self._focal, self._centre
        distorted = (px - centre) / focal
        x = distorted.copy()
        tolerance = 1e-9 / self.fx_px
        with np.errstate(over="ignore", invalid="ignore"):
            for _ in range(100):
                error = distorted - self._distort_normalized(x)
                x = x + error
                if not np.any(np.abs(error) > tolerance):
                    break
            diverged = ~np.all(
                np.abs(distorted - self._distort_normalized(x)) < 1e3 * tolerance, axis=-1
            )
        x[diverged] = np.nan
        return x * focal + centre

    def irf_pose_in_world(
        self, chaser_position_w_m: ArrayLike, chaser_q_w_crf_wxyz: ArrayLike
    ) -> tuple[Array, Array]:
        """Return the optical centre (3,) in WRF and the rotation IRF -> WRF (4,) of the camera on a
        chaser at this pose."""
        q_w_crf = np.asarray(chaser_q_w_crf_wxyz, dtype=float)
        position = np.asarray(chaser_position_w_m, dtype=float) + rotations.rotate(
            q_w_crf, self.position_crf_m
        )
        return position, rotations.multiply(q_w_crf, self.q_crf_irf_wxyz)

    def _distort_normalized(self, xy: Array) -> Array:
        k1, k2, p1, p2, k3 = (*self.distortion, 0.0)[:5]
        x, y = xy[..., 0], xy[..., 1]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        return np.stack(
            [
                x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
            ],
            axis=-1,
        )
