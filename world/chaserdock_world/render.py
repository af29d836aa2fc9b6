"""Pictures of textured cuboids, exactly projected: each visible face is warped with OpenCV, supersampled.

Order of painting: boxes do not overlap, so between any two there is a separating plane; the one on the
camera's side of it can hide the other and is painted later.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
from chaserdock_protocol import rotations
from chaserdock_protocol.camera import Camera
from chaserdock_protocol.rotations import Array
from chaserdock_protocol.targets import Box, TargetModel, face_rotation
from numpy.typing import ArrayLike, NDArray

from chaserdock_world import textures
from chaserdock_world.lens import Lens
from chaserdock_world.occlusion import PlacedBox, paint_order
from chaserdock_world.sky import Earth, Light, Sky

NEAR_M = 0.01
"""Nothing nearer to the camera's plane than this is drawn."""

# Samples a pixel along each axis: the most that keep the samples of the painted patch below the limit.
# (Textures are area averages, so even one sample a pixel puts corners to within 0.03 px.)
_SAMPLES = ((4, 500_000), (2, 1_000_000))

DAYLIGHT = Light()

Obstacle = tuple[Sequence[Box], ArrayLike, ArrayLike]
"""Boxes in the axes of a body, its position (3,) in WRF and its attitude (4,), body -> WRF."""


def chaser_boxes(
    size_m: tuple[float, float, float] = (0.25, 0.25, 0.05), probe_reach_m: float = 0.35
) -> tuple[Box, ...]:
    """Boxes, in CRF, of a chaser: its body and a thin docking probe along +X up to ``probe_reach_m``.

    Raises ValueError when the probe does not reach beyond the body.
    """
    front = size_m[0] / 2.0
    if probe_reach_m <= front:
        raise ValueError(f"the probe ({probe_reach_m} m) must reach beyond the body's front ({front} m)")
    length = probe_reach_m - front
    probe = Box((length, 0.012, 0.012), (front + length / 2.0, 0.0, 0.0), shade=0.45)
    return (Box(size_m, shade=0.3), probe)


@dataclass(frozen=True)
class _Face:
    """One face in IRF: centre (3,), unit vectors right and up, width and height in metres, grey level at
    reflectance 1, the clipped outline (n, 2) in ideal pixels, and whether all of it lies in front."""

    centre: Array
    right: Array
    up: Array
    width_m: float
    height_m: float
    level: float
    outline_px: Array
    in_front: bool
    box: Box
    index: int
    textured: bool


