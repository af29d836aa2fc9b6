# SPDX-License-Identifier: Apache-2.0
"""Traces paths of light from the camera through a scene with Mitsuba 3: soft and cast shadows, foil
that mirrors, light that bodies throw on each other.

The only module that imports ``mitsuba``. Sun, ambient light and lamp have the levels of the fast
renderer. The Earth and the stars are no bodies: they are drawn behind, as in fast images, and the
Earth's light comes from its disc.
"""

from __future__ import annotations

import importlib.util
import math
import subprocess
import sys
from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.scenario import load_scenario
from chaserdock_protocol.shipped_scenarios import find_scenario
from chaserdock_world.rendering.background import WHITE_LEVEL, Earth, Light
from chaserdock_world.rendering.scene_geometry import NEAR_M
from numpy.typing import NDArray

from chaserdock.analysis.body_renderer import light_of
from chaserdock.analysis.chase_camera import BodyPose, Viewpoint
from chaserdock.analysis.dressed_bodies import (
    Coat,
    DressedBody,
    chaser_body,
    target_body,
)

_COMPILED, _PLAIN = "llvm_ad_rgb", "scalar_rgb"
_DEPTH = 4
"""Longest path: light that was reflected by three surfaces."""
_EARTH_ALBEDO = 0.3
"""Share of sunlight that the Earth reflects: its mean over sea, land and clouds."""
_SKY_ROWS = 64
"""Rows of the map of light from the sky: 3 degrees each, finer than foil mirrors."""
_EARTH_RGB = (0.55, 0.75, 1.0)
"""Colour (red, green, blue) of the Earth's light relative to white: sea under air and clouds."""
_WRINKLE_M, _WRINKLE_DEPTH = 0.30, 0.012
"""Period and depth (m) of the wrinkles in foil: those of a loosely laid blanket."""
_CELL_M = 0.040
"""Edge (m) of a solar cell."""
_ROUGH_FOIL, _ROUGH_METAL, _ROUGH_PLASTIC = 0.22, 0.30, 0.12
"""Roughness of Beckmann's distribution: foil is the most mirror-like of metals."""
_MIRROR_SHARE = 0.45
"""Share of a metal's reflection that is a mirror's; the rest is diffuse, of wrinkles finer than a
pixel. Without it, foil in black space is black."""
Surfaces = dict[Coat, tuple[Array, Array, Array]]
"""By coat, of its m triangles: corners and normals (3 m, 3), texture coordinates (3 m, 2), m."""


def require_mitsuba() -> None:
    """Raise ChaserdockError where the package is not installed."""
    if importlib.util.find_spec("mitsuba") is None:
        raise ChaserdockError(
            "path tracing needs mitsuba, which is not installed; pip install -e '.[film]'"
        )


def fastest_variant() -> str:
    """Return the fastest variant that works here, by trying: some versions of LLVM abort the
    process that compiles with them.
    """
    tried = subprocess.run(
        [sys.executable, "-m", "chaserdock.film.path_tracer"], capture_output=True, check=False
    )
    return _COMPILED if tried.returncode == 0 else _PLAIN


def _try_compiled() -> None:
    """Render a small picture of all coats with the compiled variant."""
    scenario = load_scenario(find_scenario("demo"))
    tracer, look = PathTracer(1, _COMPILED), Viewpoint(np.zeros(3), 3.0, 0.5, 0.5, 16, 16)
    bodies = (target_body(scenario), chaser_body(scenario, 0))
    placed = [
        (surfaces(body), (np.array([x, 0.0, 0.0]), rotations.IDENTITY))
        for body, x in zip(bodies, (0.0, 0.8), strict=True)
    ]
    place, earth = (look.eye_m, look.attitude()), Earth((0.0, 0.0, -1.0), 1.0)
    tracer.trace(look.pinhole(), place, placed, light_of(scenario), earth, 0)


