# SPDX-License-Identifier: Apache-2.0
"""Scenario section ``[detumble]``: how latched chasers stop the tumble of the target, and when it counts as stopped."""

from __future__ import annotations

from pydantic import Field

from .fields import Positive, Section


class RestLimits(Section):
    """Rates below which the stack of target and latched chasers counts as stopped."""

    rate_deg_s: Positive = Field(default=0.05, description="Angular rate, degrees/s.")
    speed_m_s: Positive = Field(default=0.001, description="Speed of the common centre of mass (WRF), m/s.")


class Detumble(RestLimits):
    """Stopping the target with the thrusters of the chasers that are latched to it ([detumble.md](detumble.md))."""

    response_s: Positive = Field(
        default=0.5, description="Time in which the feedback would stop the stack with unlimited thrust, s."
    )
    timeout_s: Positive = Field(
        default=60.0,
        description="Longest time to stop the stack, s. A command that needs longer is refused; after it the thrusters close.",
    )
    plume_deg: float = Field(
        default=20.0,
        gt=0.0,
        lt=90.0,
        allow_inf_nan=False,
        description="Half angle of a thruster's plume, degrees. A thruster whose plume hits the target, a port or a latched "
        "chaser does not fire.",
    )
