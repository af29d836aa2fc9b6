# SPDX-License-Identifier: Apache-2.0
"""Scenario section ``[plume]``: plumes of the thrusters act on the target and on other chasers."""

from __future__ import annotations

import math

from chaserdock_models.plume import PlumeFlux
from pydantic import Field

from .fields import NotNegative, Positive, Section


class PlumeSection(Section):
    """Plumes of thrusters exert force and torque on the target and on the other chasers
    ([thrusters.md](thrusters.md#plumes)). Without this section: a thruster acts on its own chaser
    only."""

    limit_deg: float = Field(
        default=60.0,
        gt=0.0,
        lt=90.0,
        allow_inf_nan=False,
        description="Angle from the axis beyond which a plume has no gas, degrees.",
    )
    exponent: Positive = Field(
        default=5.0, description="Exponent m of its profile: 2 / (gamma - 1), 5 for cold nitrogen."
    )
    reach_m: Positive = Field(default=10.0, description="Distance up to which a plume acts, m.")
    avoid_factor: NotNegative = Field(
        default=10.0,
        description="A thruster whose plume hits the target or another chaser within `reach_m` "
        "(half angle `detumble.plume_deg`) costs so many times more in the allocation, in "
        "addition: it fires only where others cannot give the wrench. 0: no avoidance.",
    )

    def flux(self) -> PlumeFlux:
        """Return the momentum flux of a plume."""
        return PlumeFlux(math.radians(self.limit_deg), self.exponent)
