# SPDX-License-Identifier: Apache-2.0
"""Scenario section ``[learning]``: task, start, observation and reward of the environments in which
policies are trained (`chaserdock.envs`). Missions ignore it, so that the same file flies a trained
policy.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Annotated, Literal

import numpy as np
from pydantic import Field

from .fields import NotNegative, Number, Positive, Section

if TYPE_CHECKING:
    from . import Scenario

MOST_CHASERS = 16
"""Largest number of chasers of an environment: the arrays of its kernel have this size."""

HalfWidths = tuple[NotNegative, NotNegative, NotNegative]
HalfTurn = Annotated[float, Field(ge=0, le=180, allow_inf_nan=False)]


class LearningStart(Section):
    """Spread of the start about that of the mission: half widths of uniform distributions along
    each axis.
    """

    position_m: HalfWidths = Field(default=(0.0, 0.0, 0.0), description="Position (WRF), m.")
    rotation_deg: HalfTurn = Field(
        default=0.0, description="Attitude: rotation vector (CRF), degrees."
    )
    velocity_m_s: NotNegative = Field(default=0.0, description="Velocity (WRF), m/s.")
    rate_deg_s: NotNegative = Field(default=0.0, description="Rate (CRF), degrees/s.")
    target_rate_deg_s: NotNegative = Field(
        default=0.0, description="Rate of the target (TRF), degrees/s."
    )


class LearningReward(Section):
    """Weights of the reward of each chaser and tick."""

    progress_per_m: Number = Field(
        default=0.0, description="For each metre by which the distance from the goal falls."
    )
    turn_per_rad: Number = Field(
        default=0.0, description="For each radian by which the attitude error falls."
    )
    distance_per_m_s: Number = Field(
        default=0.0, description="Lost for each metre from the goal and second."
    )
    angle_per_rad_s: Number = Field(
        default=0.0, description="Lost for each radian of attitude error and second."
    )
    impulse_per_N_s: Number = Field(
        default=0.0,
        description="Lost for each N s: of the sum of the force components' magnitudes, or of all "
        "thrusters.",
    )
    corridor_per_s: Number = Field(
        default=0.0,
        description="Lost for each second before the port outside of the limits of "
        "`docking.corridor` or `docking.final`.",
    )
    within_per_s: Number = Field(
        default=0.0,
        description="For each second within `approach.docked_position_m` and `docked_angle_deg`; "
        "with `detumble` within the limits of rest.",
    )
    time_per_s: Number = Field(default=0.0, description="Lost for each second.")
    seen: Number = Field(
        default=0.0,
        description="`inspect`: for all points of the surface; each chaser gets the share of those "
        "that it is the first to see.",
    )
    spin_per_rad_s: Number = Field(
        default=0.0,
        description="`detumble`: for each radian/s by which the rate of the stack falls.",
    )
    drift_per_m_s: Number = Field(
        default=0.0,
        description="`detumble`: for each m/s by which the speed of the stack's centre of mass "
        "(WRF) falls.",
    )
    success: Number = Field(default=0.0, description="For the task's success.")
    failure: Number = Field(
        default=0.0,
        description="Lost by every chaser that still flies when one collides, comes too near or "
        "is lost.",
    )


class LearningInspection(Section):
    """When a point of the target's surface counts as seen by the task `inspect`: in an image, near
    enough, at no flat angle, hidden by no cuboid of the target, and sunlit.
    """

    share: float = Field(
        default=0.95,
        gt=0.0,
        le=1.0,
        allow_inf_nan=False,
        description="Share of the points that all chasers together have to see.",
    )
    spacing_m: Positive = Field(
        default=0.1, description="Largest distance of neighbouring points on a face, m."
    )
    range_m: Positive = Field(
        default=2.0, description="Largest distance of a point from the camera, m."
    )
    incidence_deg: float = Field(
        default=70.0,
        gt=0.0,
        le=90.0,
        allow_inf_nan=False,
        description="Largest angle between line of sight and normal of the face, degrees.",
    )
    sunlit: bool = Field(
        default=True,
        description="Whether a point must be in the light of `camera.sun_direction`, and in no "
        "shadow of the target.",
    )


class LearningReference(Section):
    """Largest offsets of the NMPC's reference by the action `reference`."""

    position_m: Positive = Field(default=0.5, description="Along each axis (TRF), m.")
    rotation_deg: HalfTurn = Field(
        default=20.0, description="Of the rotation vector along each axis (CRF), degrees."
    )


