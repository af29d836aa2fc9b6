"""Markers in an image to the pose of the target (ArUco, fitted sides, PnP with covariance)."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from chaserdock_protocol import plugins
from chaserdock_protocol.scenario import PERCEPTIONS, Scenario
from numpy.typing import ArrayLike, NDArray

from .pipeline import Method, Perception, PoseSolution, Sighting


class Sees(Protocol):
    """What a perception is: see `Perception.estimate` for the meaning of its arguments and its answer."""

    def estimate(
        self, image: NDArray[np.uint8], predicted: tuple[ArrayLike, ArrayLike] | None = None
    ) -> Sighting: ...


def make_perception(scenario: Scenario) -> Sees:
    """The perception that the scenario names: one of ours, or an installed ``chaserdock.perceptions`` entry point, a
    function of (camera: Camera, target: TargetModel). Raises PluginError when there is no such thing here."""
    camera, target = scenario.camera_model(), scenario.target_model()
    match scenario.perception.name:
        case "default" | "paper" as method:
            return Perception(camera, target, method)
        case name:
            return plugins.load("perception", name, PERCEPTIONS)(camera, target)


__all__ = ["Method", "Perception", "PoseSolution", "Sees", "Sighting", "make_perception"]
