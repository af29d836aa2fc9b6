# SPDX-License-Identifier: Apache-2.0
"""Perception by shape: ``python benchmarks/markerless.py [--views N] [--ranges M ...] [--only PART] [--quick] [--json FILE]``.

Images of ``geo_servicer``, 960 x 540 pixels, 60 degrees, by the world's renderer of meshes, with cast shadows, specular reflection,
insulation texture, point spread and noise. The tracker has its own renderer and estimates the light. Attitudes and suns in
front of the target are random. Parts:

- ``exact`` and ``knowledge``: tracking from a prior 1 % of the range and 1.5 degrees off, at 1, 3 and 10 m, with the exact mesh, and
  with one that is simplified to 1 mm, with panels wrong by 0.5 degrees and a scale wrong by 0.3 % (standard deviations, drawn for each
  view; the truth stays the same).
- ``gate``: as ``exact``, but from priors up to 5 % of the range and 12 degrees off at 1 to 3 m: gross errors, and those that pass the
  gate.
- ``acquisition`` and ``earth``: without a prior at 1 to 3 m, in front of space and of the Earth.
- ``inspect``: as ``knowledge`` at 1 m, after the geometry has been estimated from 36 views from all around at 1 to 1.6 m
  by the controller's filter; twelve views of each of ``views / 12`` drawn meshes.
- ``sequence``: a tumbling target at 3 m, followed at 15 Hz from its acquisition on.

Gross: an error above 2 degrees or 2 % of the range that passes the gate. Times are CPU times of this process.
"""

from __future__ import annotations

import sys
import time

import numpy as np
from common import ROOT, Figures, make_parser, run_parts

sys.path.insert(0, str(ROOT / "tests"))

from chaserdock_agents.chaser.perception.model import tracking
from chaserdock_agents.chaser.perception.model.acquisition import Acquisition
from chaserdock_agents.chaser.perception.model.alignment import Alignment, Pyramid
from chaserdock_agents.chaser.perception.model.mesh import TrackerMesh
from chaserdock_agents.chaser.perception.model.perception import ModelPerception
from chaserdock_agents.chaser.perception.refine import PoseInCamera
from chaserdock_controller.estimation.target_shape import ShapeFilter
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.geometry_errors import geometry_parameters
from chaserdock_models.meshes import with_geometry_errors
from chaserdock_models.satellites import satellite
from chaserdock_protocol.scenario.camera import Effects
from chaserdock_world.rendering.background import Earth, Light
from chaserdock_world.rendering.effects import CameraEffects
from chaserdock_world.rendering.mesh_renderer import MeshRenderer
from markerless_cases import perturbed, random_view
from numpy.typing import NDArray

CAMERA = Camera.from_hfov(960, 540, np.deg2rad(60.0))
RANGES_M = (1.0, 3.0, 10.0)
TARGET = "geo_servicer"
EXACT = TrackerMesh.of_mesh(satellite(TARGET), 0.0, 0.0)
KNOWN = satellite(TARGET, 0.001)
EARTH_RADIUS_RAD = 1.1
PANEL_SIGMA_RAD, SCALE_SIGMA = np.deg2rad(0.5), 0.003
_VIEWS_BEFORE, _VIEWS_AFTER = 36, 12
"""Views of an inspection, and views of each mesh after it."""


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


def error_of(pose: PoseInCamera, truth: PoseInCamera) -> tuple[float, float]:
    """Return the error in m and rad."""
    error = tracking.pose_error(pose, truth)
    return float(np.linalg.norm(error[:3])), float(np.linalg.norm(error[3:]))


def is_gross(error: tuple[float, float], range_m: float) -> bool:
    return error[0] > 0.02 * range_m or error[1] > np.deg2rad(2.0)


def track_cell(name: str, range_m: float, views: int, wrong: bool) -> Figures:
    """Track ``views`` single images at one range."""
    rng, scene = np.random.default_rng([int(range_m), wrong]), SatelliteImages()
    errors, nees, times, gross, rejected = [], [], [], 0, 0
    for number in range(views):
        mesh = _drawn_mesh(rng) if wrong else EXACT
        pose, light = random_view(rng, range_m, CAMERA)
        image = scene.image(pose, light, number)
        prior = perturbed(pose, rng, 0.01, np.deg2rad(1.5))
        _ = mesh.suns  # made once in a flight
        begin_s = time.process_time()
        found = _track(image, mesh, prior)
        times.append(time.process_time() - begin_s)
        if not tracking.is_valid(found):
            rejected += 1
            continue
        error = error_of(found.pose, pose)
        errors.append(error)
        gross += is_gross(error, range_m)
        e = tracking.pose_error(found.pose, pose)
        nees.append(float(e @ np.linalg.solve(found.covariance, e)))
    key = f"{name}_{range_m:g}m"
    return _quantiles(key, np.array(errors)) | {
        f"{key}_views": views,
        f"{key}_rejected": rejected,
        f"{key}_gross": gross,
        f"{key}_nees_mean": float(np.mean(nees)),
        f"{key}_mean_s": float(np.mean(times)),
        f"{key}_max_s": float(np.max(times)),
    }


