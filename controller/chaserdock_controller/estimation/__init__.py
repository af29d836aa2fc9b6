"""Fusion: the target's state from what all chasers see. Mathematics and parameters: docs/fusion.md."""

from __future__ import annotations

from .baseline import PaperEstimator, PaperParameters
from .geometry import to_world
from .mekf import Mekf
from .parameters import MekfParameters
from .types import CameraError, CameraPose, Estimator, Measurement, PoseHypothesis, TargetState

ESTIMATORS = ("mekf", "paper")


def make_estimator(name: str, parameters: MekfParameters | PaperParameters | None = None) -> Estimator:
    """The estimator called ``name`` ("mekf" or "paper"), with its own kind of parameters or, for None,
    the defaults. Raises ValueError for an unknown name, TypeError for the other one's parameters."""
    if name == "mekf":
        if parameters is not None and not isinstance(parameters, MekfParameters):
            raise TypeError(f"estimator 'mekf' takes MekfParameters, not {type(parameters).__name__}")
        return Mekf(parameters)
    if name == "paper":
        if parameters is not None and not isinstance(parameters, PaperParameters):
            raise TypeError(f"estimator 'paper' takes PaperParameters, not {type(parameters).__name__}")
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
