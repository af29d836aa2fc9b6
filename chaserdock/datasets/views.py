# SPDX-License-Identifier: Apache-2.0
"""Random views of a target, with images and masks by the world's renderer.

Sun and Earth stay where the scenario has them. The camera's attitude in WRF is drawn, which moves
both relative to camera and target. A view depends only on the seed and its number, so that a longer
dataset begins with the shorter one.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.meshes import Material, TriangleMesh
from chaserdock_models.rigid_body import BodyState
from chaserdock_models.targets import Box
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.physics.simulation import TARGET
from chaserdock_world.plant import true_mesh, true_target
from chaserdock_world.rendering.background import WHITE_LEVEL, Light
from chaserdock_world.rendering.cameras import Cameras, SceneRenderer
from chaserdock_world.rendering.mesh_renderer import MeshRenderer, mesh_of_boxes
from chaserdock_world.rendering.scene_geometry import Obstacle
from chaserdock_world.sensors.errors import true_camera
from numpy.typing import NDArray

from .shapes import shape_of
from .types import DatasetError, PoseLabel

_STREAM = 0xDA7A  # separates these random numbers from others of the same seed
_WHITE = Material("mask", diffuse=1.0)
_FULL_LIGHT = Light(sun=0.0, ambient=1.0)


@dataclass(frozen=True)
class ViewLimits:
    """Limits of random views.

    ``range_m``: least and largest distance of TRF's origin, log-uniform. ``offset_share``: largest
    distance of TRF's origin from the middle of the image, as a share of half its width and height,
    uniform. ``phase_deg``: least and largest angle at the target between sun and camera, uniform on
    that part of the sphere. Attitudes are uniform.
    """

    range_m: tuple[float, float] = (1.0, 3.0)
    offset_share: float = 0.2
    phase_deg: tuple[float, float] = (0.0, 120.0)

    def __post_init__(self) -> None:
        if not 0.0 < self.range_m[0] <= self.range_m[1]:
            raise DatasetError(
                f"range: must be positive and in ascending order, not {self.range_m[0]:g} to "
                f"{self.range_m[1]:g}"
            )
        if not 0.0 <= self.phase_deg[0] <= self.phase_deg[1] <= 180.0:
            raise DatasetError(
                f"phase: must be 0 to 180 degrees in ascending order, not {self.phase_deg[0]:g} "
                f"to {self.phase_deg[1]:g}"
            )
        if not 0.0 <= self.offset_share <= 1.0:
            raise DatasetError(f"offset: must be 0 to 1, not {self.offset_share:g}")


@dataclass(frozen=True, eq=False)
class TargetView:
    """A drawn view: its label, and the camera's attitude (4,), IRF to WRF."""

    label: PoseLabel
    q_w_irf_wxyz: Array


@dataclass(frozen=True, eq=False)
class ViewImage:
    """A rendered view with its masks.

    ``pixels`` (h, w): the image. ``mask`` (h, w): pixels of which the target covers half or more.
    ``visible`` (h, w): the same without those behind the chaser's own probe. ``silhouette``: the
    mask on a larger canvas, ``margin_px`` (2,) columns and rows on every side, that does not cut it
    off.
    """

    view: TargetView
    pixels: NDArray[np.uint8]
    mask: NDArray[np.bool_]
    visible: NDArray[np.bool_]
    silhouette: NDArray[np.bool_]
    margin_px: tuple[int, int]


def draw_view(
    limits: ViewLimits, camera: Camera, to_sun_w: Array, seed: int, number: int
) -> TargetView:
    """Draw view ``number``; ``to_sun_w`` (3,): unit vector in WRF."""
    rng = np.random.default_rng([seed, number, _STREAM])
    low, high = limits.range_m
    range_m = low * (high / low) ** rng.random()
    half = 0.5 * np.array([camera.width_px, camera.height_px])
    aside = rng.uniform(-limits.offset_share, limits.offset_share, 2) * half
    ideal = camera.undistort(half - 0.5 + aside)
    while not np.isfinite(ideal).all():  # beyond the lens: nearer to the centre
        aside = 0.9 * aside
        ideal = camera.undistort(half - 0.5 + aside)
    ray = np.append((ideal - (camera.cx_px, camera.cy_px)) / (camera.fx_px, camera.fy_px), 1.0)
    position = range_m * ray / np.linalg.norm(ray)
    q_irf_trf = rotations.normalize(rng.normal(size=4))
    least, most = (math.cos(math.radians(angle)) for angle in reversed(limits.phase_deg))
    phase, azimuth, roll = math.acos(rng.uniform(least, most)), *rng.uniform(0.0, 2.0 * math.pi, 2)
    to_camera = -position / range_m
    across = np.cross(to_camera, np.eye(3)[int(np.argmin(np.abs(to_camera)))])
    across = rotations.rotate(rotations.exp(azimuth * to_camera), across / np.linalg.norm(across))
    to_sun = math.cos(phase) * to_camera + math.sin(phase) * across
    # Any rotation that maps the drawn direction of the sun to that in WRF, then a drawn roll about
    # it.
    q_w_irf = rotations.multiply(rotations.exp(roll * to_sun_w), _between(to_sun, to_sun_w))
    return TargetView(PoseLabel(position, q_irf_trf), q_w_irf)


