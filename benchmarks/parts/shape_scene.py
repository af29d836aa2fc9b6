# SPDX-License-Identifier: Apache-2.0
"""Images of ``geo_servicer`` as a camera sees it, and the meshes by which trackers know it."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace

import numpy as np
from chaserdock_agents.chaser.perception.model import tracking
from chaserdock_agents.chaser.perception.model.alignment import Alignment, Pyramid
from chaserdock_agents.chaser.perception.model.mesh import TrackerMesh
from chaserdock_agents.chaser.perception.refine import PoseInCamera
from chaserdock_agents.chaser.sighting import geometry_message
from chaserdock_controller.estimation.target_shape import ShapeFilter, seen_place
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.meshes import TriangleMesh, with_geometry_errors
from chaserdock_models.satellites import satellite
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import PoseSolution
from chaserdock_protocol.scenario.camera import Effects
from chaserdock_protocol.scenario.navigation import NavigationSection
from chaserdock_world.rendering.background import SPACE_LEVEL, Earth, Light
from chaserdock_world.rendering.effects import CameraEffects
from chaserdock_world.rendering.mesh_renderer import MeshRenderer
from markerless_cases import perturbed, random_view
from numpy.typing import NDArray

CAMERA = Camera.from_hfov(960, 540, np.deg2rad(60.0))
TARGET = "geo_servicer"
EXACT = TrackerMesh.of_mesh(satellite(TARGET), 0.0, 0.0)
"""The target's mesh, known exactly."""
KNOWN = satellite(TARGET, 0.001)
"""The same, simplified to 1 mm."""
EARTH_RADIUS_RAD = 1.1
"""Angular radius of the Earth, in a low orbit."""
PANEL_SIGMA_RAD, SCALE_SIGMA = np.deg2rad(0.5), 0.003
"""Errors of a panel's joint about each axis, and of the scale (share), one sigma."""
PRIOR, NEAR_PRIOR = (0.01, np.deg2rad(1.5)), (0.003, np.deg2rad(0.3))
"""Errors of priors (share of the range, angle): of a new track, and of one that is followed."""
HALF_TURN = np.diag([-1.0, 1.0, -1.0])
"""Turn of the axes between opposite cameras."""
RIGHT_ANGLE = rotations.to_matrix(rotations.exp(np.array([0.0, np.pi / 2.0, 0.0])))
"""Turn of the axes between cameras at right angles."""
LAB = NavigationSection(grade="lab").errors()
"""Errors of odometry and cameras of grade `lab`."""
EXPOSURES = 8
"""Renderings whose mean is a blurred image."""
VIEWS_BEFORE = 36
"""Views of an inspection."""


class SatelliteImages:
    """Images of the satellite by the world's renderer, with the default effects of the camera."""

    def __init__(self, earth: Earth | None = None) -> None:
        self._renderer = MeshRenderer(CAMERA, satellite(TARGET), earth, Effects().point_spread_px)
        self._effects = CameraEffects(CAMERA.width_px, CAMERA.height_px, Effects(), 11)

    def image(self, pose: PoseInCamera, light: Light, number: int) -> NDArray[np.uint8]:
        """Return the image (h, w)."""
        q = rotations.from_matrix(pose.rotation)
        exact = self._renderer.render(np.zeros(3), rotations.IDENTITY, pose.position, q, (), light)
        return self._effects.apply(exact, 0, number)

    def mean_grey(self, image: NDArray[np.uint8], pose: PoseInCamera) -> float:
        """Return the mean grey level of the target in an image (h, w)."""
        return float(
            image[self.coverage(pose.position, rotations.from_matrix(pose.rotation))].mean()
        )

    def blurred(
        self, pose: PoseInCamera, step_m: Array, light: Light, number: int
    ) -> NDArray[np.uint8]:
        """Return the image (h, w) of a target that moves by ``step_m`` (3,) during the exposure,
        ``pose`` in the middle of it.
        """
        q = rotations.from_matrix(pose.rotation)
        total = np.zeros((CAMERA.height_px, CAMERA.width_px))
        shares = (np.arange(EXPOSURES) + 0.5) / EXPOSURES - 0.5
        for share in shares:
            at = pose.position + share * step_m
            total += self._renderer.render(np.zeros(3), rotations.IDENTITY, at, q, (), light)
        return self._effects.apply(np.rint(total / EXPOSURES).astype(np.uint8), 0, number)

    def coverage(self, position: Array, q: Array) -> NDArray[np.bool_]:
        """Return the mask (h, w) of the pixels on the target: those that light from everywhere
        brightens.
        """
        light = Light((0.0, 0.0, -1.0), 0.0, 1.0)
        image = self._renderer.render(np.zeros(3), rotations.IDENTITY, position, q, (), light)
        return image > SPACE_LEVEL + 4