def inspect(views: int) -> Figures:
    """Estimate the geometry from many views, correct the mesh, and track ``views`` single images at 1 m."""
    rng, scene = np.random.default_rng(21), SatelliteImages()
    errors, nees, rejected, shape_nees, used = [], [], 0, [], []
    parameters = geometry_parameters(KNOWN, PANEL_SIGMA_RAD, SCALE_SIGMA)
    for number in range(max(views // _VIEWS_AFTER, 1)):
        turns = {joint: rng.normal(0.0, PANEL_SIGMA_RAD, 3) for joint in KNOWN.joints}
        scale = rng.normal(0.0, SCALE_SIGMA)
        mesh = TrackerMesh.of_mesh(with_geometry_errors(KNOWN, scale, turns), PANEL_SIGMA_RAD, SCALE_SIGMA)
        _ = mesh.suns
        fused = ShapeFilter.prior(len(parameters))
        for k in range(_VIEWS_BEFORE):
            pose, light = random_view(rng, rng.uniform(1.0, 1.6), CAMERA)
            image = scene.image(pose, light, 1000 * number + k)
            found = _track(image, mesh, perturbed(pose, rng, 0.01, np.deg2rad(1.5)))
            if tracking.is_valid(found):
                direction = -found.pose.rotation.T @ found.pose.position
                fused = fused.with_view(
                    direction / np.linalg.norm(direction), found.geometry.matrix, found.geometry.vector
                )
        # The tracker's mesh is the true one with errors, which it should find with the opposite sign.
        true = -np.append(
            np.concatenate([turns[j] for j in KNOWN.joints]) / PANEL_SIGMA_RAD, scale / SCALE_SIGMA
        )
        off = fused.mean()[: len(true)] - true
        shape_nees.append(
            float(off @ np.linalg.solve(fused.covariance()[: len(true), : len(true)], off)) / len(true)
        )
        used.append(len(fused.cells))
        corrected = mesh.corrected(fused.mean(), fused.covariance())
        for k in range(_VIEWS_AFTER):
            pose, light = random_view(rng, 1.0, CAMERA)
            image = scene.image(pose, light, 1000 * number + 500 + k)
            found = _track(image, corrected, perturbed(pose, rng, 0.01, np.deg2rad(1.5)))
            if not tracking.is_valid(found):
                rejected += 1
                continue
            errors.append(error_of(found.pose, pose))
            e = tracking.pose_error(found.pose, pose)
            nees.append(float(e @ np.linalg.solve(found.covariance, e)))
    return _quantiles("inspect_1m", np.array(errors)) | {
        "inspect_1m_views": len(errors) + rejected,
        "inspect_1m_rejected": rejected,
        "inspect_1m_nees_mean": float(np.mean(nees)),
        "inspect_meshes": len(used),
        "inspect_views_fused_mean": float(np.mean(used)),
        "inspect_geometry_nees_per_parameter": float(np.mean(shape_nees)),
    }


def gate(views: int) -> Figures:
    """Track from priors that are mostly too far off."""
    rng, scene = np.random.default_rng(6), SatelliteImages()
    gross = passed = rejected = 0
    for number in range(views):
        range_m = rng.uniform(1.0, 3.0)
        pose, light = random_view(rng, range_m, CAMERA)
        prior = perturbed(pose, rng, rng.uniform(0.0, 0.05), np.deg2rad(rng.uniform(0.0, 12.0)))
        found = _track(scene.image(pose, light, number), EXACT, prior)
        wrong = found is None or is_gross(error_of(found.pose, pose), range_m)
        gross += wrong
        passed += wrong and tracking.is_valid(found)
        rejected += not wrong and not tracking.is_valid(found)
    return {
        "gate_views": views,
        "gate_gross": gross,
        "gate_gross_passed": passed,
        "gate_good_rejected": rejected,
    }


def acquire(views: int, in_front_of_earth: bool) -> Figures:
    """Acquire the target in ``views`` single images."""
    rng, acquisition = np.random.default_rng(4), Acquisition(CAMERA, TrackerMesh.of_mesh(KNOWN, 0.0, 0.0))
    acquisition.prepare()
    times, found, wrong = [], 0, 0
    scene = SatelliteImages()
    for number in range(views):
        range_m = rng.uniform(1.0, 3.0)
        pose, light = random_view(rng, range_m, CAMERA)
        if in_front_of_earth:
            scene = SatelliteImages(
                Earth((rng.normal(0.0, 0.5), rng.normal(0.0, 0.5), 1.0), EARTH_RADIUS_RAD)
            )
        image = scene.image(pose, light, number)
        begin_s = time.process_time()
        solutions = acquisition.find(image)
        times.append(time.process_time() - begin_s)
        right = [not is_gross(error_of(a.pose, pose), range_m) for a, _ in solutions]
        found += any(right)
        wrong += bool(right) and not any(right)
    key = "acquisition_earth" if in_front_of_earth else "acquisition"
    return {
        f"{key}_views": views,
        f"{key}_found_share": found / views,
        f"{key}_wrong": wrong,
        f"{key}_mean_s": float(np.mean(times)),
        f"{key}_max_s": float(np.max(times)),
    }


def follow(images: int) -> Figures:
    """Follow a target that turns at 4 degrees/s and drifts."""
    scene, perception = SatelliteImages(), ModelPerception(CAMERA, EXACT)
    pose, _ = random_view(np.random.default_rng(9), 3.0, CAMERA)
    errors, times, missed = [], [], 0
    for number in range(images):
        turn = rotations.to_matrix(
            rotations.exp(np.deg2rad(4.0) / 15.0 * number * np.array([0.6, 0.64, 0.48]))
        )
        moved = PoseInCamera(pose.position + 1e-3 * number * np.array([1.0, 0.0, -1.0]), turn @ pose.rotation)
        image = scene.image(moved, Light((-0.5, -0.4, -1.0)), number)
        begin_s = time.process_time()
        solutions = perception.estimate(image).solutions
        times.append(time.process_time() - begin_s)
        if not solutions:
            missed += 1
            continue
        best = solutions[0]
        estimate = PoseInCamera(best.position_irf_m, rotations.to_matrix(best.q_irf_trf_wxyz))
        errors.append(error_of(estimate, moved))
    return _quantiles("sequence", np.array(errors)) | {
        "sequence_images": images,
        "sequence_missed": missed,
        "sequence_first_s": times[0],
        "sequence_mean_s": float(np.mean(times[1:])),
        "sequence_max_s": float(np.max(times[1:])),
    }


def _track(image: NDArray[np.uint8], mesh: TrackerMesh, prior: PoseInCamera) -> Alignment | None:
    refined = tracking.refine_from_prior(Pyramid(image, CAMERA), mesh, prior)
    return refined[0] if refined else None


def _drawn_mesh(rng: np.random.Generator) -> TrackerMesh:
    """Return a tracker mesh with drawn errors."""
    turns = {joint: rng.normal(0.0, PANEL_SIGMA_RAD, 3) for joint in KNOWN.joints}
    wrong = with_geometry_errors(KNOWN, rng.normal(0.0, SCALE_SIGMA), turns)
    return TrackerMesh.of_mesh(wrong, PANEL_SIGMA_RAD, SCALE_SIGMA)


def _quantiles(key: str, errors: Array) -> Figures:
    out: Figures = {}
    for share in (50, 95):
        position, attitude = np.percentile(errors, share, axis=0)
        out |= {f"{key}_p{share}_m": float(position), f"{key}_p{share}_rad": float(attitude)}
    return out


def main() -> None:
    parts = ("exact", "knowledge", "inspect", "gate", "acquisition", "earth", "sequence")
    parser = make_parser(__doc__, parts)
    parser.add_argument("--views", type=int, help="views per cell (default 300, with --quick 20)")
    parser.add_argument(
        "--ranges", type=float, nargs="+", default=RANGES_M, metavar="M", help="ranges of the tracking cells"
    )
    options = parser.parse_args()
    views = options.views or (20 if options.quick else 300)

    def cells(name: str, wrong: bool) -> Figures:
        figures = Figures()
        for range_m in options.ranges:
            figures |= track_cell(name, range_m, views, wrong)
        return figures

    run_parts(
        options,
        {
            "exact": lambda: cells("exact", False),
            "knowledge": lambda: cells("knowledge", True),
            "inspect": lambda: inspect(views),
            "gate": lambda: gate(views),
            "acquisition": lambda: acquire(views, False),
            "earth": lambda: acquire(views, True),
            "sequence": lambda: follow(views),
        },
    )


if __name__ == "__main__":
    main()
