# SPDX-License-Identifier: Apache-2.0
"""`chaserdock.Tracker` on photographs of printed marker sheets, by a renderer of its own."""

from __future__ import annotations

import math
import time
from dataclasses import replace

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.targets import target_model
from common import Figures, Group, Options, percentiles
from numpy.typing import NDArray
from sheet_views import (
    Lens,
    Photograph,
    PrintedSheet,
    cut_marker,
    printed,
    random_view,
    rotation_of,
    sheet_target,
)

from chaserdock.analysis.pose_errors import normalized_square, pose_error
from chaserdock.targets.marker_sheets import marker_bits
from chaserdock.tracking.tracker import Tracker

SMALL = Lens(640, 480, 600.0, 600.0, 322.3, 237.1)
_PAPER, _TILT_RAD = target_model("paper"), math.radians(50.0)
_FALSE_M, _FALSE_RAD = 0.01, math.radians(3.0)
"""Errors above these are a false pose: ten times those of the worst view of a sheet at 1 m."""


def views_of(options: Options, views: int, quick: int) -> int:
    """Return the number of views."""
    return quick if options.quick else views


def measure_accuracy(options: Options) -> Figures:
    """Evaluate views of a sheet at 1 m (two markers of 90 mm), in sharp and in poor images: errors,
    and NEES, of which six are expected.
    """
    figures: Figures = {}
    for name, lens, photo in (
        ("1280x720", Lens(), Photograph()),
        ("1280x720_poor", Lens(), Photograph(jpeg=60, noise=3.0, blur_px=0.8)),
        ("640x480", SMALL, Photograph()),
    ):
        figures |= _accuracy(
            f"track_{name}", lens, replace(photo, lens=lens), views_of(options, 200, 6)
        )
    return figures


def _accuracy(name: str, lens: Lens, photo: Photograph, count: int) -> Figures:
    sheet = printed(_PAPER)
    tracker, rng = Tracker(lens.camera(), sheet_target(_PAPER, sheet)), np.random.default_rng(17)
    errors, squares = [], []
    for _ in range(count):
        position, rotation = random_view(rng, lens, 1.0, _TILT_RAD, 0.15)
        image = photo.of(sheet, position, rotation, rng)
        tracker.reset()
        pose = tracker.track(image, 0).pose
        if pose is None:
            continue
        true = position, rotations.from_matrix(rotation)
        errors.append(pose_error(*true, pose.position_m, pose.q_wxyz))
        squares.append(float(normalized_square(errors[-1], pose.covariance)))
    e = np.array(errors).reshape(-1, 6)
    away, turned = np.linalg.norm(e[:, :3], axis=1), np.linalg.norm(e[:, 3:], axis=1)
    false = (away > _FALSE_M) | (turned > _FALSE_RAD)
    return {
        f"{name}_views": count,
        f"{name}_lost": count - len(errors),
        f"{name}_false": int(false.sum()),
        **percentiles(away, f"{name}_position_error", "m", "median", "max"),
        **percentiles(np.degrees(turned), f"{name}_attitude_error", "deg", "median", "max"),
        f"{name}_nees_mean": float(np.mean(squares)),
    }


def measure_speed(options: Options) -> Figures:
    """Time an image of 640 x 480 to poses where the sheet moves from image to image: with what the
    last images tell, and without.
    """
    count, sheet = views_of(options, 200, 20), printed(_PAPER)
    lens = replace(SMALL, samples=3)
    images = [_moving(lens, k, sheet) for k in range(count)]
    target = sheet_target(_PAPER, sheet)
    figures: Figures = {}
    for name in ("prior", "no_prior"):
        tracker = Tracker(lens.camera(), target)
        times = []
        for k, image in enumerate(images):
            if name == "no_prior":
                tracker.reset()
            begin_s = time.thread_time()
            tracker.track(image, 33_333_333 * k)
            times.append(time.thread_time() - begin_s)
        key = f"track_640x480_{name}"
        figures |= percentiles(times, f"{key}_cpu", "s", "median", "p95")
        figures[f"{key}_images_per_cpu_s"] = len(times) / sum(times)
    return figures


def _moving(lens: Lens, k: int, sheet: PrintedSheet) -> NDArray[np.uint8]:
    position = np.array([0.05 * math.sin(k / 20), 0.04 * math.cos(k / 17), 0.8 + 0.001 * k])
    turn = rotation_of([0.4 * math.sin(k / 25), 0.3, 0.01 * k]) @ np.diag([1.0, -1.0, -1.0])
    return Photograph(lens).of(sheet, position, turn, np.random.default_rng(k))


def measure_margin(options: Options) -> Figures:
    """Count views of a marker, by its size in the image and the width of its white border in cells,
    that give no pose: dark ground, border as stated.
    """
    count, side_m, figures = views_of(options, 16, 2), 0.09, Figures()
    lens = replace(SMALL, samples=4)
    for dictionary in ("DICT_4X4_50", "DICT_5X5_50", "DICT_APRILTAG_36h11"):
        cell_m = side_m / len(marker_bits(dictionary, 3))
        for side_px in (20, 30, 50):
            for cells in (0.2, 0.3, 0.4, 0.5, 1.0):
                margin_m = cells * cell_m
                sheet = cut_marker(dictionary, 3, side_m, margin_m)
                tracker = Tracker(
                    lens.camera(), {3: side_m}, dictionary=dictionary, margin_m=margin_m
                )
                rng, lost, off = np.random.default_rng(7), 0, []
                for _ in range(count):
                    distance_m = lens.fx * side_m / side_px
                    position, rotation = random_view(rng, lens, distance_m, 0.8, 0.06)
                    image = Photograph(lens, behind=30.0).of(sheet, position, rotation, rng)
                    tracker.reset()
                    poses = tracker.track(image, 0).targets[0].poses
                    lost += not poses
                    if poses:
                        nearest = min(np.linalg.norm(p.position_m - position) for p in poses)
                        off.append(float(nearest) / distance_m)
                key = f"margin_{dictionary}_{side_px}px_{cells:g}cells"
                figures[f"{key}_lost"] = lost
                figures |= percentiles(off, f"{key}_position_error", "share", "median")
    return figures


GROUP = Group(
    {
        "track-accuracy": measure_accuracy,
        "track-speed": measure_speed,
        "track-margin": measure_margin,
    }
)
