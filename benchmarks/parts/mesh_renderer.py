# SPDX-License-Identifier: Apache-2.0
"""The renderer of meshes: processor time, and its images against those of the ray tracer Embree.

Time: of one image of 960 x 540 pixels of each shipped satellite, and beside it of the box of the
main job by the renderer of boxes, at 1 and 3 m, random attitudes and suns, one thread; the least of
four runs of each view. Accuracy: 480 x 270 pixels with 36 rays each:
mean grey-level error inside surfaces, and the displacement of silhouettes and shadow edges by
blocks of 12 pixels; without textures.
"""

from __future__ import annotations

import time

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.camera import Camera
from chaserdock_models.satellites import satellite
from chaserdock_models.targets import target_model
from chaserdock_protocol.scenario.camera import Effects
from chaserdock_world.rendering.cameras import SceneRenderer
from chaserdock_world.rendering.mesh_renderer import MeshRenderer
from chaserdock_world.rendering.rasterizer import Renderer
from common import Figures, Group, Options, percentiles
from markerless_cases import random_view

SATELLITES = ("geo_servicer", "cubesat_12u")
BOX = "paper"
"""Target of the main job."""
RANGES_M = (1.0, 3.0)
RUNS = 4
"""Repetitions of which the least time counts: other programs prolong some."""


def measure_time(options: Options) -> Figures:
    """Time images of meshes by satellite and range."""
    views = views_of(options)
    camera, figures = Camera.from_hfov(960, 540, np.deg2rad(60.0)), {}
    spread_px = Effects().point_spread_px
    renderers: dict[str, SceneRenderer] = {
        name: MeshRenderer(camera, satellite(name), None, spread_px) for name in SATELLITES
    }
    renderers[BOX] = Renderer(camera, target_model(BOX), None, spread_px)
    for name, renderer in renderers.items():
        for range_m in RANGES_M:
            rng, times = np.random.default_rng(1), []
            for _ in range(views):
                pose, light = random_view(rng, range_m, camera)
                q, runs = rotations.from_matrix(pose.rotation), []
                for _ in range(RUNS):
                    begin_s = time.thread_time()
                    renderer.render(np.zeros(3), rotations.IDENTITY, pose.position, q, (), light)
                    runs.append(time.thread_time() - begin_s)
                times.append(min(runs))
            key = f"{name}_{range_m:g}m"
            figures |= {
                f"{key}_mean_s": float(np.mean(times)),
                f"{key}_max_s": float(np.max(times)),
            }
    return figures


def measure_accuracy(options: Options) -> Figures:
    """Compare grey levels, silhouettes and shadow edges with those of the ray tracer Embree."""
    from embree_images import compare  # Embree is installed for tests only

    views = max(1, views_of(options) // 4)
    camera, rng = Camera.from_hfov(480, 270, np.deg2rad(60.0)), np.random.default_rng(3)
    greys, silhouettes, shadows = [], [], []
    for _ in range(views):
        for name in SATELLITES:
            for range_m in RANGES_M:
                pose, light = random_view(rng, range_m, camera)
                q = rotations.from_matrix(pose.rotation)
                grey, silhouette, shadow = compare(
                    satellite(name), camera, pose.position, q, light, 6
                )
                greys.append(grey)
                silhouettes.append(np.abs(silhouette))
                shadows.append(np.abs(shadow))
    edges, shades = np.concatenate(silhouettes), np.concatenate(shadows)
    return {
        "grey_error_mean_levels": float(np.mean(greys)),
        "grey_error_max_levels": float(np.max(greys)),
        "silhouette_blocks": len(edges),
        **percentiles(edges, "silhouette", "px", "median", "p95", "p99", "max"),
        "shadow_blocks": len(shades),
        **percentiles(shades, "shadow_edge", "px", "median", "p95", "p99", "max"),
    }


def views_of(options: Options) -> int:
    """Return the number of views by satellite and range."""
    return options.views or (2 if options.quick else 20)


GROUP = Group({"mesh-time": measure_time, "mesh-accuracy": measure_accuracy})
