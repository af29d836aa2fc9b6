# SPDX-License-Identifier: Apache-2.0
"""Perception by shape in single images and sequences of ``geo_servicer``.

960 x 540 pixels, 60 degrees, by the world's renderer of meshes, with cast shadows, specular
reflection, insulation texture, point spread and noise. The tracker has its own renderer and
estimates the light. Attitudes and suns in front of the target are random. Single images are tracked
from a prior 1 % of the range and 1.5 degrees off. The exact mesh, or one as known: simplified to 1
mm, with panels wrong by 0.5 degrees and a scale wrong by 0.3 % (standard deviations, drawn for each
view; the truth stays the same).

Gross: an error above 2 degrees or 2 % of range that passes the gate. Views in which the target is
darker than 5 grey levels are left out. Times are CPU times of this process.
"""

from __future__ import annotations

import time
import zlib
from argparse import ArgumentParser
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from chaserdock_agents.chaser.perception.model import tracking
from chaserdock_agents.chaser.perception.model.acquisition import Acquisition
from chaserdock_agents.chaser.perception.model.mesh import TrackerMesh
from chaserdock_agents.chaser.perception.model.perception import ModelPerception
from chaserdock_agents.chaser.perception.refine import PoseInCamera
from chaserdock_controller.estimation.target_shape import ShapeFilter
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.meshes import with_geometry_errors
from chaserdock_models.satellites import satellite
from chaserdock_protocol.scenario.camera import Effects
from chaserdock_world.rendering.background import Light
from chaserdock_world.rendering.effects import CameraEffects
from common import Figures, Group, KeptResults, Options, described
from markerless_cases import backlit_view, perturbed, random_view
from numpy.typing import NDArray

from .shape_scene import (
    CAMERA,
    EXACT,
    KNOWN,
    NEAR_PRIOR,
    PANEL_SIGMA_RAD,
    PRIOR,
    RIGHT_ANGLE,
    SCALE_SIGMA,
    TARGET,
    CamerasAround,
    SatelliteImages,
    drawn_mesh,
    earth_behind,
    error_of,
    inspected,
    is_gross,
    track,
)

RANGES_M = (1.0, 3.0, 10.0)
FLIGHT_IMAGES = 30
TURN = np.deg2rad(4.0) / 15.0 * np.array([0.6, 0.64, 0.48])
"""Turn of a tumbling target from image to image."""
LEAST_GREY = 5.0
"""A darker target is not seen by anyone."""
MOST_UNSEEN = 120
"""Images within which a target must be acquired: eight seconds."""

ViewRow = dict[str, float]
"""Figures of one view."""
_BLUR_PX, _LAMP = 4.0, 60.0
"""Blur of an image in pixels, power of the lamp (that of `harsh-light`)."""
_SHADED = (
    (1.5, (0.3, -0.5, 1.0)),
    (1.0, (-0.2, 0.3, 1.0)),
    (2.2, (0.6, 0.1, 1.0)),
    (1.2, (0.0, -0.2, 1.0)),
    (0.8, (0.2, 0.2, 1.0)),
)
"""Ranges, and directions of the sun behind the target."""
_SHADED_IMAGES = 40
"""Images of each turning target."""
_VIEWS_AFTER = 12
"""Views of each mesh after it."""


@dataclass(frozen=True)
class Cells:
    """Views by cell, of which ``path`` keeps those that are done."""

    path: Path | None

    def rows(
        self,
        cell: str,
        views: int,
        view: Callable[[np.random.Generator, int], ViewRow],
        like: str = "",
    ) -> list[ViewRow]:
        """Return the rows of a cell; ``view`` makes that of a number with a generator of its own,
        or that of the cell ``like``.
        """
        stream = zlib.crc32((like or cell).encode())
        return KeptResults(self.path, {"cell": cell}, ViewRow).of(
            range(views), lambda number: view(np.random.default_rng([stream, number]), number)
        )


