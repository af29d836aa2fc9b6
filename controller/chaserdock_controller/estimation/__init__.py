# SPDX-License-Identifier: Apache-2.0
"""Estimate the target's state from the sightings of all chasers. Mathematics and parameters:
docs/estimation.md.
"""

from __future__ import annotations

from .baseline import PaperEstimator, PaperParameters
from .geometry import to_world
from .mekf import Mekf
from .parameters import MekfParameters
from .types import CameraError, CameraPose, Estimator, Measurement, PoseHypothesis, TargetState

ESTIMATORS = ("mekf", "paper")


def make_estimator(
    name: str, parameters: MekfParameters | PaperParameters | None = None
) -> Estimator:
    """Create the estimator ``name`` ("mekf" or "paper") with its parameters (None: the defaults).

    Raises ValueError for an unknown name and TypeError for parameters of another estimator.
    """
    if name == "mekf":
        if parameters is not None and not isinstance(parameters, MekfParameters):
            raise TypeError(
                f"estimator 'mekf' takes MekfParameters, not {type(parameters).__name__}"
            )
        return Mekf(parameters)
    if name == "paper":
        if parameters is not None and not isinstance(parameters, PaperParameters):
            raise TypeError(
                f"estimator 'paper' takes PaperParameters, not {type(parameters).__name__}"
            )
        return PaperEstimator(parameters)
    raise ValueError(f"unknown estimator {name!r}; known: {', '.join(ESTIMATORS)}")


__all__ = [
    "ESTIMATORS",
    "CameraError",
    "CameraPose",
    "Estimator",
    "Measurement",
    "Mekf",
    "MekfParameters",
    "PaperEstimator",
    "PaperParameters",
    "PoseHypothesis",
    "TargetState",
    "make_estimator",
    "to_world",
]
