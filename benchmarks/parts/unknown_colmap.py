# SPDX-License-Identifier: Apache-2.0
"""COLMAP on the images of an unknown target, beside which the mapper in flight is judged.

Every ``EVERY``-th image of two chasers over a turn of the target, with masks that leave a circle
about it. COLMAP works on all of them at once, and knows calibration, but no odometry: its frame and
unit are fitted to the truth.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.satellites import satellite
from common import BenchmarkFailed, Figures, Group, KeptResults, Options, seeds_of

from .unknown_map import case_of, nearest_rotation, surface_distances
from .unknown_scene import SceneCase, UnknownImages

EVERY = 10
"""Images from one that COLMAP gets to the next: 2 s, in which the target turns by 6 to 10 degrees.
All pairs of all 1,100 images would take hours."""


@dataclass(frozen=True)
class ColmapOutcome:
    """Share of the images with a pose; RMS of the target's position (m) in the cameras and of the
    angles of its pose (rad); distances of the points from the surface; processor time.
    """

    images: int
    posed_share: float
    position_m: float = np.nan
    angle_rad: float = np.nan
    points: int = 0
    point_median_m: float = np.nan
    point_p90_m: float = np.nan
    cpu_s: float = np.nan

    def line(self) -> str:
        """Return the figures as a line of text."""
        return (
            f"{self.posed_share:.0%} of {self.images} images, {1e3 * self.position_m:.2f} mm "
            f"{np.rad2deg(self.angle_rad):.3f} deg; {self.points} points, "
            f"{1e3 * self.point_median_m:.1f}, {1e3 * self.point_p90_m:.1f} mm; {self.cpu_s:.0f} s"
        )


def true_pose(images: UnknownImages, chaser: int, time_s: float) -> tuple[Array, Array]:
    """Return rotation (3, 3) and translation (3,) from TRF to the calibrated camera."""
    own = images.state(f"chaser/{chaser}", time_s)
    eye, q = images.camera.irf_pose_in_world(own.position_m, own.q_wxyz)
    place, q_target = images.target_pose(time_s)
    axes = rotations.to_matrix(q).T
    return axes @ rotations.to_matrix(q_target), axes @ (place - eye)


def fly(case: SceneCase, folder: Path, seed: int) -> ColmapOutcome:
    """Return COLMAP's figures for the sequence of a seed."""
    from peers.colmap_map import map_images

    images = UnknownImages(replace(case, seed=seed), folder)
    parts = satellite(case.mesh).parts
    radius_m = max(float(np.linalg.norm(p.vertices_m, axis=1).max()) for p in parts)
    with TemporaryDirectory() as work:
        masks = Path(work) / "masks"
        masks.mkdir()
        chosen = images.kept(EVERY, case.turn_s)
        for name, (chaser, time_s) in chosen.items():
            _, place = true_pose(images, chaser, time_s)
            mask = np.zeros((images.camera.height_px, images.camera.width_px), dtype=np.uint8)
            x, y = images.camera.project(place).tolist()
            size_px = images.camera.fx_px * radius_m / float(np.linalg.norm(place))
            cv2.circle(mask, (round(x), round(y)), round(size_px), 255, -1)
            cv2.imwrite(str(masks / f"{name}.png"), mask)
        begin_s = time.process_time()
        found = map_images(images.folder, masks, list(chosen), images.camera, Path(work))
        cpu_s = time.process_time() - begin_s
    if found is None:
        return ColmapOutcome(len(chosen), 0.0, cpu_s=cpu_s)
    true = [true_pose(images, *chosen[name]) for name in found.names]
    true_turns, true_places = (np.array(part) for part in zip(*true, strict=True))
    eyes = -np.einsum("nji,nj->ni", found.turns, found.translations)
    true_eyes = -np.einsum("nji,nj->ni", true_turns, true_places)
    scale, turn, shift = _similarity(eyes, true_eyes)
    # Of the model's frame in TRF: x_trf = scale turn x + shift.
    turns = found.turns @ turn.T
    places = scale * found.translations - np.einsum("nij,j->ni", turns, shift)
    angles = [
        rotations.log(rotations.from_matrix(a @ b.T))
        for a, b in zip(turns, true_turns, strict=True)
    ]
    distances = surface_distances(case.mesh, scale * found.points @ turn.T + shift)
    return ColmapOutcome(
        len(chosen),
        len(found.names) / len(chosen),
        float(np.sqrt(((places - true_places) ** 2).sum(axis=1).mean())),
        float(np.sqrt((np.array(angles) ** 2).sum(axis=1).mean())),
        len(found.points),
        float(np.median(distances)),
        float(np.percentile(distances, 90)),
        cpu_s,
    )


def _similarity(points: Array, to: Array) -> tuple[float, Array, Array]:
    """Return scale, rotation (3, 3) and shift (3,) of the similarity nearest to a map of points (n,
    3): S. Umeyama, "Least-squares estimation of transformation parameters", 1991.
    """
    middle, to_middle = points.mean(axis=0), to.mean(axis=0)
    a, b = points - middle, to - to_middle
    turn = nearest_rotation(b.T @ a)
    scale = float((b * (a @ turn.T)).sum() / (a**2).sum())
    return scale, turn, to_middle - scale * turn @ middle


def measure(options: Options) -> Figures:
    """Map the images of a turn of each seed with COLMAP (``pip install pycolmap``)."""
    outcomes: list[ColmapOutcome] = []
    for seed in seeds_of(options, 20, 1):
        case = case_of(options, seed)
        key = {"colmap": case.mesh, "sun": list(case.to_sun), "every": EVERY,
               "omega": [round(v, 6) for v in case.omega_rad_s]}  # fmt: skip
        outcomes += KeptResults(options.results, key, ColmapOutcome).of(
            [seed], partial(fly, case, options.images), ColmapOutcome.line
        )
    if not any(outcome.points for outcome in outcomes):
        raise BenchmarkFailed("COLMAP found no model", {})
    names = list(ColmapOutcome.__dataclass_fields__)
    return {
        f"{name}_median": float(np.nanmedian([getattr(o, name) for o in outcomes]))
        for name in names
    }


GROUP = Group({"colmap": measure}, on_request=("colmap",), uses=("flights", "first", "results"))
