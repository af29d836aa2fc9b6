# SPDX-License-Identifier: Apache-2.0
"""External view of a mission: the viewpoint, and what is drawn around the rendered bodies."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from numpy.typing import NDArray

from .camera_frustum import CameraFrustum
from .dressed_bodies import tint
from .motion import Track

BgrImage = NDArray[np.uint8]
BodyPose = tuple[Array, Array]
"""Position (3,) WRF and attitude (4,) body to WRF."""

_NEAR_M = 0.02
"""Least depth (m) that is drawn; bounds the division by depth. Bodies are farther away."""
_SHIFT = 4
"""Bits of OpenCV's fixed-point coordinates behind the point: 1/16 px, finer than antialiasing
shows."""
_TARGET_PATH = (150, 150, 150)
"""Colour (BGR, 0 to 255) of the target's path: grey, because chasers are coloured."""
_PLUME = np.array([255.0, 226.0, 190.0])
_PLUME_SHARE = 0.3
"""Opacity of each of the four layers of a plume."""


@dataclass(frozen=True)
class Viewpoint:
    """A camera that looks at a point ``centre_m`` (3,), WRF.

    ``distance_m``, ``azimuth_rad``, ``elevation_rad``: position of the camera from that point, in
    WRF. ``middle_px``: where the point is seen; the middle of the image without it.
    """

    centre_m: Array
    distance_m: float
    azimuth_rad: float
    elevation_rad: float
    width_px: int
    height_px: int
    middle_px: tuple[float, float] | None = None

    @property
    def eye_m(self) -> Array:
        """Position (3,) of the camera, WRF."""
        return self.centre_m + self.axes()[2] * self.distance_m

    @property
    def principal_px(self) -> tuple[float, float]:
        """Where the optical axis meets the image."""
        return self.middle_px or (self.width_px / 2.0, self.height_px / 2.0)

    def axes(self) -> Array:
        """Return the camera axes right, up and backwards (3, 3), rows in WRF."""
        ca, sa = np.cos(self.azimuth_rad), np.sin(self.azimuth_rad)
        ce, se = np.cos(self.elevation_rad), np.sin(self.elevation_rad)
        back = np.array([ce * ca, ce * sa, se])
        right = np.array([-sa, ca, 0.0])
        return np.stack([right, np.cross(back, right), back])

    @property
    def focal_px(self) -> float:
        """Focal length, pixels."""
        return 1.25 * min(self.width_px, 1.35 * self.height_px)

    def pinhole(self) -> Camera:
        """Return the camera's intrinsics."""
        w, h = self.width_px, self.height_px
        return Camera(w, h, self.focal_px, self.focal_px, *self.principal_px)

    def attitude(self) -> Array:
        """Return the rotation (4,) from image axes (right, down, forward) to WRF."""
        right, up, back = self.axes()
        return rotations.from_matrix(np.stack([right, -up, -back], axis=1))

    def project(self, points_m: Array) -> tuple[Array, Array]:
        """Return pixels (..., 2) and depths (...), m, of points (..., 3) in WRF. Pixels are invalid
        at depths <= 0.
        """
        local = (points_m - self.centre_m) @ self.axes().T
        depth = self.distance_m - local[..., 2]
        scale = self.focal_px / np.maximum(depth, _NEAR_M)[..., None]
        px = local[..., :2] * scale * (1.0, -1.0) + self.principal_px
        return px, depth


def interpolated(track: Track, time_s: float) -> BodyPose:
    """Return the pose at a time, between the ticks around it; the first or last one outside."""
    last = len(track.time_s) - 1
    row = min(max(int(np.searchsorted(track.time_s, time_s)) - 1, 0), max(last - 1, 0))
    after = min(row + 1, last)
    span_s = max(float(track.time_s[after] - track.time_s[row]), 1e-9)
    share = min(max((time_s - float(track.time_s[row])) / span_s, 0.0), 1.0)
    p, q = track.position_m, track.q_wxyz
    end = q[after] if float(q[row] @ q[after]) >= 0.0 else -q[after]
    turned = (1.0 - share) * q[row] + share * end  # ticks are degrees apart: as good as slerp
    return p[row] + share * (p[after] - p[row]), turned / np.linalg.norm(turned)


@dataclass(frozen=True)
class Shot:
    """A picture of the bodies to be rendered. ``name``: unique in a film."""

    name: str
    look: Viewpoint
    target: BodyPose
    chasers: Mapping[int, BodyPose]


@dataclass(frozen=True)
class RenderedBodies:
    """Rendered bodies over a background (`body_renderer`). ``bgr`` (h, w, 3): the image.
    ``behind`` (h, w, 3): the same without bodies. ``covered`` (h, w): pixels that a body covers.
    """

    behind: BgrImage
    bgr: BgrImage
    covered: NDArray[np.bool_]


