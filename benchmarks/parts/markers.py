# SPDX-License-Identifier: Apache-2.0
"""Accuracy, range and speed of perception by markers, and both renderers.

Gross error: more than 10 degrees or 10 cm (for an ambiguous view: of the solution nearer to the
truth).
"""

from __future__ import annotations

import time
from argparse import ArgumentParser
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import cv2
import numpy as np
from chaserdock_agents.chaser.perception import (
    Method,
    Perception,
    PerceptionResult,
    make_perception,
)
from chaserdock_agents.chaser.perception.corners import SETTINGS, mean_side_px
from chaserdock_agents.chaser.perception.detect import dictionary_of
from chaserdock_agents.chaser.perception.pnp import MarkerTable
from chaserdock_agents.chaser.sighting import decode_image, look
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.rigid_body import BodyState
from chaserdock_models.targets import face_rotation, target_model
from chaserdock_protocol.scenario.camera import Effects
from chaserdock_world.rendering.background import Light
from chaserdock_world.rendering.cameras import Cameras
from chaserdock_world.rendering.effects import CameraEffects
from chaserdock_world.rendering.pose_cameras import make_cameras
from chaserdock_world.rendering.rasterizer import Renderer
from common import Figures, Group, Options, described, percentiles
from flights import load_shipped
from numpy.typing import NDArray

from chaserdock.analysis.pose_errors import normalized_square, pose_error

CAMERA_POSITION, CAMERA_ATTITUDE = np.zeros(3), rotations.IDENTITY  # IRF = WRF
HFOV = np.deg2rad(60.0)
"""Horizontal field of view, rad: that of the default camera."""
GROSS_M, GROSS_RAD = 0.1, np.deg2rad(10.0)
"""Errors of a pose above which it is grossly wrong."""
JPEG_QUALITY = 85
"""That of images between processes."""
# Attitude of an upright face that faces the camera.
FACING = rotations.from_matrix(np.diag([1.0, -1.0, -1.0]))


@dataclass
class View:
    """An image and the true pose of the target (IRF)."""

    image: NDArray[np.uint8]
    position: Array
    q: Array
    complete_markers: int