class PathTracer:
    """Traces light to a camera. ``samples``: paths a pixel; ``variant``: of Mitsuba;
    ``threads``: that share an image.
    """

    def __init__(self, samples: int, variant: str = _PLAIN, threads: int = 1) -> None:
        mitsuba: Any = importlib.import_module("mitsuba")
        mitsuba.set_variant(variant)
        mitsuba.set_log_level(mitsuba.LogLevel.Error)
        drjit: Any = importlib.import_module("drjit")
        drjit.set_thread_count(threads)
        self._mi = mitsuba
        self._samples = samples
        self._bsdfs: dict[Coat, Any] = {}

    def trace(
        self,
        camera: Camera,
        pose: BodyPose,
        bodies: Sequence[tuple[Surfaces, BodyPose]],
        light: Light,
        earth: Earth | None,
        seed: int,
        smooth: bool = False,
    ) -> NDArray[np.float32]:
        """Return light (red, green, blue; 1 is level 255) and coverage of each pixel (h, w, 4).

        ``camera``: without distortion, of square pixels. ``pose``: its place and its attitude, IRF
        to WRF. ``earth``: shines where the sun lights it. ``smooth``: a pixel weighs light by a
        Gaussian that is wider than its square, not by the square.
        """
        mi = self._mi
        scene: dict[str, Any] = {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": _DEPTH, "hide_emitters": True},
            "sensor": self._sensor(camera, pose, "gaussian" if smooth else "box"),
        } | self._lights(light, earth, pose[0])
        for k, (coated, placed) in enumerate(bodies):
            for n, (coat, surface) in enumerate(coated.items()):
                scene[f"body_{k}_{n}"] = self._mesh(coat, surface, placed)
        image = np.array(mi.render(mi.load_dict(scene), spp=self._samples, seed=seed))
        return np.nan_to_num(image.astype(np.float32))

    def _sensor(self, camera: Camera, pose: BodyPose, pixel_filter: str) -> dict[str, Any]:
        w, h = camera.width_px, camera.height_px
        # Mitsuba's cameras look along +Z, too, but X is left and Y is up.
        to_world = np.eye(4)
        to_world[:3, :3] = rotations.to_matrix(pose[1]) * (-1.0, -1.0, 1.0)
        to_world[:3, 3] = pose[0]
        return {
            "type": "perspective",
            "fov_axis": "x",
            "fov": math.degrees(2.0 * math.atan(0.5 * w / camera.fx_px)),
            "near_clip": NEAR_M,
            "far_clip": 1e3,
            # Its first pixel begins at 0; ours has its centre there.
            "principal_point_offset_x": 0.5 - (camera.cx_px + 0.5) / w,
            "principal_point_offset_y": 0.5 - (camera.cy_px + 0.5) / h,
            "to_world": self._mi.ScalarTransform4f(to_world.tolist()),
            "film": {
                "type": "hdrfilm",
                "width": w,
                "height": h,
                "pixel_format": "rgba",
                "rfilter": {"type": pixel_filter},
            },
            # Stratified, also in the choice of the light: a third of the noise on sunlit white.
            "sampler": {"type": "multijitter", "sample_count": self._samples},
        }

    def _lights(self, light: Light, earth: Earth | None, lamp_m: Array) -> dict[str, Any]:
        """Return the sources of light; a white face in full sun and ambient light has level 235."""
        white = WHITE_LEVEL / 255.0
        if earth is None:
            sky = {"type": "constant", "radiance": _rgb((white * light.ambient,) * 3)}
        else:
            sky = {"type": "envmap", "bitmap": self._mi.Bitmap(_sky(light, earth))}
        sources: dict[str, Any] = {"sky": sky}
        if light.sun > 0.0:
            sources["sun"] = {
                "type": "directional",
                "direction": (-light.direction_w).tolist(),
                "irradiance": _rgb((math.pi * white * light.sun,) * 3),
            }
        if light.lamp > 0.0:
            intensity = _rgb((math.pi * light.lamp / 255.0,) * 3)
            sources["lamp"] = {"type": "point", "position": lamp_m.tolist(), "intensity": intensity}
        return sources

    def _mesh(self, coat: Coat, surface: tuple[Array, Array, Array], pose: BodyPose) -> Any:
        mi, (corners, normals, uv) = self._mi, surface
        if coat not in self._bsdfs:
            self._bsdfs[coat] = mi.load_dict(self._bsdf(coat))
        properties = mi.Properties()
        properties["bsdf"] = self._bsdfs[coat]
        mesh = mi.Mesh(
            "surface",
            vertex_count=len(corners),
            face_count=len(corners) // 3,
            has_vertex_normals=True,
            has_vertex_texcoords=True,
            props=properties,
        )
        values = mi.traverse(mesh)
        placed = rotations.rotate(pose[1], corners) + pose[0]
        values["vertex_positions"] = placed.ravel().astype(np.float32)
        values["vertex_normals"] = rotations.rotate(pose[1], normals).ravel().astype(np.float32)
        values["vertex_texcoords"] = uv.ravel().astype(np.float32)
        values["faces"] = np.arange(len(corners), dtype=np.uint32)
        values.update()
        return mesh

    def _bsdf(self, coat: Coat) -> dict[str, Any]:
        mi = self._mi
        diffuse: dict[str, Any] = {"type": "diffuse", "reflectance": _rgb(coat.rgb)}
        if coat.metal:
            rough = _ROUGH_FOIL if coat.texture else _ROUGH_METAL
            mirror = {
                "type": "roughconductor",
                "material": "none",
                "alpha": rough,
                "specular_reflectance": _rgb(tuple(min(1.0, 1.6 * c) for c in coat.specular)),
            }
            blend = {"type": "blendbsdf", "weight": _MIRROR_SHARE, "a": diffuse, "b": mirror}
            if coat.texture != "insulation":
                return blend
            wrinkles = {
                "type": "bitmap",
                "bitmap": mi.Bitmap(_wrinkles()[:, :, None]),
                "raw": True,
                "to_uv": mi.ScalarTransform4f().scale(1.0 / _WRINKLE_M),
            }
            return {"type": "bumpmap", "texture": wrinkles, "scale": _WRINKLE_DEPTH, "bsdf": blend}
        if coat.texture == "cells":
            grid = {
                "type": "bitmap",
                "bitmap": mi.Bitmap(_cells(coat.rgb)),
                "raw": True,
                "to_uv": mi.ScalarTransform4f().scale(1.0 / _CELL_M),
            }
            return {"type": "roughplastic", "alpha": _ROUGH_PLASTIC, "diffuse_reflectance": grid}
        if max(coat.specular) > 0.05:
            return {
                "type": "roughplastic",
                "alpha": _ROUGH_PLASTIC,
                "diffuse_reflectance": _rgb(coat.rgb),
            }
        return diffuse


