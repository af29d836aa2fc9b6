# SPDX-License-Identifier: Apache-2.0
"""Scenario section ``[detumble]``: how latched chasers stop the tumble of the target, and when it
counts as stopped.
"""

from __future__ import annotations

from typing import ClassVar

from pydantic import Field

from .fields import NotNegative, Positive, Section, UnitQuaternion


class RestLimits(Section):
    """Rates below which the stack of target and latched chasers counts as stopped."""

    rate_deg_s: Positive = Field(default=0.05, description="Angular rate, degrees/s.")
    speed_m_s: Positive = Field(
        default=0.001, description="Speed of the common centre of mass (WRF), m/s."
    )


class Identification(Section):
    """Mass properties of the stack, identified in flight from the odometry of latched chasers and
    their pulses. What is not known of the target before: `target.mass_sigma_share`,
    `target.inertia_sigma_share`, `target.centre_of_mass_sigma_m`."""

    enabled: bool = Field(
        default=False,
        description="Whether mass, centre of mass and inertia are identified, and used by the "
        "control of the stack. Without it those of `[target]` are taken as exact.",
    )
    thrust_share: Positive = Field(
        default=0.05,
        description="Standard deviation of each thruster's thrust, constant in a mission.",
    )
    pulse_scatter_share: NotNegative = Field(
        default=0.03, description="Standard deviation of each pulse's impulse."
    )


class Detumble(RestLimits):
    """Stopping the target with the thrusters of the chasers that are latched to it
    ([detumble.md](detumble.md)).
    """

    response_s: ClassVar[float] = 0.5
    """Time in which the feedback would stop the stack if thrust were unlimited, s: some ticks of
    the default rate. As thrust is limited, it matters near rest only.
    """
    timeout_s: Positive = Field(
        default=60.0,
        description="Longest time to stop the stack, s. A command that needs longer is refused; "
        "after it the thrusters close.",
    )
    plume_deg: float = Field(
        default=20.0,
        gt=0.0,
        lt=90.0,
        allow_inf_nan=False,
        description="Half angle of a thruster's plume, degrees. A thruster whose plume hits the "
        "target, a port or a latched chaser does not fire.",
    )
    plan_s: Positive | None = Field(
        default=None,
        description="Time in which a plan of least propellant stops the stack, s. Without it the "
        "feedback stops it as fast as it can.",
    )
    attitude_wxyz: UnitQuaternion | None = Field(
        default=None,
        description="Attitude that the stopped stack turns to and keeps, TRF to WRF: unit "
        "quaternion, scalar first. Without it the stack keeps the attitude in which it "
        "stopped, within the limits of its rate.",
    )
    slew_deg_s: Positive = Field(default=1.0, description="Largest rate of that turn, degrees/s.")
    identification: Identification = Identification()
