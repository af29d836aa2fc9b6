# SPDX-License-Identifier: Apache-2.0
"""Measure the position of a target too far for markers, from its bearing in the image.

Range and attitude are measured otherwise. The target is the spot that has the size of the known
shape at that range. Its centre is placed so that the centroid of the projected shape is that of the
spot.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.targets import TargetModel, cuboid_corners
from numpy.typing import ArrayLike, NDArray

from .lens import strong_stretch
from .pnp import TargetPose

POINT_SPREAD_PX = 0.65
"""Standard deviation per axis (px) of the image of a point."""


@dataclass(frozen=True)
class BearingParameters:
    """Parameters of the search for a spot, measured by benchmarks/perception.py
    (markers-bearing).
    """

    # Least brightness of a spot above the background, grey levels.
    levels: float = 6.0
    # The same in standard deviations of the noise: 1 pixel in 3.5 million exceeds it without a
    # spot.
    sigmas: float = 5.0
    # Margin of a spot, px, whose pixels belong to it: three standard deviations of the point
    # spread.
    margin_px: int = 2
    # A pixel's grey level counts up to a share of the spot's brightness, so that differently lit
    # faces of a large spot count alike, and pixels of a small one in proportion to what they show
    # of the target. The share is this number over the spot's radius,
    saturation_px: float = 0.6
    # at least this share,
    saturation_min: float = 0.1
    # at most this share,
    saturation_max: float = 0.8
    # and at least this many grey levels.
    saturation_levels: float = 8.0
    # Error of the centroid by pixel grid and compression, px at a radius of 1 px; it falls with the
    # root of the radius. Measured.
    grid_share_px: float = 0.2
    # Error of the centroid by markers and light, as a share of the radius. Measured.
    light_share: float = 0.013
    # Largest error of a spot's radius, as a share of the expected one,
    size_share: float = 0.25
    # plus this many standard deviations by noise.
    size_sigmas: float = 5.0
    # Least brightness of the target above the background, grey levels averaged over its silhouette.
    level_min: float = 10.0
    # Largest brightness: that of the sensor.
    level_max: float = 255.0
    # Greatest distance of the target from the predicted place, px.
    near_px: float = 8.0
    # Without a prediction, the brightest spot is accepted if it exceeds the next by this factor
    # (docs/estimation.md).
    clear_ratio: float = 1.5
    # Expected radius, px, below which stars are as bright as the target: the servicer beyond some
    # 120 m.
    star_px: float = 1.2
    # Such a small target is first accepted within this angle of the optical axis only.
    aim_rad: float = math.radians(2.0)
    # Least range in radii of the target: nearer, it does not look like a spot.
    nearest: float = 2.0
    # Largest range in radii: beyond, the target is less than a fifth of a pixel wide.
    farthest: float = 1e4
    # Side of the raster on which a silhouette is drawn, px. Its radius is exact to half a raster
    # pixel of some 100, far below ``size_share``.
    raster: int = 256


_SPOT = BearingParameters()


class BearingError(Exception):
    """An image without a spot that is clearly the target."""


class Silhouette(NamedTuple):
    """Area (px²), centroid (2,) and root mean square radius of a silhouette, in ideal pixels."""

    area_px2: float
    centroid_px: Array
    radius_px: float


class Spot(NamedTuple):
    """A bright spot.

    ``centroid_px`` (2,). ``radius_px``: root mean square radius. ``flux``: sum of the grey levels
    above the background. ``noise_px``: standard deviation of the centroid per axis by the noise of
    the image.
    """

    centroid_px: Array
    radius_px: float
    flux: float
    noise_px: float


class RangedTarget(NamedTuple):
    """Measured range of the target, m, with standard deviation, and its attitude.

    Attitude: TRF to IRF (4,), with covariance (3, 3) in TRF axes.
    """

    range_m: float
    range_sigma_m: float
    q_wxyz: Array
    attitude_covariance_rad2: Array


class BearingFinder:
    """Find the target as a spot in images of a camera. Stateless.

    ``focal_share``: standard deviation of the relative error of the focal length. The range does
    not depend on it, while estimators expect depths as seen through the camera.
    """

    def __init__(self, camera: Camera, model: TargetModel, focal_share: float = 0.0) -> None:
        self._camera, self._focal_share = camera, focal_share
        self._corners = np.array(
            [
                rotations.rotate(np.array(b.q_wxyz), cuboid_corners(b.size_m)) + b.position_m
                for b in model.boxes
            ]
        )
        self._reach_m = float(np.linalg.norm(self._corners, axis=-1).max())

    def find(
        self,
        image: NDArray[np.uint8],
        target: RangedTarget,
        predicted_irf_m: ArrayLike | None = None,
    ) -> TargetPose:
        """Return the pose of the target in a grey image (h, w).

        ``predicted_irf_m`` (3,): predicted position, near which the spot is expected. Raises
        BearingError if no spot is clearly the target.
        """
        if not _SPOT.nearest * self._reach_m < target.range_m < _SPOT.farthest * self._reach_m:
            raise BearingError(
                f"a range of {target.range_m:.3g} m is too near or too far for a bearing"
            )
        expected = self._silhouette(np.array([0.0, 0.0, target.range_m]), target.q_wxyz)
        spots = find_spots(image, expected.radius_px)
        plausible = [(s, v) for s in spots if (v := self._shape_at(s, target)) is not None]
        if not plausible:
            sizes = ", ".join(
                f"{s.radius_px:.1f}" for s in sorted(spots, key=lambda s: -s.flux)[:3]
            )
            raise BearingError(
                f"no spot of the target's size, a radius of {_blurred(expected.radius_px):.1f} px "
                f"at {target.range_m:.1f} m" + (f"; the brightest have {sizes} px" if spots else "")
            )
        spot, seen = self._choose(plausible, predicted_irf_m, expected.radius_px < _SPOT.star_px)
        ideal = self._camera.undistort(spot.centroid_px)
        place = self._along(ideal, target.range_m)
        centre = ideal - (seen.centroid_px - self._camera.project_ideal(place))
        sigma_px = math.hypot(spot.noise_px, bias_px(seen.radius_px)) * self._stretch(ideal)
        return self._pose(centre, sigma_px, target)

    def _choose(
        self,
        plausible: list[tuple[Spot, Silhouette]],
        predicted_irf_m: ArrayLike | None,
        starlike: bool,
    ) -> tuple[Spot, Silhouette]:
        if predicted_irf_m is not None:
            place = self._camera.project(predicted_irf_m)
            near = min(
                plausible, key=lambda found: float(np.linalg.norm(found[0].centroid_px - place))
            )
            if (
                float(np.linalg.norm(near[0].centroid_px - place))
                < _SPOT.near_px + near[1].radius_px
            ):
                return near
        found = [p for p in plausible if not starlike or self._off_axis(p[0]) < _SPOT.aim_rad]
        if not found:
            raise BearingError(
                "spots of the target's size may be stars, away from the optical axis"
            )
        first, *others = sorted(found, key=lambda candidate: -candidate[0].flux)
        if others and first[0].flux < _SPOT.clear_ratio * others[0][0].flux:
            raise BearingError(
                f"{len(found)} spots of the target's size, none much brighter than the others"
            )
        return first

    def _off_axis(self, spot: Spot) -> float:
        """Return the angle between a spot and the optical axis, rad."""
        return math.acos(
            min(float(self._along(self._camera.undistort(spot.centroid_px), 1.0)[2]), 1.0)
        )

    def _shape_at(self, spot: Spot, target: RangedTarget) -> Silhouette | None:
        """Return the silhouette expected at a spot; None if size or brightness of the spot differ
        from it.
        """
        ideal = self._camera.undistort(spot.centroid_px)
        if not np.all(np.isfinite(ideal)):
            return None
        expected = self._silhouette(self._along(ideal, target.range_m), target.q_wxyz)
        stretch = self._stretch(ideal)
        radius = _blurred(expected.radius_px / stretch)
        fits = (
            abs(spot.radius_px - radius)
            <= _SPOT.size_share * radius + _SPOT.size_sigmas * spot.noise_px
        )
        level = spot.flux / (expected.area_px2 / stretch**2)
        return expected if fits and _SPOT.level_min <= level <= _SPOT.level_max else None

    def _stretch(self, ideal_px: Array) -> float:
        return float(strong_stretch(self._camera, ideal_px)) if self._camera.distorts else 1.0

    def _silhouette(self, position_irf_m: Array, q_wxyz: Array) -> Silhouette:
        return silhouette(self._camera, self._corners, q_wxyz, position_irf_m)

    def _along(self, ideal_px: Array, range_m: float) -> Array:
        c = self._camera
        ray = np.array([(ideal_px[0] - c.cx_px) / c.fx_px, (ideal_px[1] - c.cy_px) / c.fy_px, 1.0])
        return ray * (range_m / float(np.linalg.norm(ray)))

    def _pose(self, centre_px: Array, sigma_px: float, target: RangedTarget) -> TargetPose:
        """Return the pose with its covariance.

        An error in pixels moves the target across the line of sight, an error of the range along
        it.
        """
        position = self._along(centre_px, target.range_m)
        c, along = self._camera, position / target.range_m
        # Displacement of the target per pixel (3, 2), less its part along the line of sight.
        across = np.array([[1.0 / c.fx_px, 0.0], [0.0, 1.0 / c.fy_px], [0.0, 0.0]]) * position[2]
        across = across - np.outer(along, along @ across)
        range_sigma = math.hypot(target.range_sigma_m, self._focal_share * target.range_m)
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = sigma_px**2 * across @ across.T + range_sigma**2 * np.outer(
            along, along
        )
        covariance[3:, 3:] = target.attitude_covariance_rad2
        return TargetPose(position, target.q_wxyz, covariance, sigma_px)


def bias_px(radius_px: float) -> float:
    """Return the systematic error of a spot's centroid, px: its standard deviation per axis.

    It is due to pixel grid and compression, and to markers and light.
    """
    return math.hypot(
        _SPOT.grid_share_px / math.sqrt(max(radius_px, 1.0)), _SPOT.light_share * radius_px
    )


def _blurred(radius_px: float) -> float:
    return math.hypot(radius_px, math.sqrt(2.0) * POINT_SPREAD_PX)


def silhouette(
    camera: Camera, corners_trf_m: Array, q_wxyz: Array, position_irf_m: Array
) -> Silhouette:
    """Return the silhouette of cuboids with corners (n, 8, 3) in TRF, at a pose in front of the
    camera.
    """
    px = camera.project_ideal(rotations.rotate(q_wxyz, corners_trf_m) + position_irf_m)
    low = px.min(axis=(0, 1))
    scale = (_SPOT.raster - 3) / float((px.max(axis=(0, 1)) - low).max())
    canvas = np.zeros((_SPOT.raster, _SPOT.raster), dtype=np.uint8)
    for cuboid in np.round(((px - low) * scale + 1.0) * 16.0).astype(np.int32):
        cv2.fillConvexPoly(canvas, cv2.convexHull(cuboid), 1, shift=4)
    m = cv2.moments(canvas, binaryImage=True)
    centroid = np.array([m["m10"], m["m01"]]) / m["m00"]
    radius = math.sqrt((m["mu20"] + m["mu02"]) / m["m00"])
    return Silhouette(m["m00"] / scale**2, (centroid - 1.0) / scale + low, radius / scale)


def find_spots(image: NDArray[np.uint8], radius_px: float) -> list[Spot]:
    """Return the bright spots of an image (h, w) that may have a root mean square radius
    ``radius_px``.

    Spots that touch the border are left out.
    """
    # No shape extends beyond four times its radius; ``_shape_at`` decides.
    largest = 4.0 * _blurred(radius_px) + 2.0 * _SPOT.margin_px
    share = min(max(_SPOT.saturation_px / radius_px, _SPOT.saturation_min), _SPOT.saturation_max)

    level = float(np.median(image))
    sigma = max(1.4826 * float(np.median(np.abs(image - level))), 1.0)
    _, bright = cv2.threshold(
        image, level + max(_SPOT.levels, _SPOT.sigmas * sigma), 1, cv2.THRESH_BINARY
    )
    _, labels, stats, _ = cv2.connectedComponentsWithStats(bright, connectivity=8)

    height, width = image.shape
    spots = []
    for label, (x, y, w, h, area) in enumerate(stats.tolist()):
        inside = (
            x > _SPOT.margin_px
            and y > _SPOT.margin_px
            and x + w + _SPOT.margin_px < width
            and y + h + _SPOT.margin_px < height
        )
        if label == 0 or area < 2 or max(w, h) > largest or not inside:
            continue
        part = (
            slice(y - _SPOT.margin_px, y + h + _SPOT.margin_px),
            slice(x - _SPOT.margin_px, x + w + _SPOT.margin_px),
        )
        spot = _measure(image[part] - level, labels[part] == label, sigma, share)
        first = np.array([part[1].start, part[0].start])
        spots.append(spot._replace(centroid_px=spot.centroid_px + first))
    return spots


def _measure(above: Any, mask: NDArray[np.bool_], sigma: float, share: float) -> Spot:
    """Return the spot that ``mask`` (h, w) covers.

    ``above`` (h, w): grey levels above the background. ``sigma``: their noise. ``share``:
    saturation, see ``BearingParameters.saturation_px``.
    """
    kernel = np.ones((2 * _SPOT.margin_px + 1, 2 * _SPOT.margin_px + 1), dtype=np.uint8)
    around = cv2.dilate(mask.astype(np.uint8), kernel)
    above = above * around
    limit = max(share * float(np.quantile(above[mask], 0.9)), _SPOT.saturation_levels)
    weights = np.clip(above / limit, -1.0, 1.0)
    total = max(float(weights.sum()), 1.0)
    y, x = np.indices(above.shape)
    centre = np.array([(weights * x).sum(), (weights * y).sum()]) / total
    distance2 = (x - centre[0]) ** 2 + (y - centre[1]) ** 2
    radius = math.sqrt(max(float((weights * distance2).sum()) / total, 0.0))
    noise = (
        sigma / limit / total * math.sqrt(float((distance2 * (weights < 1.0) * around).sum()) / 2.0)
    )
    return Spot(centre, radius, float(above.sum()), noise)
