# SPDX-License-Identifier: Apache-2.0
"""What a tracker looks for: a target with markers or a shape, or single markers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import cast, get_args

from chaserdock_agents.chaser.perception import (
    Method,
    Perception,
    PerceptionMethod,
    named_perception,
)
from chaserdock_agents.chaser.perception.detect import LEAST_MARGIN_CELLS, dictionary_of
from chaserdock_models.camera import Camera
from chaserdock_models.targets import Box, Marker, TargetModel
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.scenario.files import find_flight_target
from chaserdock_protocol.scenario.target import dictionary_size

_PLATE_M = 1e-3
"""Thickness of the plate that a single marker lies on, m: only its edges matter."""


class TrackError(ChaserdockError):
    """A target that cannot be tracked, or an image that is not of the camera."""


@dataclass(frozen=True, eq=False)
class Subject:
    """One body that is tracked: its ``name``, its geometry and the perception that finds it."""

    name: str
    model: TargetModel
    perception: PerceptionMethod


def subjects_of(
    camera: Camera,
    target: str | Path | TargetModel | Mapping[int, float],
    perception: str | None,
    dictionary: str,
    margin_m: float | None,
    mesh_scale: float,
    live: bool,
) -> tuple[Subject, ...]:
    """Return what a tracker follows; see `Tracker`. Raises TrackError, ScenarioError,
    PluginError.
    """
    if isinstance(target, TargetModel):
        if perception not in (None, *get_args(Method)) or not target.markers:
            raise TrackError("a TargetModel is tracked by its markers; give a file for a shape")
        name = perception or "default"
        return (Subject(target.name, target, Perception(camera, target, _method(name))),)
    if isinstance(target, Mapping):
        if not target:
            raise TrackError("no markers given; give {id: side in m}")
        method = _method(perception or "default")
        models = [marker_target(i, side, dictionary, margin_m) for i, side in target.items()]
        return tuple(Subject(m.name, m, Perception(camera, m, method)) for m in models)
    known = find_flight_target(str(target), mesh_scale)
    model = known.shape()
    name = perception or ("default" if model.markers else "model")
    if name == "statistical":
        raise TrackError(f"perception {name}: draws measurements and needs no images")
    if name in get_args(Method) and not model.markers:
        raise TrackError(f"perception {name}: needs markers, and {target} has none; use model")
    return (Subject(model.name, model, named_perception(name, camera, known, not live)),)


def _method(name: str) -> Method:
    if name not in get_args(Method):
        raise TrackError(f"perception {name}: must be one of {', '.join(get_args(Method))}")
    return cast("Method", name)


def marker_target(
    number: int, side_m: float, dictionary: str, margin_m: float | None = None
) -> TargetModel:
    """Return a single marker as a target: its axes are x right, y up, z out of the paper, from its
    centre.

    ``margin_m``: width of the white border, which is darker beyond; None: at least the width that
    perception needs. Raises TrackError.
    """
    try:
        last = dictionary_size(dictionary) - 1
    except ValueError as error:
        raise TrackError(str(error)) from None
    if not 0 <= number <= last:
        raise TrackError(f"marker {number}: {dictionary} has 0 to {last}")
    if not 0.0 < side_m < float("inf"):
        raise TrackError(f"marker {number}: its side must be positive, m (got {side_m:g})")
    marker = Marker(number, side_m, (0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    name = f"marker-{number}"
    if margin_m is not None:
        if not 0.0 < margin_m < float("inf"):
            raise TrackError(f"the white border must be positive, m (got {margin_m:g})")
        wide = side_m + 2.0 * margin_m
        return TargetModel(name, (), (marker,), dictionary, (wide, wide, _PLATE_M), margin_m)
    cells = dictionary_of(dictionary).markerSize + 2
    least_m = LEAST_MARGIN_CELLS * side_m / cells
    wide = side_m + 2.0 * least_m
    plate = Box((wide, wide, _PLATE_M), (0.0, 0.0, -_PLATE_M / 2.0), shade=1.0)
    # White paint that ends beyond the plate: the border is as wide as the plate, or wider.
    size = (wide, wide, _PLATE_M)
    return TargetModel(name, (plate,), (marker,), dictionary, size, 2.0 * least_m)