class Views:
    """Views of a target by one camera."""

    def __init__(self, target: str, width: int = 1280, height: int = 720):
        self.camera = Camera.from_hfov(width, height, HFOV)
        self.model = target_model(target)
        self.renderer = Renderer(self.camera, self.model, None, Effects().point_spread_px)
        self.effects = CameraEffects(width, height, Effects(), 7)
        self.count = 0

    def view(self, position: Array, q: Array, to_sun: Array) -> View:
        """Return an image with all default effects, encoded and decoded as between processes."""
        exact = self.renderer.render(
            CAMERA_POSITION, CAMERA_ATTITUDE, position, q, (), Light(tuple(to_sun.tolist()))
        )
        taken = self.effects.apply(exact, 0, self.count)
        self.count += 1
        code = cv2.imencode(".jpg", taken, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
        image: Any = cv2.imdecode(code, cv2.IMREAD_GRAYSCALE)
        return View(image, position, q, self._complete_markers(position, q))

    def _complete_markers(self, position: Array, q: Array) -> int:
        """Return the number of markers that face the camera with all corners in the image."""
        corners = (
            rotations.rotate(q, np.array([m.corners_trf_m() for m in self.model.markers]))
            + position
        )
        normals = rotations.rotate(q, np.array([m.normal_trf() for m in self.model.markers]))
        px = self.camera.project(corners)
        inside = (px > 2.0) & (px < (self.camera.width_px - 3.0, self.camera.height_px - 3.0))
        facing = (normals * corners.mean(axis=1)).sum(axis=1) < 0.0
        return int((inside.all(axis=(1, 2)) & facing).sum())

    def right_ids(self, detector: cv2.aruco.ArucoDetector, view: View) -> int:
        """Return how many markers a detector finds, to 5 px, where they are."""
        right = set[int]()
        found, ids, _ = detector.detectMarkers(view.image)
        for px, number in zip(found, [] if ids is None else ids.ravel().tolist(), strict=True):
            marker = self.model.marker(int(number))
            if marker is None:
                continue
            at = rotations.rotate(view.q, marker.corners_trf_m()) + view.position
            if np.abs(self.camera.project(at) - px[0]).max() < 5.0:
                right.add(marker.id)
        return len(right)

    def perception(self, method: Method = "default") -> Perception:
        return Perception(self.camera, self.model, method)

    def random_views(self, count: int, near_m: float, far_m: float, seed: int) -> Iterator[View]:
        """Yield views at random attitudes, the centre in the middle 40 % of width and height, the
        sun in a random direction.
        """
        generator = np.random.default_rng(seed)
        size = np.array([self.camera.width_px, self.camera.height_px])
        for _ in range(count):
            z = generator.uniform(near_m, far_m)
            px = generator.uniform(0.3, 0.7, 2) * size
            ray = (px - (self.camera.cx_px, self.camera.cy_px)) / (
                self.camera.fx_px,
                self.camera.fy_px,
            )
            q = rotations.normalize(generator.normal(size=4))
            yield self.view(np.append(ray, 1.0) * z, q, generator.normal(size=3))

    def face_views(
        self,
        count: int,
        distance_m: float,
        tilt_rad: float,
        lit: bool,
        seed: int,
        lateral_m: float = 0.0,
    ) -> Iterator[View]:
        """Yield views of a face: the body's centre at ``distance_m``, tilt up to ``tilt_rad``,
        random roll, lateral offset up to ``lateral_m``; the sun behind the camera, or behind the
        target."""
        generator = np.random.default_rng(seed)
        for k in range(count):
            tilt = generator.normal(size=3) * (1.0, 1.0, 0.0)
            tilt *= tilt_rad * generator.uniform() / np.linalg.norm(tilt)
            turn = rotations.multiply(
                FACING, rotations.exp([0.0, 0.0, generator.uniform(-np.pi, np.pi)])
            )
            q = rotations.multiply(
                rotations.multiply(rotations.exp(tilt), turn),
                rotations.conjugate(face_rotation(k % 6)),
            )
            sun = np.array([*generator.uniform(-0.5, 0.5, 2), -1.0 if lit else 1.0])
            position = np.array([*generator.uniform(-lateral_m, lateral_m, 2), distance_m])
            yield self.view(position, q, sun)


def errors_of(sighting: PerceptionResult, view: View) -> tuple[float, float]:
    """Return the errors (m, rad) of the solution with the smaller angle error."""
    errors = [
        (
            float(np.linalg.norm(s.position_irf_m - view.position)),
            float(rotations.angle_between(s.q_irf_trf_wxyz, view.q)),
        )
        for s in sighting.solutions
    ]
    return min(errors, key=lambda e: e[1])


class ViewResults:
    """Perception results of many views."""

    def __init__(self) -> None:
        self.errors: list[tuple[float, float]] = []
        self.not_detected = self.ambiguous = self.no_complete_marker = 0

    def add(self, sighting: PerceptionResult, view: View) -> None:
        if not sighting.solutions:
            self.not_detected += 1
            self.no_complete_marker += view.complete_markers == 0
            return
        self.ambiguous += len(sighting.solutions) > 1
        self.errors.append(errors_of(sighting, view))

    def figures(self, name: str) -> Figures:
        e = np.array(self.errors).reshape(-1, 2)
        gross = (e[:, 0] > GROSS_M) | (e[:, 1] > GROSS_RAD)
        out: Figures = {
            f"{name}_views": len(e) + self.not_detected,
            f"{name}_not_detected": self.not_detected,
            f"{name}_not_detected_without_complete_marker": self.no_complete_marker,
            f"{name}_ambiguous": self.ambiguous,
            f"{name}_gross_errors": int(gross.sum()),
        }
        for k, (what, unit) in enumerate((("position_error", "m"), ("attitude_error", "rad"))):
            out |= percentiles(e[:, k], f"{name}_{what}", unit, "median", "p95", "max")
        return out


def accuracy(count: int) -> Figures:
    """Evaluate random views of both targets at 0.5 to 2 m by both methods (the baseline on a tenth
    of them), and with a prediction that is wrong by 3 mm and 0.3 degrees along each axis (1 sigma).
    """
    out: Figures = {}
    for target in ("servicer", "paper"):
        views, generator = Views(target), np.random.default_rng(4)
        ours, paper = views.perception(), views.perception("paper")
        results, tracking, baseline = ViewResults(), ViewResults(), ViewResults()
        for k, view in enumerate(views.random_views(count, 0.5, 2.0, 4)):
            results.add(ours.estimate(view.image), view)
            turn = rotations.exp(np.deg2rad(0.3) * generator.normal(size=3))
            predicted = view.position + 3e-3 * generator.normal(size=3)
            tracking.add(
                ours.estimate(view.image, (predicted, rotations.multiply(view.q, turn))), view
            )
            if k % 10 == 0 or count < 1000:
                baseline.add(paper.estimate(view.image), view)
        out |= results.figures(target) | baseline.figures(f"{target}_baseline")
        out |= tracking.figures(f"{target}_tracking")
    return out


def at_one_metre(count: int) -> Figures:
    """Evaluate a lit face and a shadowed face without a brighter one in view."""
    out: Figures = {}
    for target in ("servicer", "paper"):
        views = Views(target)
        ours, paper = views.perception(), views.perception("paper")
        for lit in (True, False):
            results, baseline = ViewResults(), ViewResults()
            for view in views.face_views(count, 1.0, np.deg2rad(40.0), lit, 5, 0.1):
                results.add(ours.estimate(view.image), view)
                baseline.add(paper.estimate(view.image), view)
            name = f"{target}_1m_{'lit' if lit else 'dark'}"
            out |= results.figures(name) | baseline.figures(f"{name}_baseline")
    return out


def reach(count: int) -> Figures:
    """Return the share of views in which the servicer is detected without gross error: by the gap
    from lens to face (docking: up to 5 degrees, 1 cm off the axis), and by distance (up to 40
    degrees)."""
    out: Figures = {}
    views = Views("servicer")
    perception = views.perception()
    half_m = 0.2

    def detected(
        distance_m: float, tilt_deg: float, lateral_m: float, faces: tuple[int, ...]
    ) -> float:
        results = ViewResults()
        shown = views.face_views(6 * count, distance_m, np.deg2rad(tilt_deg), True, 6, lateral_m)
        for k, view in enumerate(shown):
            if k % 6 in faces:
                results.add(perception.estimate(view.image), view)
        gross = results.figures("x")["x_gross_errors"]
        return (len(results.errors) - gross) / (len(results.errors) + results.not_detected)

    for gap_m in (0.08, 0.10, 0.15, 0.20, 0.25):
        # Faces 0 and 1, across x, are half_m from the centre.
        out[f"servicer_detected_at_gap_{gap_m * 100:.0f}_cm_share"] = detected(
            half_m + gap_m, 5.0, 0.01, (0, 1)
        )
    for distance_m in (2.0, 3.0, 4.0, 4.5):
        out[f"servicer_detected_at_{distance_m:g}_m_share"] = detected(
            distance_m, 40.0, 0.2, tuple(range(6))
        )
    return out


def near_views(count: int) -> Figures:
    """Evaluate random attitudes with the centre at 0.28 to 0.45 m: the body fills the image."""
    views, results = Views("servicer"), ViewResults()
    perception = views.perception()
    for view in views.random_views(count, 0.28, 0.45, 8):
        results.add(perception.estimate(view.image), view)
    return results.figures("servicer_near")


def speed(count: int) -> Figures:
    """Time image to pose without prediction, with an inexact prediction (tracking), and by the
    baseline.
    """
    out: Figures = {}
    for target in ("servicer", "paper"):
        for width, height in ((640, 480), (1280, 720)):
            views = Views(target, width, height)
            took: dict[str, list[float]] = {"no_prediction": [], "tracking": [], "baseline": []}
            ours, paper = views.perception(), views.perception("paper")
            off = rotations.exp([0.01, -0.01, 0.01])
            for view in views.random_views(count, 0.5, 2.0, 9):
                prediction = (view.position + 0.005, rotations.multiply(view.q, off))
                for name, perception, predicted in (
                    ("no_prediction", ours, None),
                    ("tracking", ours, prediction),
                    ("baseline", paper, None),
                ):
                    begin_s = time.thread_time()
                    perception.estimate(view.image, predicted)
                    took[name].append(time.thread_time() - begin_s)
            for name, values in took.items():
                key = f"{target}_{width}x{height}_image_to_pose_{name}_cpu"
                out |= percentiles(values, key, "s", "median", "p95")
    return out


def rendering(count: int) -> Figures:
    """Time an image of 640 x 480, and the errors of the corners fitted in it."""
    views = Views("servicer", 640, 480)
    perception = views.perception()
    took: list[float] = []
    off: list[float] = []
    generator = np.random.default_rng(12)
    for _ in range(count):
        position = np.array([*generator.uniform(-0.1, 0.1, 2), generator.uniform(0.7, 2.0)])
        q = rotations.normalize(generator.normal(size=4))
        light = Light(tuple((generator.normal(size=3) - (0, 0, 1.5)).tolist()))
        begin_s = time.thread_time()
        image = views.renderer.render(CAMERA_POSITION, CAMERA_ATTITUDE, position, q, (), light)
        took.append(time.thread_time() - begin_s)
        sighting = perception.estimate(image)
        for i, corners in zip(sighting.marker_ids.tolist(), sighting.corners_px, strict=True):
            marker = views.model.marker(i)
            assert marker is not None
            truth = views.camera.project(rotations.rotate(q, marker.corners_trf_m()) + position)
            off += np.linalg.norm(corners - truth, axis=1).tolist()
    return percentiles(took, "render_exact_cpu", "s", "median") | percentiles(
        off, "render_exact_corner_error", "px", "median", "p95"
    )


def far(count: int, first: int = 0) -> Figures:
    """Return figures of views of the servicer, in whose images its markers are hardly large enough;
    of two solutions the nearer.
    """
    scenario = load_shipped("docking-contact", 'navigation.grade="exact"')
    cameras = Cameras(scenario)
    perception = make_perception(scenario)
    camera = scenario.camera_model()
    zero, out = np.zeros(3), Figures()
    for metres in (5.0, 6.0, 6.5, 7.0, 7.5):
        rng, found = np.random.default_rng([24 + first, int(10 * metres)]), []
        for k in range(count):
            q = rotations.exp(rng.normal(0.0, 0.15, 3))
            turn = rotations.exp(rng.normal(0.0, 0.01, 3))
            own = np.array([-metres, *rng.normal(0.0, 0.05 * metres, 2)])
            states = {
                "target": BodyState(zero, zero, q, zero),
                "chaser/0": BodyState(own, zero, turn, zero),
            }
            seen = perception.estimate(decode_image(cameras.image(0, k, k, 0, states)))
            eye, attitude = camera.irf_pose_in_world(own, turn)
            true_m = rotations.rotate_inverse(attitude, -eye)
            true_q = rotations.multiply(rotations.conjugate(attitude), q)
            errors = [
                (pose_error(true_m, true_q, s.position_irf_m, s.q_irf_trf_wxyz), s.covariance)
                for s in seen.solutions
            ]
            if errors:
                found.append(min(errors, key=lambda e: float(np.linalg.norm(e[0][3:]))))
        at = f"far_{metres:g}m_"
        out[f"{at}without_a_pose"] = count - len(found)
        if found:
            e = np.array([error for error, _ in found])
            squares = normalized_square(e, np.array([covariance for _, covariance in found]))
            angles_rad = np.sqrt(np.mean(np.sum(e[:, 3:] ** 2, axis=1)))
            out |= {
                f"{at}nees_mean": float(squares.mean()),
                f"{at}depth_rms_m": float(np.sqrt(np.mean(e[:, 2] ** 2))),
                f"{at}angle_rms_deg": float(np.degrees(angles_rad)),
            }
    return out


def bearing(count: int) -> Figures:
    """Return figures of the position by bearing and range, by range: random attitude and place in
    the image, eight suns, among stars.

    ``nees_bearing_mean``: per degree of freedom, of the two across the line of sight. With the
    prediction that a flight has; ``alone``: views that are measured without it, too, and
    ``alone_wrong``: with something else taken for the target. Views with markers do not count.
    """
    suns = np.random.default_rng(24).normal(size=(8, 3)).tolist()
    scenarios = [
        load_shipped(
            "docking-contact",
            'navigation.grade="exact"',
            "ranging={}",
            f"camera.sun_direction={sun}",
        )
        for sun in suns
    ]
    lit = [make_cameras(scenario) for scenario in scenarios]
    perception, camera = make_perception(scenarios[0]), scenarios[0].camera_model()
    zero, still, out = np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), {}
    for metres in (7.0, 10.0, 15.0, 20.0, 30.0, 50.0, 80.0, 120.0, 160.0, 200.0):
        rng = np.random.default_rng([24, int(metres)])
        errors, squares, ranges = [], [], []
        alone = wrong = missed = 0
        for k in range(count):
            q = rotations.normalize(rng.normal(size=4))
            own = np.array([-metres, *rng.uniform(-0.2, 0.2, 2) * metres])
            states = {
                "target": BodyState(zero, zero, q, zero),
                "chaser/0": BodyState(own, zero, still, zero),
            }
            eye, attitude = camera.irf_pose_in_world(own, still)
            true_m = rotations.rotate_inverse(attitude, -eye)
            image = lit[k % len(lit)].image(0, k, k, 0, states)
            sigma_m = 3.0 * metres / camera.fx_px
            predicted = true_m + rng.normal(0.0, sigma_m, 3), still
            seen = look(perception, image, predicted)
            if seen.marker_ids:
                continue
            free = look(perception, image, None)
            if free.solutions:
                alone += 1
                wrong += (
                    np.linalg.norm(np.array(free.solutions[0].position_m) - true_m) > 10.0 * sigma_m
                )
            if not seen.solutions:
                missed += 1
                continue
            error = np.array(seen.solutions[0].position_m) - true_m
            covariance = np.array(seen.solutions[0].covariance).reshape(6, 6)[:3, :3]
            along = true_m / np.linalg.norm(true_m)
            basis = np.linalg.svd(along[None])[2][1:]
            across, part = basis @ error, basis @ covariance @ basis.T
            errors.append(across / metres * camera.fx_px)
            squares.append(float(across @ np.linalg.solve(part, across)) / 2.0)
            ranges.append(float(along @ error) ** 2 / float(along @ covariance @ along))
        at = f"bearing_{metres:g}m_"
        out |= {
            f"{at}measured": len(errors),
            f"{at}missed": missed,
            f"{at}rms_px": float(np.sqrt(np.mean(np.square(errors)))),
            f"{at}nees_bearing_mean": float(np.mean(squares)),
            f"{at}nees_range_mean": float(np.mean(ranges)),
            f"{at}alone": alone,
            f"{at}alone_wrong": int(wrong),
        }
    return out


