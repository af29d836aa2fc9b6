# SPDX-License-Identifier: Apache-2.0
"""How well, how far and how fast the cameras see: ``python benchmarks/vision.py [--quick] [--json FILE]``.

Random views of both targets with all effects at default strength, by the default perception and by the paper's
beside it; a lit and a dark face at 1 m; how near and far the servicer is seen; image to pose in time; both
renderers. Gross errors: over 10 degrees or 10 cm from the truth (of an ambiguous view, its nearer solution).
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from chaserdock_agents.chaser.perception import Method, Perception, Sighting
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.targets import face_rotation, target_model
from chaserdock_protocol.scenario.camera import Effects
from chaserdock_world.rendering.background import Light
from chaserdock_world.rendering.effects import CameraEffects
from chaserdock_world.rendering.rasterizer import Renderer
from chaserdock_world.rendering.tinyrenderer import TinyRenderer
from numpy.typing import NDArray
from results import options_of, write_json

EYE, AHEAD = np.zeros(3), rotations.IDENTITY  # IRF = WRF
HFOV = np.deg2rad(60.0)
GROSS_M, GROSS_RAD = 0.1, np.deg2rad(10.0)
JPEG_QUALITY = 85
# A face turned to the camera, upright: its right is the image's right, its up the image's up.
FACING = rotations.from_matrix(np.diag([1.0, -1.0, -1.0]))

Figures = dict[str, float]


@dataclass
class View:
    """One image with the pose of the target (IRF) that it shows."""

    image: NDArray[np.uint8]
    position: Array
    q: Array
    whole_markers: int


class Bench:
    """A camera and a target in it."""

    def __init__(self, target: str, width: int = 1280, height: int = 720):
        self.camera = Camera.from_hfov(width, height, HFOV)
        self.model = target_model(target)
        self.renderer = Renderer(self.camera, self.model)
        self.effects = CameraEffects(width, height, Effects(), 7)
        self.count = 0

    def view(self, position: Array, q: Array, to_sun: Array) -> View:
        """An image with all default effects, compressed and decompressed as between the processes."""
        exact = self.renderer.render(EYE, AHEAD, position, q, (), Light(tuple(to_sun.tolist())))
        taken = self.effects.apply(exact, 0, self.count)
        self.count += 1
        code = cv2.imencode(".jpg", taken, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1]
        image: Any = cv2.imdecode(code, cv2.IMREAD_GRAYSCALE)
        return View(image, position, q, self._whole_markers(position, q))

    def _whole_markers(self, position: Array, q: Array) -> int:
        """How many markers face the camera with all of their corners in the image."""
        corners = rotations.rotate(q, np.array([m.corners_trf_m() for m in self.model.markers])) + position
        normals = rotations.rotate(q, np.array([m.normal_trf() for m in self.model.markers]))
        px = self.camera.project(corners)
        inside = (px > 2.0) & (px < (self.camera.width_px - 3.0, self.camera.height_px - 3.0))
        facing = (normals * corners.mean(axis=1)).sum(axis=1) < 0.0
        return int((inside.all(axis=(1, 2)) & facing).sum())

    def perception(self, method: Method = "default") -> Perception:
        return Perception(self.camera, self.model, method)

    def random_views(self, count: int, near_m: float, far_m: float, seed: int) -> Iterator[View]:
        """Any attitude, the centre in the middle 40 % of the image each way, the sun anywhere."""
        generator = np.random.default_rng(seed)
        size = np.array([self.camera.width_px, self.camera.height_px])
        for _ in range(count):
            z = generator.uniform(near_m, far_m)
            px = generator.uniform(0.3, 0.7, 2) * size
            ray = (px - (self.camera.cx_px, self.camera.cy_px)) / (self.camera.fx_px, self.camera.fy_px)
            q = rotations.normalize(generator.normal(size=4))
            yield self.view(np.append(ray, 1.0) * z, q, generator.normal(size=3))

    def face_views(
        self, count: int, distance_m: float, tilt_rad: float, lit: bool, seed: int, aside_m: float = 0.0
    ) -> Iterator[View]:
        """A face at ``distance_m`` (of the body's centre), tilted by up to ``tilt_rad``, turned at will and off the
        axis by up to ``aside_m``; the sun behind the camera, or behind the target."""
        generator = np.random.default_rng(seed)
        for k in range(count):
            tilt = generator.normal(size=3) * (1.0, 1.0, 0.0)
            tilt *= tilt_rad * generator.uniform() / np.linalg.norm(tilt)
            turn = rotations.multiply(FACING, rotations.exp([0.0, 0.0, generator.uniform(-np.pi, np.pi)]))
            q = rotations.multiply(
                rotations.multiply(rotations.exp(tilt), turn), rotations.conjugate(face_rotation(k % 6))
            )
            sun = np.array([*generator.uniform(-0.5, 0.5, 2), -1.0 if lit else 1.0])
            position = np.array([*generator.uniform(-aside_m, aside_m, 2), distance_m])
            yield self.view(position, q, sun)


def errors_of(sighting: Sighting, view: View) -> tuple[float, float]:
    """Error in metres and radians, of the nearer solution."""
    each = [
        (
            float(np.linalg.norm(s.position_irf_m - view.position)),
            float(rotations.angle_between(s.q_irf_trf_wxyz, view.q)),
        )
        for s in sighting.solutions
    ]
    return min(each, key=lambda e: e[1])


class Tally:
    """Errors of many views, and their figures."""

    def __init__(self) -> None:
        self.errors: list[tuple[float, float]] = []
        self.nothing = self.two = self.unmarked = 0

    def add(self, sighting: Sighting, view: View) -> None:
        if not sighting.solutions:
            self.nothing += 1
            self.unmarked += view.whole_markers == 0
            return
        self.two += len(sighting.solutions) > 1
        self.errors.append(errors_of(sighting, view))

    def figures(self, name: str) -> Figures:
        e = np.array(self.errors).reshape(-1, 2)
        gross = (e[:, 0] > GROSS_M) | (e[:, 1] > GROSS_RAD)
        out: Figures = {
            f"{name}_views": len(e) + self.nothing,
            f"{name}_nothing_seen": self.nothing,
            f"{name}_nothing_seen_and_no_whole_marker_in_view": self.unmarked,
            f"{name}_two_solutions": self.two,
            f"{name}_gross_errors": int(gross.sum()),
        }
        if len(e):
            for k, what in enumerate(("position_error", "attitude_error")):
                unit = ("m", "rad")[k]
                out[f"{name}_{what}_p50_{unit}"] = float(np.median(e[:, k]))
                out[f"{name}_{what}_p95_{unit}"] = float(np.percentile(e[:, k], 95))
                out[f"{name}_{what}_max_{unit}"] = float(e[:, k].max())
        return out


def accuracy(count: int) -> Figures:
    """Random views at 0.5 to 2 m, of both targets, by both methods (the baseline on a tenth of them)."""
    out: Figures = {}
    for target in ("servicer", "paper"):
        bench = Bench(target)
        ours, paper = bench.perception(), bench.perception("paper")
        tally, baseline = Tally(), Tally()
        for k, view in enumerate(bench.random_views(count, 0.5, 2.0, 4)):
            tally.add(ours.estimate(view.image), view)
            if k % 10 == 0 or count < 1000:
                baseline.add(paper.estimate(view.image), view)
        out |= tally.figures(target) | baseline.figures(f"{target}_baseline")
    return out


def at_one_metre(count: int) -> Figures:
    """A lit face and one in its own shadow, with no brighter one in view."""
    out: Figures = {}
    for target in ("servicer", "paper"):
        bench = Bench(target)
        ours, paper = bench.perception(), bench.perception("paper")
        for lit in (True, False):
            tally, baseline = Tally(), Tally()
            for view in bench.face_views(count, 1.0, np.deg2rad(40.0), lit, 5, 0.1):
                tally.add(ours.estimate(view.image), view)
                baseline.add(paper.estimate(view.image), view)
            name = f"{target}_1m_{'lit' if lit else 'dark'}"
            out |= tally.figures(name) | baseline.figures(f"{name}_baseline")
    return out


def reach(count: int) -> Figures:
    """Share of views in which the servicer is seen: gap from the lens to the face (docking: little tilt, the
    middle of the face within 1 cm of the axis), and far away (up to 40 degrees)."""
    out: Figures = {}
    bench = Bench("servicer")
    perception = bench.perception()
    half_m = 0.2

    def seen(distance_m: float, tilt_deg: float, aside_m: float, faces: tuple[int, ...]) -> float:
        tally = Tally()
        views = bench.face_views(6 * count, distance_m, np.deg2rad(tilt_deg), True, 6, aside_m)
        for k, view in enumerate(views):
            if k % 6 in faces:
                tally.add(perception.estimate(view.image), view)
        wrong = tally.figures("x")["x_gross_errors"]
        return (len(tally.errors) - wrong) / (len(tally.errors) + tally.nothing)

    for gap_m in (0.08, 0.10, 0.15, 0.20, 0.25):
        # The faces across x are the ones half_m from the centre.
        out[f"servicer_seen_at_gap_{gap_m * 100:.0f}_cm_share"] = seen(half_m + gap_m, 5.0, 0.01, (0, 1))
    for distance_m in (2.0, 3.0, 4.0, 4.5):
        out[f"servicer_seen_at_{distance_m:g}_m_share"] = seen(distance_m, 40.0, 0.2, tuple(range(6)))
    return out


def near_views(count: int) -> Figures:
    """Any attitude with the centre at 0.28 to 0.45 m, where the body fills the image."""
    bench, tally = Bench("servicer"), Tally()
    perception = bench.perception()
    for view in bench.random_views(count, 0.28, 0.45, 8):
        tally.add(perception.estimate(view.image), view)
    return tally.figures("servicer_near")


def speed(count: int) -> Figures:
    """Image to pose, medians: from scratch, and with a prediction that is a little off."""
    out: Figures = {}
    for target in ("servicer", "paper"):
        for width, height in ((640, 480), (1280, 720)):
            bench = Bench(target, width, height)
            took: dict[str, list[float]] = {"scratch": [], "tracking": [], "baseline": []}
            ours, paper = bench.perception(), bench.perception("paper")
            off = rotations.exp([0.01, -0.01, 0.01])
            for view in bench.random_views(count, 0.5, 2.0, 9):
                near = (view.position + 0.005, rotations.multiply(view.q, off))
                for name, perception, predicted in (
                    ("scratch", ours, None),
                    ("tracking", ours, near),
                    ("baseline", paper, None),
                ):
                    begun = time.thread_time()
                    perception.estimate(view.image, predicted)
                    took[name].append(time.thread_time() - begun)
            for name, values in took.items():
                out[f"{target}_{width}x{height}_image_to_pose_{name}_p50_s"] = float(np.median(values))
                out[f"{target}_{width}x{height}_image_to_pose_{name}_p95_s"] = float(
                    np.percentile(values, 95)
                )
    return out


def rendering(count: int) -> Figures:
    """640 x 480, the exact renderer and TinyRenderer (its bias undone): time, and error of the fitted corners."""
    bench = Bench("servicer", 640, 480)
    renderers = {
        "exact": bench.renderer,
        "tinyrenderer": TinyRenderer(bench.camera, bench.model, supersampled=1),
        "tinyrenderer_2x": TinyRenderer(bench.camera, bench.model, supersampled=2),
    }
    perception = bench.perception()
    took: dict[str, list[float]] = {name: [] for name in renderers}
    off: dict[str, list[float]] = {name: [] for name in renderers}
    generator = np.random.default_rng(12)
    for _ in range(count):
        position = np.array([*generator.uniform(-0.1, 0.1, 2), generator.uniform(0.7, 2.0)])
        q = rotations.normalize(generator.normal(size=4))
        light = Light(tuple((generator.normal(size=3) - (0, 0, 1.5)).tolist()))
        for name, renderer in renderers.items():
            begun = time.thread_time()
            image = renderer.render(EYE, AHEAD, position, q, (), light)
            took[name].append(time.thread_time() - begun)
            sighting = perception.estimate(image)
            for i, corners in zip(sighting.marker_ids.tolist(), sighting.corners_px, strict=True):
                marker = bench.model.marker(i)
                assert marker is not None
                truth = bench.camera.project(rotations.rotate(q, marker.corners_trf_m()) + position)
                off[name] += np.linalg.norm(corners - truth, axis=1).tolist()
    out: Figures = {}
    for name in renderers:
        out[f"render_640x480_{name}_p50_s"] = float(np.median(took[name]))
        out[f"render_640x480_{name}_corner_error_p50_px"] = float(np.median(off[name]))
        out[f"render_640x480_{name}_corner_error_p95_px"] = float(np.percentile(off[name], 95))
    tiny, exact = "render_640x480_tinyrenderer", "render_640x480_exact"
    out["render_times_faster_than_tinyrenderer"] = out[f"{tiny}_p50_s"] / out[f"{exact}_p50_s"]
    for p in ("p50", "p95"):
        key = f"corner_error_{p}_px"
        out[f"render_corner_error_{p}_share_of_tinyrenderer"] = out[f"{exact}_{key}"] / out[f"{tiny}_{key}"]
    return out


def main() -> None:
    parser = options_of(__doc__)
    parser.add_argument("--only", choices=("accuracy", "metre", "reach", "near", "speed", "rendering"))
    options = parser.parse_args()
    cv2.setNumThreads(1)
    quick = options.quick
    parts = {
        "rendering": lambda: rendering(20 if quick else 200),
        "speed": lambda: speed(30 if quick else 200),
        "reach": lambda: reach(10 if quick else 100),
        "near": lambda: near_views(60 if quick else 600),
        "metre": lambda: at_one_metre(100 if quick else 1000),
        "accuracy": lambda: accuracy(150 if quick else 10_000),
    }
    result: Figures = {}
    for name, part in parts.items():
        if options.only in (None, name):
            figures = part()
            for key, value in figures.items():
                print(f"{key:62}  {value:.4g}", flush=True)
            result |= figures
    write_json(options.json, result)


if __name__ == "__main__":
    main()
