# SPDX-License-Identifier: Apache-2.0
"""The scenario in full: the flight scenario, and what only the world and tools for before and after
a flight may know.
"""

from __future__ import annotations

from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from pydantic import Field, model_validator

from .bodies import Target
from .camera import CameraSection
from .checks import check_consistent
from .detumble import RestLimits
from .faults import Fault
from .fields import MAX_CHASERS, Index, NotNegative, Positive, Section, Vector
from .flight import FlightScenario
from .lab import LabSection, check_lab
from .learning import LearningSection, check_learning
from .mapping import MapLimits
from .rendezvous import Arrival, ConeLimit, SpeedLimit
from .schema import FlightChaser
from .simulation import SimulationSection
from .thrusters import ThrusterFailure
from .truth import TruthSection
from .world import WorldSection


class Chaser(FlightChaser):
    """One chaser: its reference pose, and its initial state relative to that. It starts without
    rotation in WRF.
    """

    start_offset_m: Vector = Field(
        default=(0.0, 0.0, 0.0),
        description="Initial position relative to the reference position (TRF), m.",
    )
    start_rotation_rad: Vector = Field(
        default=(0.0, 0.0, 0.0),
        description="Initial attitude relative to the reference attitude: rotation vector (CRF), "
        "rad.",
    )
    start_velocity_m_s: Vector = Field(
        default=(0.0, 0.0, 0.0), description="Initial velocity (WRF), m/s."
    )


class Success(Section):
    """Criteria of a successful mission, evaluated on ground truth, in addition to those of every
    mission: no collision, and loads on ports within their limits. Omitted criteria are not
    evaluated.
    """

    docked: tuple[Index, ...] = Field(
        default=(), description="Chasers that must be docked at the end."
    )
    reached: tuple[Index, ...] = Field(
        default=(),
        description="Chasers that must be at the destination of their last `goto` at the end.",
    )
    reached_position_m: Positive = Field(default=0.02, description="Tolerance of `reached`, m.")
    reached_within_s: Positive | None = Field(
        default=None,
        description="Longest time from that `goto` until a chaser is there to stay, s.",
    )
    latched: tuple[Index, ...] = Field(
        default=(), description="Chasers that must be latched at the end."
    )
    detumbled: RestLimits | None = Field(
        default=None,
        description="Rates that the stack of target and latched chasers must not exceed at the "
        "end.",
    )
    map: MapLimits | None = None
    speed_limit: SpeedLimit | None = None
    approach_cone: ConeLimit | None = None
    arrival: Arrival | None = None
    abort_clear_m: Positive | None = Field(
        default=None,
        description="Half edge of the cube about the target's centre, along the axes of TRF, out "
        "of which the centre of a chaser must stay from its first abort on, m.",
    )
    keep_distances: bool = Field(
        default=True, description="Whether the distances of `[limits]` must be kept."
    )
    steady_position_rms_m: Positive | None = Field(
        default=None,
        description="Largest RMS of each chaser's position error in the steady interval, m.",
    )
    steady_orientation_rms_deg: Positive | None = Field(
        default=None,
        description="Largest RMS of each chaser's attitude error in the steady interval, degrees.",
    )
    max_estimate_position_m: Positive | None = Field(
        default=None,
        description="Largest error of the estimated position of a chaser relative to the target "
        "after `settling_s`, m (with "
        "`paper`: of the target's position).",
    )
    max_estimate_orientation_deg: Positive | None = Field(
        default=None,
        description="Largest error of the estimated attitude of a chaser relative to the target "
        "after `settling_s`, degrees "
        "(with `paper`: of the target's attitude).",
    )


class Scenario(FlightScenario):
    """A mission: the keys of the flight scenario, some with more keys in their tables, and those
    below.
    """

    extends: str | None = Field(
        default=None,
        exclude=True,
        description="Scenario that this one is a variant of: the name of a shipped scenario, or "
        "the path of a file relative to this one.",
    )
    description: str = Field(default="", description="One sentence for lists and reports.")
    settling_s: NotNegative = Field(
        default=20.0, description="Begin of the steady interval, s of mission time."
    )
    steady_until_s: Positive | None = Field(
        default=None,
        description="End of the steady interval, s of mission time. Without it: the end of the "
        "mission.",
    )
    seed: int = Field(default=0, ge=0, lt=2**32, description="Seed of everything random.")
    # Fields are frozen, so that a narrower type than the flight scenario's is sound.
    target: Target = Target()  # pyright: ignore[reportIncompatibleVariableOverride]
    camera: CameraSection = CameraSection()  # pyright: ignore[reportIncompatibleVariableOverride]
    chasers: tuple[Chaser, ...] = Field(  # pyright: ignore[reportIncompatibleVariableOverride]
        min_length=1, max_length=MAX_CHASERS
    )
    thruster_failure: tuple[ThrusterFailure, ...] = ()
    fault: tuple[Fault, ...] = Field(default=(), max_length=100)
    success: Success = Success()
    world: WorldSection = WorldSection()
    truth: TruthSection = TruthSection()
    simulation: SimulationSection = SimulationSection()
    lab: LabSection | None = None
    learning: LearningSection | None = None

    @model_validator(mode="after")
    def _check_consistent(self) -> Scenario:
        if self.extends is not None:
            raise ValueError("extends: is resolved in scenario files only")
        check_consistent(self)
        check_lab(self)
        check_learning(self)
        return self

    def goal_of(self, chaser: int) -> tuple[float, Vector] | None:
        """Return time (s) and destination (TRF, m) of a chaser's last ``goto`` in the timeline, or
        None.
        """
        goals = [
            (e.at_s, e.offset_m)
            for e in self.timeline
            if chaser in e.chasers and e.offset_m is not None
        ]
        return max(goals, key=lambda goal: goal[0], default=None)

    def start_pose(self, chaser: int) -> tuple[Array, Array]:
        """Return position (3,) in WRF and attitude (4,), CRF to WRF, of a chaser at time zero."""
        c = self.chasers[chaser]
        offset = [a + b for a, b in zip(c.position_m, c.start_offset_m, strict=True)]
        position = self.target.position_m + rotations.rotate(self.target.q_wxyz, offset)
        attitude = rotations.multiply(self.target.q_wxyz, c.q_wxyz)
        return position, rotations.multiply(attitude, rotations.exp(c.start_rotation_rad))