def best_detector(dictionary: cv2.aruco.Dictionary) -> cv2.aruco.ArucoDetector:
    """Return OpenCV's detector with the settings that find most markers in these views."""
    best = cv2.aruco.DetectorParameters()
    best.adaptiveThreshWinSizeStep, best.minMarkerPerimeterRate = 4, 0.01
    best.minMarkerDistanceRate = 0.05
    return cv2.aruco.ArucoDetector(dictionary, best)


def small(count: int, first: int = 0) -> Figures:
    """Return NEES (of two poses the nearer) and number of markers, beside those that OpenCV's
    detector finds at the right place with its defaults and with its best settings, in random views
    by range.
    """
    out: Figures = {}
    for target, near_m, far_m in (
        ("servicer", 0.5, 1.5), ("servicer", 1.5, 4.0), ("servicer", 4.0, 5.5),
        ("paper", 0.5, 1.5), ("paper", 1.5, 3.0),
    ):  # fmt: skip
        views, squares = Views(target, 640, 480), []
        perception, ours, missed = views.perception(), 0, 0
        dictionary = dictionary_of(views.model.dictionary)
        detectors = {
            "opencv": cv2.aruco.ArucoDetector(dictionary),
            "opencv_best": best_detector(dictionary),
        }
        theirs, fewer = dict.fromkeys(detectors, 0), dict.fromkeys(detectors, 0)
        for view in views.random_views(count, near_m, far_m, 3 + first):
            sighting = perception.estimate(view.image)
            used = len(sighting.marker_ids)
            ours, missed = ours + used, missed + (not sighting.solutions)
            for name, detector in detectors.items():
                right = views.right_ids(detector, view)
                theirs[name], fewer[name] = theirs[name] + right, fewer[name] + (used < right)
            each = [
                (
                    pose_error(view.position, view.q, s.position_irf_m, s.q_irf_trf_wxyz),
                    s.covariance,
                )
                for s in sighting.solutions
            ]
            if each:
                squares.append(min(float(e @ np.linalg.solve(c, e)) for e, c in each))
        at = f"small_{target}_{near_m:g}_to_{far_m:g}_m_"
        out |= {
            f"{at}nees_mean": float(np.mean(squares)),
            f"{at}without_a_pose": missed,
            f"{at}markers": ours,
        }
        for name in detectors:
            out |= {
                f"{at}markers_by_{name}": theirs[name],
                f"{at}views_with_fewer_than_{name}": fewer[name],
            }
    return out


