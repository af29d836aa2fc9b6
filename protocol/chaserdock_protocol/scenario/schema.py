"""The scenario file: TOML, every value checked, every error with its path and what would be right.

Names are snake_case with their unit at the end; frames as everywhere: WRF world, CRF chaser, TRF target.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.camera import Camera
from chaserdock_models.clock import Timing
from chaserdock_models.docking_geometry import axis_error_deg, centre_offset
from chaserdock_models.targets import TargetModel
from pydantic import AfterValidator, Field, ValidationError, model_validator

from chaserdock_protocol import plugins

from .bodies import Body, Target
from .camera import CameraSection
from .checks import check_apart, check_references
from .docking import Docking
from .faults import Fault, check_faults
from .fields import Name, NotNegative, Positive, Section, UnitQuaternion, Vector, finite
from .files import read_toml, resolve_files
from .migrations import FORMAT, old_keys
from .odometry import OdometrySection
from .overrides import ScenarioError, explain, override
from .thrusters import ThrusterFailure, check_pulses


class Time(Section):
    """Rates and latencies of simulated time."""

    rate_hz: Annotated[int, Field(ge=1, le=240)] = 15
    image_hz: Annotated[int, Field(ge=1, le=240)] = 15
    physics_hz: Annotated[int, Field(ge=60, le=20000)] = 960
    latency_s: NotNegative = 1.0 / 30.0

    @model_validator(mode="after")
    def _divide(self) -> Time:
        if self.physics_hz % self.rate_hz:
            raise ValueError(f"physics_hz must be a multiple of rate_hz ({self.physics_hz}, {self.rate_hz})")
        if self.rate_hz % self.image_hz:
            raise ValueError(f"rate_hz must be a multiple of image_hz ({self.rate_hz}, {self.image_hz})")
        return self


class EstimatorSection(Section):
    """How sightings become the target's odometry; the numbers are ``mekf``'s.

    ``camera_bias_*``: one sigma of each camera's own calibration error (place of the lens, mounting, focal length),
    which is then estimated. 0: the cameras are as calibrated, which is so in the world's images.
    """

    name: Name = "mekf"
    camera_bias_position_m: NotNegative = 0.0
    camera_bias_attitude_deg: NotNegative = 0.0
    camera_bias_focal_share: NotNegative = 0.0

    @property
    def estimates_cameras(self) -> bool:
        """Whether the cameras' calibration errors are estimated."""
        told = (self.camera_bias_position_m, self.camera_bias_attitude_deg, self.camera_bias_focal_share)
        return self.name == "mekf" and any(told)


class PerceptionSection(Section):
    """How an image becomes a pose."""

    name: Name = "default"


PERCEPTIONS = ("default", "paper")
ESTIMATORS = ("mekf", "paper")
SOLVERS = ("rti", "ipopt", "fatrop", "alpaqa", "open")
"""Chaserdock's own parts, by the name that a scenario chooses them with; others may be installed (see ``plugins``)."""

MAX_STAGES = 500
"""Most prediction steps of a plan; more could not be solved in time, and messages bound their size."""


MAX_DURATION_S = 90 * 86_400.0
"""Longest mission: messages count simulated time in nanoseconds up to 2**53 (see ``message_fields``)."""


class Controller(Section):
    """The NMPC: solver, horizon, weights (the paper's names in docs/controller.md).

    ``max_iterations`` bounds a solve, in iterations as the solver counts them, so that it flies the same anywhere.
    ``solve_budget_s``, wall time, bounds it in real time alone, by as many iterations as have been found to fit.
    ``standby``: a second controller flies along, ready to take over (docs/redundancy.md).
    """

    standby: bool = False
    solver: Name = "rti"
    max_iterations: Annotated[int, Field(ge=0)] | None = None
    solve_budget_s: Positive | None = None
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
    def _budget(self) -> Controller:
        if self.solve_budget_s is not None and self.solver in SOLVERS[1:]:
            raise ValueError(
                f"solve_budget_s goes with the solver rti; {self.solver} cannot be held to a time"
            )
        return self

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
    command: Literal["approach", "hold", "retreat", "abort", "goto", "calibrate", "isolate", "restore"]
    chasers: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)]
    offset_m: Vector | None = None
    thruster: Annotated[int, Field(ge=0, le=254)] | None = None

    @model_validator(mode="after")
    def _goto(self) -> TimelineEntry:
        if (self.command == "goto") != (self.offset_m is not None):
            raise ValueError("offset_m goes with the command goto, and goto needs it")
        if (self.command in ("isolate", "restore")) != (self.thruster is not None):
            raise ValueError("thruster goes with the commands isolate and restore, and these need it")
        return self


