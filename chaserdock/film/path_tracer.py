# SPDX-License-Identifier: Apache-2.0
"""Traces paths of light from the camera through a scene with Mitsuba 3: soft and cast shadows, foil
that mirrors, light that bodies throw on each other.

The only module that imports ``mitsuba``. Sun, ambient light and reflectances are those of the fast
renderer. The Earth and the stars are no bodies: they are drawn behind, as in the fast film, and the
Earth's light comes from its direction.
"""

from __future__ import annotations

import importlib.util
import math
import subprocess
import sys
from collections.abc import Mapping
from typing import Any

import cv2
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_protocol.shipped_scenarios import find_scenario
from chaserdock_world.orbit import earth_disc, to_sun
from chaserdock_world.rendering.background import WHITE_LEVEL
from numpy.typing import NDArray

from chaserdock.analysis.chase_camera import BodyPose, Viewpoint
from chaserdock.analysis.dressed_bodies import (
    AMBIENT,
    GAMMA,
    Coat,
    DressedBody,
    chaser_body,
    target_body,
)

_COMPILED, _PLAIN = "llvm_ad_rgb", "scalar_rgb"
_DEPTH = 4
"""Longest path: light that was reflected by three surfaces."""
_EARTHSHINE = 0.16
"""Irradiance of a white Earth over that of the sun: its albedo of 0.3, half of its disc lit."""
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
_DENOISE, _DENOISE_COLOUR = 5.0, 6.0
"""Strength of the denoising of brightness and colour, grey levels: the noise of 16 samples is
about twice that."""


def require_mitsuba() -> None:
    """Raise ChaserdockError where the package is not installed."""
    if importlib.util.find_spec("mitsuba") is None:
        raise ChaserdockError(
            "path-traced films need mitsuba, which is not installed; pip install -e '.[film]'"
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
    look = Viewpoint(np.zeros(3), 3.0, 0.5, 0.5, 16, 16)
    poses = [(np.array([x, 0.0, 0.0]), rotations.IDENTITY) for x in (0.0, 0.8)]
    PathTracer(scenario, (0,), 1, _COMPILED).render(look, poses[0], {0: poses[1]}, 0)


class PathTracer:
    """Renders the bodies of one scenario on one processor. ``chasers``: numbers; ``samples``:
    paths a pixel; ``variant``: of Mitsuba.
    """

    def __init__(
        self, scenario: Scenario, chasers: tuple[int, ...], samples: int, variant: str = _PLAIN
    ) -> None:
        mitsuba: Any = importlib.import_module("mitsuba")
        mitsuba.set_variant(variant)
        mitsuba.set_log_level(mitsuba.LogLevel.Error)
        drjit: Any = importlib.import_module("drjit")
        drjit.set_thread_count(1)  # frames are in parallel
        self._mi = mitsuba
        self._samples = samples
        self._sun, self._disc = np.array(to_sun(scenario)), earth_disc(scenario)
        self._target = _surfaces(target_body(scenario))
        self._chasers = {i: _surfaces(chaser_body(scenario, i)) for i in chasers}
        self._bsdfs: dict[Coat, Any] = {}

    def render(
        self, look: Viewpoint, target: BodyPose, chasers: Mapping[int, BodyPose], seed: int
    ) -> NDArray[np.uint8]:
        """Return the picture (h, w, 4): blue, green, red for display, and coverage."""
        mi = self._mi
        scene: dict[str, Any] = {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": _DEPTH, "hide_emitters": True},
            "sensor": self._sensor(look),
        } | self._lights()
        bodies = [(self._target, target)] + [(self._chasers[i], chasers[i]) for i in chasers]
        for k, (surfaces, pose) in enumerate(bodies):
            for n, (coat, surface) in enumerate(surfaces.items()):
                scene[f"body_{k}_{n}"] = self._mesh(coat, surface, pose)
        image = np.array(mi.render(mi.load_dict(scene), spp=self._samples, seed=seed))
        return _displayed(image)

    def _sensor(self, look: Viewpoint) -> dict[str, Any]:
        mi, (w, h) = self._mi, (look.width_px, look.height_px)
        _, up, _ = look.axes()
        x, y = look.principal_px
        transform = mi.ScalarTransform4f().look_at(
            origin=look.eye_m.tolist(), target=look.centre_m.tolist(), up=up.tolist()
        )
        return {
            "type": "perspective",
            "fov_axis": "x",
            "fov": math.degrees(2.0 * math.atan(0.5 * w / look.focal_px)),
            "near_clip": 0.01,
            "far_clip": 1e3,
            "principal_point_offset_x": 0.5 - x / w,
            "principal_point_offset_y": 0.5 - y / h,
            "to_world": transform,
            "film": _film((w, h)),
            # Stratified, also in the choice of the light: a third of the noise on sunlit white.
            "sampler": {"type": "multijitter", "sample_count": self._samples},
        }

    def _lights(self) -> dict[str, Any]:
        white = WHITE_LEVEL / 255.0
        sun = math.pi * white * (1.0 - AMBIENT)
        lights = {
            "ambient": {"type": "constant", "radiance": _rgb((white * AMBIENT,) * 3)},
            "sun": _directional(-self._sun, (sun,) * 3),
        }
        if self._disc is not None:
            r, g, b = (_EARTHSHINE * sun * c for c in _EARTH_RGB)
            lights["earth"] = _directional(-np.array(self._disc[0]), (r, g, b))
        return lights

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


def _film(size_px: tuple[int, int]) -> dict[str, Any]:
    return {
        "type": "hdrfilm",
        "width": size_px[0],
        "height": size_px[1],
        "pixel_format": "rgba",
        "rfilter": {"type": "gaussian"},
    }


def _rgb(values: Any) -> dict[str, Any]:
    return {"type": "rgb", "value": [float(v) for v in values]}


def _directional(along: Array, irradiance: tuple[float, ...]) -> dict[str, Any]:
    return {"type": "directional", "direction": along.tolist(), "irradiance": _rgb(irradiance)}


def _surfaces(body: DressedBody) -> dict[Coat, tuple[Array, Array, Array]]:
    """Return corners, normals (3 m, 3) and texture coordinates (3 m, 2), m, of the m triangles of
    each coat, body axes.
    """
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


def _displayed(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return light and coverage (h, w, 4) as denoised levels for display, BGR and coverage."""
    cover = np.clip(image[:, :, 3:4], 0.0, 1.0)
    light = image[:, :, 2::-1] / np.maximum(cover, 1e-3)
    levels = np.clip(255.0 * np.nan_to_num(light), 0.0, 255.0)
    # Exponent before rounding: the dark half has more levels then.
    bright = np.asarray((255.0 * (levels / 255.0) ** GAMMA).astype(np.uint8))
    denoised = cv2.fastNlMeansDenoisingColored(bright, None, _DENOISE, _DENOISE_COLOUR, 5, 15)
    return np.dstack([denoised, 255.0 * cover]).astype(np.uint8)


if __name__ == "__main__":
    _try_compiled()