def corner_errors(count: int, first: int = 0) -> Figures:
    """Return errors of fitted corners beside the stated ones, by the narrowest cell of a marker:
    root mean square, per coordinate; mean and median square of whitened errors (1 and 0.45).
    """
    out: Figures = {}
    for target in ("servicer", "paper"):
        views = Views(target, 960, 540)
        perception, table = views.perception(), MarkerTable.of(views.model)
        found: list[tuple[float, Array, Array, Array]] = []
        for view in views.random_views(count, 0.4, 4.5, 5 + first):
            truth = views.camera.project_ideal(
                rotations.rotate(view.q, table.corners) + view.position
            )
            rows = np.flatnonzero(np.isin(table.ids, perception.estimate(view.image).marker_ids))
            for row in rows.tolist():  # each alone: all small ones by their cells
                refined = perception.refined(view.image, truth[[row]], np.array([row]))
                if not refined.good[0]:
                    continue
                white = refined.errors.whitening[0]
                off = (refined.corners_px[0] - truth[row]).ravel()
                area_px = float(cv2.contourArea(truth[row].astype(np.float32)))
                cell_px = area_px / mean_side_px(truth[[row]])[0] / perception.reader.cells
                found.append((cell_px, off, white @ off, np.linalg.inv(white.T @ white)))
        for low_px, high_px in pairwise((1.0, 2.0, 3.0, 5.0, 10.0, 100.0)):
            part = [f for f in found if low_px <= f[0] < high_px]
            if not part:
                continue
            squares = np.square([white for _, _, white, _ in part])
            stated = np.trace(np.array([c for *_, c in part]), axis1=1, axis2=2) / 8.0
            at = f"corners_{target}_cells_of_{low_px:g}_to_{high_px:g}_px_"
            out |= {
                f"{at}markers": len(part),
                f"{at}rms_px": float(np.sqrt(np.mean(np.square([off for _, off, *_ in part])))),
                f"{at}stated_median_px": float(np.sqrt(np.median(stated))),
                f"{at}whitened_square_mean": float(np.mean(squares)),
                f"{at}whitened_square_median": float(np.median(squares)),
            }
    return out