class Success(Section):
    """What makes a run a success, judged on ground truth; what is left out is not asked.

    ``reached``: chasers that at the end are where their last ``goto`` of the time line sent them, to
    ``reached_position_m``, and have been since ``reached_within_s`` after that command at the latest.
    """

    docked: tuple[Annotated[int, Field(ge=0)], ...] = ()
    reached: tuple[Annotated[int, Field(ge=0)], ...] = ()
    reached_position_m: Positive = 0.02
    reached_within_s: Positive | None = None
    latched: tuple[Annotated[int, Field(ge=0)], ...] = ()
    max_collisions: Annotated[int, Field(ge=0)] = 0
    keep_distances: bool = True
    steady_position_rms_m: Positive | None = None
    steady_orientation_rms_deg: Positive | None = None
    max_estimate_position_m: Positive | None = None
    max_estimate_orientation_deg: Positive | None = None


class Scenario(Section):
    """A whole mission, resolved: what every process gets from the world."""

    format: Literal[2] = FORMAT
    name: Name
    description: str = ""
    duration_s: Annotated[Positive, Field(le=MAX_DURATION_S)]
    settling_s: NotNegative = 20.0
    steady_until_s: Positive | None = None
    seed: Annotated[int, Field(ge=0, lt=2**32)] = 0
    time: Time = Time()
    target: Target = Target()
    chaser: Body = Body()
    camera: CameraSection = CameraSection()
    odometry: OdometrySection = OdometrySection()
    perception: PerceptionSection = PerceptionSection()
    estimator: EstimatorSection = EstimatorSection()
    controller: Controller = Controller()
    limits: Limits = Limits()
    approach: Approach = Approach()
    docking: Docking = Docking()
    chasers: Annotated[tuple[Chaser, ...], Field(min_length=1, max_length=16)]
    timeline: tuple[TimelineEntry, ...] = ()
    thruster_failure: tuple[ThrusterFailure, ...] = ()
    fault: Annotated[tuple[Fault, ...], Field(max_length=100)] = ()
    success: Success = Success()

    @model_validator(mode="after")
    def _consistent(self) -> Scenario:
        check_apart(self)
        check_references(self)
        if (
            self.target.geometry is not None
            and self.target.geometry.mesh
            and self.camera.renderer != "pybullet"
        ):
            raise ValueError('target.geometry.mesh: is drawn by camera.renderer = "pybullet" alone')
        named = [(f"timeline.{i}.chasers", entry.chasers) for i, entry in enumerate(self.timeline)]
        last = len(self.chasers) - 1
        named += [(f"docking.ports.{i}.chaser", (port.chaser,)) for i, port in enumerate(self.docking.ports)]
        judged = [
            (f"success.{what}", getattr(self.success, what)) for what in ("docked", "latched", "reached")
        ]
        for where, chasers in (*named, *judged):
            if max(chasers, default=0) > last:
                raise ValueError(f"{where}: there is no chaser {max(chasers)}; this mission has 0 to {last}")
        for i in self.success.reached:
            if self.goal_of(i) is None:
                raise ValueError(f"success.reached: no goto of the timeline names chaser {i}")
        if self.chaser.actuation == "thrusters":
            check_pulses(self.chaser.thrusters, self.chaser.modulation, self.time.physics_hz)
        _check_failures(self)
        _check_ports(self)
        check_faults(self.fault, self)
        return self

    def goal_of(self, chaser: int) -> tuple[float, Vector] | None:
        """When (s) and whereto (TRF, m) the last ``goto`` of the time line sends a chaser, if one does."""
        sent = [(e.at_s, e.offset_m) for e in self.timeline if chaser in e.chasers and e.offset_m is not None]
        return max(sent, key=lambda entry: entry[0], default=None)

    @property
    def timing(self) -> Timing:
        return Timing(
            physics_hz=self.time.physics_hz,
            rate_hz=self.time.rate_hz,
            image_hz=self.time.image_hz,
            latency_steps=round(self.time.latency_s * self.time.physics_hz),
        )

    def camera_model(self) -> Camera:
        """The chasers' camera, as perception and fusion know it."""
        return self.camera.model()

    def target_model(self) -> TargetModel:
        """Geometry and markers of the target."""
        return self.target.shape()

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


