# SPDX-License-Identifier: Apache-2.0
"""A satellite of cuboids without markers: as a ray tracer draws it, and as a tracker mesh."""

from __future__ import annotations

import cv2
import numpy as np
from chaserdock_agents.chaser.perception.model.mesh import TrackerMesh
from chaserdock_agents.chaser.perception.model.rendering import Lighting
from chaserdock_agents.chaser.perception.refine import PoseInCamera
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.satellites import satellite
from chaserdock_models.targets import Box
from chaserdock_protocol.scenario.camera import Effects
from chaserdock_world.rendering.background import WHITE_LEVEL, Light
from chaserdock_world.rendering.effects import CameraEffects
from chaserdock_world.rendering.mesh_renderer import MeshRenderer
from numpy.typing import NDArray

# Bus, panels on booms, instruments and thrusters: different on every side.
BOXES = (
    Box((0.40, 0.32, 0.32), (0.0, 0.0, 0.0), shade=0.6),
    Box((0.16, 0.50, 0.012), (0.02, 0.47, 0.03), shade=0.25),
    Box((0.16, 0.38, 0.012), (0.02, -0.41, 0.03), shade=0.25),
    Box((0.02, 0.06, 0.02), (0.02, 0.19, 0.03), shade=0.8),
    Box((0.02, 0.06, 0.02), (0.02, -0.19, 0.03), shade=0.8),
    Box((0.12, 0.14, 0.10), (-0.02, 0.05, 0.21), shade=0.85),
    Box((0.08, 0.08, 0.14), (0.09, -0.06, -0.23), shade=0.35),
    Box((0.10, 0.06, 0.06), (0.25, 0.08, 0.06), shade=0.9),
    Box((0.06, 0.10, 0.10), (-0.23, -0.05, -0.04), shade=0.45),
)
PANELS = (1, 2)


def mesh_of(
    boxes: tuple[Box, ...] = BOXES, panel_sigma_rad: float = 0.0, scale_sigma: float = 0.0
) -> TrackerMesh:
    """Return the mesh of ``boxes``; modes: each panel about its boom (the y axis), and the scale of
    all.
    """
    exact = TrackerMesh.of_boxes(boxes, 0.0)
    vertices = exact.vertices_m
    modes = []
    if panel_sigma_rad > 0.0:
        for panel in PANELS:
            mode = np.zeros_like(vertices)
            own = slice(8 * panel, 8 * panel + 8)
            mode[own] = panel_sigma_rad * np.cross(
                [0.0, 1.0, 0.0], vertices[own] - boxes[panel].position_m
            )
            modes.append(mode)
    if scale_sigma > 0.0:
        modes.append(scale_sigma * vertices)
    stacked = np.array(modes).reshape(len(modes), len(vertices), 3)
    return TrackerMesh(vertices, exact.triangles, exact.reflectance, stacked)


def wrong_boxes(panel_rad: tuple[float, float], scale: float) -> tuple[Box, ...]:
    """Return the boxes with turned panels and another scale: a tracker's imperfect knowledge."""
    out = []
    for i, box in enumerate(BOXES):
        angle = panel_rad[PANELS.index(i)] if i in PANELS else 0.0
        w, x, y, z = rotations.exp(np.array([0.0, angle, 0.0])).tolist()
        (a, b, c), (d, e, f) = (scale * np.array(v) for v in (box.size_m, box.position_m))
        out.append(
            Box(
                (float(a), float(b), float(c)),
                (float(d), float(e), float(f)),
                (w, x, y, z),
                box.shade,
            )
        )
    return tuple(out)


