# SPDX-License-Identifier: Apache-2.0
"""Scores a perception on a dataset; each image is processed without memory of the previous one."""

from __future__ import annotations

import pkgutil
import time
from collections.abc import Callable, Sequence
from typing import Any, get_args

import numpy as np
from chaserdock_agents.chaser.perception import Method, PerceptionMethod, make_perception
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.scenario.camera import FlightCamera, Intrinsics
from chaserdock_protocol.scenario.schema import PerceptionSection

from .scores import PoseErrors, pose_errors, summarize
from .shapes import sampled
from .types import DatasetError, LabelledImage, PoseLabel, TargetShape, read_grey


def perception_of(name: str | None, flight: FlightScenario, camera: Camera) -> PerceptionMethod:
    """Return a perception for the camera of a dataset, by its name in a scenario or a class
    ``MODULE:NAME``.

    None: the perception of the flight scenario. Raises DatasetError for a class that cannot be
    created, PluginError for an unknown name.
    """
    if name is not None and ":" in name:
        return _of_class(name, flight, camera)
    updated: dict[str, Any] = {"camera": _section_of(camera)}
    if name is not None:
        updated["perception"] = PerceptionSection(name=name)
    used = name or flight.perception.name
    if used == "statistical":
        raise DatasetError(
            f"--perception {used}: needs no images, it draws measurements; give another one"
        )
    if used in get_args(Method) and not flight.target_model().markers:
        raise DatasetError(
            f"--perception {used}: needs markers; the target {flight.target.model!r} has none"
        )
    return make_perception(flight.model_copy(update=updated), single_images=True)


def _of_class(name: str, flight: FlightScenario, camera: Camera) -> PerceptionMethod:
    try:
        factory: Callable[..., PerceptionMethod] = pkgutil.resolve_name(name)
        return factory(camera, flight.target_model())
    except Exception as error:  # a user's module may raise anything
        raise DatasetError(
            f"--perception {name}: cannot be made: {type(error).__name__}: {error}"
        ) from error


def _section_of(camera: Camera) -> FlightCamera:
    c = camera
    intrinsics = Intrinsics(
        width_px=c.width_px,
        height_px=c.height_px,
        fx_px=c.fx_px,
        fy_px=c.fy_px,
        cx_px=c.cx_px,
        cy_px=c.cy_px,
        distortion=c.distortion,
        lens_model=c.lens_model,
    )
    return FlightCamera(intrinsics=intrinsics)


def score_perception(
    perception: PerceptionMethod,
    images: Sequence[LabelledImage],
    camera: Camera,
    shape: TargetShape | None,
    progress: Callable[[int], None] = lambda done: None,
) -> dict[str, float]:
    """Return the figures of `summarize` for the best solution of a perception in every image, and
    the CPU time per image.

    A perception with memory must have ``reset()``, which is called before each image. Raises
    DatasetError.
    """
    reset: Callable[[], None] = getattr(perception, "reset", lambda: None)
    points = None if shape is None else TargetShape(
        sampled(shape.points_m), shape.diameter_m, shape.symmetries, shape.continuous
    )  # fmt: skip
    errors: list[PoseErrors | None] = []
    times: list[float] = []
    for number, image in enumerate(images):
        pixels = read_grey(image.path, camera)
        reset()
        begin_s = time.process_time()
        solutions = perception.estimate(pixels).solutions
        times.append(time.process_time() - begin_s)
        if solutions:
            best = solutions[0]
            estimate = PoseLabel(_array(best.position_irf_m), _array(best.q_irf_trf_wxyz))
            # Of several instances, the perception answers for the one that it found.
            each = (pose_errors(estimate, of, points) for of in (image.label, *image.others))
            errors.append(min(each, key=lambda e: e.score_2019))
        else:
            errors.append(None)
        progress(number + 1)
    return summarize(errors, points) | {
        "cpu_s_mean": float(np.mean(times)),
        "cpu_s_max": float(np.max(times)),
    }


def _array(values: Array) -> Array:
    return np.asarray(values, dtype=float)