def held(count: int) -> Figures:
    """Return the NEES of poses while a chaser holds 1 m before a face, off by 1 mm and 0.1 degrees
    RMS over half a second, and 45 times the variance of the mean of 45 whitened errors (3 s): 1 if
    they are white and as large as stated.
    """
    out: Figures = {}
    for target in ("servicer", "paper"):
        views, rng, images = Views(target, 960, 540), np.random.default_rng(6), 45
        perception = views.perception()
        squares, means = [], []
        for _ in range(count):
            roll = rng.uniform(-0.02, 0.02)
            moved = np.zeros(6)
            errors = []
            for _ in range(images):
                moved += -0.13 * moved + 0.5 * rng.normal(size=6)
                turn = rotations.exp(np.radians(0.1) * moved[3:] + [0.0, 0.0, roll])
                place = 1e-3 * moved[:3] + [0.0, 0.0, 1.0]
                view = views.view(place, rotations.multiply(turn, FACING), np.array([0.2, 0.3, -1]))
                for s in perception.estimate(view.image).solutions[:1]:
                    error = pose_error(view.position, view.q, s.position_irf_m, s.q_irf_trf_wxyz)
                    errors.append(np.linalg.solve(np.linalg.cholesky(s.covariance), error))
            squares += np.sum(np.square(errors), axis=1).tolist()
            means.append(np.mean(errors, axis=0))
        out |= {
            f"held_{target}_nees_mean": float(np.mean(squares)),
            f"held_{target}_mean_of_{images}_variance_ratio": float(
                images * np.mean(np.square(means))
            ),
        }
    return out


