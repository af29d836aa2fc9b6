# SPDX-License-Identifier: Apache-2.0
"""Typed form of a flight's summary; docs/summary.md describes the fields. SI units and radians."""

from __future__ import annotations

from html import escape
from typing import Any, Literal

import msgspec
from chaserdock_protocol.messages import DrawnBody
from msgspec import Struct

from .criterion import Criterion
from .verdict import Verdict, verdict_of


class SteadyErrors(Struct, frozen=True, kw_only=True):
    """Mean square tracking errors after the settling time; None if the flight has no such part."""

    position_mse_m2: float | None
    orientation_mse_rad2: float | None


class PortLoadPeaks(Struct, frozen=True, kw_only=True):
    """Largest loads at a chaser's port over all physics steps.

    ``closing_impulse_N_s``: largest impulse in a tick in which a latch closed.
    ``limit_exceeded_s``: end of the first tick with a load beyond the port's limits, or None.
    """

    peak_force_N: float
    peak_torque_N_m: float
    peak_axial_N: float
    peak_shear_N: float
    peak_bending_N_m: float
    closing_impulse_N_s: float
    limit_exceeded_s: float | None = None


class Capture(Struct, frozen=True, kw_only=True):
    """Docking by contact of one chaser. The figures at contact are None without a latch."""

    latched: bool
    verified: bool
    latch_time_s: float | None
    contact_lateral_m: float | None
    contact_angle_rad: float | None
    contact_closing_m_s: float | None
    contact_lateral_speed_m_s: float | None
    probe_touches: int
    refused: list[str]
    port_load: PortLoadPeaks | None = None


class PassiveSafetySummary(Struct, frozen=True, kw_only=True):
    """Passive safety of a chaser's plans: smallest margin of the coasts after a loss of thrust,
    when it occurred, closest approach of that coast, and share of the plans that were safe.
    """

    min_margin_sigmas: float
    min_margin_time_s: float
    distance_m: float
    safe_share: float


class AssuranceSummary(Struct, frozen=True, kw_only=True):
    """Commands of a chaser that its assurance changed, those among them that it replaced by the
    backup, how many by hazard, and the least room (m) to a surface that must not be crossed.
    """

    changed: int
    backup: int
    hazards: dict[str, int]
    least_room_m: float | None


class RendezvousFigures(Struct, frozen=True, kw_only=True):
    """Quantities that the criteria of a published task judge: least margin to the speed limit;
    largest angle from the cone's axis; arrival; first abort, with the least half edge of a cube
    about the target that the chaser touched afterwards. None if the flight has no such part.
    """

    speed_margin_m_s: float | None
    cone_angle_rad: float | None
    arrived_s: float | None
    arrived_speed_m_s: float | None
    abort_s: float | None
    abort_clear_m: float | None


class PoseEstimateErrors(Struct, frozen=True, kw_only=True):
    """Errors of an estimated pose after the settling time, and the mean NEES (6 expected); None
    without an estimate there.
    """

    position_rms_m: float | None
    orientation_rms_rad: float | None
    max_position_error_m: float | None
    max_orientation_error_rad: float | None
    nees_mean: float | None


class EstimatedTracking(Struct, frozen=True, kw_only=True):
    """RMS distance and angle of a chaser's odometry from its reference pose on the estimated target
    after the settling time; None if the flight has no such part.
    """

    position_rms_m: float | None
    orientation_rms_rad: float | None


class SightingCount(Struct, frozen=True, kw_only=True):
    """Sightings that the estimator used, and that it rejected because their innovation does not fit
    its covariance.
    """

    used: int
    rejected: int


class InnovationFigures(Struct, frozen=True, kw_only=True):
    """Innovations of a chaser's sightings after the settling time: how many were used and rejected,
    the mean of their normalized square per degree of freedom (1 for white errors as stated), and
    the share of all above the 95 % band (0.025); None without any.
    """

    used: int
    rejected: int
    mean_per_freedom: float | None
    rejected_mean_per_freedom: float | None
    above_share: float | None


