# SPDX-License-Identifier: Apache-2.0
"""Sections of a scenario: every key with type, default, range and description.

Keys are snake_case and end with their unit. Frames: WRF world, CRF chaser, TRF target, IRF image
(docs/frames.md).
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from chaserdock_protocol.messages import OperatorCommandName

from .fields import (
    Fraction,
    Index,
    LookAt,
    Name,
    NotNegative,
    Oriented,
    Positive,
    Section,
    UnitQuaternion,
    Vector,
    is_zero,
)
from .mapping import PortChoice

MARKER_PERCEPTIONS = ("default", "paper", "paper_iterative", "statistical")
MAPPING = "features"
"""Perception that knows nothing of the target's shape."""
PERCEPTIONS = (*MARKER_PERCEPTIONS, "model", MAPPING)
ESTIMATORS = ("joint", "paper")
SOLVERS = ("rti", "ipopt", "open")
"""Names of the built-in parts that a scenario selects. Further ones may be installed (``plugins``).
"""

MAX_ESTIMATE_MARGIN_M = 0.1
"""Largest distance, m, that an uncertain estimate adds to the keep-out. Larger: chasers are pushed
out of places that they can hold; smaller: a poor estimate leaves less room.
"""
MAX_STAGES = 500
"""Longest prediction: more stages could not be solved in time, and messages bound their size."""

MAX_DURATION_S = 90 * 86_400.0
"""Longest mission: messages count simulated time in nanoseconds up to 2**53 (see
``message_fields``).
"""


class Time(Section):
    """Rates and latency of simulated time."""

    rate_hz: int = Field(
        default=15,
        ge=1,
        le=240,
        description="Ticks of control per second, Hz. It must divide `physics_hz`.",
    )
    image_hz: int = Field(
        default=15, ge=1, le=240, description="Images per second, Hz. It must divide `rate_hz`."
    )
    physics_hz: int = Field(
        default=960, ge=60, le=20000, description="Physics steps per second, Hz."
    )
    latency_s: NotNegative = Field(
        default=1.0 / 30.0,
        description="Time from a tick to the effect of the commands computed from it, s, rounded "
        "to physics steps.",
    )

    @model_validator(mode="after")
    def _check_divisors(self) -> Time:
        if self.physics_hz % self.rate_hz:
            raise ValueError(
                f"physics_hz must be a multiple of rate_hz ({self.physics_hz}, {self.rate_hz})"
            )
        if self.rate_hz % self.image_hz:
            raise ValueError(
                f"rate_hz must be a multiple of image_hz ({self.rate_hz}, {self.image_hz})"
            )
        return self


class EstimatorSection(Section):
    """Fusion of all chasers' sightings into the target's state."""

    name: Name = Field(
        default="joint",
        description="`joint`: filter of target, chasers, sensors and disturbances. `paper`: the "
        "paper's average, with odometry "
        "taken as exact. Or an installed plugin.",
    )
    target_acceleration_noise: Positive | None = Field(
        default=None,
        description="Of `joint`: square root of the spectral density of the target's unmodelled "
        "acceleration, m/s²/√Hz. Not set: 1e-5 for `torque_free`, otherwise 5e-6. Far away "
        "it decides how well the relative velocity is known.",
    )
    target_angular_noise: Positive | None = Field(
        default=None, description="The same of its angular acceleration, rad/s²/√Hz."
    )


class PerceptionSection(Section):
    """Pose estimation from one image."""

    name: Name = Field(
        default="default",
        description="`default`, `paper` (the paper's method, with EPnP), `paper_iterative` (the "
        "same with OpenCV's iterative PnP, as in the authors' public code), `model` (by the "
        "target's shape, without markers: [markerless.md](markerless.md)), `features` (nothing is "
        "known of the target: [unknown-target.md](unknown-target.md)), `statistical` (no "
        "images: measurements are drawn around the true pose, "
        "[simulation.md](simulation.md)), or an installed plugin.",
    )


class ControllerOptions(Section):
    """Keys of `Controller` that are no part of the NMPC's problem."""

    standby: bool = Field(
        default=False,
        description="Start a second controller as hot standby ([redundancy.md](redundancy.md)).",
    )
    solver: Name = Field(
        default="rti",
        description=f"One of {', '.join(f'`{name}`' for name in SOLVERS)}, or an installed plugin.",
    )
    max_iterations: int | None = Field(
        default=None,
        ge=0,
        description="Most iterations per solve, as the solver counts them. Without it: the "
        "solver's default.",
    )
    solve_budget_s: Positive | None = Field(
        default=None,
        description="Wall time per solve, s: in real time, limits the iterations to what fits. "
        "Only with the solver `rti`.",
    )
    feed_forward: bool = Field(
        default=True,
        description="Count the input cost from the force and torque that the reference motion "
        "needs. Otherwise from zero, "
        "as in the paper.",
    )
    command_lifetime_s: Positive = Field(
        default=0.5, description="Age at which a chaser rejects a command and uses its fallback, s."
    )


