# SPDX-License-Identifier: Apache-2.0
"""Estimate the pose of the target in an image, from markers or from its shape.

Markers: ArUco detection, corners by fitted edges, PnP with covariance.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from chaserdock_models.camera import Camera
from chaserdock_protocol import plugins
from chaserdock_protocol.scenario import PERCEPTIONS, FlightScenario
from chaserdock_protocol.scenario.bodies import FlightTarget
from numpy.typing import ArrayLike, NDArray

from .bearing import BearingError, BearingFinder, RangedTarget
from .model.mesh import TrackerMesh
from .model.perception import ModelPerception
from .pipeline import GeometryInformation, Method, Perception, PerceptionResult, TargetPose
from .statistical import StatisticalPerception


class PerceptionMethod(Protocol):
    """Estimate the pose of the target in an image; see `Perception.estimate`."""

    def estimate(
        self, image: NDArray[np.uint8], predicted: tuple[ArrayLike, ArrayLike] | None = None
    ) -> PerceptionResult: ...


class FarPerception:
    """Measure a near target by its markers, and one too far for these by bearing and measured
    range.
    """

    def __init__(self, by_markers: Perception, by_bearing: BearingFinder) -> None:
        self.by_markers, self.by_bearing = by_markers, by_bearing

    def estimate(
        self, image: NDArray[np.uint8], predicted: tuple[ArrayLike, ArrayLike] | None = None
    ) -> PerceptionResult:
        """Return what markers show; the caller adds the range."""
        return self.by_markers.estimate(image, predicted)


def make_perception(scenario: FlightScenario, single_images: bool = False) -> PerceptionMethod:
    """Return the perception that the scenario names, as `named_perception`."""
    camera, name = scenario.camera_model(), scenario.perception.name
    if name == "statistical":
        return StatisticalPerception(camera, scenario.target_model(), scenario.ranging)
    perception = named_perception(name, camera, scenario.target, single_images)
    if scenario.ranging is None or not isinstance(perception, Perception):
        return perception
    focal_share = scenario.navigation.errors().camera_focal_share
    return FarPerception(perception, BearingFinder(camera, scenario.target_model(), focal_share))


def named_perception(
    name: str, camera: Camera, target: FlightTarget, single_images: bool = False
) -> PerceptionMethod:
    """Return a perception of images by its name.

    It is built in, or an installed ``chaserdock.perceptions`` entry point, which is a function of
    (camera: Camera, target: TargetModel). ``single_images``: images do not follow each other, so
    that an acquisition ends in the image in which it begins. Raises PluginError for a perception
    that is not installed.
    """
    match name:
        case "default" | "paper" | "paper_iterative" as method:
            return Perception(camera, target.shape(), method)
        case "model":
            perception = ModelPerception(camera, tracker_mesh(target), single_images=single_images)
            perception.prepare()
            return perception
        case "features":
            raise plugins.PluginError(
                "perception 'features' maps a target in a mission only; it gives no poses of "
                "single images"
            )
        case _:
            return plugins.make("perception", name, PERCEPTIONS, camera, target.shape())


def tracker_mesh(target: FlightTarget) -> TrackerMesh:
    """Return what the flight software knows of a target's shape: its mesh, or its cuboids."""
    mesh, knowledge = target.known_mesh(), target.knowledge
    if mesh is None:
        return TrackerMesh.of_boxes(target.shape().boxes)
    return TrackerMesh.of_mesh(mesh, np.deg2rad(knowledge.panel_deg), knowledge.scale_share)


__all__ = [
    "BearingError",
    "BearingFinder",
    "FarPerception",
    "GeometryInformation",
    "Method",
    "Perception",
    "PerceptionMethod",
    "PerceptionResult",
    "RangedTarget",
    "TargetPose",
    "make_perception",
    "named_perception",
    "tracker_mesh",
]