def inspect(views: int) -> Figures:
    """Estimate the geometry from many views, correct the mesh, and track ``views`` single images at
    1 m.
    """
    rng, scene = np.random.default_rng(21), SatelliteImages()
    errors, nees, rejected, shape_nees, used, scale_off = [], [], 0, [], [], []
    for number in range(max(views // _VIEWS_AFTER, 1)):
        turns = {joint: rng.normal(0.0, PANEL_SIGMA_RAD, 3) for joint in KNOWN.joints}
        scale = rng.normal(0.0, SCALE_SIGMA)
        mesh = TrackerMesh.of_mesh(
            with_geometry_errors(KNOWN, scale, turns), PANEL_SIGMA_RAD, SCALE_SIGMA
        )
        _ = mesh.suns
        fused = inspected(scene, mesh, rng, 1000 * number)
        # The tracker's mesh is the true one with errors, which it should find with the opposite
        # sign.
        true = -np.append(
            np.concatenate([turns[j] for j in KNOWN.joints]) / PANEL_SIGMA_RAD, scale / SCALE_SIGMA
        )
        off = fused.mean()[: len(true)] - true
        shape_nees.append(
            float(off @ np.linalg.solve(fused.covariance()[: len(true), : len(true)], off))
            / len(true)
        )
        used.append(len(fused.cells))
        scale_off.append(off[-1] * SCALE_SIGMA)
        corrected = mesh.corrected(fused.mean(), fused.covariance())
        for k in range(_VIEWS_AFTER):
            pose, light = random_view(rng, 1.0, CAMERA)
            image = scene.image(pose, light, 1000 * number + 500 + k)
            found = track(image, corrected, perturbed(pose, rng, 0.01, np.deg2rad(1.5)))
            if found is None or not tracking.is_valid(found):
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
        "inspect_scale_rms": float(np.sqrt(np.mean(np.square(scale_off)))),
    }


def triangulated(cells: Cells, range_m: float, views: int) -> Figures:
    """Track single images after one image of each of four cameras around the target, whose
    distances tell the scale.
    """
    scene, quarter = SatelliteImages(), RIGHT_ANGLE
    turns = tuple(np.linalg.matrix_power(quarter, k) for k in range(4))

    def view(rng: np.random.Generator, number: int) -> ViewRow:
        mesh = drawn_mesh(rng)
        before = ShapeFilter.prior(len(mesh.modes_m))
        fused = CamerasAround.drawn(turns, rng).fused(
            before, mesh, scene, rng, 5 * number, inspect=False
        )
        corrected = mesh.corrected(fused.mean(), fused.covariance())
        pose, light = random_view(rng, range_m, CAMERA)
        image = scene.image(pose, light, 5 * number + 4)
        return tracked_view(image, corrected, pose, perturbed(pose, rng, *PRIOR))

    key = f"triangulated_{range_m:g}m"
    return tracking_figures(key, cells.rows(key, views, view))


def tracked_view(
    image: NDArray[np.uint8], mesh: TrackerMesh, pose: PoseInCamera, prior: PoseInCamera
) -> ViewRow:
    """Return the result of tracking one image."""
    _ = mesh.suns  # made once in a flight
    begin_s = time.process_time()
    found = track(image, mesh, prior)
    took_s = time.process_time() - begin_s
    if found is None:
        return {"s": took_s, "valid": 0.0, "wrong": 1.0}
    figures = {"s": took_s, "valid": float(tracking.is_valid(found))}
    return figures | pose_figures(found.pose, found.covariance, pose)


def pose_figures(estimate: PoseInCamera, covariance: Array, truth: PoseInCamera) -> ViewRow:
    """Return the errors of a pose, and its squared error by the covariance (6, 6)."""
    e, range_m = tracking.pose_error(estimate, truth), float(np.linalg.norm(truth.position))
    error = error_of(estimate, truth)
    return {
        "wrong": float(is_gross(error, range_m)),
        "m": error[0],
        "rad": error[1],
        "along_m": abs(float(e[:3] @ truth.position)) / range_m,
        "nees": float(e @ np.linalg.solve(covariance, e)),
    }


def tracking_figures(key: str, rows: list[ViewRow]) -> Figures:
    """Return the figures of views that were tracked."""
    valid = [row for row in rows if row["valid"]]
    figures: Figures = {f"{key}_views": len(rows), f"{key}_rejected": len(rows) - len(valid)}
    figures[f"{key}_gross"] = sum(row["wrong"] for row in valid)
    if valid:
        figures |= _quantiles(key, np.array([(row["m"], row["rad"]) for row in valid]))
        figures[f"{key}_p95_along_m"] = float(np.percentile([row["along_m"] for row in valid], 95))
        figures[f"{key}_nees_mean"] = float(np.mean([row["nees"] for row in valid]))
    times = [row["s"] for row in rows]
    return figures | {f"{key}_mean_s": float(np.mean(times)), f"{key}_max_s": float(np.max(times))}


def track_cell(cells: Cells, name: str, range_m: float, views: int) -> Figures:
    """Track single images at one range."""
    scene = SatelliteImages()

    def view(rng: np.random.Generator, number: int) -> ViewRow:
        mesh = drawn_mesh(rng) if name == "knowledge" else EXACT
        pose, light = random_view(rng, range_m, CAMERA)
        image = scene.image(pose, light, number)
        return tracked_view(image, mesh, pose, perturbed(pose, rng, *PRIOR))

    key = f"{name}_{range_m:g}m"
    return tracking_figures(key, cells.rows(key, views, view))


def crossed(cells: Cells, range_m: float, views: int) -> Figures:
    """Track single images of two cameras at right angles, and average their poses."""
    scene = SatelliteImages()

    def view(rng: np.random.Generator, number: int) -> ViewRow:
        mesh = drawn_mesh(rng)
        pose, light = random_view(rng, range_m, CAMERA)
        total, weighted, took_s = np.zeros((6, 6)), np.zeros(6), 0.0
        for turn in (np.eye(3), RIGHT_ANGLE):
            seen = PoseInCamera(pose.position, turn @ pose.rotation)
            image = scene.image(seen, replace(light, to_sun_w=tuple(turn @ light.to_sun_w)), number)
            prior = perturbed(seen, rng, *PRIOR)
            begin_s = time.process_time()
            found = track(image, mesh, prior)
            took_s += time.process_time() - begin_s
            if found is None or not tracking.is_valid(found):
                return {"s": took_s, "valid": 0.0, "wrong": 0.0}
            # In the axes of the first camera; the attitude's error is in those of the target.
            axes = np.eye(6)
            axes[:3, :3] = turn.T
            information = np.linalg.inv(axes @ found.covariance @ axes.T)
            total += information
            weighted += information @ (axes @ tracking.pose_error(found.pose, seen))
        e = np.linalg.solve(total, weighted)
        error = float(np.linalg.norm(e[:3])), float(np.linalg.norm(e[3:]))
        return {
            "s": took_s,
            "valid": 1.0,
            "wrong": float(is_gross(error, range_m)),
            "m": error[0],
            "rad": error[1],
            "along_m": abs(float(e[:3] @ pose.position)) / range_m,
            "nees": float(e @ total @ e),
        }

    key = f"crossed_{range_m:g}m"
    return tracking_figures(key, cells.rows(key, views, view))


def independent(cells: Cells, name: str, range_m: float, views: int) -> Figures:
    """Track images of an independent renderer at one range."""
    from embree_images import plain, trace

    effects = CameraEffects(CAMERA.width_px, CAMERA.height_px, Effects(), 11)
    mesh = plain(satellite(TARGET))
    tracker = TrackerMesh.of_mesh(mesh, 0.0, 0.0)

    def view(rng: np.random.Generator, number: int) -> ViewRow:
        drawn = tracker if name == "independent" else drawn_mesh(rng, plain(KNOWN))
        pose, light = random_view(rng, range_m, CAMERA)
        exact = trace(
            mesh, CAMERA, pose.position, rotations.from_matrix(pose.rotation), light, 3
        ).level
        spread = cv2.GaussianBlur(exact, (0, 0), Effects().point_spread_px)
        image = effects.apply(np.rint(np.clip(spread, 0.0, 255.0)).astype(np.uint8), 0, number)
        return tracked_view(image, drawn, pose, perturbed(pose, rng, *PRIOR))

    key = f"{name}_{range_m:g}m"
    return tracking_figures(key, cells.rows(key, views, view))


def behind(cells: Cells, views: int) -> Figures:
    """Track single images in front of the Earth."""

    def view(rng: np.random.Generator, number: int) -> ViewRow:
        pose, light = random_view(rng, rng.uniform(1.0, 3.0), CAMERA)
        image = SatelliteImages(earth_behind(rng)).image(pose, light, number)
        return tracked_view(image, EXACT, pose, perturbed(pose, rng, *PRIOR))

    return tracking_figures("behind", cells.rows("behind", views, view))


def bright_figures(key: str, rows: list[ViewRow]) -> Figures:
    """Return the figures of the views whose target is bright enough to be seen."""
    return tracking_figures(key, [row for row in rows if row["grey"] >= LEAST_GREY])


def backlit(cells: Cells, views: int) -> Figures:
    """Track single images with the sun behind the target."""
    scene = SatelliteImages()

    def view(rng: np.random.Generator, number: int) -> ViewRow:
        pose, light = backlit_view(rng, CAMERA)
        image = scene.image(pose, light, number)
        row = tracked_view(image, EXACT, pose, perturbed(pose, rng, *NEAR_PRIOR))
        return row | {"grey": scene.mean_grey(image, pose)}

    return bright_figures("backlit", cells.rows("backlit", views, view))


def lamp_view(rng: np.random.Generator) -> tuple[PoseInCamera, Light]:
    """Return a pose at 1 to 2 m, and the light of the camera's lamp."""
    pose, _ = random_view(rng, rng.uniform(1.0, 2.0), CAMERA)
    return pose, Light(sun=0.0, ambient=0.01, lamp=_LAMP)


def lamp(cells: Cells, views: int) -> Figures:
    """Track single images in eclipse, by the light of the camera's lamp."""
    scene = SatelliteImages()

    def view(rng: np.random.Generator, number: int) -> ViewRow:
        pose, light = lamp_view(rng)
        image = scene.image(pose, light, number)
        row = tracked_view(image, EXACT, pose, perturbed(pose, rng, *PRIOR))
        return row | {"grey": scene.mean_grey(image, pose)}

    return bright_figures("lamp", cells.rows("lamp", views, view))


def in_flight(
    cells: Cells,
    cell: str,
    views: int,
    draw: Callable[[np.random.Generator], tuple[PoseInCamera, Light]],
) -> Figures:
    """Follow the target to each view of a cell through the images of two seconds.

    Images without a track start from the pose that others expect. Figures: of the last images;
    images without a pose before the first one, the most of a view, and after it, as a share; and
    the mean NEES of all images.
    """
    scene, key, acquisition = SatelliteImages(), f"{cell}_flight", Acquisition(CAMERA, EXACT)

    def view(rng: np.random.Generator, number: int) -> ViewRow:
        pose, light = draw(rng)
        row: ViewRow = {"grey": scene.mean_grey(scene.image(pose, light, number), pose)}
        if row["grey"] < LEAST_GREY:
            return row
        perception, seen, nees = ModelPerception(CAMERA, EXACT, acquisition), [], []
        perception.prepare()
        for k in range(1 - FLIGHT_IMAGES, 1):
            moved = PoseInCamera(
                pose.position, rotations.to_matrix(rotations.exp(k * TURN)) @ pose.rotation
            )
            near = perturbed(moved, rng, *NEAR_PRIOR)
            expected = near.position, rotations.from_matrix(near.rotation)
            image = scene.image(moved, light, number)
            begin_s = time.process_time()
            solutions = perception.estimate(image, expected).solutions
            row |= {
                "s": time.process_time() - begin_s,
                "valid": float(bool(solutions)),
                "wrong": 0.0,
            }
            seen.append(bool(solutions))
            if solutions:
                best = solutions[0]
                found = PoseInCamera(best.position_irf_m, rotations.to_matrix(best.q_irf_trf_wxyz))
                row |= pose_figures(found, best.covariance, moved)
                nees.append(row["nees"])
        first = seen.index(True) if any(seen) else FLIGHT_IMAGES
        lost = float(np.mean(np.logical_not(seen[first:]))) if any(seen) else 1.0
        return row | {
            "first": first,
            "lost": lost,
            "nees_all": float(np.mean(nees)) if nees else np.nan,
        }

    rows = cells.rows(f"{cell}-flight", views, view, cell)
    bright = [row for row in rows if row["grey"] >= LEAST_GREY]
    return bright_figures(key, rows) | {
        f"{key}_images_until_seen": max(row["first"] for row in bright),
        f"{key}_lost_share": float(np.mean([row["lost"] for row in bright])),
        f"{key}_nees_all_mean": float(np.nanmean([row["nees_all"] for row in bright])),
        f"{key}_nees_all_median": float(np.nanmedian([row["nees_all"] for row in bright])),
    }


def blur(cells: Cells, views: int) -> Figures:
    """Track single images of a target that moves during the exposure."""
    scene = SatelliteImages()

    def view(rng: np.random.Generator, number: int) -> ViewRow:
        pose, light = random_view(rng, rng.uniform(1.0, 3.0), CAMERA)
        along = rng.uniform(0.0, 2.0 * np.pi)
        step_m = (
            _BLUR_PX
            * pose.position[2]
            / CAMERA.fx_px
            * np.array([np.cos(along), np.sin(along), 0.0])
        )
        image = scene.blurred(pose, step_m, light, number)
        return tracked_view(image, EXACT, pose, perturbed(pose, rng, *PRIOR))

    return tracking_figures("blur", cells.rows("blur", views, view))


def gate(cells: Cells, views: int) -> Figures:
    """Track from priors that are mostly too far off."""
    scene = SatelliteImages()

    def view(rng: np.random.Generator, number: int) -> ViewRow:
        pose, light = random_view(rng, rng.uniform(1.0, 3.0), CAMERA)
        prior = perturbed(pose, rng, rng.uniform(0.0, 0.05), np.deg2rad(rng.uniform(0.0, 12.0)))
        return tracked_view(scene.image(pose, light, number), EXACT, pose, prior)

    rows = cells.rows("gate", views, view)
    return {
        "gate_views": len(rows),
        "gate_gross": sum(row["wrong"] for row in rows),
        "gate_gross_passed": sum(row["wrong"] * row["valid"] for row in rows),
        "gate_good_rejected": sum((1.0 - row["wrong"]) * (1.0 - row["valid"]) for row in rows),
    }


def acquire(cells: Cells, key: str, views: int) -> Figures:
    """Acquire the target in single images, or with two cameras."""
    acquisition = Acquisition(CAMERA, TrackerMesh.of_mesh(KNOWN, 0.0, 0.0))
    acquisition.prepare()

    def view(rng: np.random.Generator, number: int) -> ViewRow:
        range_m = rng.uniform(1.0, 3.0)
        pose, light = random_view(rng, range_m, CAMERA)
        scene = SatelliteImages(earth_behind(rng) if key == "earth" else None)
        right, took_s = [], []
        for turn in (np.eye(3), RIGHT_ANGLE) if key == "pair" else (np.eye(3),):
            # The same target and sun, in the axes of another camera that looks at the target from
            # aside.
            seen = PoseInCamera(pose.position, turn @ pose.rotation)
            image = scene.image(seen, replace(light, to_sun_w=tuple(turn @ light.to_sun_w)), number)
            begin_s = time.process_time()
            solutions = acquisition.find(image)
            took_s.append(time.process_time() - begin_s)
            good = [not is_gross(error_of(a.pose, seen), range_m) for a, _ in solutions]
            right.append(any(good) if good else None)
        return {
            "s": float(max(took_s)),
            "found": float(True in right),
            "wrong": float(False in right),
        }

    rows = cells.rows(key, views, view)
    times = [row["s"] for row in rows]
    return {
        f"{key}_views": len(rows),
        f"{key}_found_share": float(np.mean([row["found"] for row in rows])),
        f"{key}_wrong": sum(row["wrong"] for row in rows),
        f"{key}_mean_s": float(np.mean(times)),
        f"{key}_max_s": float(np.max(times)),
    }


def follow(key: str, images: int, first_m: float, closing_m: float) -> Figures:
    """Follow a target that turns at 4 degrees/s and, once acquired, comes ``closing_m`` nearer with
    each image.
    """
    scene, perception = SatelliteImages(), ModelPerception(CAMERA, EXACT)
    perception.prepare()
    pose, _ = random_view(np.random.default_rng(9), first_m, CAMERA)
    errors, times, missed, acquired_after = [], [], 0, 0
    for number in range(MOST_UNSEEN + images):
        turn = rotations.to_matrix(rotations.exp(number * TURN))
        nearer = max(0, number - acquired_after) * closing_m / first_m
        moved = PoseInCamera(pose.position * (1.0 - nearer), turn @ pose.rotation)
        image = scene.image(moved, Light((-0.5, -0.4, -1.0)), number)
        begin_s = time.process_time()
        solutions = perception.estimate(image).solutions
        times.append(time.process_time() - begin_s)
        if not solutions:
            missed += bool(errors)
            acquired_after += not errors
        else:
            best = solutions[0]
            estimate = PoseInCamera(best.position_irf_m, rotations.to_matrix(best.q_irf_trf_wxyz))
            errors.append(error_of(estimate, moved))
        if missed + len(errors) == images:
            break
    return _quantiles(key, np.array(errors)) | {
        f"{key}_images": images,
        f"{key}_missed": missed,
        f"{key}_images_until_acquired": acquired_after,
        f"{key}_mean_s": float(np.mean(times[acquired_after:])),
        f"{key}_max_s": float(np.max(times[acquired_after:])),
        f"{key}_acquisition_mean_s": float(np.mean(times[:acquired_after])),
        f"{key}_acquisition_max_s": float(np.max(times[:acquired_after])),
    }


def shaded(images: int) -> Figures:
    """Start from expected poses, and follow, on the shaded side of targets that turn at 4
    degrees/s; so many images of each.
    """
    scene, least_s, seen = SatelliteImages(), [], 0
    for number, (range_m, sun) in enumerate(_SHADED):
        rng = np.random.default_rng(number)
        pose, _ = random_view(rng, range_m, CAMERA)
        views = []
        for k in range(images):
            moved = PoseInCamera(
                pose.position, rotations.to_matrix(rotations.exp(k * TURN)) @ pose.rotation
            )
            near = perturbed(moved, rng, *NEAR_PRIOR)
            expected = near.position, rotations.from_matrix(near.rotation)
            views.append((scene.image(moved, Light(sun, 0.92, 0.08), k), expected))
        repeated = []
        for _ in range(3):
            perception = ModelPerception(CAMERA, EXACT)
            perception.prepare()
            times = []
            for image, expected in views:
                begin_s = time.process_time()
                result = perception.estimate(image, expected)
                times.append(time.process_time() - begin_s)
                seen += bool(result.solutions)
            repeated.append(times)
        least_s += np.min(repeated, axis=0).tolist()
    return {
        "shaded_images": len(least_s),
        "shaded_seen": seen / 3,
        "shaded_mean_s": float(np.mean(least_s)),
        "shaded_max_s": max(least_s),
    }


def _quantiles(key: str, errors: Array) -> Figures:
    out: Figures = {}
    for share in (50, 95):
        position, attitude = np.percentile(errors, share, axis=0)
        out |= {f"{key}_p{share}_m": float(position), f"{key}_p{share}_rad": float(attitude)}
    return out


def at_ranges(
    cell: Callable[[Cells, float, int], Figures],
    cells: Cells,
    ranges_m: Sequence[float],
    views: int,
) -> Figures:
    """Return the figures of a cell at several ranges."""
    figures = Figures()
    for range_m in ranges_m:
        figures |= cell(cells, range_m, views)
    return figures


AT_RANGES: dict[str, tuple[Callable[[Cells, float, int], Figures], str]] = {
    "exact": (
        lambda cells, range_m, views: track_cell(cells, "exact", range_m, views),
        "Track single images at 1, 3 and 10 m with the exact mesh.",
    ),
    "knowledge": (
        lambda cells, range_m, views: track_cell(cells, "knowledge", range_m, views),
        "Track the same with a mesh as known.",
    ),
    "crossed": (crossed, "Track the same by two cameras at right angles, poses averaged."),
    "triangulated": (
        triangulated,
        "Track the same after one image of each of four cameras around the target at 1 to 1.6 m, "
        "whose distances odometry of grade lab measures, which tells the scale.",
    ),
    "independent": (
        lambda cells, range_m, views: independent(cells, "independent", range_m, views),
        "Track images by the ray tracer Embree, without texture, with the exact mesh.",
    ),
    "independent-knowledge": (
        lambda cells, range_m, views: independent(cells, "independent-knowledge", range_m, views),
        "Track the same with a mesh as known.",
    ),
}
VIEWS: dict[str, tuple[Callable[[Cells, int], Figures], str]] = {
    "inspect": (
        lambda _, views: inspect(views),
        "Track at 1 m after the geometry has been estimated by the controller's filter from 36 "
        "views at 1 to 1.6 m, by two cameras on opposite sides: twelve views of each drawn mesh.",
    ),
    "behind": (behind, "Track at 1 to 3 m in front of the Earth."),
    "backlit": (backlit, "Track at 1 to 3 m with the sun behind the target."),
    "backlit-flight": (
        lambda cells, views: in_flight(
            cells, "backlit", views, lambda rng: backlit_view(rng, CAMERA)
        ),
        "Track the views of backlit as in flight, each the last of 30 images of a turning target.",
    ),
    "lamp": (lamp, "Track at 1 to 2 m in eclipse, by the light of the camera's lamp."),
    "lamp-flight": (
        lambda cells, views: in_flight(cells, "lamp", views, lamp_view),
        "Track the views of lamp as in flight.",
    ),
    "blur": (
        blur,
        "Track at 1 to 3 m a target that moves by four pixels during the exposure; the pose is "
        "that in the middle of it.",
    ),
    "gate": (
        gate,
        "Track from priors up to 5 % of the range and 12 degrees off at 1 to 3 m: gross errors, "
        "and those that pass the gate.",
    ),
    "acquisition": (
        lambda cells, views: acquire(cells, "acquisition", views),
        "Find the target without a prior at 1 to 3 m, in front of space.",
    ),
    "earth": (
        lambda cells, views: acquire(cells, "earth", views),
        "Find it in front of the Earth.",
    ),
    "pair": (
        lambda cells, views: acquire(cells, "pair", views),
        "Find it by one of two cameras at right angles.",
    ),
    "sequence": (
        lambda _, views: follow("sequence", views, 3.0, 0.0),
        "Follow a tumbling target at 15 Hz from its acquisition on, at 3 m.",
    ),
    "closing": (
        lambda _, views: follow("closing", min(views, 100), 1.4, 0.0085),
        "Follow it from 1.4 to 0.55 m.",
    ),
    "shaded": (
        lambda _, views: shaded(min(views, _SHADED_IMAGES)),
        "Time images of the shaded side of tumbling targets at 0.8 to 2.2 m, from poses that "
        "others expect: the least of three repetitions, as other programs prolong it.",
    ),
}


def views_of(options: Options) -> int:
    """Return the number of views of a cell."""
    return options.views or (3 if options.quick else 300)


def run_at_ranges(name: str, options: Options) -> Figures:
    """Run a cell at the ranges of the options."""
    cells = Cells(options.results)
    return at_ranges(AT_RANGES[name][0], cells, options.ranges, views_of(options))


def run_views(name: str, options: Options) -> Figures:
    """Run a cell."""
    return VIEWS[name][0](Cells(options.results), views_of(options))


def add_options(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--views", type=int, metavar="N", help="of mesh and shape: views of a cell (20 and 300)"
    )
    parser.add_argument(
        "--ranges",
        type=float,
        nargs="+",
        default=RANGES_M,
        metavar="M",
        help="of shape: ranges of the cells at several ranges",
    )


GROUP = Group(
    {
        **{
            f"shape-{name}": described(partial(run_at_ranges, name), text)
            for name, (_, text) in AT_RANGES.items()
        },
        **{
            f"shape-{name}": described(partial(run_views, name), text)
            for name, (_, text) in VIEWS.items()
        },
    },
    ("results",),
    add_options,
)