class LearningSection(Section):
    """Task and reward of a training environment ([learning.md](learning.md)). Its criteria are
    those of missions: `approach`, `docking`, `limits`, `detumble`.
    """

    task: Literal["hold", "dock", "inspect", "detumble"] = Field(
        description="`hold`: stay at the reference pose. `dock`: come to the docking distance or "
        "into the port, as `docking.kind` says. `inspect`: see the target's surface. `detumble`: "
        "latched to the target, stop it."
    )
    action: Literal["actuators", "reference"] = Field(
        default="actuators",
        description="`actuators`: those of `chaser.actuation`. `reference`: offsets of the "
        "reference that the NMPC follows.",
    )
    observation: Literal["truth", "statistical", "images"] = Field(
        default="truth",
        description="`truth`; `statistical`: with the errors that a filter of the statistical "
        "perception's measurements has; `images`: what the camera sees.",
    )
    episode_s: Positive = Field(description="Longest episode, s. At least a tick.")
    start: LearningStart = LearningStart()
    reward: LearningReward = LearningReward()
    inspect: LearningInspection = LearningInspection()
    reference: LearningReference = LearningReference()


def check_learning(scenario: Scenario) -> None:
    """Check the section with the rest of a scenario. Raises ValueError."""
    learning = scenario.learning
    if learning is None:
        return
    count = len(scenario.chasers)
    if count > MOST_CHASERS:
        raise ValueError(f"learning: for at most {MOST_CHASERS} chasers (got {count})")
    if round(learning.episode_s * scenario.time.rate_hz) < 1:
        raise ValueError(
            f"learning.episode_s: {learning.episode_s:g} s is shorter than a tick of "
            f"{1.0 / scenario.time.rate_hz:g} s"
        )
    if learning.task == "detumble" or (
        learning.task == "dock" and scenario.docking.kind == "capture"
    ):
        portless = [i for i in range(count) if scenario.docking.port_of(i) is None]
        if portless:
            raise ValueError(
                f"learning.task: chasers {', '.join(map(str, portless))} have no port to dock at"
            )
    if learning.action == "reference":
        _check_reference(scenario, learning)
    if learning.task == "detumble":
        _check_stack(learning)
    else:
        _check_spread(scenario, math.hypot(*learning.start.position_m))


def _check_reference(scenario: Scenario, learning: LearningSection) -> None:
    """Raise ValueError if the NMPC cannot fly the chasers."""
    if learning.task == "detumble":
        raise ValueError('learning.action: "reference" is for free chasers, not for "detumble"')
    if scenario.chaser.actuation != "ideal":
        raise ValueError('learning.action: "reference" needs chaser.actuation = "ideal"')


def _check_stack(learning: LearningSection) -> None:
    """Raise ValueError for keys without a meaning for latched chasers."""
    if learning.observation != "truth":
        raise ValueError(
            'learning.observation: "detumble" has "truth" only; latched chasers know their motion '
            "from odometry, whose errors environments do not have"
        )
    start = learning.start
    spreads = {
        "position_m": any(start.position_m),
        "rotation_deg": start.rotation_deg,
        "velocity_m_s": start.velocity_m_s,
        "rate_deg_s": start.rate_deg_s,
    }
    if found := [key for key, spread in spreads.items() if spread]:
        raise ValueError(
            f'learning.start.{found[0]}: must be 0 for "detumble", whose chasers start at their '
            "ports; target_rate_deg_s spreads the rate"
        )


def _check_spread(scenario: Scenario, reach_m: float) -> None:
    """Raise ValueError if chasers could start too near to the target or to each other, or lost."""
    starts = [scenario.start_pose(i)[0] for i in range(len(scenario.chasers))]
    keep, limits = "learning.start.position_m", scenario.limits
    for i, start in enumerate(starts):
        away_m = float(np.linalg.norm(start - np.asarray(scenario.target.position_m)))
        if away_m - reach_m <= limits.min_distance_target_m:
            raise ValueError(
                f"{keep}: chaser {i} could start {max(0.0, away_m - reach_m):.3f} m from the "
                f"target; limits.min_distance_target_m is {limits.min_distance_target_m:g} m"
            )
        if away_m + reach_m >= limits.max_reference_distance_m:
            raise ValueError(
                f"{keep}: chaser {i} could start {away_m + reach_m:.3f} m from the target; "
                f"limits.max_reference_distance_m is {limits.max_reference_distance_m:g} m"
            )
        for j in range(i):
            apart_m = float(np.linalg.norm(start - starts[j])) - 2.0 * reach_m
            if apart_m <= limits.min_distance_chasers_m:
                raise ValueError(
                    f"{keep}: chasers {j} and {i} could start {max(0.0, apart_m):.3f} m apart; "
                    f"limits.min_distance_chasers_m is {limits.min_distance_chasers_m:g} m"
                )