class Scene:
    """A ray tracer of the cuboids, with cast shadows; independent of the tracker's and of the
    world's rasterizer.

    ``background`` (h, w): grey levels behind the target, None for space.
    """

    def __init__(
        self, camera: Camera, background: Array | None = None, boxes: tuple[Box, ...] = BOXES
    ) -> None:
        self.camera, self.boxes, self.samples = camera, boxes, 2
        shape = (camera.height_px, camera.width_px)
        self.background = np.full(shape, 4.0) if background is None else background
        self.effects = CameraEffects(camera.width_px, camera.height_px, Effects(), 11)

    def image(
        self, pose: PoseInCamera, light: Light, number: int = 0, gain: float = 1.0
    ) -> NDArray[np.uint8]:
        """Return the image (h, w) with point spread and noise; ``gain`` multiplies the light."""
        low, high = self._rectangle(pose)
        exact = self.background.copy()
        if np.all(high > low):
            n = self.samples
            offsets = (np.arange(n) + 0.5) / n - 0.5
            x = (np.arange(low[0], high[0])[:, None] + offsets).ravel()
            y = (np.arange(low[1], high[1])[:, None] + offsets).ravel()
            px = self.camera.undistort(np.stack(np.meshgrid(x, y), axis=-1))
            ideal = (px - (self.camera.cx_px, self.camera.cy_px)) / (
                self.camera.fx_px,
                self.camera.fy_px,
            )
            rays = (
                np.concatenate([ideal, np.ones((*ideal.shape[:2], 1))], axis=-1).reshape(-1, 3)
                @ pose.rotation
            )
            grey = self._trace(
                rays, -pose.rotation.T @ pose.position, pose.rotation.T @ light.direction_w, light
            )
            grey = grey.reshape(len(y), len(x))
            window = np.s_[low[1] : high[1], low[0] : high[0]]
            behind = np.repeat(np.repeat(exact[window], n, axis=0), n, axis=1)
            fine = np.where(np.isnan(grey), behind, np.minimum(gain * grey, 255.0))
            exact[window] = fine.reshape(len(y) // n, n, len(x) // n, n).mean(axis=(1, 3))
        spread = cv2.GaussianBlur(exact, (0, 0), Effects().point_spread_px)
        return self.effects.apply(np.rint(np.clip(spread, 0.0, 255.0)).astype(np.uint8), 0, number)

    def _rectangle(self, pose: PoseInCamera) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Return the pixels, first and end, that the target touches."""
        corners = mesh_of(self.boxes).vertices_m @ pose.rotation.T + pose.position
        px = self.camera.project(np.where(corners[:, 2:] > 0.05, corners, [0.0, 0.0, 1.0]))
        size = np.array([self.camera.width_px, self.camera.height_px])
        low = np.clip(np.floor(px.min(axis=0)) - 4, 0, size)
        return low.astype(np.int64), np.clip(np.ceil(px.max(axis=0)) + 5, 0, size).astype(np.int64)

    def _trace(self, rays: Array, origin: Array, to_sun: Array, light: Light) -> Array:
        """Return the grey level (n,) of rays (n, 3) in TRF, NaN where they miss."""
        nearest, grey = np.full(len(rays), np.inf), np.full(len(rays), np.nan)
        normal = np.zeros((len(rays), 3))
        shade = np.zeros(len(rays))
        for box in self.boxes:
            near = _rays_near(box, origin, rays)
            enter, axis, direction = _enter(box, origin, rays[near])
            hit = enter < nearest[near]
            chosen = near[hit]
            nearest[chosen], shade[chosen] = enter[hit], box.shade
            side = axis[hit]
            own = -np.sign(direction[hit, side])[:, None] * np.eye(3)[side]
            normal[chosen] = own @ rotations.to_matrix(np.array(box.q_wxyz)).T
        seen = np.isfinite(nearest)
        cosine = np.maximum(normal[seen] @ to_sun, 0.0)
        points = origin + rays[seen] * nearest[seen, None] + 1e-5 * normal[seen]
        lit = cosine > 0.0
        for box in self.boxes:
            rest = np.flatnonzero(lit)
            enter, _, _ = _enter(box, points[rest], np.broadcast_to(to_sun, (len(rest), 3)))
            lit[rest[np.isfinite(enter)]] = False
        grey[seen] = WHITE_LEVEL * shade[seen] * (light.ambient + light.sun * cosine * lit)
        return grey


def _rays_near(box: Box, origin: Array, rays: Array) -> NDArray[np.int64]:
    """Return the indices of the rays that come within the sphere around a box."""
    to = np.array(box.position_m) - origin
    along = rays @ to
    square = np.einsum("ij,ij->i", rays, rays)
    gap = float(to @ to) - along * along / square
    return np.flatnonzero(gap < 0.25 * float(np.dot(box.size_m, box.size_m)))


def _enter(box: Box, origin: Array, rays: Array) -> tuple[Array, NDArray[np.int64], Array]:
    """Return the distance at which rays enter a box, infinite for a miss, the axis of the side, and
    the rays in box axes.
    """
    to_box = rotations.to_matrix(np.array(box.q_wxyz))
    start, direction = (origin - np.array(box.position_m)) @ to_box, rays @ to_box
    with np.errstate(divide="ignore", invalid="ignore"):
        half = np.array(box.size_m) / 2.0
        a, b = (-half - start) / direction, (half - start) / direction
    first, last = np.minimum(a, b), np.maximum(a, b)
    axis = np.argmax(first, axis=1)
    enter = first.max(axis=1)
    return np.where((enter > 0.0) & (enter < last.min(axis=1)), enter, np.inf), axis, direction


def lighting_of(light: Light) -> Lighting:
    """Return the light as flight software knows it."""
    return Lighting(np.array(light.direction_w), light.sun, light.ambient)


def backlit_view(rng: np.random.Generator, camera: Camera) -> tuple[PoseInCamera, Light]:
    """Draw a pose at 1 to 3 m, and a sun behind the target."""
    pose, _ = random_view(rng, rng.uniform(1.0, 3.0), camera)
    sun = (rng.normal(0.0, 0.6), rng.normal(0.0, 0.6), 1.0)
    ambient = float(rng.uniform(0.01, 0.2))
    return pose, Light(sun, 1.0 - ambient, ambient)


def satellite_image(pose: PoseInCamera, light: Light, number: int) -> NDArray[np.uint8]:
    """Return an image (540, 960), 60 degrees wide, of `geo_servicer` by the world's renderer, as
    benchmarks/perception.py makes it.
    """
    camera = Camera.from_hfov(960, 540, np.deg2rad(60.0))
    renderer = MeshRenderer(camera, satellite("geo_servicer"), None, Effects().point_spread_px)
    q = rotations.from_matrix(pose.rotation)
    exact = renderer.render(np.zeros(3), rotations.IDENTITY, pose.position, q, (), light)
    return CameraEffects(960, 540, Effects(), 11).apply(exact, 0, number)


def random_view(
    rng: np.random.Generator, range_m: float, camera: Camera
) -> tuple[PoseInCamera, Light]:
    """Draw an attitude, a place in the middle of the image and a direction of the sun in front of
    the target.
    """
    aside = rng.uniform(-0.1, 0.1, 2) * (camera.width_px, camera.height_px) / camera.fx_px
    rotation = rotations.to_matrix(rotations.normalize(rng.normal(size=4)))
    sun = rng.normal(size=3)
    sun[2] = -abs(sun[2])
    position = np.append(aside, 1.0) * range_m
    return PoseInCamera(position, rotation), Light(tuple(sun.tolist()))


def perturbed(
    pose: PoseInCamera, rng: np.random.Generator, share: float, angle_rad: float
) -> PoseInCamera:
    """Return ``pose`` moved by ``share`` of its range and turned by ``angle_rad``, in random
    directions.
    """
    move: Array = rng.normal(size=3)
    axis: Array = rng.normal(size=3)
    move *= share * np.linalg.norm(pose.position) / np.linalg.norm(move)
    turn = rotations.to_matrix(rotations.exp(angle_rad * axis / np.linalg.norm(axis)))
    return PoseInCamera(pose.position + move, turn @ pose.rotation)