def error_of(pose: PoseInCamera, truth: PoseInCamera) -> tuple[float, float]:
    """Return the error in m and rad."""
    error = tracking.pose_error(pose, truth)
    return float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))


def is_gross(error: tuple[float, float], range_m: float) -> bool:
    return error[0] > 0.02 * range_m or error[1] > np.deg2rad(2.0)


@dataclass(frozen=True)
class CamerasAround:
    """Cameras around the target at one time, with odometry of grade `lab`: ``turns``, (3, 3), of
    their axes about the target, and ``shifts_m`` (n, 3) of their lenses, which flight software does
    not know."""

    turns: tuple[Array, ...]
    shifts_m: Array

    @classmethod
    def drawn(cls, turns: tuple[Array, ...], rng: np.random.Generator) -> CamerasAround:
        return cls(turns, rng.normal(0.0, LAB.camera_shift_m, (len(turns), 3)))

    def fused(
        self,
        before: ShapeFilter,
        mesh: TrackerMesh,
        scene: SatelliteImages,
        rng: np.random.Generator,
        first: int,
        inspect: bool,
    ) -> ShapeFilter:
        """Return the geometry after one image of each camera at 1 to 1.6 m: by their distances, and
        if they ``inspect`` by each.
        """
        fused, count, seen_from = before, len(mesh.modes_m), []
        pose, light = random_view(rng, 1.0, CAMERA)
        for number, turn in enumerate(self.turns):
            aside, _ = random_view(rng, rng.uniform(1.0, 1.6), CAMERA)
            seen = PoseInCamera(aside.position, turn @ pose.rotation)
            image = scene.image(
                seen, replace(light, to_sun_w=tuple(turn @ light.to_sun_w)), first + number
            )
            lens_m = seen.rotation.T @ (self.shifts_m[number] - seen.position)
            lens_m += rng.normal(0.0, LAB.position_noise_m, 3)
            found = track(image, mesh, perturbed(seen, rng, *PRIOR))
            if found is None or not tracking.is_valid(found):
                continue
            if inspect:
                direction = -found.pose.rotation.T @ found.pose.position
                direction /= np.linalg.norm(direction)
                fused = fused.with_view(direction, found.geometry.matrix, found.geometry.vector)
            solution = PoseSolution(
                position_m=vector(found.pose.position),
                q_wxyz=vector(rotations.from_matrix(found.pose.rotation)),
                covariance=vector(found.covariance),
                reprojection_rms_px=found.rms_px,
            )
            place = seen_place(solution, geometry_message(found.geometry), count)
            seen_from += [] if place is None else [(place, lens_m)]
        sigma_m, common_m = np.sqrt(2.0) * LAB.position_noise_m, np.sqrt(2.0) * LAB.camera_shift_m
        for (a, lens_a), (b, lens_b) in itertools.combinations(seen_from, 2):
            length_m = float(np.linalg.norm(lens_a - lens_b))
            fused = fused.with_baseline(a, b, length_m, float(sigma_m), float(common_m))
        return fused


def inspected(
    scene: SatelliteImages, mesh: TrackerMesh, rng: np.random.Generator, first: int
) -> ShapeFilter:
    """Return the geometry by the views of two cameras on opposite sides of the target."""
    cameras = CamerasAround.drawn((np.eye(3), HALF_TURN), rng)
    fused = ShapeFilter.prior(len(mesh.modes_m))
    for number in range(0, VIEWS_BEFORE, 2):
        fused = cameras.fused(fused, mesh, scene, rng, first + number, inspect=True)
    return fused


def earth_behind(rng: np.random.Generator) -> Earth:
    """Draw the place of the Earth behind a target."""
    return Earth((rng.normal(0.0, 0.5), rng.normal(0.0, 0.5), 1.0), EARTH_RADIUS_RAD)


def track(image: NDArray[np.uint8], mesh: TrackerMesh, prior: PoseInCamera) -> Alignment | None:
    refined = tracking.refine_from_prior(Pyramid(image, CAMERA), mesh, prior)
    return refined[0] if refined else None


def drawn_mesh(rng: np.random.Generator, known: TriangleMesh = KNOWN) -> TrackerMesh:
    """Return a tracker mesh with drawn errors."""
    turns = {joint: rng.normal(0.0, PANEL_SIGMA_RAD, 3) for joint in known.joints}
    wrong = with_geometry_errors(known, rng.normal(0.0, SCALE_SIGMA), turns)
    return TrackerMesh.of_mesh(wrong, PANEL_SIGMA_RAD, SCALE_SIGMA)
