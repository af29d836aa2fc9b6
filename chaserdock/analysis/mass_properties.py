# SPDX-License-Identifier: Apache-2.0
"""Formats identified mass properties for report and viewer, beside the stated and, if recorded, the
true values.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from chaserdock_controller.estimation.composite_body import stated_properties
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

_LEARNT_SHARE = 0.9
"""Standard deviation, relative to that before the flight, above which a value counts as the prior.
At 0.9 the flight holds a quarter as much information as the statement. Larger: noise of the filter
counts as identification; smaller: slow convergence counts as none.
"""
PRIOR_ONLY = "(prior only)"


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


def prior_sigmas(scenario: FlightScenario) -> Array:
    """Return the standard deviations (10,) of the scenario's target before the flight, SI units."""
    return np.sqrt(np.diag(stated_properties(scenario).covariance))


def true_values(drawn: DrawnBody) -> Array:
    """Return the values (10,) of a recorded true body."""
    inertia = np.array(drawn.inertia_kg_m2).reshape(3, 3)
    return np.array([drawn.mass_kg, *drawn.centre_of_mass_m, *(inertia[e] for e in _ELEMENTS)])


@dataclass(frozen=True)
class PropertyRow:
    """One quantity of the table as text: value and standard deviation of target and stack; stated
    value; true value, if known.

    ``off``: true error of the target's value in standard deviations. Target and stack say
    ``PRIOR_ONLY`` where the flight has taught nothing about the quantity.
    """

    name: str
    target: str
    stated: str
    true: str
    off: str
    stack: str


def property_rows(
    estimate: StackEstimate, scenario: FlightScenario, true: Array | None, missing: str
) -> list[PropertyRow]:
    """Return the rows of a table; ``missing`` stands for an unknown value."""
    stated, prior = stated_values(scenario), prior_sigmas(scenario)
    target, sigma = values_of(estimate.target)
    stack, stack_sigma = values_of(estimate.stack)
    rows = []
    for k, name in enumerate(NAMES):
        off = (
            missing
            if true is None or not sigma[k]
            else f"{(target[k] - true[k]) / sigma[k]:+z.1f} sigma"
        )
        learnt_below = _LEARNT_SHARE * prior[k]
        rows.append(
            PropertyRow(
                f"{name}, {UNITS[k]}",
                _with_sigma(target[k], sigma[k], SCALE[k], learnt_below),
                f"{stated[k] * SCALE[k]:.4g}",
                missing if true is None else f"{true[k] * SCALE[k]:.4g}",
                off,
                _with_sigma(stack[k], stack_sigma[k], SCALE[k], learnt_below)
                if estimate.chasers
                else missing,
            )
        )
    return rows


def _with_sigma(value: float, sigma: float, scale: float, learnt_below: float) -> str:
    """Return a value and its standard deviation, both times ``scale`` and to the second digit of
    the latter, with ``PRIOR_ONLY`` unless the deviation is below ``learnt_below``.
    """
    shown = sigma * scale
    digits = 0 if shown <= 0.0 else max(0, 1 - int(np.floor(np.log10(shown))))
    text = f"{value * scale:z.{digits}f} ± {shown:.{digits}f}"
    return text if sigma < learnt_below else f"{text} {PRIOR_ONLY}"
