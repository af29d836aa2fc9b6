# SPDX-License-Identifier: Apache-2.0
"""Gymnasium's spaces of a training task."""

from __future__ import annotations

from typing import Any

import numpy as np
from chaserdock_protocol.errors import ScenarioError
from chaserdock_protocol.scenario import Scenario
from gymnasium.spaces import Box, Space

from .batch import Floats, ObservationArray
from .task import TrainingTask


def observation_space(task: TrainingTask) -> Space[ObservationArray]:
    """Return the space of an observation (width,), not limited; the elements are listed in
    docs/learning.md. Of images (h, w, 1): grey levels.
    """
    if task.learning.observation == "images":
        camera = task.scenario.camera
        grey: Any = Box(0, 255, (camera.height_px, camera.width_px, 1), np.uint8)
        return grey
    box: Any = Box(-np.inf, np.inf, (task.width,), np.float32)
    return box


def action_space(task: TrainingTask) -> Space[Floats]:
    """Return the space of an action (actuators,): shares of the limits of a wrench or of the
    offsets of a reference, -1 to 1, or open times of thrusters in shares of a tick, 0 to 1.
    """
    box: Any = Box(0.0 if task.pulsed else -1.0, 1.0, (task.actuators,), np.float32)
    return box


def require_one_chaser(scenario: Scenario) -> None:
    """Raise ScenarioError for a scenario with several chasers."""
    count = len(scenario.chasers)
    if count != 1:
        raise ScenarioError(
            f"{scenario.name}: Gymnasium's environments have one chaser (got {count}); use "
            "chaserdock.envs.parallel_env"
        )


def require_finite(action: object, name: str) -> None:
    """Raise ValueError for an action with a number that is not finite."""
    if not np.isfinite(np.asarray(action, dtype=float)).all():
        raise ValueError(f"{name}: must be finite numbers")