def _fixed(px: Array) -> NDArray[np.int32]:
    # Clip points far outside the image: OpenCV's fixed-point coordinates overflow.
    return np.round(np.clip(px, -20_000, 20_000) * (1 << _SHIFT)).astype(np.int32)


def _fill(image: BgrImage, px: Array, bgr: Array) -> None:
    cv2.fillConvexPoly(image, _fixed(px), np.clip(bgr, 0, 255).tolist(), cv2.LINE_AA, _SHIFT)


def _lines(
    image: BgrImage, view: Viewpoint, points_m: Array, bgr: Sequence[float], closed: bool = False
) -> None:
    px, depth = view.project(points_m)
    if len(px) > 1 and np.all(depth > _NEAR_M):
        cv2.polylines(image, [_fixed(px)], closed, bgr, 1, cv2.LINE_AA, _SHIFT)


def draw(
    frustum: CameraFrustum,
    view: Viewpoint,
    rendered: RenderedBodies,
    chasers: Mapping[int, BodyPose],
    paths: Mapping[int | None, Array],
    cameras: Mapping[int, bool],
    plumes: Mapping[int, Array] | None = None,
) -> BgrImage:
    """Draw paths, plumes and the frustums of cameras around rendered bodies: (height, width, 3),
    BGR.

    ``paths``: points (N, 3) WRF behind each chaser, and the target's under None. ``cameras``:
    chasers whose frustum is drawn, and whether their image was used; then it is brighter.
    ``plumes``: nozzles and ends of thruster plumes (K, 2, 3) of each chaser, CRF; those behind its
    centre are hidden by bodies.
    """
    image = rendered.behind.copy()
    for body, points in paths.items():
        shade = _TARGET_PATH if body is None else (0.75 * tint(body)).tolist()
        _lines(image, view, points, shade)
    before = []
    for i, lines in (plumes or {}).items():
        position, attitude = chasers[i]
        _, middle_m = view.project(position)
        for nozzle, end in rotations.rotate(attitude, lines) + position:
            if float(view.project(nozzle)[1]) < float(middle_m):
                before.append((nozzle, end))
            else:
                _draw_plume(image, view, nozzle, end)
    image[rendered.covered] = rendered.bgr[rendered.covered]
    for nozzle, end in before:
        _draw_plume(image, view, nozzle, end)
    _draw_cameras(image, view, frustum, chasers, cameras)
    return image


def _draw_cameras(
    image: BgrImage,
    view: Viewpoint,
    frustum: CameraFrustum,
    chasers: Mapping[int, BodyPose],
    cameras: Mapping[int, bool],
) -> None:
    """Draw the frustums of the chasers' cameras, and the chasers' numbers."""
    for i, used in cameras.items():
        position, attitude = chasers[i]
        strength = 1.0 if used else 0.4
        bgr = (strength * tint(i)).tolist()
        far = rotations.rotate(attitude, frustum.corners_m) + position
        origin = rotations.rotate(attitude, frustum.origin_m) + position
        for corner in far:
            _lines(image, view, np.stack([origin, corner]), bgr)
        _lines(image, view, far, bgr, closed=True)
        (x, y), _ = view.project(position)
        label_px = (
            round(float(np.clip(x, -1e4, 1e4))) + 22,
            round(float(np.clip(y, -1e4, 1e4))) - 20,
        )
        cv2.putText(
            image, str(i), label_px, cv2.FONT_HERSHEY_SIMPLEX, 0.55, (235, 235, 235), 1, cv2.LINE_AA
        )


def _draw_plume(image: BgrImage, view: Viewpoint, nozzle: Array, end: Array) -> None:
    """Draw a plume as a triangle that widens from the nozzle (3,) to its end (3,), WRF, and
    fades.
    """
    for share in (1.0, 0.75, 0.5, 0.25):
        px, depth = view.project(np.stack([nozzle, nozzle + share * (end - nozzle)]))
        along = px[1] - px[0]
        if np.any(depth <= _NEAR_M) or float(np.linalg.norm(along)) < 1.0:
            return
        across = 0.22 * np.array([-along[1], along[0]])
        corners = np.stack([px[0], px[1] + across, px[1] - across])
        low = np.clip(np.floor(corners.min(axis=0)).astype(int), 0, image.shape[1::-1])
        high = np.clip(np.ceil(corners.max(axis=0)).astype(int) + 1, 0, image.shape[1::-1])
        part = image[low[1] : high[1], low[0] : high[0]]
        if part.size:
            plume = part.copy()
            _fill(plume, corners - low, _PLUME)
            cv2.addWeighted(plume, _PLUME_SHARE, part, 1.0 - _PLUME_SHARE, 0.0, dst=part)
