# SPDX-License-Identifier: Apache-2.0
"""External view of a mission, drawn with OpenCV: rendered bodies, or flat faces in order of depth
(painter's algorithm).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from matplotlib.colors import to_rgb
from numpy.typing import NDArray

from .plots import colour
from .scene import Face, Scene

BgrImage = NDArray[np.uint8]
BodyPose = tuple[Array, Array]
"""Position (3,) WRF and attitude (4,) body to WRF."""

_NEAR_M = 0.02
"""Least depth (m) that is drawn; bounds the division by depth. Bodies are farther away."""
_SHIFT = 4
"""Bits of OpenCV's fixed-point coordinates behind the point: 1/16 px, finer than antialiasing
shows."""
_SPACE = (26, 21, 18)
"""Colour (BGR, 0 to 255) of space without a background: almost black, so that dark bodies stand
out.
"""
_TARGET_PATH = (150, 150, 150)
"""Colour (BGR, 0 to 255) of the target's path: grey, because chasers are coloured."""
_PLUME = np.array([255.0, 214.0, 150.0])


def tint(chaser: int) -> Array:
    """Return a chaser's colour (3,), BGR, 0 to 255: that of the figures, lightened for the dark
    background.
    """
    rgb = np.array(to_rgb(colour(chaser)))
    return (255.0 * (0.78 * rgb + 0.22))[::-1]


@dataclass(frozen=True)
class Viewpoint:
    """A camera that looks at a point ``centre_m`` (3,), WRF, in the middle of the image.

    ``distance_m``, ``azimuth_rad``, ``elevation_rad``: position of the camera from that point, in
    WRF.
    """

    centre_m: Array
    distance_m: float
    azimuth_rad: float
    elevation_rad: float
    width_px: int
    height_px: int

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
        return Camera(w, h, self.focal_px, self.focal_px, w / 2.0, h / 2.0)

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
        px = local[..., :2] * scale * (1.0, -1.0) + (self.width_px / 2.0, self.height_px / 2.0)
        return px, depth


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
    scene: Scene,
    view: Viewpoint,
    sun: Array,
    target: BodyPose,
    chasers: dict[int, BodyPose],
    paths: dict[int | None, Array],
    seeing: frozenset[int],
    plumes: dict[int, Array] | None = None,
    background: BgrImage | None = None,
    rendered: RenderedBodies | None = None,
) -> BgrImage:
    """Draw target and chasers into an image (height, width, 3), BGR.

    ``sun`` (3,): direction to it in WRF, unit length. ``paths``: points (N, 3) WRF behind each
    chaser, and the target's under None. ``seeing``: chasers whose image was used; their camera
    frustums are brighter. ``plumes``: nozzles and ends of thruster plumes (K, 2, 3) of each chaser,
    CRF. ``background``: stars and Earth; plain space without. ``rendered``: takes the place of the
    background and of the faces of the scene.
    """
    space = np.full((view.height_px, view.width_px, 3), _SPACE, dtype=np.uint8)
    if rendered is not None:
        background = rendered.behind
    image = space if background is None else background.copy()
    for body, points in paths.items():
        shade = _TARGET_PATH if body is None else (0.75 * tint(body)).tolist()
        _lines(image, view, points, shade)
    if rendered is None:
        _draw_faces(image, scene, view, sun, target, chasers)
    else:
        image[rendered.covered] = rendered.bgr[rendered.covered]
    for i, lines in (plumes or {}).items():
        position, attitude = chasers[i]
        for nozzle, end in rotations.rotate(attitude, lines) + position:
            _draw_plume(image, view, nozzle, end)
    _draw_cameras(image, view, scene, chasers, seeing)
    return image


def _draw_faces(
    image: BgrImage,
    scene: Scene,
    view: Viewpoint,
    sun: Array,
    target: BodyPose,
    chasers: dict[int, BodyPose],
) -> None:
    """Draw the faces of the bodies that are turned towards the view, the farthest first."""
    bodies: list[tuple[BodyPose, tuple[Face, ...], Array | None]] = [(target, scene.target, None)]
    bodies += [(pose, scene.chaser, tint(i)) for i, pose in chasers.items()]
    eye = view.centre_m + view.axes()[2] * view.distance_m
    visible = []
    for (position, attitude), faces, hue in bodies:
        for face in faces:
            corners = rotations.rotate(attitude, face.corners_m) + position
            normal = rotations.rotate(attitude, face.normal)
            away = eye - corners.mean(axis=0)
            if normal @ away > 0.0:
                light = 0.45 + 0.55 * max(0.0, float(normal @ sun))
                visible.append(
                    (
                        float(np.linalg.norm(away)) - face.lift_m,
                        position,
                        attitude,
                        face,
                        corners,
                        light,
                        hue,
                    )
                )
    visible.sort(key=lambda item: -item[0])
    for _, position, attitude, face, corners, light, hue in visible:
        px, depth = view.project(corners)
        if np.any(depth <= _NEAR_M):
            continue
        bgr = (
            np.full(3, float(face.grey)) if hue is None else hue * (0.3 + 0.75 * face.grey / 128.0)
        )
        _fill(image, px, bgr * light)
        for quad, grey in face.decals:
            px, _ = view.project(rotations.rotate(attitude, quad) + position)
            _fill(image, px, np.full(3, grey * light))


def _draw_cameras(
    image: BgrImage,
    view: Viewpoint,
    scene: Scene,
    chasers: dict[int, BodyPose],
    seeing: frozenset[int],
) -> None:
    """Draw the frustum of each chaser's camera, and its number."""
    for i, (position, attitude) in chasers.items():
        strength = 1.0 if i in seeing else 0.4
        bgr = (strength * tint(i)).tolist()
        far = rotations.rotate(attitude, scene.camera_corners_m) + position
        origin = rotations.rotate(attitude, scene.camera_origin_m) + position
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
    """Draw a plume as a triangle that widens from the nozzle (3,) to its end (3,), WRF."""
    px, depth = view.project(np.stack([nozzle, end]))
    along = px[1] - px[0]
    if np.any(depth <= _NEAR_M) or float(np.linalg.norm(along)) < 1.0:
        return
    across = 0.22 * np.array([-along[1], along[0]])
    _fill(image, np.stack([px[0], px[1] + across, px[1] - across]), _PLUME)
