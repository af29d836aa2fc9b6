# SPDX-License-Identifier: Apache-2.0
"""Camera: its matrix, its lens (`lenses`), and its mounting on the chaser.

Pixel centres lie at integer coordinates: the image covers (-0.5, width - 0.5) x (-0.5, height -
0.5). "Ideal" pixels belong to the same camera matrix without lens distortion.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from . import rotations
from .arrays import Array
from .lenses import Lens, LensModel, lens_of


def focal_and_centre(matrix: ArrayLike) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy of a camera matrix (3, 3). Raises ValueError for one with skew, and for
    one that is none.
    """
    (fx, skew, cx), (zero, fy, cy), last = np.reshape(np.asarray(matrix, float), (3, 3)).tolist()
    if not np.isfinite(matrix).all() or zero != 0.0 or last != [0.0, 0.0, 1.0]:
        raise ValueError("must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] with finite numbers")
    if abs(skew) > _NO_SKEW * abs(fx):
        raise ValueError(
            f"has a skew of {skew:g} px, which no camera here has: calibrate with the skew fixed "
            "at 0"
        )
    return fx, fy, cx, cy


_NO_SKEW = 1e-9
"""Share of the focal length: rounding, below 1e-6 px in every image."""
Q_CRF_IRF_FORWARD_WXYZ: tuple[float, float, float, float] = (0.5, -0.5, 0.5, -0.5)
"""Rotation IRF -> CRF of a camera that looks along +X with +Z up (z -> x, x -> -y, y -> -z)."""


@dataclass(frozen=True)
class Camera:
    """One camera and its mounting.

    ``width_px``, ``height_px``: image size. ``fx_px``, ``fy_px``, ``cx_px``, ``cy_px``: camera
    matrix, without skew. ``distortion``: coefficients of ``lens_model``, dimensionless (`lenses`);
    empty for an ideal image. ``position_crf_m``: optical centre in CRF. ``q_crf_irf_wxyz``:
    rotation IRF -> CRF. Raises ValueError for sizes or focal lengths that are not positive, an
    unknown lens model and a wrong number of coefficients.
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
    lens_model: LensModel = "perspective"

    def __post_init__(self) -> None:
        if self.width_px <= 0 or self.height_px <= 0:
            raise ValueError(f"image size must be positive: {self.width_px} x {self.height_px}")
        if not (self.fx_px > 0.0 and self.fy_px > 0.0):
            raise ValueError(f"focal lengths must be positive: {self.fx_px}, {self.fy_px}")
        lens_of(self.lens_model, tuple(self.distortion))

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

    @cached_property
    def lens(self) -> Lens:
        """The lens, in normalized coordinates."""
        return lens_of(self.lens_model, tuple(self.distortion))

    @property
    def distorts(self) -> bool:
        """Whether the image differs from the ideal one."""
        return bool(self.distortion)

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
        not in front, or beyond what the lens images.
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
        """Convert ideal pixels (..., 2) to pixels in the distorted image (..., 2); NaN beyond the
        lens' `valid_radius`.
        """
        ideal_px = np.asarray(ideal_px, dtype=float)
        if not self.distorts:
            return ideal_px.copy()
        return self.lens.distort(self.normalized(ideal_px)) * self._focal + self._centre

    def undistort(self, px: ArrayLike) -> Array:
        """Convert pixels in the distorted image (..., 2) to ideal pixels (..., 2).

        To 1e-9 px; NaN outside the part of the image that the lens images invertibly.
        """
        px = np.asarray(px, dtype=float)
        if not self.distorts:
            return px.copy()
        ideal = self.lens.undistort(self.normalized(px), 1e-9 / self.fx_px)
        return ideal * self._focal + self._centre

    def normalized(self, px: ArrayLike) -> Array:
        """Convert pixels (..., 2) to normalized coordinates, at distance 1."""
        return (np.asarray(px, dtype=float) - self._centre) / self._focal

    def distortion_jacobian(self, ideal_px: ArrayLike) -> Array:
        """Return the derivative (..., 2, 2) of pixels in the image by ideal pixels (..., 2)."""
        ideal = self.normalized(ideal_px)
        if not self.distorts:
            return np.broadcast_to(np.eye(2), (*ideal.shape, 2)).copy()
        scale = self._focal[:, None] / self._focal
        return self.lens.jacobian(ideal) * scale

    def stretch(self, ideal_px: ArrayLike) -> Array:
        """Return how many ideal pixels (...,) a pixel of the image covers, along a side, at ideal
        pixels (..., 2): 1 without distortion, more where the lens compresses the image.
        """
        j = self.distortion_jacobian(ideal_px)
        with np.errstate(divide="ignore", invalid="ignore"):
            return 1.0 / np.sqrt(j[..., 0, 0] * j[..., 1, 1] - j[..., 0, 1] * j[..., 1, 0])

    def ros_distortion(self) -> tuple[str, list[float]]:
        """Return distortion model and coefficients as ROS names and orders them."""
        if self.lens_model == "equidistant":
            return "equidistant", list(self.distortion)
        if len(self.distortion) <= 5:
            return "plumb_bob", [*self.distortion, *[0.0] * 5][:5]
        return "rational_polynomial", list(self.distortion)

    def angles_to_borders(self) -> tuple[float, float, float, float]:
        """Return the angles, rad, from the optical axis to the left, top, right and bottom border
        of the image, level with the principal point, or to where the lens ends before.
        """
        angles = []
        for axis, end in ((0, 0.0), (1, 0.0), (0, self.width_px - 1.0), (1, self.height_px - 1.0)):
            px = self._centre.copy()
            px[axis] = end
            away = abs(float(self.normalized(self.undistort(px))[axis]))
            angles.append(math.atan(self.lens.valid_radius if math.isnan(away) else away))
        left, top, right, bottom = angles
        return left, top, right, bottom

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
