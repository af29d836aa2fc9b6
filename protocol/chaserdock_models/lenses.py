# SPDX-License-Identifier: Apache-2.0
"""Lens models: the one place that knows where a lens images a ray.

A ray (x, y, z) has ideal coordinates (x / z, y / z); a lens displaces them. Models and the order of
their coefficients are those of OpenCV:

- ``perspective``: k1, k2, p1, p2[, k3[, k4, k5, k6[, s1, s2, s3, s4[, tau_x, tau_y]]]]. Radial and
  decentering terms of D. C. Brown, "Decentering distortion of lenses", 1966; a rational radial
  term; a thin prism; a tilted sensor. Without coefficients the image is ideal.
- ``equidistant``: k1, k2, k3, k4 of a fisheye lens, theta (1 + k1 theta^2 + ... + k4 theta^8) with
  theta the angle from the axis: J. Kannala, S. Brandt, "A generic camera model and calibration
  method for conventional, wide-angle, and fish-eye lenses", 2006. Rays at 90 degrees and beyond
  have no ideal coordinates.

Kernels in C compute the same from `Lens.native`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from .arrays import Array

LensModel = Literal["perspective", "equidistant"]

COEFFICIENTS: dict[LensModel, tuple[int, ...]] = {
    "perspective": (0, 4, 5, 8, 12, 14),
    "equidistant": (4,),
}
"""Numbers of coefficients that a model may have."""
_FIXED_POINT_ROUNDS, _NEWTON_ROUNDS = 25, 12
"""Most rounds: usual lenses take 5 to 20, and 3."""
_STEEPEST_RAD = math.radians(89.9)
"""Polynomials are searched for a turn up to this angle from the axis."""
_DIRECTIONS, _ANGLES = 64, 1800
"""In so many directions, at so many angles from the axis (0.05 degrees apart)."""
_TABLE = 1024
"""Entries of the table that starts Newton's method."""
_CHUNK = 16384
"""Points that are undistorted together: they stay in the processor's cache."""


@dataclass(frozen=True)
class Lens(ABC):
    """A lens in normalized coordinates, ideal (..., 2) and distorted (..., 2).

    ``coefficients``: see the module. Ideal coordinates beyond ``valid_radius``, where the model
    turns back or ends, have no image.
    """

    coefficients: tuple[float, ...]

    @cached_property
    @abstractmethod
    def valid_radius(self) -> float:
        """Distance from the axis, in ideal coordinates, up to which the model can be inverted;
        infinite if it can everywhere.
        """

    @property
    @abstractmethod
    def native(self) -> tuple[float, ...]:
        """``LensModel`` of native/lens.h as numbers."""

    @abstractmethod
    def jacobian(self, ideal: Array) -> Array:
        """Return the derivative (..., 2, 2) of the distorted by the ideal coordinates."""

    @abstractmethod
    def _map(self, ideal: Array) -> Array:
        """Distort without regard to ``valid_radius``."""

    @abstractmethod
    def _invert(self, distorted: Array, tolerance: float) -> Array:
        """Return ideal coordinates (n, 2) of n points; anything where there are none."""

    def distort(self, ideal: Array) -> Array:
        """Return the distorted coordinates; NaN beyond ``valid_radius``."""
        if math.isinf(self.valid_radius):
            return self._map(ideal)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            out = self._map(ideal)
            out[~(_square(ideal) < self.valid_radius**2)] = np.nan
        return out

    def undistort(self, distorted: Array, tolerance: float) -> Array:
        """Return the ideal coordinates; NaN where there are none within ``valid_radius``.

        They are iterated to ``tolerance``, and their image is within a thousand times that of
        ``distorted``.
        """
        points = distorted.reshape(-1, 2)
        out = np.empty_like(points)
        with np.errstate(over="ignore", invalid="ignore", divide="ignore"):
            for first in range(0, len(points), _CHUNK):
                part = points[first : first + _CHUNK]
                ideal = self._invert(part, tolerance)
                error = np.abs(part - self._map(ideal))
                good = np.all(error < 1e3 * tolerance, axis=-1)
                good &= _square(ideal) < self.valid_radius**2
                ideal[~good] = np.nan
                out[first : first + _CHUNK] = ideal
        return out.reshape(distorted.shape)