def _between(a: Array, b: Array) -> Array:
    """Return the shortest rotation (4,) that turns unit vector ``a`` to ``b``."""
    if float(a @ b) < -0.999999:
        axis = np.cross(a, np.eye(3)[int(np.argmin(np.abs(a)))])
        return rotations.exp(math.pi * axis / np.linalg.norm(axis))
    return rotations.normalize(np.array([1.0 + float(a @ b), *np.cross(a, b).tolist()]))


class ViewRenderer:
    """Renders random views of a scenario's target by the camera of chaser 0, with the scenario's
    light and effects.

    ``renderer_of``: makes another renderer of the images; masks are drawn by the world's. The
    camera has no errors against its calibration. Raises DatasetError for a scenario in which it
    has.
    """

    def __init__(
        self,
        scenario: Scenario,
        limits: ViewLimits,
        renderer_of: Callable[[Camera], SceneRenderer] | None = None,
    ) -> None:
        self.camera = scenario.camera_model()
        if true_camera(scenario, 0) != self.camera:
            raise DatasetError(
                "truth.camera and navigation: labels hold for a camera without errors; remove "
                "the errors of the camera"
            )
        self._scenario, self._limits = scenario, limits
        self._cameras = Cameras(scenario, renderer_of)
        self._to_sun_w = np.array(self._cameras.light_at(0.0).direction_w)
        self.mesh = target_mesh(scenario)
        self.shape = shape_of(self.mesh, symmetric=not true_target(scenario).markers)
        self._mask = _Coverage(self.camera, self.mesh)
        _, probe = scenario.chaser.boxes()
        self._visible = _Coverage(self.camera, self.mesh, probe)
        self._margin_px = (self.camera.width_px, self.camera.height_px)
        self._wide = _Coverage(_padded(self.camera, self._margin_px), self.mesh)

    def view(self, number: int) -> TargetView:
        """Return view ``number``."""
        return draw_view(self._limits, self.camera, self._to_sun_w, self._scenario.seed, number)

    def render(self, number: int) -> ViewImage:
        """Return the image and masks of view ``number``."""
        view = self.view(number)
        pixels = self._cameras.render(0, number, 0, self._states(view))
        mask = self._mask.of(view.label)
        cut = mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any()
        visible = self._visible.of(view.label)
        if not cut:
            return ViewImage(view, pixels, mask, visible, mask, (0, 0))
        return ViewImage(view, pixels, mask, visible, self._wide.of(view.label), self._margin_px)

    def _states(self, view: TargetView) -> dict[str, BodyState]:
        """Return the states of target and chaser 0; the target is at WRF's origin and has the
        scenario's rates.
        """
        still, q_w_irf = np.zeros(3), view.q_w_irf_wxyz
        q_w_trf = rotations.multiply(q_w_irf, view.label.q_irf_trf_wxyz)
        q_w_crf = rotations.multiply(
            q_w_irf, rotations.conjugate(np.array(self.camera.q_crf_irf_wxyz))
        )
        eye = -rotations.rotate(q_w_irf, view.label.position_irf_m)
        own = eye - rotations.rotate(q_w_crf, np.array(self.camera.position_crf_m))
        omega = np.array(self._scenario.target.omega_rad_s)
        return {
            TARGET: BodyState(still, still, q_w_trf, omega),
            "chaser/0": BodyState(own, still, q_w_crf, still),
        }


class _Coverage:
    """Finds the pixels that a target covers: renders it white, under ambient light, before the
    stars of one camera attitude.

    ``own``: a box in chaser axes, drawn black, that hides the target.
    """

    def __init__(self, camera: Camera, mesh: TriangleMesh, own: Box | None = None) -> None:
        white = tuple(replace(part, material=_WHITE) for part in mesh.parts)
        self._renderer = MeshRenderer(camera, TriangleMesh("mask", white, {}))
        self._obstacles: tuple[Obstacle, ...] = ()
        if own is not None:
            q = rotations.conjugate(np.array(camera.q_crf_irf_wxyz))
            place = -rotations.rotate(q, np.array(camera.position_crf_m))
            self._obstacles = (((replace(own, shade=0.0),), place, q),)
        behind = np.array([0.0, 0.0, -1e3])
        self._empty = self._draw(PoseLabel(behind, rotations.IDENTITY))

    def of(self, label: PoseLabel) -> NDArray[np.bool_]:
        """Return the pixels (h, w) of which the target covers half or more."""
        return np.asarray(
            self._draw(label) - self._empty >= 0.5 * (WHITE_LEVEL - self._empty), dtype=np.bool_
        )

    def _draw(self, label: PoseLabel) -> NDArray[np.float32]:
        own = (np.zeros(3), rotations.IDENTITY)
        image = self._renderer.render(
            *own, label.position_irf_m, label.q_irf_trf_wxyz, self._obstacles, _FULL_LIGHT
        )
        return np.asarray(image, dtype=np.float32)


def target_mesh(scenario: Scenario) -> TriangleMesh:
    """Return the mesh of the target as the world draws it, without its markers."""
    mesh = true_mesh(scenario)
    return mesh_of_boxes(true_target(scenario).boxes) if mesh is None else mesh


def _padded(camera: Camera, margin_px: tuple[int, int]) -> Camera:
    """Return the camera, without distortion, whose image extends by ``margin_px`` columns and rows
    on every side.
    """
    x, y = margin_px
    return replace(
        camera,
        width_px=camera.width_px + 2 * x,
        height_px=camera.height_px + 2 * y,
        cx_px=camera.cx_px + x,
        cy_px=camera.cy_px + y,
        distortion=(),
        lens_model="perspective",
    )
