# SPDX-License-Identifier: Apache-2.0
"""Exports a dataset: images of random views with their labels, and the flight scenario from which a
perception is created.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path

from chaserdock_protocol.errors import errors_of_writing
from chaserdock_protocol.output_files import write_atomically
from chaserdock_protocol.scenario import Scenario, flight_scenario_json

from .bop import BopWriter
from .speed_plus import SpeedPlusWriter
from .types import DatasetError, Layout, Split, check_camera, check_new
from .views import ViewLimits, ViewRenderer

DESCRIPTION = "dataset.json"
FOLDERS: dict[Layout, str] = {"bop": "bop", "speed+": "speedplus"}
EXACT_CAMERA = 'navigation.grade="exact"'
"""Override of a scenario by which the camera matches its calibration exactly."""


def export_dataset(
    scenario: Scenario,
    folder: Path,
    images: int,
    limits: ViewLimits,
    layouts: tuple[Layout, ...],
    validation_share: float = 0.2,
    progress: Callable[[int], None] = lambda done: None,
    path_samples: int | None = None,
    jobs: int = 1,
) -> None:
    """Write ``images`` labelled images into a new ``folder``. The last ones, a share of
    ``validation_share``, are for validation. ``path_samples``: trace so many paths of light a
    pixel, on ``jobs`` processors, by the extra ``film``; None: the world's renderer.

    Raises DatasetError for a folder that is not empty or cannot be written, and for a camera with
    errors; ChaserdockError without the extra.
    """
    check_new(folder)
    for layout in layouts:
        check_camera(scenario.camera_model(), layout)
    tracer = None
    if path_samples is not None:
        from chaserdock.film.camera_images import path_tracing

        tracer = path_tracing(scenario, path_samples, jobs)
    renderer = ViewRenderer(scenario, limits, tracer)
    first_validation = images - round(validation_share * images)
    with errors_of_writing(folder, DatasetError):
        folder.mkdir(parents=True, exist_ok=True)
        kinds = {"bop": BopWriter, "speed+": SpeedPlusWriter}
        made = (renderer.camera, renderer.mesh, renderer.shape)
        writers = [kinds[k](folder / FOLDERS[k], *made) for k in layouts]
        for number in range(images):
            image = renderer.render(number)
            split: Split = "train" if number < first_validation else "validation"
            for writer in writers:
                writer.add(number, split, image)
            progress(number + 1)
        for writer in writers:
            writer.close()
        write_atomically(folder / DESCRIPTION, _description(scenario, images, limits, path_samples))


def _description(
    scenario: Scenario, images: int, limits: ViewLimits, path_samples: int | None
) -> str:
    facts = {
        "format": 1,
        "chaserdock": version("chaserdock"),
        "scenario": scenario.name,
        "seed": scenario.seed,
        "images": images,
        "limits": asdict(limits),
        "renderer": "fast" if path_samples is None else "path",
        "path_samples": path_samples,
        "flight_scenario": json.loads(flight_scenario_json(scenario)),
    }
    return json.dumps(facts, indent=1) + "\n"
