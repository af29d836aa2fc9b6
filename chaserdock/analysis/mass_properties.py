# SPDX-License-Identifier: Apache-2.0
"""Formats identified mass properties for report and viewer, beside the stated and, if recorded, the
true values.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import DrawnBody, MassEstimate, StackEstimate
from chaserdock_protocol.scenario import FlightScenario

NAMES = ("mass", "centre x", "centre y", "centre z", "Ixx", "Iyy", "Izz", "Ixy", "Ixz", "Iyz")
UNITS = ("kg", "mm", "mm", "mm", *["kg m²"] * 6)
SCALE = np.array([1.0, 1e3, 1e3, 1e3, *[1.0] * 6])
"""Names, units, and factors from SI of mass, centre of mass (TRF) and inertia about it (TRF axes),
in the order of a covariance.
"""
_ELEMENTS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
"""Row and column of the elements of an inertia tensor in the order of messages."""


def values_of(mass: MassEstimate) -> tuple[Array, Array]:
    """Return the values (10,) of an estimate and their standard deviations (10,), SI units."""
    values = np.array([mass.mass_kg, *mass.centre_of_mass_m, *mass.inertia_kg_m2])
    return values, np.sqrt(np.maximum(np.array(mass.covariance)[::11], 0.0))


def stated_values(scenario: FlightScenario) -> Array:
    """Return the values (10,) of the scenario's target, which its controllers know."""
    target = scenario.target
    return np.array(
        [target.mass_kg, *target.centre_of_mass_m, *(target.inertia_tensor[e] for e in _ELEMENTS)]
    )


def true_values(drawn: DrawnBody) -> Array:
    """Return the values (10,) of a recorded true body."""
    inertia = np.array(drawn.inertia_kg_m2).reshape(3, 3)
    return np.array([drawn.mass_kg, *drawn.centre_of_mass_m, *(inertia[e] for e in _ELEMENTS)])


@dataclass(frozen=True)
class PropertyRow:
    """One quantity of the table as text: value and standard deviation of target and stack; stated
    value; true value, if known.

    ``off``: true error of the target's value in standard deviations.
    """

    name: str
    target: str
    stated: str
    true: str
    off: str
    stack: str


def property_rows(
    estimate: StackEstimate, stated: Array, true: Array | None, missing: str
) -> list[PropertyRow]:
    """Return the rows of a table; ``missing`` stands for an unknown value."""
    target, sigma = values_of(estimate.target)
    stack, stack_sigma = values_of(estimate.stack)
    rows = []
    for k, name in enumerate(NAMES):
        off = (
            missing
            if true is None or not sigma[k]
            else f"{(target[k] - true[k]) / sigma[k]:+.1f} sigma"
        )
        rows.append(
            PropertyRow(
                f"{name}, {UNITS[k]}",
                _with_sigma(target[k] * SCALE[k], sigma[k] * SCALE[k]),
                f"{stated[k] * SCALE[k]:.4g}",
                missing if true is None else f"{true[k] * SCALE[k]:.4g}",
                off,
                _with_sigma(stack[k] * SCALE[k], stack_sigma[k] * SCALE[k])
                if estimate.chasers
                else missing,
            )
        )
    return rows


def _with_sigma(value: float, sigma: float) -> str:
    """Return a value and its standard deviation, both to the second digit of the latter."""
    digits = 0 if sigma <= 0.0 else max(0, 1 - int(np.floor(np.log10(sigma))))
    return f"{value:.{digits}f} ± {sigma:.{digits}f}"