def _check_failures(scenario: Scenario) -> None:
    """Thrusters fail in this mission only where there are some."""
    chasers, thrusters = len(scenario.chasers), len(scenario.chaser.thrusters)
    if scenario.thruster_failure and scenario.chaser.actuation != "thrusters":
        raise ValueError('thruster_failure: thrusters fail only with chaser.actuation = "thrusters"')
    for k, failure in enumerate(scenario.thruster_failure):
        if failure.chaser >= chasers:
            raise ValueError(
                f"thruster_failure.{k}.chaser: there is no chaser {failure.chaser}; this mission has 0 to {chasers - 1}"
            )
        if failure.thruster >= thrusters:
            raise ValueError(
                f"thruster_failure.{k}.thruster: there is no thruster {failure.thruster}; the body has 0 to {thrusters - 1}"
            )
        if any(
            (f.chaser, f.thruster) == (failure.chaser, failure.thruster)
            for f in scenario.thruster_failure[:k]
        ):
            raise ValueError(
                f"thruster_failure.{k}: thruster {failure.thruster} of chaser {failure.chaser} fails twice"
            )


def _check_ports(scenario: Scenario) -> None:
    docking = scenario.docking
    for i in scenario.success.latched:
        if docking.port_of(i) is None:
            raise ValueError(
                f"success.latched: chaser {i} has no port; see docking.kind and [[docking.ports]]"
            )
    if docking.kind != "capture":
        return
    if scenario.target.motion != "torque_free":
        raise ValueError(
            f"target.motion: docking by capture needs torque_free, a target that feels it, not {scenario.target.motion}"
        )
    if scenario.chaser.probe_reach_m <= scenario.chaser.size_m[0] / 2:
        raise ValueError("chaser.probe_reach_m: the probe must reach beyond the body's front")
    for k, port in enumerate(docking.ports):
        entry = centre_offset(port, scenario.chaser.probe_reach_m, docking.entry_m)
        nearest_m = scenario.limits.min_distance_target_m
        if math.hypot(*entry) <= nearest_m:
            raise ValueError(
                f"docking.ports.{k}: its corridor begins {math.hypot(*entry):.3g} m from the target's centre, inside "
                f"limits.min_distance_target_m ({nearest_m:g} m); make docking.entry_m longer"
            )
        off_deg = axis_error_deg(port, np.asarray(scenario.chasers[port.chaser].q_wxyz))
        if off_deg > 0.1:
            raise ValueError(
                f"docking.ports.{k}.axis: chaser {port.chaser} looks along its +X {off_deg:.3g} degrees off the "
                "axis into the port; turn chasers.q_wxyz or the axis"
            )


def _checked(validate: Callable[[Any], Scenario], values: Any, source: str) -> Scenario:
    try:
        return validate(values)
    except ValidationError as error:
        raise ScenarioError("\n".join(f"{source}: {line}" for line in explain(error))) from None


def parse_scenario(values: dict[str, Any], source: str) -> Scenario:
    """Scenario from nested tables; raises ScenarioError with one line a fault, each with its path."""
    if old := old_keys(values):
        raise ScenarioError("\n".join(f"{source}: {line}" for line in old))
    return _checked(Scenario.model_validate, values, source)


def scenario_from_json(text: str, source: str) -> Scenario:
    """Scenario as the world sends it; raises ScenarioError."""
    return _checked(Scenario.model_validate_json, text, source)


def _require_parts(scenario: Scenario, source: str) -> None:
    parts: tuple[tuple[plugins.Kind, str, str, tuple[str, ...]], ...] = (
        ("perception", "perception.name", scenario.perception.name, PERCEPTIONS),
        ("estimator", "estimator.name", scenario.estimator.name, ESTIMATORS),
        ("solver", "controller.solver", scenario.controller.solver, SOLVERS),
    )
    for kind, path, name, own in parts:
        try:
            plugins.require(kind, name, own)
        except plugins.PluginError as error:
            raise ScenarioError(f"{source}: {path}: {error}") from None


def load_scenario(path: Path, overrides: tuple[str, ...] = ()) -> Scenario:
    """Scenario file with ``key.path=value`` overrides (values in TOML's notation); raises ScenarioError.

    Files it names lie relative to it; those that an override names, to the working directory. The parts that it names
    have to be installed here; a scenario from the world or a log may name what is not.
    """
    values = read_toml(path)
    resolve_files(values, path.parent)
    for text in overrides:
        override(values, text, lambda: parse_scenario(values, str(path)).model_dump(mode="json"))
    resolve_files(values, Path())
    scenario = parse_scenario(values, str(path))
    _require_parts(scenario, str(path))
    return scenario
