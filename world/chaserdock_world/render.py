"""Pictures of textured cuboids, exactly projected: each visible face is warped with OpenCV, supersampled.

Order of painting: boxes do not overlap, so between any two there is a separating plane; the one on the
camera's side of it can hide the other and is painted later.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from chaserdock_protocol import rotations
from chaserdock_protocol.camera import Camera
from chaserdock_protocol.rotations import Array
from chaserdock_protocol.targets import Box, TargetModel
from numpy.typing import ArrayLike, NDArray

from chaserdock_world import textures
from chaserdock_world.faces import Face, Frustum, Obstacle, visible_boxes
from chaserdock_world.lens import Lens
from chaserdock_world.occlusion import PlacedBox, paint_order
from chaserdock_world.patches import Rectangle, patches
from chaserdock_world.sky import Earth, Light, Sky

# Samples a pixel along each axis: the most that keep the samples of the painted patch below the limit.
# (Textures are area averages, so even one sample a pixel puts corners to within 0.03 px.)
_SAMPLES = ((4, 500_000), (2, 1_000_000))

DAYLIGHT = Light()


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
        self._frustum = Frustum(camera, self._origin, self._size)

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

        bodies: list[Obstacle] = [(self.model.boxes, target_p_w_m, target_q_w_trf_wxyz), *obstacles]
        seen = visible_boxes(self._frustum, bodies, position, q_w_irf, to_sun, light)
        placed = [PlacedBox(box.centre_m, box.rotation, box.half_m, *box.bounds_px()) for box in seen]
        covered = [self._covered(box.low_px, box.high_px) for box in placed]
        canvas = self._sky.background(q_w_irf, light)
        order = paint_order(placed) if placed else []
        for patch, members in patches(covered):
            self._paint(canvas, patch, [face for i in order if i in members for face in seen[i].faces])
        return self._lens.distorted(canvas)

    def _covered(self, low: Array, high: Array) -> Rectangle:
        """The pixels of the canvas that an outline between ``low`` and ``high`` (2,) can touch."""
        x0, y0 = np.maximum(np.floor(low).astype(int) - 1, 0).tolist()
        x1, y1 = np.minimum(np.ceil(high).astype(int) + 2, self._size).tolist()
        return x0, y0, x1, y1

    def _paint(self, canvas: NDArray[np.uint8], patch: Rectangle, faces: list[Face]) -> None:
        """Paints faces, back to front, onto a supersampled copy of the ``patch`` of the canvas that they cover."""
        x0, y0, x1, y1 = patch
        if x1 <= x0 or y1 <= y0:
            return
        view = canvas[y0:y1, x0:x1]
        samples = next((n for n, limit in _SAMPLES if n * n * view.size <= limit), 1)
        size = (samples * (x1 - x0), samples * (y1 - y0))
        fine = np.asarray(cv2.resize(view, size, interpolation=cv2.INTER_NEAREST), dtype=np.uint8)
        # Ideal pixel of the camera -> sample of the fine patch; pixel centres are integers in both.
        shift = (samples - 1) / 2.0 - samples * (self._origin + np.array([x0, y0]))
        to_patch = np.array([[samples, 0.0, shift[0]], [0.0, samples, shift[1]], [0.0, 0.0, 1.0]])
        for face in faces:
            outline = (face.outline_px - (x0, y0)) * samples + (samples - 1) / 2.0
            if face.body == 0 and self._texture(face.box, face.side, 0, 0) is not None:
                self._paint_texture(fine, face, to_patch, outline)
            else:
                value = min(255, round(face.level * face.shade))
                fixed = np.rint(outline * 16.0).astype(np.int32)
                cv2.fillConvexPoly(fine, fixed, value, cv2.LINE_8, 4)
        cv2.resize(fine, (x1 - x0, y1 - y0), dst=view, interpolation=cv2.INTER_AREA)

    def _paint_texture(self, patch: NDArray[np.uint8], face: Face, to_patch: Array, outline: Array) -> None:
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

    def _texture_for(self, face: Face, to_patch: Array, outline: Array) -> NDArray[np.uint8]:
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
        texture = self._texture(face.box, face.side, level[0], level[1])
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