def _square(xy: Array) -> Array:
    return xy[..., 0] * xy[..., 0] + xy[..., 1] * xy[..., 1]


@dataclass(frozen=True)
class _Perspective(Lens):
    @cached_property
    def _k(self) -> tuple[float, ...]:
        return (*self.coefficients, *[0.0] * 14)[:14]

    @cached_property
    def _tilt(self) -> Array | None:
        """Projection (3, 3) of the image onto the tilted sensor; None without tilt."""
        tau_x, tau_y = self._k[12:]
        if not (tau_x or tau_y):
            return None
        (sx, cx), (sy, cy) = ((math.sin(t), math.cos(t)) for t in (tau_x, tau_y))
        turn = np.array([[cy, 0.0, -sy], [0.0, 1.0, 0.0], [sy, 0.0, cy]]) @ np.array(
            [[1.0, 0.0, 0.0], [0.0, cx, sx], [0.0, -sx, cx]]
        )
        along = turn[2, 2]
        onto = np.array([[along, 0.0, -turn[0, 2]], [0.0, along, -turn[1, 2]], [0.0, 0.0, 1.0]])
        return onto @ turn

    @property
    def native(self) -> tuple[float, ...]:
        tilt = np.eye(3) if self._tilt is None else self._tilt
        kind = 0.0 if not self.coefficients else 1.0 if len(self.coefficients) <= 5 else 2.0
        return kind, self.valid_radius**2, *self._k, *tilt.ravel().tolist()

    @cached_property
    def valid_radius(self) -> float:
        if not any(self._k[:12]):
            return math.inf
        direction = np.linspace(0.0, 2.0 * math.pi, _DIRECTIONS, endpoint=False)
        unit = np.stack([np.cos(direction), np.sin(direction)], axis=-1)
        radii = np.tan(np.linspace(0.0, _STEEPEST_RAD, _ANGLES))
        bad = ~self._regular(radii[:, None, None] * unit)
        if not bad.any():
            return math.inf
        first = int(np.argmax(bad.any(axis=1)))
        unit = unit[bad[first]]
        low, high = np.full(len(unit), radii[first - 1]), np.full(len(unit), radii[first])
        for _ in range(60):
            middle = 0.5 * (low + high)
            turned = ~self._regular(middle[:, None] * unit)
            low, high = np.where(turned, low, middle), np.where(turned, middle, high)
        return float(low.min())

    def _regular(self, ideal: Array) -> NDArray[np.bool_]:
        """Return where the image neither turns back nor jumps."""
        r2 = _square(ideal)
        k4, k5, k6 = self._k[5:8]
        with np.errstate(divide="ignore", invalid="ignore"):  # at a pole
            xx, xy, yx, yy = self._flat_jacobian(ideal[..., 0], ideal[..., 1])
            turn = xx * yy - xy * yx
        return (turn > 0.0) & (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)) > 0.0)

    def _map(self, ideal: Array) -> Array:
        flat = self._flat(ideal)
        return flat if self._tilt is None else _project(self._tilt, flat)

    def _flat(self, ideal: Array) -> Array:
        """Distort without the sensor's tilt."""
        return np.stack(self._flat_xy(ideal[..., 0], ideal[..., 1]), axis=-1)

    def _flat_xy(self, x: Array, y: Array) -> tuple[Array, Array]:
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = self._k[:12]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        if len(self.coefficients) > 5:
            radial = radial / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        u = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
        v = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
        if len(self.coefficients) > 8:
            u, v = u + r2 * (s1 + r2 * s2), v + r2 * (s3 + r2 * s4)
        return u, v

    def jacobian(self, ideal: Array) -> Array:
        flat = np.stack(self._flat_jacobian(ideal[..., 0], ideal[..., 1]), axis=-1).reshape(
            *ideal.shape, 2
        )
        if self._tilt is None:
            return flat
        at = self._flat(ideal)
        w = at @ self._tilt[2, :2] + self._tilt[2, 2]
        seen = _project(self._tilt, at)
        turn = self._tilt[:2, :2] - seen[..., :, None] * self._tilt[2, :2]
        return turn / w[..., None, None] @ flat

    def _flat_jacobian(self, x: Array, y: Array) -> tuple[Array, Array, Array, Array]:
        """Return the Jacobian of `_flat` by rows."""
        k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4 = self._k[:12]
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        # By r^2, twice: it is multiplied by derivatives of r^2, 2 x and 2 y.
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + r2 * 3.0 * k3))
        if len(self.coefficients) > 5:
            below = 1.0 + r2 * (k4 + r2 * (k5 + r2 * k6))
            radial = radial / below
            slope = (slope - 2.0 * radial * (k4 + r2 * (2.0 * k5 + r2 * 3.0 * k6))) / below
        prism_x, prism_y = 2.0 * (s1 + 2.0 * s2 * r2), 2.0 * (s3 + 2.0 * s4 * r2)
        across = x * y * slope + 2.0 * (p1 * x + p2 * y)
        return (
            radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x + prism_x * x,
            across + prism_x * y,
            across + prism_y * x,
            radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x + prism_y * y,
        )

    def _invert(self, distorted: Array, tolerance: float) -> Array:
        if self._tilt is not None:
            distorted = _project(np.asarray(np.linalg.inv(self._tilt), float), distorted)
        if len(self.coefficients) > 5 or math.isfinite(self.valid_radius):
            return self._newton(distorted, tolerance)
        ideal = distorted.copy()
        error = distorted
        for _ in range(_FIXED_POINT_ROUNDS):
            error = distorted - self._flat(ideal)
            ideal = ideal + error
            if not np.any(np.abs(error) > tolerance):
                return ideal
        # Strong distortion: the fixed point attracts no more.
        rest = ~np.all(np.abs(error) <= tolerance, axis=-1)
        ideal[rest] = self._newton(distorted[rest], tolerance)
        return ideal

    def _newton(self, distorted: Array, tolerance: float) -> Array:
        """Newton's method from the radial part's inverse, kept within ``valid_radius``."""
        radii, images = self._radial_table
        seen = np.sqrt(_square(distorted))
        start = np.interp(seen, images, radii)
        scale = start / np.maximum(seen, 1e-300)
        u, v = distorted[:, 0].copy(), distorted[:, 1].copy()
        ideal = np.empty((2, len(u)))
        x, y = u * scale, v * scale
        active = np.arange(len(u))
        for _ in range(_NEWTON_ROUNDS):
            at_u, at_v = self._flat_xy(x, y)
            right, down = u - at_u, v - at_v
            xx, xy, yx, yy = self._flat_jacobian(x, y)
            turn = xx * yy - xy * yx
            dx, dy = (yy * right - xy * down) / turn, (xx * down - yx * right) / turn
            x, y = x + dx, y + dy
            shrink = np.maximum(np.sqrt(x * x + y * y) / self.valid_radius, 1.0)
            x, y = x / shrink, y / shrink
            ideal[:, active] = x, y
            on = ~((np.abs(dx) <= tolerance) & (np.abs(dy) <= tolerance))
            active, x, y, u, v = active[on], x[on], y[on], u[on], v[on]
            if not len(active):
                break
        return ideal.T.copy()

    @cached_property
    def _radial_table(self) -> tuple[Array, Array]:
        """Ideal radii, and their images by the radial part, both ascending."""
        k1, k2, _, _, k3, k4, k5, k6 = self._k[:8]
        end = min(math.atan(self.valid_radius), _STEEPEST_RAD)
        radii = np.tan(np.linspace(0.0, end, _TABLE))
        r2 = radii * radii
        images = (
            radii
            * (1.0 + r2 * (k1 + r2 * (k2 + r2 * k3)))
            / (1.0 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        )
        return radii, np.maximum.accumulate(images)


def _project(matrix: Array, xy: Array) -> Array:
    out = xy @ matrix[:, :2].T + matrix[:, 2]
    return out[..., :2] / out[..., 2:]


@dataclass(frozen=True)
class _Equidistant(Lens):
    @property
    def native(self) -> tuple[float, ...]:
        return (
            3.0,
            self.valid_radius**2,
            *self.coefficients,
            *[0.0] * 10,
            *np.eye(3).ravel().tolist(),
        )

    @cached_property
    def valid_angle(self) -> float:
        """Angle from the axis up to which the polynomial rises, at most 90 degrees, rad."""
        k1, k2, k3, k4 = self.coefficients
        roots = np.polynomial.Polynomial([1.0, 3.0 * k1, 5.0 * k2, 7.0 * k3, 9.0 * k4]).roots()
        turns = [
            math.sqrt(z.real) for z in roots if z.real > 0.0 and abs(z.imag) < 1e-9 * abs(z.real)
        ]
        return min([math.pi / 2.0, *turns])

    @cached_property
    def valid_radius(self) -> float:
        end = self.valid_angle
        return math.tan(end) if end < math.pi / 2.0 else math.inf

    def _image(self, theta: Array) -> Array:
        k1, k2, k3, k4 = self.coefficients
        t2 = theta * theta
        return theta * (1.0 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))

    def _slope(self, theta: Array) -> Array:
        k1, k2, k3, k4 = self.coefficients
        t2 = theta * theta
        return 1.0 + t2 * (3.0 * k1 + t2 * (5.0 * k2 + t2 * (7.0 * k3 + t2 * 9.0 * k4)))

    def _map(self, ideal: Array) -> Array:
        r = np.sqrt(_square(ideal))
        theta = np.arctan(r)
        scale = np.where(r > 1e-8, self._image(theta) / np.maximum(r, 1e-8), 1.0)
        return ideal * scale[..., None]

    def jacobian(self, ideal: Array) -> Array:
        r2 = _square(ideal)
        r = np.sqrt(r2)
        theta, length = np.arctan(r), np.maximum(r, 1e-8)
        scale = np.where(r > 1e-8, self._image(theta) / length, 1.0)
        along = self._slope(theta) / (1.0 + r2)
        outer = ideal[..., :, None] * ideal[..., None, :]
        bend = np.where(r > 1e-8, (along - scale) / length**2, 0.0)
        return scale[..., None, None] * np.eye(2) + bend[..., None, None] * outer

    def _invert(self, distorted: Array, tolerance: float) -> Array:
        seen = np.sqrt(_square(distorted))
        angles = np.linspace(0.0, self.valid_angle, _TABLE)
        theta = np.interp(seen, self._image(angles), angles)
        for _ in range(_NEWTON_ROUNDS):
            step = (seen - self._image(theta)) / self._slope(theta)
            theta = np.clip(theta + step, 0.0, self.valid_angle)
            if not np.any(np.abs(step) > 1e-3 * tolerance):
                break
        return (
            distorted * np.where(seen > 1e-8, np.tan(theta) / np.maximum(seen, 1e-8), 1.0)[:, None]
        )


@lru_cache(maxsize=64)
def lens_of(model: LensModel, coefficients: tuple[float, ...]) -> Lens:
    """Return a lens. Raises ValueError for an unknown model, a wrong number of coefficients, and
    such that are not finite.
    """
    if model not in get_args(LensModel):
        raise ValueError(f"unknown lens model {model!r}; known: {', '.join(get_args(LensModel))}")
    counts = COEFFICIENTS[model]
    if len(coefficients) not in counts:
        raise ValueError(
            f"the {model} lens takes {one_of(counts)} distortion coefficients, not "
            f"{len(coefficients)}"
        )
    if not all(map(math.isfinite, coefficients)):
        raise ValueError(f"distortion coefficients must be finite: {coefficients}")
    return _Equidistant(coefficients) if model == "equidistant" else _Perspective(coefficients)


def one_of(counts: tuple[int, ...]) -> str:
    """Return numbers as text: 4, 5 or 8."""
    *first, last = map(str, counts)
    return f"{', '.join(first)} or {last}" if first else last