class ChaserSummary(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """Results of one chaser, measured on ground truth or on a reference; what is measured on poses
    is None without either.
    """

    position_mse_m2: float | None
    orientation_mse_rad2: float | None
    steady: SteadyErrors
    docked: bool | None
    dock_time_s: float | None
    reached_time_s: float | None
    min_distance_target_m: float | None
    impulse_N_s: float
    thruster_impulse_N_s: float
    propellant_kg: float
    relative_estimate: PoseEstimateErrors | None = None
    capture: Capture | None = None
    passive_safety: PassiveSafetySummary | None = None
    assurance: AssuranceSummary | None = None
    rendezvous: RendezvousFigures | None = None
    estimated_tracking: EstimatedTracking | None = None
    sightings: SightingCount | None = None
    innovations: InnovationFigures | None = None


class TargetEstimateErrors(PoseEstimateErrors, frozen=True, kw_only=True):
    """Errors of the target estimate after the settling time; None without an estimate there.

    ``max_orientation_error_at_s``: time of the largest one; None in summaries of earlier versions.
    """

    velocity_rms_m_s: float | None
    omega_rms_rad_s: float | None
    max_orientation_error_at_s: float | None = None


class StackRest(Struct, frozen=True, kw_only=True):
    """Final rates of the target with its latched chasers, and since when they are within
    ``success.detumbled``.
    """

    speed_m_s: float
    rate_rad_s: float
    since_s: float | None


class MappingFigures(Struct, frozen=True, kw_only=True):
    """What the maps of a target of unknown shape show: status at the end, number of maps, time of
    the first one, figures of the last one, and time of the first one whose loop has closed. None
    without a map, or without ground truth.
    """

    status: str
    maps: int
    first_map_s: float | None
    first_rate_error_share: float | None
    rate_error_share: float | None
    scale_sigma_share: float | None
    landmarks: int
    residual_px: float | None
    closed_s: float | None = None


class Latency(Struct, frozen=True, kw_only=True):
    """Wall time from the publication of an image to the actuator command of the same tick."""

    p50: float | None
    p99: float | None
    max: float | None


class SolveTimes(Struct, frozen=True, kw_only=True):
    """Wall time of the solver per tick."""

    p50: float | None
    p95: float | None
    max: float | None


class Solver(Struct, frozen=True, kw_only=True):
    """The NMPC solver: its name, solve times, failures, and plans with a relaxed keep-out
    constraint.
    """

    name: str
    solve_s: SolveTimes
    failures: int
    relaxed: int


class TimedEvent(Struct, frozen=True, kw_only=True):
    """An event, a warning, or a command with its reply."""

    time_s: float
    what: str


class MessageCount(Struct, frozen=True, kw_only=True):
    """Messages of one key in the log, and gaps in their numbering."""

    count: int
    lost: int


class PlumeSummary(Struct, frozen=True, kw_only=True):
    """Impulses of thruster plumes on a body: sums of their magnitudes per tick, and the largest
    force.
    """

    impulse_N_s: float
    angular_impulse_N_m_s: float
    peak_force_N: float


class Summary(Struct, frozen=True, kw_only=True, omit_defaults=True):
    """The summary of a flight, as in summary.json; ``chasers`` by chaser number."""

    scenario: str
    seed: int
    mode: str
    ticks: int
    sim_time_s: float
    wall_time_s: float
    success: bool
    failures: list[str]
    not_judged: list[str]
    criteria: list[Criterion] = []
    doubts: list[str] = []
    ended: str = ""
    log_lacks: list[str] = []
    judged_against: str = ""
    impulses_are: Literal["true", "commanded"] = "true"
    run_failure: str | None = None
    events: list[TimedEvent]
    chasers: dict[int, ChaserSummary]
    min_distance_chasers_m: float | None
    collisions: int | None
    target_estimate: TargetEstimateErrors
    latency_s: Latency
    late_commands: int | None
    unanswered: int
    solver: Solver
    messages: dict[str, MessageCount]
    rejected: dict[str, int]
    digest: str
    peak_memory_bytes: int | None = None
    cpu_s: dict[str, float] | None = None
    drawn: list[DrawnBody] = []
    stack: StackRest | None = None
    mapping: MappingFigures | None = None
    plumes: dict[str, PlumeSummary] = {}

    @property
    def verdict(self) -> Verdict:
        """Return the verdict with all that qualifies it."""
        return verdict_of(self.as_dict())

    def as_dict(self) -> dict[str, Any]:
        """Return the content of a summary.json."""
        return msgspec.to_builtins(self, str_keys=True)

    def __repr__(self) -> str:
        head = f"{self.scenario}, seed {self.seed}: {self.verdict.headline}"
        return "\n".join([head, *(f"  {line}" for line in self.verdict.lines())])

    def _repr_html_(self) -> str:
        """Return what a notebook shows."""
        head = f"<b>{escape(self.scenario)}</b>, seed {self.seed}: {self.verdict.badge()}"
        return f"<p>{head}</p>{self.verdict.html()}"

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> Summary:
        """Return the typed form of the content of a summary.json."""
        return msgspec.convert(values, cls, str_keys=True)
