# SPDX-License-Identifier: Apache-2.0
"""Scenario section ``[plume]``: plumes of the thrusters act on the target and on other chasers."""

from __future__ import annotations

import math

from chaserdock_models.plume import PlumeFlux
from pydantic import Field

from .fields import Positive, Section


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

    def flux(self) -> PlumeFlux:
        """Return the momentum flux of a plume."""
        return PlumeFlux(math.radians(self.limit_deg), self.exponent)
