# SPDX-License-Identifier: Apache-2.0
"""Scenario tables about thrusters: layout, pulse modulation, and failures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.thruster_bodies import BODIES
from chaserdock_models.thruster_model import FailureKind
from chaserdock_models.wrench_set import wrench_matrix, wrench_set
from pydantic import Field, model_validator

from .fields import Index, NotNegative, Positive, Section, UnitVector, Vector

MAX_THRUSTERS = 24
"""The number of facets of the attainable wrench set grows with the fifth power of the number of
thrusters.
"""


class Thruster(Section):
    """One on-off thruster."""

    position_m: Vector = Field(description="Position of the nozzle (CRF), m.")
    direction: UnitVector = Field(
        description="Direction of its force on the body (CRF), unit vector."
    )
    thrust_N: Positive = Field(description="Full thrust, N.")
    min_on_s: Positive = Field(
        default=0.010, description="Minimum on-time, s: a shorter pulse does not open the valve."
    )
    rise_s: NotNegative = Field(
        default=0.002,
        description="Time of the linear rise of the thrust after the valve opens, s. At most "
        "`min_on_s`.",
    )
    fall_s: NotNegative = Field(
        default=0.002,
        description="Time of the linear fall of the thrust after the valve closes, s.",
    )
    isp_s: Positive = Field(
        default=70.0, description="Specific impulse, s. It gives the propellant consumption."
    )

    @model_validator(mode="after")
    def _check_rise(self) -> Thruster:
        if self.min_on_s < self.rise_s:
            raise ValueError(f"min_on_s ({self.min_on_s}) must be at least rise_s ({self.rise_s})")
        return self


class Modulation(Section):
    """Conversion of commanded thrust to one pulse per carrier period, its width proportional to the
    thrust ([thrusters.md](thrusters.md))."""

    carrier_hz: int = Field(
        default=10,
        ge=1,
        le=240,
        description="Carrier frequency, Hz. It must divide `time.physics_hz`.",
    )


class ThrusterFailure(Section):
    """A permanent failure of one thruster."""

    chaser: Index = Field(description="Number of the chaser, from 0.")
    thruster: Index = Field(description="Number of the thruster, from 0.")
    at_s: NotNegative = Field(description="Begin, s of mission time.")
    kind: FailureKind = Field(
        description="`stuck_off`: it never opens. `stuck_on`: it never closes. `weak`: it gives "
        "`factor` of its thrust."
    )
    factor: float | None = Field(
        default=None,
        ge=0,
        le=1,
        allow_inf_nan=False,
        description="Remaining share of the thrust, for `weak` only.",
    )
    reported: bool = Field(
        default=False,
        description="Whether the chaser is informed at once. Otherwise it has to detect the "
        "failure.",
    )

    @model_validator(mode="after")
    def _check_factor(self) -> ThrusterFailure:
        if (self.kind == "weak") != (self.factor is not None):
            raise ValueError("factor goes with the kind weak, and weak needs it")
        return self


def thrusts_max(thrusters: Sequence[Thruster]) -> Array:
    """Return the full thrust (n,) of all thrusters, N."""
    return np.array([t.thrust_N for t in thrusters])


def check_layout(thrusters: Sequence[Thruster], wrench_max: Array) -> None:
    """Raise ValueError unless the thrusters can give every wrench within ``wrench_max`` (6,), on
    all axes at once on which that is not 0; nothing holds a body that lifts off its floor.
    """
    if not thrusters:
        raise ValueError(
            "actuation thrusters needs thrusters, or a body with thrusters: "
            + ", ".join(sorted(BODIES))
        )
    axes, planar = np.flatnonzero(wrench_max), not wrench_max.all()
    lifting = [k for k, t in enumerate(thrusters) if planar and t.direction[2]]
    if lifting:
        raise ValueError(
            f"thrusters.{lifting[0]}.direction: pushes a planar body up or down; its third "
            f"component must be 0 (got {thrusters[lifting[0]].direction[2]:g})"
        )
    scale = wrench_set(wrench_matrix(thrusters), axes).box_scale(thrusts_max(thrusters), wrench_max)
    if scale <= 1e-6:
        raise ValueError(
            "thrusters cannot give force and torque in every direction: no "
            + ("control of x, y and yaw" if planar else "6-DoF control")
        )
    if scale < 1.0:
        raise ValueError(
            f"force_max_N {wrench_max[0]:g} and torque_max_N_m {wrench_max[3]:g} on all axes at "
            f"once are more than the thrusters can give; at most {scale:.3f} of both"
        )


def check_pulses(thrusters: Sequence[Thruster], modulation: Modulation, physics_hz: int) -> None:
    """Raise ValueError unless pulses fit into carrier periods, and carrier periods into whole
    physics steps.
    """
    carrier = modulation.carrier_hz
    if physics_hz % carrier:
        raise ValueError(
            f"time.physics_hz must be a multiple of chaser.modulation.carrier_hz ({physics_hz}, "
            f"{carrier})"
        )
    longest = max(t.min_on_s + t.fall_s for t in thrusters)
    if longest > 1.0 / carrier:
        raise ValueError(
            f"chaser.modulation.carrier_hz: a period of {1.0 / carrier:g} s is shorter than the "
            f"shortest pulse including its fall, {longest:g} s"
        )