class Renderer:
    """Draws what ``camera`` sees of a target and of other bodies.

    Keeps textures and lookup tables, no state: equal arguments give equal pictures. Raises ValueError when
    the camera's distortion cannot be inverted everywhere in the picture.
    """

    def __init__(self, camera: Camera, model: TargetModel, earth: Earth | None = None):
        self.camera = camera
        self.model = model
        # By box, face and the halvings of its resolution across and up; coarser ones are made when needed.
        self._textures: dict[tuple[int, int, int, int], NDArray[np.uint8] | None] = {
            (index, face, 0, 0): textures.finest_texture(model, index, face)
            for index in range(len(model.boxes))
            for face in range(6)
        }
        # The canvas is the ideal picture; with lens distortion it reaches beyond the frame.
        self._lens = Lens(camera)
        self._origin, self._size = self._lens.origin_px, self._lens.size_px
        self._sky = Sky(camera, self._origin, self._size, earth)
        # Planes n x + d >= 0 (n_x, n_y, n_z, d) within which a point is in front and on the canvas, with a
        # pixel to spare; and, of the canvas' borders, unit normals into it.
        left, top = (self._origin - 1.0 - (camera.cx_px, camera.cy_px)).tolist()
        right, bottom = left + self._size[0] + 1.0, top + self._size[1] + 1.0
        self._planes = np.array(
            [
                [0.0, 0.0, 1.0, -NEAR_M],
                [camera.fx_px, 0.0, -left, 0.0],
                [-camera.fx_px, 0.0, right, 0.0],
                [0.0, camera.fy_px, -top, 0.0],
                [0.0, -camera.fy_px, bottom, 0.0],
            ]
        )
        borders = self._planes[1:, :3] - [0.0, 0.0, 0.5]
        self._borders = (borders / np.linalg.norm(borders, axis=1, keepdims=True)).tolist()

    def render(
        self,
        camera_position_w_m: ArrayLike,
        camera_q_w_irf_wxyz: ArrayLike,
        target_p_w_m: ArrayLike,
        target_q_w_trf_wxyz: ArrayLike,
        obstacles: Sequence[Obstacle] = (),
        light: Light = DAYLIGHT,
    ) -> NDArray[np.uint8]:
        """Picture (h, w), uint8, of the target and the ``obstacles``, lens distortion included.

        ``camera_position_w_m`` (3,), ``camera_q_w_irf_wxyz`` (4,): see `Camera.irf_pose_in_world`.
        ``light``: a face turned from the sun lies in its own (attached) shadow; no shadows are cast.
        """
        q_w_irf = np.asarray(camera_q_w_irf_wxyz, dtype=float)
        position = np.asarray(camera_position_w_m, dtype=float)
        to_sun = rotations.rotate_inverse(q_w_irf, light.direction_w)

        placed: list[PlacedBox] = []
        faces: list[list[_Face]] = []
        bodies: list[Obstacle] = [(self.model.boxes, target_p_w_m, target_q_w_trf_wxyz), *obstacles]
        for body, (boxes, p_w, q_w) in enumerate(bodies):
            q_irf_body = rotations.multiply(rotations.conjugate(q_w_irf), q_w)
            p_irf = rotations.rotate_inverse(q_w_irf, np.asarray(p_w, dtype=float) - position)
            r_body = rotations.to_matrix(q_irf_body)
            for index, box in enumerate(boxes):
                shape = _shape(box)
                centre = p_irf + r_body @ shape.position
                if not self._may_be_seen(centre.tolist(), shape.radius):
                    continue
                r_box = r_body @ shape.rotation
                seen = self._visible_faces(box, index, body == 0, centre, r_box, to_sun, light)
                if seen:
                    outline = np.concatenate([face.outline_px for face in seen])
                    low, high = outline.min(axis=0), outline.max(axis=0)
                    placed.append(PlacedBox(centre, r_box, shape.half, low, high))
                    faces.append(seen)

        canvas = self._sky.background(q_w_irf, light)
        if faces:
            ordered = [face for i in paint_order(placed) for face in faces[i]]
            self._paint(canvas, ordered)
        return self._lens.distorted(canvas)

    def _may_be_seen(self, centre: list[float], radius: float) -> bool:
        """False when a sphere lies behind the near plane or beside the field of view."""
        x, y, z = centre
        if z + radius < NEAR_M:
            return False
        return all(a * x + b * y + c * z >= -radius for a, b, c in self._borders)

    def _visible_faces(
        self, box: Box, index: int, is_target: bool, centre: Array, r_box: Array, to_sun: Array, light: Light
    ) -> list[_Face]:
        shape = _shape(box)
        axes = (r_box @ _FACE_AXES).swapaxes(1, 2)  # rows: right, up, normal
        middles = centre + shape.depths * axes[:, 2]
        facing = np.flatnonzero((axes[:, 2] * middles).sum(axis=1) < 0.0)  # not seen from behind
        axes, middles = axes[facing], middles[facing]
        corners = (middles[:, None] + shape.across[facing] * axes[:, None, 0]) + shape.along[facing] * axes[
            :, None, 1
        ]
        in_front = np.logical_and.reduce(corners[..., 2] >= NEAR_M, axis=1)
        distances: Array = corners @ self._planes[:, :3].T + self._planes[:, 3]
        outside = distances < 0.0
        cut = np.logical_or.reduce(outside, axis=(1, 2))
        pixels = self.camera.project_ideal(corners) - self._origin
        cosines = (axes[:, 2] @ to_sun).tolist()
        found = []
        for k, face in enumerate(facing.tolist()):
            px = pixels[k]
            if cut[k]:
                polygon = self._clip(corners[k], outside[k])
                if len(polygon) < 3:
                    continue
                px = self.camera.project_ideal(polygon) - self._origin
            width, height, _ = _face_extent(box.size_m, face)
            level = light.level(cosines[k], -middles[k], axes[k, 2])
            textured = is_target and self._texture(index, face, 0, 0) is not None
            found.append(
                _Face(
                    middles[k],
                    axes[k, 0],
                    axes[k, 1],
                    width,
                    height,
                    level,
                    px,
                    bool(in_front[k]),
                    box,
                    6 * index + face,
                    textured,
                )
            )
        return found

    def _clip(self, corners: Array, outside: NDArray[np.bool_]) -> Array:
        """The part (n, 3) of a face (4, 3) that is in front and on the canvas (Sutherland-Hodgman);
        ``outside`` (4, 5): which corners lie outside of which planes."""
        if outside.all(axis=0).any():
            return corners[:0]
        polygon = corners
        for plane in self._planes[outside.any(axis=0)]:
            distance = polygon @ plane[:3] + plane[3]
            kept: list[Array] = []
            for i in range(len(polygon)):
                d0, d1 = distance[i - 1], distance[i]
                if (d0 < 0.0) != (d1 < 0.0):
                    kept.append(polygon[i - 1] + (polygon[i] - polygon[i - 1]) * (d0 / (d0 - d1)))
                if d1 >= 0.0:
                    kept.append(polygon[i])
            if len(kept) < 3:
                return corners[:0]
            polygon = np.array(kept)
        return polygon

    def _paint(self, canvas: NDArray[np.uint8], faces: list[_Face]) -> None:
        """Paints faces, back to front, onto a supersampled copy of the part of the canvas they cover."""
        outline = np.concatenate([face.outline_px for face in faces])
        x0, y0 = np.maximum(np.floor(outline.min(axis=0)).astype(int) - 1, 0).tolist()
        x1, y1 = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + 2, self._size).tolist()
        if x1 <= x0 or y1 <= y0:
            return
        view = canvas[y0:y1, x0:x1]
        samples = next((n for n, limit in _SAMPLES if n * n * view.size <= limit), 1)
        size = (samples * (x1 - x0), samples * (y1 - y0))
        patch = np.asarray(cv2.resize(view, size, interpolation=cv2.INTER_NEAREST), dtype=np.uint8)
        # Ideal pixel of the camera -> sample of the patch; pixel centres are integers in both.
        shift = (samples - 1) / 2.0 - samples * (self._origin + np.array([x0, y0]))
        to_patch = np.array([[samples, 0.0, shift[0]], [0.0, samples, shift[1]], [0.0, 0.0, 1.0]])
        for face in faces:
            outline = (face.outline_px - (x0, y0)) * samples + (samples - 1) / 2.0
            if face.textured:
                self._paint_texture(patch, face, to_patch, outline)
            else:
                value = min(255, round(face.level * face.box.shade))
                fixed = np.rint(outline * 16.0).astype(np.int32)
                cv2.fillConvexPoly(patch, fixed, value, cv2.LINE_8, 4)
        cv2.resize(patch, (x1 - x0, y1 - y0), dst=view, interpolation=cv2.INTER_AREA)

    def _paint_texture(self, patch: NDArray[np.uint8], face: _Face, to_patch: Array, outline: Array) -> None:
        low = np.maximum(np.floor(outline.min(axis=0)).astype(int) - 2, 0)
        high = np.minimum(np.ceil(outline.max(axis=0)).astype(int) + 3, (patch.shape[1], patch.shape[0]))
        if np.any(high <= low):
            return
        to_patch = to_patch @ self.camera.matrix()
        texture = self._texture_for(face, to_patch, outline)
        rows, columns = texture.shape
        # Texel (column, row, 1) -> point of the face in IRF -> sample of the patch.
        texel = np.array([[1.0, 0.0, 0.5 - columns / 2.0], [0.0, -1.0, rows / 2.0 - 0.5], [0.0, 0.0, 1.0]])
        basis = np.stack(
            [face.right * face.width_m / columns, face.up * face.height_m / rows, face.centre], axis=-1
        )
        to_roi = np.array([[1.0, 0.0, -low[0]], [0.0, 1.0, -low[1]], [0.0, 0.0, 1.0]]) @ to_patch
        homography = np.linalg.inv(to_roi @ basis @ texel)
        homography /= np.abs(homography).max()
        roi = patch[low[1] : high[1], low[0] : high[0]]
        size = (roi.shape[1], roi.shape[0])
        lit = cv2.convertScaleAbs(texture, alpha=face.level / 255.0)
        flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
        if face.in_front:
            # A transparent border blends over half a texel on either side of the face's edge.
            cv2.warpPerspective(lit, homography, size, roi, flags, cv2.BORDER_TRANSPARENT)
            return
        # Part of the face is behind the camera, where the homography mirrors it: paint the rest alone.
        warped = cv2.warpPerspective(lit, homography, size, None, flags, cv2.BORDER_REPLICATE)
        mask = np.zeros(roi.shape, dtype=np.uint8)
        cv2.fillConvexPoly(mask, np.rint((outline - low) * 16.0).astype(np.int32), 255, cv2.LINE_8, 4)
        cv2.copyTo(warped, mask, roi)

    def _texture_for(self, face: _Face, to_patch: Array, outline: Array) -> NDArray[np.uint8]:
        """The texture whose texels are, at the middle of the visible part, about a sample wide and high."""
        # Ray through the middle of the outline, cut with the face's plane.
        ray = np.linalg.solve(to_patch, np.append(outline.mean(axis=0), 1.0))
        normal = rotations.cross(face.right, face.up)
        point = ray * (normal @ face.centre) / (normal @ ray)
        level = []
        for axis in (face.right, face.up):
            moved = to_patch @ axis  # derivative of homogeneous sample coordinates per metre
            at = to_patch @ point
            samples_per_m = np.linalg.norm((moved[:2] - at[:2] / at[2] * moved[2]) / at[2])
            level.append(max(0, round(-float(np.log2(max(samples_per_m, 1.0) * textures.FINEST_TEXEL_M)))))
        texture = self._texture(face.index // 6, face.index % 6, level[0], level[1])
        assert texture is not None
        return texture

    def _texture(self, box_index: int, face: int, level_x: int, level_y: int) -> NDArray[np.uint8] | None:
        key = (box_index, face, level_x, level_y)
        if key not in self._textures:
            finest = self._textures[box_index, face, 0, 0]
            if finest is None:
                return None
            size = (max(2, finest.shape[1] >> level_x), max(2, finest.shape[0] >> level_y))
            # The mean over the area again, so that edges stay where they are.
            coarse = cv2.resize(finest, size, interpolation=cv2.INTER_AREA)
            self._textures[key] = np.asarray(coarse, dtype=np.uint8)
        return self._textures[key]


_FACE_AXES = np.array([rotations.to_matrix(face_rotation(face)) for face in range(6)])
_CORNERS = np.array([[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]])


def _face_extent(size_m: tuple[float, float, float], face: int) -> tuple[float, float, float]:
    """As `targets.face_extent`, without its general rotation: faces come in pairs along x, y and z."""
    x, y, z = size_m
    return ((y, z, x / 2.0), (x, z, y / 2.0), (x, y, z / 2.0))[face // 2]


@dataclass(frozen=True)
class _Shape:
    """What a box's own figures give: ``position`` (3,), ``rotation`` (3, 3), ``half`` edges (3,), ``radius`` of
    its bounding sphere; by face, distance of the middle ``depths`` (6, 1) and of the corners from it ``across``
    and ``along`` (6, 4, 1), metres."""

    position: Array
    rotation: Array
    half: Array
    radius: float
    depths: Array
    across: Array
    along: Array


@lru_cache(maxsize=1024)
def _shape(box: Box) -> _Shape:
    extents = np.array([_face_extent(box.size_m, face) for face in range(6)])
    size = np.array(box.size_m)
    return _Shape(
        np.array(box.position_m),
        rotations.to_matrix(box.q_wxyz),
        size / 2.0,
        0.5 * float(np.linalg.norm(size)),
        extents[:, 2:],
        (_CORNERS[:, 0] * extents[:, :1])[..., None],
        (_CORNERS[:, 1] * extents[:, 1:2])[..., None],
    )
