# SPDX-License-Identifier: Apache-2.0
"""Scenario tables ``[[truth.oscillator]]``: parts of a body that move on springs. Only the world
reads them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.oscillators import MassDistribution, frequencies_hz, rest_fault, rigid_rest
from pydantic import Field

from .fields import Fraction, Positive, PositiveVector, Section, Vector

if TYPE_CHECKING:
    from . import Scenario

STEPS_PER_PERIOD = 30
"""Least number of physics steps in a period of the fastest oscillation, at which its frequency is
off by 1e-5 and a step still is stable by a factor of ten.
"""


class Oscillator(Section):
    """A mass on springs that each body carries, within its stated mass: a mode of a panel, or fuel.
    The flight software does not know of it ([world.md](world.md#bodies-that-are-not-rigid))."""

    body: Literal["chaser", "target"] = Field(
        default="chaser", description="What carries it: each chaser, or the target."
    )
    mass_share: Annotated[float, Field(gt=0, le=0.5, allow_inf_nan=False)] = Field(
        description="Its share of the body's mass: of a mode, its effective mass."
    )
    position_m: Vector = Field(description="Where it rests (CRF or TRF), m.")
    frequency_hz: Positive | PositiveVector = Field(
        description="Frequency along each axis of the body, or one for all, Hz, while the body is "
        "held; a free one moves against it, faster."
    )
    damping_share: Fraction | tuple[Fraction, Fraction, Fraction] = Field(
        default=0.005,
        description="Damping along each axis, or one for all, as a share of critical.",
    )
    propellant: bool = Field(
        default=False,
        description="Whether thrusters consume it: its mass falls by the impulse over specific "
        "impulse and standard gravity. Centre of mass and inertia follow.",
    )

    @property
    def frequencies_hz(self) -> tuple[float, float, float]:
        """Frequencies along the axes of the body."""
        f = self.frequency_hz
        return f if isinstance(f, tuple) else (f, f, f)

    @property
    def damping_shares(self) -> tuple[float, float, float]:
        """Damping along the axes of the body."""
        d = self.damping_share
        return d if isinstance(d, tuple) else (d, d, d)


def check_oscillators(scenario: Scenario) -> None:
    """Raise ValueError unless the bodies of a scenario can carry what it states."""
    chaser, target, stated = scenario.chaser, scenario.target, scenario.truth.oscillator
    if stated and chaser.is_planar:
        raise ValueError("truth.oscillator: bodies on a floor are rigid")
    for k, oscillator in enumerate(stated):
        of_target = oscillator.body == "target"
        if of_target and target.motion != "torque_free":
            raise ValueError(f'truth.oscillator.{k}.body: needs target.motion = "torque_free"')
        if oscillator.propellant and (of_target or chaser.actuation != "thrusters"):
            raise ValueError(
                f"truth.oscillator.{k}.propellant: only a chaser's thrusters consume any "
                '(chaser.actuation = "thrusters")'
            )
    for body, whole in (
        ("chaser", MassDistribution(chaser.mass_kg, np.zeros(3), np.diag(chaser.inertia))),
        (
            "target",
            MassDistribution(
                target.mass_kg, np.array(target.centre_of_mass_m), target.inertia_tensor
            ),
        ),
    ):
        carried = tuple(o for o in stated if o.body == body)
        if carried and (fault := _fault(carried, whole, scenario.time.physics_hz)):
            raise ValueError(f"truth.oscillator: the {body}: {fault}")


def _fault(oscillators: Sequence[Oscillator], whole: MassDistribution, physics_hz: int) -> str:
    """Return why a body cannot carry these, or why physics steps do not resolve their motion."""
    if (share := sum(o.mass_share for o in oscillators)) >= 1.0:
        return f"mass_share adds up to {share:g}, which must be less than 1"
    masses_kg, places_m = point_masses(oscillators, whole.mass_kg)
    rest = rigid_rest(whole, masses_kg, places_m)
    if fault := rest_fault(rest):
        return f"{fault}; choose a smaller mass_share, or position_m closer to its centre of mass"
    held = np.array([o.frequencies_hz for o in oscillators])
    fastest = float(frequencies_hz(rest, masses_kg, places_m, held)[-1])
    if fastest * STEPS_PER_PERIOD <= physics_hz:
        return ""
    return (
        f"while it is free, frequency_hz makes it oscillate at {fastest:.3g} Hz; time.physics_hz = "
        f"{physics_hz} resolves {physics_hz / STEPS_PER_PERIOD:.3g} Hz"
    )


def point_masses(oscillators: Sequence[Oscillator], mass_kg: float) -> tuple[Array, Array]:
    """Return masses (n,) and places (n, 3) of what a body of this mass carries."""
    return (
        mass_kg * np.array([o.mass_share for o in oscillators]),
        np.array([o.position_m for o in oscillators]),
    )