class Controller(ControllerOptions):
    """The NMPC: solver, horizon and weights ([controller.md](controller.md) relates them to the
    paper's symbols).
    """

    # Each of these reaches the solver: a parameter of the problem, or a setting of one of its terms
    # (controller/chaserdock_controller/nmpc/terms), under the same name. Any other is an error.
    horizon_s: Positive = Field(
        default=3.0,
        description=f"Prediction horizon, s: at least one and at most {MAX_STAGES} steps `dt_s`.",
    )
    dt_s: Positive = Field(
        default=0.1,
        description="Step of the prediction, s. A command is held for a tick, so a shorter step is "
        "lengthened to one.",
    )
    falloff: Fraction = Field(
        default=0.0,
        description="Linear decrease of the stage weights along the horizon: 0 is constant, 1 "
        "ends at zero.",
    )
    weight_position: NotNegative = Field(
        default=65.0, description="Weight of the position error, 1/m²."
    )
    weight_orientation: NotNegative = Field(
        default=35.0,
        description="Weight of the attitude error (squared vector part of the error quaternion).",
    )
    weight_force: Positive = Field(default=3.5, description="Weight of the force, 1/N².")
    weight_torque: Positive = Field(default=40.0, description="Weight of the torque, 1/(N m)².")
    weight_final_position: NotNegative = Field(
        default=3250.0,
        description="Additional weight of the position error at the end of the horizon, 1/m².",
    )
    weight_final_orientation: NotNegative = Field(
        default=1750.0,
        description="Additional weight of the attitude error at the end of the horizon.",
    )
    integrator: Literal["rk4", "euler"] = Field(
        default="rk4", description="Integrator of the prediction."
    )

    @model_validator(mode="after")
    def _check_consistent(self) -> Controller:
        if self.solve_budget_s is not None and self.solver in SOLVERS[1:]:
            raise ValueError(
                f"solve_budget_s goes with the solver rti; {self.solver} has no time limit"
            )
        stages = self.horizon_s / self.dt_s
        if round(min(stages, MAX_STAGES)) < 1:
            raise ValueError(
                f"horizon_s ({self.horizon_s}) is shorter than one step dt_s ({self.dt_s})"
            )
        if stages > MAX_STAGES:
            raise ValueError(f"horizon_s / dt_s is {stages:.0f} stages; at most {MAX_STAGES}")
        return self

    def at_rate(self, rate_hz: int) -> Controller:
        """Return the controller for ticks at ``rate_hz``: its step is at least a tick, for which a
        command is held.

        Raises ValueError for a horizon shorter than a tick.
        """
        if self.dt_s * rate_hz >= 1.0 - 1e-9:
            return self
        if self.horizon_s < 1.0 / rate_hz:
            raise ValueError(f"horizon_s ({self.horizon_s:g} s) is shorter than a tick")
        return self.model_copy(update={"dt_s": 1.0 / rate_hz})


class Limits(Section):
    """Distances between body centres that the controller keeps."""

    min_distance_target_m: NotNegative = Field(
        default=0.35, description="Smallest distance from the target, m."
    )
    estimate_margin_sigmas: NotNegative = Field(
        default=3.0,
        description="Standard deviations of a chaser's estimated position relative to the target "
        f"that are added to `min_distance_target_m`, at most {MAX_ESTIMATE_MARGIN_M:g} m in all.",
    )
    min_distance_shape_m: NotNegative = Field(
        default=0.0,
        description="Smallest distance of a chaser's shape (body and probe) from each cuboid of "
        "the target's shape (bus, panels, booms) and from the shapes of other chasers, m, "
        "outside of corridors, in addition to `min_distance_target_m` and "
        "`min_distance_chasers_m`, which may then be smaller or 0. 0: off. Needs the solver "
        "`rti`.",
    )
    min_distance_chasers_m: NotNegative = Field(
        default=0.35, description="Smallest distance between chasers, m."
    )
    max_reference_distance_m: Positive = Field(
        default=25.0, description="Largest distance of a reference position from the target, m."
    )
    passive_safety: Literal["off", "monitor", "enforce"] = Field(
        default="off",
        description="`monitor`: at every tick, whether the coast after a loss of all thrust at "
        "any moment of the plan stays outside `min_distance_target_m`; the certificate is "
        "published and changes are logged. `enforce`: outside the final corridor, plans are "
        "kept safe by constraints, moves are as slow as this needs, moves that cannot be "
        "safe are refused, and a chaser whose plans are not safe aborts onto a safe coast. "
        "Needs the estimator `joint`, and `enforce` the solver `rti`.",
    )
    final_corridor_m: NotNegative = Field(
        default=0.0,
        description='Distance from the target within which `passive_safety = "enforce"` does not '
        "apply, m. It never applies in the "
        "corridor of a port.",
    )
    passive_safety_s: Annotated[float, Field(gt=0, le=100_000, allow_inf_nan=False)] | None = Field(
        default=None,
        description="Length of that coast, s. Without it: two orbits, in free space 600 s.",
    )
    passive_safety_force_N: NotNegative | None = Field(
        default=None,
        description="Disturbance force on a chaser without thrust, N: standard deviation along "
        "each axis. Coasts are predicted with it. Without it: the estimator's 10 mN, far too much "
        "for a coast of orbits. State what the environment exerts (drag, sunlight, plumes).",
    )