COUNTS: dict[str, tuple[Callable[..., Figures], int, int]] = {
    "rendering": (rendering, 200, 20),
    "speed": (speed, 200, 30),
    "reach": (reach, 100, 4),
    "near": (near_views, 600, 30),
    "metre": (at_one_metre, 1000, 30),
    "accuracy": (accuracy, 10_000, 60),
    "far": (far, 80, 4),
    "small": (small, 200, 10),
    "corners": (corner_errors, 200, 4),
    "held": (held, 20, 1),
    "bearing": (bearing, 80, 8),
}
"""Number of views of each part, and number with ``--quick``."""
SEEDED = "far", "small", "corners"
"""Parts of other views with ``--first``."""


def measure(name: str, options: Options) -> Figures:
    """Measure a part."""
    if options.strip is not None:
        SETTINGS.partial_px = options.strip
    part, full, quick = COUNTS[name]
    count = quick if options.quick else full
    return part(count, options.first) if name in SEEDED else part(count)


def add_options(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--strip",
        type=float,
        metavar="PX",
        help="of markers-far: fit borders that end at neighbours beside a part of a side as strips "
        "below this width (1.5)",
    )


GROUP = Group(
    {
        f"markers-{name}": described(partial(measure, name), part.__doc__ or "")
        for name, (part, _, _) in COUNTS.items()
    },
    uses=("first",),
    add_options=add_options,
)