def _sky(light: Light, earth: Earth) -> NDArray[np.float32]:
    """Return the radiance (n, 2 n, 3) of ambient light and the Earth by polar angle from Y and
    longitude from -Z to X, WRF.
    """
    polar = (np.arange(_SKY_ROWS) + 0.5)[:, None] * np.pi / _SKY_ROWS
    longitude = (np.arange(2 * _SKY_ROWS) + 0.5) * np.pi / _SKY_ROWS
    x, z = np.sin(polar) * np.sin(longitude), -np.sin(polar) * np.cos(longitude)
    rays = np.stack([x, np.broadcast_to(np.cos(polar), x.shape), z], axis=-1)
    centre = np.array(earth.direction_w) / np.linalg.norm(earth.direction_w)
    # A sphere of this radius at distance 1, as behind the bodies.
    radius, cosine = math.sin(earth.radius_rad), rays @ centre
    inside = cosine**2 - (1.0 - radius**2)
    distance = cosine - np.sqrt(np.maximum(inside, 0.0))
    normals = (distance[..., None] * rays - centre) / radius
    day = np.maximum(normals @ light.direction_w, 0.0) * ((inside > 0.0) & (cosine > 0.0))
    shine = _EARTH_ALBEDO * light.sun * day[..., None] * np.array(_EARTH_RGB)
    return (WHITE_LEVEL / 255.0 * (light.ambient + shine)).astype(np.float32)


def _rgb(values: Any) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(v) for v in values]}


def surfaces(body: DressedBody) -> Surfaces:
    """Return the surfaces of a body, in its axes."""
    out = {}
    for coat, soup in body.surfaces().items():
        corners, normals = soup.corners_m.reshape(-1, 3), soup.normals.reshape(-1, 3)
        # Seen along the axis that the triangle faces most.
        first, second, third = np.moveaxis(soup.corners_m, 1, 0)
        flat = np.cross(second - first, third - first)
        axis = np.repeat(np.abs(flat).argmax(axis=1), 3)
        rows = np.arange(len(corners))
        uv = np.column_stack([corners[rows, (axis + 1) % 3], corners[rows, (axis + 2) % 3]])
        out[coat] = corners, normals, uv
    return out


def _wrinkles() -> NDArray[np.float32]:
    """Return the heights (256, 256), 0 to 1, of crumpled foil; periodic."""
    generator = np.random.Generator(np.random.PCG64(7))
    heights = np.zeros((256, 256), np.float32)
    for octave in range(2, 6):
        noise = generator.standard_normal((1 << octave, 1 << octave)).astype(np.float32)
        tiled = cv2.resize(np.tile(noise, (3, 3)), (768, 768), interpolation=cv2.INTER_LINEAR)
        heights += np.abs(tiled[256:512, 256:512]) * 0.55**octave
    return (heights - heights.min()) / np.ptp(heights)


def _cells(rgb: tuple[float, float, float]) -> NDArray[np.float32]:
    """Return the reflectance (64, 64, 3) of one cell with its gaps and finger lines."""
    image = np.tile(np.array(rgb, np.float32), (64, 64, 1))
    image[:, 31:33] = 0.25  # bus bar
    image[:2] = image[-2:] = image[:, :2] = image[:, -2:] = 0.42  # gap to the next one
    return image


if __name__ == "__main__":
    _try_compiled()