class Approach(Section):
    """Approach to a distance, and when a chaser counts as docked with `docking.kind = "held"`."""

    dock_distance_m: Positive = Field(
        default=0.40,
        description="Distance from the target's centre, m; from the chosen port on a target of "
        "unknown shape.",
    )
    max_speed_m_s: Positive = Field(
        default=0.03,
        description="Speed of the reference relative to the target, m/s. `goto` flies at twice "
        "this speed.",
    )
    closing_per_s: NotNegative = Field(
        default=0.0,
        description="Increase of the speed limit of `goto` with the distance from the target, "
        "1/s: `goto` flies at most at 2 `max_speed_m_s` + `closing_per_s` x distance, all "
        "along its way.",
    )
    cone_deg: Annotated[float, Field(gt=0, lt=90, allow_inf_nan=False)] | None = Field(
        default=None,
        description="Half angle of the approach cone about the direction of a chaser's reference "
        "position, apex at the target's centre, degrees: a `goto` out of it is refused. The "
        "camera must see the target from its edge. Without it: no cone.",
    )
    docked_position_m: Positive = Field(
        default=0.01, description="Largest position error of a docked chaser, m."
    )
    docked_angle_deg: Positive = Field(
        default=1.0, description="Largest attitude error of a docked chaser, degrees."
    )
    docked_time_s: Positive = Field(
        default=5.0, description="Time within both errors before it counts as docked, s."
    )
    face_target: bool = Field(
        default=False,
        description="Turn the reference attitude with the position, so that a chaser faces the "
        "target after a `goto`. Otherwise it keeps its attitude in TRF.",
    )


class FlightChaser(Oriented):
    """One chaser of the flight software: its reference pose."""

    position_m: Vector = Field(description="Reference position (TRF), m. Not the origin.")
    q_wxyz: UnitQuaternion = Field(
        description="Reference attitude, CRF to TRF: unit quaternion, scalar first. Or give "
        "`attitude_deg` or `look_at`."
    )
    look_at: LookAt | None = Field(
        default=None,
        exclude=True,
        description="Alternative to `q_wxyz`: point +X, and so the camera, at the target's "
        "centre, without roll.",
    )

    @model_validator(mode="after")
    def _check_position(self) -> FlightChaser:
        if is_zero(self.position_m):
            raise ValueError(
                "position_m must not be the target's origin: the approach line begins there"
            )
        return self


class TimelineEntry(Section):
    """An operator command at a given time."""

    at_s: NotNegative = Field(description="Mission time, s.")
    command: Literal[OperatorCommandName, "port"] = Field(
        description="`approach`: dock. `hold`: stop at the present place. `retreat`: return to "
        "the reference position. `abort`: the same, twice as fast. `goto`: fly to "
        "`offset_m`. `calibrate`: manoeuvre to calibrate the camera. `inspect`: fly around "
        "the target and estimate its geometry. `identify`: fire pulses that show the mass "
        "properties of the stack. `detumble`: stop the target with latched chasers. "
        "`isolate`, `restore`: close or open the shut-off valve of `thruster`. `port`: choose "
        "a place on a target of unknown shape (`port`) to dock at."
    )
    chasers: tuple[Index, ...] = Field(min_length=1, description="Numbers of the chasers, from 0.")
    offset_m: Vector | None = Field(
        default=None,
        description="Destination of `goto` (TRF), m. Without it: before the chaser's chosen port.",
    )
    thruster: int | None = Field(
        default=None,
        ge=0,
        le=254,
        description="Number of the thruster, from 0, for `isolate` and `restore`.",
    )
    port: PortChoice | None = None

    @model_validator(mode="after")
    def _check_arguments(self) -> TimelineEntry:
        if self.command != "goto" and self.offset_m is not None:
            raise ValueError("offset_m goes with the command goto")
        if (self.command == "port") != (self.port is not None):
            raise ValueError("port goes with the command port, and that needs it")
        if (self.command in ("isolate", "restore")) != (self.thruster is not None):
            raise ValueError(
                "thruster goes with the commands isolate and restore, and these need it"
            )
        return self
