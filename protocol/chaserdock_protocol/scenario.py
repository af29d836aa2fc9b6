"""The scenario file: TOML, every value checked, every error with its path and what would be right.

Names are snake_case with their unit at the end; frames as everywhere: WRF world, CRF chaser, TRF target.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field, ValidationError, model_validator

from . import rotations
from .camera import Camera
from .clock import Timing
from .scenario_bodies import Body, Target
from .scenario_camera import CameraSection
from .scenario_fields import Name, NotNegative, Positive, Section, UnitQuaternion, Vector, finite
from .scenario_text import ScenarioError, explain, override


class Time(Section):
    """Rates and latencies of simulated time."""

    rate_hz: Annotated[int, Field(ge=1, le=240)] = 15
    picture_hz: Annotated[int, Field(ge=1, le=240)] = 15
    physics_hz: Annotated[int, Field(ge=60, le=20000)] = 960
    latency_s: NotNegative = 1.0 / 30.0

    @model_validator(mode="after")
    def _divide(self) -> Time:
        if self.physics_hz % self.rate_hz:
            raise ValueError(f"physics_hz must be a multiple of rate_hz ({self.physics_hz}, {self.rate_hz})")
        if self.rate_hz % self.picture_hz:
            raise ValueError(f"rate_hz must be a multiple of picture_hz ({self.rate_hz}, {self.picture_hz})")
        return self


class EstimatorSection(Section):
    """How sightings become the target's odometry; the numbers are ``mekf``'s.

    ``camera_bias_*``: one sigma of each camera's own calibration error, which is then estimated. 0: the cameras are as
    calibrated, which is so in the world's pictures.
    """

    name: Literal["mekf", "paper"] = "mekf"
    camera_bias_position_m: NotNegative = 0.0
    camera_bias_attitude_deg: NotNegative = 0.0


class PerceptionSection(Section):
    """How a picture becomes a pose."""

    name: Literal["default", "paper"] = "default"


MAX_STAGES = 500
"""Most prediction steps of a plan; more could not be solved in time, and messages bound their size."""


class Controller(Section):
    """The NMPC: solver, horizon, weights (the paper's names in docs/controller.md).

    ``max_iterations`` bounds a solve, in iterations as the solver counts them, so that it flies the same anywhere.
    """

    solver: Literal["rti", "ipopt", "fatrop", "alpaqa"] = "rti"
    max_iterations: Annotated[int, Field(ge=0)] | None = None
    horizon_s: Positive = 3.0
    dt_s: Positive = 0.1
    falloff: Annotated[float, AfterValidator(finite), Field(ge=0, le=1)] = 0.0
    weight_position: NotNegative = 65.0
    weight_orientation: NotNegative = 35.0
    weight_force: Positive = 3.5
    weight_torque: Positive = 40.0
    weight_final_position: NotNegative = 3250.0
    weight_final_orientation: NotNegative = 1750.0
    integrator: Literal["rk4", "euler"] = "rk4"
    feed_forward: bool = True
    command_lifetime_s: Positive = 0.5

    @model_validator(mode="after")
    def _stages(self) -> Controller:
        if round(self.horizon_s / self.dt_s) < 1:
            raise ValueError(f"horizon_s ({self.horizon_s}) is shorter than one step dt_s ({self.dt_s})")
        if self.horizon_s / self.dt_s > MAX_STAGES:
            raise ValueError(
                f"horizon_s / dt_s is {self.horizon_s / self.dt_s:.0f} stages; at most {MAX_STAGES}"
            )
        return self


class Limits(Section):
    """Distances that the controller keeps, centre to centre.

    ``estimate_margin_sigmas``: how many standard deviations of the target's estimated position are added to the
    distance from it, at most 0.1 m. 0: the estimate is taken as it is.
    """

    min_distance_target_m: NotNegative = 0.35
    estimate_margin_sigmas: NotNegative = 0.0
    min_distance_chasers_m: NotNegative = 0.35
    max_reference_distance_m: Positive = 25.0


class Approach(Section):
    """How an approach is flown, and when a chaser counts as docked.

    ``face_target``: the reference attitude turns with the offset, so that a chaser sent elsewhere goes on facing the
    target; otherwise it keeps its attitude in TRF.
    """

    dock_distance_m: Positive = 0.40
    max_speed_m_s: Positive = 0.03
    docked_position_m: Positive = 0.01
    docked_angle_deg: Positive = 1.0
    docked_time_s: Positive = 5.0
    face_target: bool = False


class Chaser(Section):
    """One chaser: its reference pose in TRF and where it starts, relative to that pose.

    The start is ``start_offset_m`` (TRF) away from the reference position, turned by ``start_rotation_rad`` (rotation
    vector, CRF) from the reference attitude, with ``start_velocity_m_s`` (WRF), not rotating.
    """

    position_m: Vector
    q_wxyz: UnitQuaternion
    start_offset_m: Vector = (0.0, 0.0, 0.0)
    start_rotation_rad: Vector = (0.0, 0.0, 0.0)
    start_velocity_m_s: Vector = (0.0, 0.0, 0.0)

    @model_validator(mode="after")
    def _outside(self) -> Chaser:
        if not any(self.position_m):
            raise ValueError("position_m must not be the target's own origin: the approach line begins there")
        return self


class TimelineEntry(Section):
    """A command at a time of the mission."""

    at_s: NotNegative
    command: Literal["approach", "hold", "retreat", "abort", "goto"]
    chasers: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]
    offset_m: Vector | None = None

    @model_validator(mode="after")
    def _goto(self) -> TimelineEntry:
        if (self.command == "goto") != (self.offset_m is not None):
            raise ValueError("offset_m goes with the command goto, and goto needs it")
        return self


class Success(Section):
    """What makes a run a success, judged on ground truth; what is left out is not asked."""

    docked: tuple[Annotated[int, Field(ge=0)], ...] = ()
    max_collisions: Annotated[int, Field(ge=0)] = 0
    keep_distances: bool = True
    steady_position_rms_m: Positive | None = None
    steady_orientation_rms_deg: Positive | None = None
    max_estimate_position_m: Positive | None = None
    max_estimate_orientation_deg: Positive | None = None


class Scenario(Section):
    """A whole mission, resolved: what every process gets from the world."""

    name: Name
    description: str = ""
    duration_s: Positive
    settling_s: NotNegative = 20.0
    steady_until_s: Positive | None = None
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    time: Time = Time()
    target: Target = Target()
    chaser: Body = Body()
    camera: CameraSection = CameraSection()
    perception: PerceptionSection = PerceptionSection()
    estimator: EstimatorSection = EstimatorSection()
    controller: Controller = Controller()
    limits: Limits = Limits()
    approach: Approach = Approach()
    chasers: Annotated[tuple[Chaser, ...], Field(min_length=1, max_length=16)]
    timeline: tuple[TimelineEntry, ...] = ()
    success: Success = Success()

    @model_validator(mode="after")
    def _consistent(self) -> Scenario:
        _check_apart(self)
        named = [(f"timeline.{i}.chasers", entry.chasers) for i, entry in enumerate(self.timeline)]
        last = len(self.chasers) - 1
        for where, chasers in (*named, ("success.docked", self.success.docked)):
            if max(chasers, default=0) > last:
                raise ValueError(f"{where}: there is no chaser {max(chasers)}; this mission has 0 to {last}")
        return self

    @property
    def timing(self) -> Timing:
        return Timing(
            physics_hz=self.time.physics_hz,
            rate_hz=self.time.rate_hz,
            picture_hz=self.time.picture_hz,
            latency_steps=round(self.time.latency_s * self.time.physics_hz),
        )

    def camera_model(self) -> Camera:
        """The chasers' camera, as perception, rendering and fusion use it."""
        c = self.camera
        return Camera.from_hfov(c.width_px, c.height_px, math.radians(c.hfov_deg), c.position_m)

    @property
    def ticks(self) -> int:
        return self.timing.ticks_in(self.duration_s)

    def start_pose(self, chaser: int) -> tuple[rotations.Array, rotations.Array]:
        """Position (3,) WRF and attitude (4,) CRF to WRF of a chaser at time zero."""
        c = self.chasers[chaser]
        offset = [a + b for a, b in zip(c.position_m, c.start_offset_m, strict=True)]
        position = self.target.position_m + rotations.rotate(self.target.q_wxyz, offset)
        attitude = rotations.multiply(self.target.q_wxyz, c.q_wxyz)
        return position, rotations.multiply(attitude, rotations.exp(c.start_rotation_rad))


def _check_apart(scenario: Scenario) -> None:
    starts = [scenario.start_pose(i)[0] for i in range(len(scenario.chasers))]
    width = math.hypot(*scenario.chaser.size_m)
    for i, a in enumerate(starts):
        for j in range(i):
            apart = math.dist(a, starts[j])
            if apart < width:
                raise ValueError(
                    f"chasers.{j} and chasers.{i} start {apart:.3f} m apart, inside one another; "
                    f"their bodies need {width:.3f} m"
                )


def _checked(validate: Callable[[Any], Scenario], values: Any, source: str) -> Scenario:
    try:
        return validate(values)
    except ValidationError as error:
        raise ScenarioError("\n".join(f"{source}: {line}" for line in explain(error))) from None


def parse_scenario(values: dict[str, Any], source: str) -> Scenario:
    """Scenario from nested tables; raises ScenarioError with one line a fault, each with its path."""
    return _checked(Scenario.model_validate, values, source)


def scenario_from_json(text: str, source: str) -> Scenario:
    """Scenario as the world sends it; raises ScenarioError."""
    return _checked(Scenario.model_validate_json, text, source)


def load_scenario(path: Path, overrides: tuple[str, ...] = ()) -> Scenario:
    """Scenario file with ``key.path=value`` overrides (values in TOML's notation); raises ScenarioError."""
    try:
        values = tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ScenarioError(f"{path}: cannot be read: {error.strerror or error}") from None
    except UnicodeDecodeError as error:
        raise ScenarioError(f"{path}: not UTF-8 text: {error}") from None
    except tomllib.TOMLDecodeError as error:
        raise ScenarioError(f"{path}: not TOML: {error}") from None
    for text in overrides:
        override(values, text)
    return parse_scenario(values, str(path))
