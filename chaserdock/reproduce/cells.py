"""Figures as the page writes them. A run that is not finished yet leaves a dash."""

from __future__ import annotations

from collections.abc import Callable

from .runner import Results
from .tables import Errors, errors_of_study, floor_of_study

NONE = "-"


def position_text(x: float) -> str:
    """Position MSE in the paper's unit, 1e-2 m^2."""
    return f"{x * 1e2:.4g}"


def orientation_text(x: float) -> str:
    """Orientation MSE in the paper's unit, 1e-3 rad^2."""
    return f"{x * 1e3:.4g}"


def cell(errors: Errors | None, shown: Callable[[Errors], str]) -> str:
    """What ``shown`` says of errors that are there."""
    return NONE if errors is None else shown(errors)


def study_errors(results: Results, name: str) -> Errors | None:
    """The errors of a study, if it is finished."""
    found = results.studies.get(name)
    return None if found is None else errors_of_study(found)


def study_floor(results: Results, name: str) -> float | None:
    """The least possible position MSE (m^2) of a study's start, if it is finished."""
    found = results.studies.get(name)
    return None if found is None else floor_of_study(found)
