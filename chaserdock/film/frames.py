# SPDX-License-Identifier: Apache-2.0
"""Path-traced pictures of a film as PNG files, drawn in parallel; what is there is kept."""

from __future__ import annotations

import hashlib
import multiprocessing
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, wait
from pathlib import Path

import cv2
import numpy as np
from chaserdock_protocol.errors import ChaserdockError, errors_of_writing
from chaserdock_protocol.output_files import write_atomically
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.orbit import earth_disc
from chaserdock_world.rendering.background import Background, Earth
from numpy.typing import NDArray

from chaserdock.analysis.body_renderer import coloured_space, light_of, shown
from chaserdock.analysis.chase_camera import BgrImage, RenderedBodies, Shot, Viewpoint
from chaserdock.analysis.dressed_bodies import GAMMA, DressedBody, chaser_body, target_body
from chaserdock.images import write_image

from .path_tracer import PathTracer, fastest_variant, require_mitsuba, surfaces

_DENOISE, _DENOISE_COLOUR = 5.0, 6.0
"""Strength of the denoising of brightness and colour, grey levels: the noise of 16 samples is
about twice that."""
_PROGRESS_S = 1.0
"""Interval, s, at which the number of pictures is shown."""
PLAN = "plan.txt"
"""Name of the file beside the pictures that says of what they are."""


class PathTracedBodies:
    """Renders the shots of a film into a folder by path tracing, then returns them by name.

    Pictures that the folder holds of the same film are kept: an interrupted film is resumed. Those
    of another film are deleted. Raise ChaserdockError without mitsuba.
    """

    def __init__(
        self, scenario: Scenario, folder: Path, shots: Sequence[Shot], samples: int, jobs: int
    ) -> None:
        require_mitsuba()
        self._folder, self._light = folder, light_of(scenario)
        disc = earth_disc(scenario)
        self._earth = None if disc is None else Earth(*disc)
        self._spaces: dict[tuple[object, ...], Background] = {}
        missing = _missing(folder, _plan_of(scenario, shots, samples), shots)
        self.drawn = len(missing)
        if not missing:
            return
        variant = fastest_variant()
        chasers = tuple(missing[0].chasers)
        # Not forked: the renderer has threads. Each process draws every jobs-th picture.
        context = multiprocessing.get_context("spawn")
        with ProcessPoolExecutor(jobs, context) as pool:
            parts = [missing[k::jobs] for k in range(jobs)]
            running = [
                pool.submit(_draw, scenario, chasers, folder, part, samples, variant)
                for part in parts
            ]
            while wait(running, _PROGRESS_S).not_done:
                drawn = sum(_file_of(folder, shot).is_file() for shot in missing)
                print(f"\r{drawn} of {len(missing)} pictures", end="", file=sys.stderr, flush=True)
            print(file=sys.stderr)
            for one in running:
                one.result()

    def render(self, shot: Shot) -> RenderedBodies:
        """Return the picture of a shot over stars and Earth."""
        file = _file_of(self._folder, shot)
        image = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)
        if image is None or image.shape != (shot.look.height_px, shot.look.width_px, 4):
            raise ChaserdockError(f"{file}: cannot be read as a picture of this film")
        behind, cover = self._behind(shot.look), image[:, :, 3:].astype(np.float32) / 255.0
        mixed = cover * image[:, :, :3] + (1.0 - cover) * behind
        return RenderedBodies(behind, mixed.astype(np.uint8), cover[:, :, 0] > 0.0)

    def _behind(self, look: Viewpoint) -> BgrImage:
        key = (look.width_px, look.height_px, look.middle_px)
        if key not in self._spaces:
            size = (look.width_px, look.height_px)
            self._spaces[key] = Background(look.pinhole(), np.zeros(2), size, self._earth)
        return shown(coloured_space(self._spaces[key].draw(look.attitude(), self._light).image))


def _plan_of(scenario: Scenario, shots: Sequence[Shot], samples: int) -> str:
    """Return a digest of all that the pictures depend on."""
    digest = hashlib.sha256(scenario.model_dump_json().encode())
    # A mesh is a file of which the scenario has but the name.
    for body in _bodies(scenario, sorted({i for shot in shots for i in shot.chasers})):
        for part, coat in body.parts:
            digest.update(f"{coat!r} {part.triangles.shape}".encode())
            digest.update(part.vertices_m.round(9).tobytes() + part.triangles.tobytes())
    for shot in shots:
        poses = [shot.target, *shot.chasers.values()]
        numbers = np.concatenate([np.concatenate(pose) for pose in poses]).round(9)
        digest.update(f"{shot.name} {shot.look!r} {list(shot.chasers)}".encode())
        digest.update(numbers.tobytes())
    return f"{digest.hexdigest()} samples {samples}\n"


def _missing(folder: Path, plan: str, shots: Sequence[Shot]) -> list[Shot]:
    """Return the shots whose pictures are not in the folder; delete those of another plan."""
    with errors_of_writing(folder):
        folder.mkdir(parents=True, exist_ok=True)
        stated = folder / PLAN
        if not stated.is_file() or stated.read_text(encoding="utf-8") != plan:
            for file in folder.glob("[0-9]*.png"):
                file.unlink()
            write_atomically(stated, plan)
    return [shot for shot in shots if not _file_of(folder, shot).is_file()]


def _file_of(folder: Path, shot: Shot) -> Path:
    """Return the file of a picture."""
    return folder / f"{shot.name}.png"


def _draw(
    scenario: Scenario,
    chasers: tuple[int, ...],
    folder: Path,
    shots: Sequence[Shot],
    samples: int,
    variant: str,
) -> None:
    """Draw pictures into the folder. A picture is complete where it has its name."""
    tracer, light, disc = PathTracer(samples, variant), light_of(scenario), earth_disc(scenario)
    earth = None if disc is None else Earth(*disc)
    target, *others = (surfaces(body) for body in _bodies(scenario, chasers))
    for shot in shots:
        look = shot.look
        poses = [shot.chasers[i] for i in chasers]
        bodies = [(target, shot.target), *zip(others, poses, strict=True)]
        seed = int.from_bytes(hashlib.sha256(shot.name.encode()).digest()[:4], "big")
        place = look.eye_m, look.attitude()
        traced = tracer.trace(look.pinhole(), place, bodies, light, earth, seed, smooth=True)
        write_image(_file_of(folder, shot), _displayed(traced))


def _bodies(scenario: Scenario, chasers: Sequence[int]) -> list[DressedBody]:
    """Return the target and chasers."""
    return [target_body(scenario), *(chaser_body(scenario, i) for i in chasers)]


def _displayed(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return light and coverage (h, w, 4) as denoised levels for display, BGR and coverage."""
    cover = np.clip(image[:, :, 3:4], 0.0, 1.0)
    light = image[:, :, 2::-1] / np.maximum(cover, 1e-3)
    levels = np.clip(255.0 * light, 0.0, 255.0)
    # Exponent before rounding: the dark half has more levels then.
    bright = np.asarray((255.0 * (levels / 255.0) ** GAMMA).astype(np.uint8))
    denoised = cv2.fastNlMeansDenoisingColored(bright, None, _DENOISE, _DENOISE_COLOUR, 5, 15)
    return np.dstack([denoised, 255.0 * cover]).astype(np.uint8)
