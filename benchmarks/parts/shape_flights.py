# SPDX-License-Identifier: Apache-2.0
"""Missions with perception by shape, complete, in one process, with rendered images.

The seed draws the errors of the target's geometry, of sensors and of images. A flight's line states
how it ended; the figures are the worst over flights, and times are CPU times of this process by
part.

Each sighting is compared with the true pose of the target in the true camera, of position and
rotation apart: ``sighting_*_nees``, the squared error over the stated covariance (3 expected); and
``sighting_*_correlation_*`` of the errors of one chaser at several lags, and of two chasers at one
tick (``cameras``): mean products of errors, as ratios to their mean square. Errors are whitened by
the stated covariance in the axes of TRF, and their mean is not subtracted.
"""

from __future__ import annotations

import itertools
import math
import sys
import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import msgspec
import numpy as np
from chaserdock_controller.interfaces import TickInputs, TickOutputs
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import GeometryEstimate, Image, PoseSolution, Sighting
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.physics.simulation import TARGET
from chaserdock_world.plant import true_geometry_errors
from chaserdock_world.rendering.cameras import States
from chaserdock_world.sensors.errors import true_camera
from common import Figures, Group, KeptResults, Options, described, seeds_of
from flights import load_shipped

from chaserdock.analysis.pose_errors import normalized_square, pose_covariance, pose_error
from chaserdock.experiments.in_process import InProcessMission, TickRecord
from chaserdock.experiments.perception import RenderedImages

SCENARIOS = {
    "docking": "markerless-docking",
    "capture": "markerless-capture",
    "inspection": "markerless-inspection",
}
QUICK = ("duration_s=20.0", "settling_s=10.0", "steady_until_s=20.0", "timeline=[]")
PROGRESS_S = 5.0
"""Time between lines of progress."""
LAGS_S = (0.0, 1.0, 5.0, 20.0)
"""Lags of the correlations; 0 stands for the next image."""
KINDS = {"position": slice(0, 3), "rotation": slice(3, 6)}
STEADY_RAD = math.radians(0.3)
"""Bar of the tracking error with that of 3 mm."""


class MarkerlessOutcome(msgspec.Struct, frozen=True):
    """How one flight ended, and what perception, estimate and computer did in it.

    ``steady_position_m``, ``steady_orientation_rad``: RMS tracking errors of the worst chaser in
    the steady interval. ``estimate_*``: of the target's estimate from its first sighting on, RMS
    and most; ``nees``: mean, 6 expected, and of position and rotation alone, 3 expected.
    ``seen_share``: of the images, by chaser. ``unseen_s``: longest time without a sighting after
    the first, by chaser. ``*_ms``: CPU time per tick by part; ``image_*_ms``: of the perception,
    per image. ``touch_m``, ``touch_deg``: at the latch. ``geometry_views``: views of an inspection;
    ``geometry_nees``: normalized squared error of its estimate per parameter, 1 expected.
    ``sightings``: figures of their errors.
    """

    seed: int
    cause: str
    success: bool
    time_s: float
    contacts: list[tuple[str, str]]
    steady_position_m: float
    steady_orientation_rad: float
    estimate_rms_m: float
    estimate_rms_rad: float
    estimate_max_m: float
    estimate_max_rad: float
    nees: float
    first_seen_s: list[float]
    seen_share: list[float]
    unseen_s: list[float]
    image_mean_ms: float
    image_p99_ms: float
    image_max_ms: float
    render_ms: float
    perception_ms: float
    controller_ms: float
    tick_ms: float
    nees_position: float = math.nan
    nees_rotation: float = math.nan
    geometry_views: int = 0
    geometry_nees: float | None = None
    touch_m: float | None = None
    touch_deg: float | None = None
    sightings: dict[str, float] = msgspec.field(default_factory=dict)
    retreats: list[str] = msgspec.field(default_factory=list)


def whitened_error(true_position_m: Array, true_q: Array, solution: PoseSolution) -> Array:
    """Return the error (6,) of a solution over its stated covariance, in the axes of TRF; true pose
    in IRF.
    """
    q = np.array(solution.q_wxyz)
    error = pose_error(true_position_m, true_q, np.array(solution.position_m), q)
    axes = np.eye(6)
    axes[:3, :3] = rotations.to_matrix(q).T
    covariance = axes @ np.reshape(solution.covariance, (6, 6)) @ axes.T
    error = axes @ error
    return np.concatenate(
        [np.linalg.solve(np.linalg.cholesky(covariance[k, k]), error[k]) for k in KINDS.values()],
        dtype=np.float64,
    )


class JudgedImages(RenderedImages):
    """Rendered images and the perceptions of the chasers, with the CPU times of both, and the
    whitened errors (6,) of all images by chaser, NaN without a pose.
    """

    def __init__(self, scenario: Scenario) -> None:
        super().__init__(scenario)
        self._true_cameras = [true_camera(scenario, i) for i in range(len(scenario.chasers))]
        self._truth: dict[int, tuple[Array, Array]] = {}
        self.errors: list[list[Array]] = [[] for _ in scenario.chasers]
        self.render_s: list[float] = []
        self.perception_s: list[float] = []
        self.seen: list[list[bool]] = [[] for _ in scenario.chasers]

    def image(self, chaser: int, tick: int, time_ns: int, states: States) -> Image:
        own, target = states[f"chaser/{chaser}"], states[TARGET]
        eye, attitude = self._true_cameras[chaser].irf_pose_in_world(own.position_m, own.q_wxyz)
        q = rotations.multiply(rotations.conjugate(attitude), target.q_wxyz)
        self._truth[chaser] = rotations.rotate_inverse(attitude, target.position_m - eye), q
        begin_s = time.process_time()
        image = super().image(chaser, tick, time_ns, states)
        self.render_s.append(time.process_time() - begin_s)
        return image

    def see(self, chaser: int, image: Image) -> Sighting:
        begin_s = time.process_time()
        sighting = super().see(chaser, image)
        self.perception_s.append(time.process_time() - begin_s)
        self.seen[chaser].append(sighting.status == "seen")
        single = len(sighting.solutions) == 1
        self.errors[chaser].append(
            whitened_error(*self._truth[chaser], sighting.solutions[0])
            if single
            else np.full(6, math.nan)
        )
        return sighting


def correlation(a: Array, b: Array) -> float:
    """Return the correlation of errors (images, 3) without subtracting their means; of images in
    which both are known.
    """
    both = np.isfinite(a[:, 0]) & np.isfinite(b[:, 0])
    a, b = a[both], b[both]
    return float(np.sum(a * b) / math.sqrt(np.sum(a * a) * np.sum(b * b)))


def sighting_figures(errors: Array, images_per_s: float) -> Figures:
    """Return the figures of the errors (chasers, images, 6) of one flight; correlations at lags
    shorter than half of it.
    """
    figures: Figures = {}
    for kind, part in KINDS.items():
        of_kind = errors[:, :, part]
        squares = np.sum(of_kind**2, axis=2)
        figures[f"{kind}_nees"] = float(np.nanmean(squares))
        for lag_s in LAGS_S:
            lag = max(1, round(lag_s * images_per_s))
            if 2 * lag > len(of_kind[0]):
                continue
            values = [correlation(e[:-lag], e[lag:]) for e in of_kind]
            figures[f"{kind}_correlation_{f'{lag_s:g}_s' if lag_s else 'next'}"] = float(
                np.mean(values)
            )
        pairs = [correlation(*pair) for pair in itertools.combinations(of_kind, 2)]
        figures[f"{kind}_correlation_cameras"] = float(np.mean(pairs))
    return figures


class TimedMission(InProcessMission):
    """Keeps the CPU times of its controller and the newest estimate of the geometry."""

    controller_s = 0.0
    geometry: GeometryEstimate | None = None

    def _control(self, inputs: TickInputs) -> TickOutputs | None:
        begin_s = time.process_time()
        outputs = super()._control(inputs)
        self.controller_s += time.process_time() - begin_s
        for wrench in outputs.wrenches.values() if outputs is not None else ():
            self.geometry = wrench.geometry or self.geometry
        return outputs


class EstimateError(NamedTuple):
    """Error of the target's estimate, and its normalized squares: of the pose, of position and of
    rotation alone.
    """

    position_m: float
    rotation_rad: float
    nees: float = math.nan
    nees_position: float = math.nan
    nees_rotation: float = math.nan


def estimate_error(record: TickRecord) -> EstimateError | None:
    """Return the error of the target's estimate; None before the first sighting."""
    estimate = record.outputs.target if record.outputs is not None else None
    if estimate is None or estimate.status == "none":
        return None
    truth = record.states[TARGET]
    known = np.array(estimate.position_m), np.array(estimate.q_wxyz)
    e = pose_error(truth.position_m, truth.q_wxyz, *known)
    error = EstimateError(float(np.linalg.norm(e[:3])), float(np.linalg.norm(e[3:])))
    if not len(estimate.covariance):
        return error
    covariance = pose_covariance(estimate.covariance)
    parts = (slice(0, 6), slice(0, 3), slice(3, 6))
    squares = [float(normalized_square(e[p], covariance[p, p])) for p in parts]
    return EstimateError(error.position_m, error.rotation_rad, *squares)


def fly(seed: int, scenario: Scenario) -> MarkerlessOutcome:
    """Fly one mission."""
    images = JudgedImages(scenario)
    capture, wanted = scenario.docking.kind == "capture", scenario.success.latched
    rows, errors, next_s = [], [], PROGRESS_S
    begin_s = time.process_time()
    with TimedMission(scenario, images) as flight:
        while flight.tick < scenario.ticks:
            record = flight.step()
            errors.append([record.tracking_errors[i] for i in flight.chasers])
            rows.append(estimate_error(record))
            phases = [flight.phase(i) for i in flight.chasers]
            if record.time_s >= next_s:
                next_s += PROGRESS_S
                print_progress(seed, record, images, rows[-1], phases)
            if capture and all(phases[i] == "verified" for i in wanted):
                break
        total_s = time.process_time() - begin_s
        return outcome(seed, flight, images, errors, rows, total_s)


def print_progress(
    seed: int,
    record: TickRecord,
    images: JudgedImages,
    error: EstimateError | None,
    phases: list[str],
) -> None:
    error = error or EstimateError(math.nan, math.nan)
    tracking = ", ".join(
        f"{phase} {1e3 * e[0]:.1f} mm {math.degrees(e[1]):.2f} deg"
        for phase, e in zip(phases, record.tracking_errors.values(), strict=True)
    )
    print(
        f"  {seed}: {record.time_s:.0f} s; estimate {1e3 * error.position_m:.2f} mm "
        f"{math.degrees(error.rotation_rad):.3f} deg, NEES {error.nees:.1f}; {tracking}; "
        f"perception {1e3 * np.mean(images.perception_s):.1f} ms, "
        f"most {1e3 * max(images.perception_s):.0f} ms",
        file=sys.stderr,
        flush=True,
    )


def longest_gap(seen: list[bool]) -> int:
    """Return the largest number of images in a row without a sighting, after the first one."""
    longest = now = 0
    for value in seen[seen.index(True) :] if True in seen else []:
        now = 0 if value else now + 1
        longest = max(longest, now)
    return longest


def outcome(
    seed: int,
    flight: TimedMission,
    images: JudgedImages,
    errors: list[list[tuple[float, float]]],
    rows: list[EstimateError | None],
    total_s: float,
) -> MarkerlessOutcome:
    scenario, capture = flight.scenario, flight.scenario.docking.kind == "capture"
    done = "verified" if capture else "docked"
    wanted = scenario.success.latched if capture else scenario.success.docked
    missing = [i for i in wanted if flight.phase(i) != done]
    tick_s = np.arange(len(errors)) / scenario.timing.rate_hz
    until_s = scenario.steady_until_s or scenario.duration_s
    late = (tick_s >= scenario.settling_s) & (tick_s <= until_s)
    steady = np.array(errors)[late] if late.any() else np.full((1, 1, 2), np.nan)
    rms = np.sqrt(np.mean(steady**2, axis=0)).max(axis=0)
    known = np.array([r for r in rows if r is not None] or [EstimateError(math.nan, math.nan)])
    retreats = [text for i in flight.chasers for text in flight.retreats(i)]
    touch = next((t for t in flight.touches if t.latched), None)
    if flight.contacts:
        cause = f"collision {sorted(flight.contacts)[0]}"
    elif missing:
        cause = f"not {done}: " + ", ".join(f"chaser {i} in {flight.phase(i)}" for i in missing)
    else:
        cause = done + (f" after {len(retreats)} retreats" if retreats else "")
    ticks, per_image = len(errors), 1e3 * np.array(images.perception_s)
    image_s = 1.0 / scenario.timing.rate_hz * scenario.timing.ticks_per_image
    return MarkerlessOutcome(
        seed=seed,
        cause=cause,
        success=not missing and not flight.contacts,
        time_s=flight.time_s,
        contacts=sorted(flight.contacts),
        steady_position_m=float(rms[0]),
        steady_orientation_rad=float(rms[1]),
        estimate_rms_m=float(np.sqrt(np.mean(known[:, 0] ** 2))),
        estimate_rms_rad=float(np.sqrt(np.mean(known[:, 1] ** 2))),
        estimate_max_m=float(known[:, 0].max()),
        estimate_max_rad=float(known[:, 1].max()),
        nees=float(np.nanmean(known[:, 2])),
        nees_position=float(np.nanmean(known[:, 3])),
        nees_rotation=float(np.nanmean(known[:, 4])),
        first_seen_s=[s.index(True) * image_s if True in s else math.inf for s in images.seen],
        seen_share=[float(np.mean(s)) for s in images.seen],
        unseen_s=[longest_gap(s) * image_s for s in images.seen],
        image_mean_ms=float(per_image.mean()),
        image_p99_ms=float(np.percentile(per_image, 99)),
        image_max_ms=float(per_image.max()),
        render_ms=1e3 * sum(images.render_s) / ticks,
        perception_ms=1e3 * sum(images.perception_s) / ticks,
        controller_ms=1e3 * flight.controller_s / ticks,
        tick_ms=1e3 * total_s / ticks,
        touch_m=None if touch is None else touch.lateral_m,
        touch_deg=None if touch is None else math.degrees(touch.angle_rad),
        sightings=sighting_figures(np.array(images.errors), 1.0 / image_s),
        retreats=retreats,
        geometry_views=0 if flight.geometry is None else flight.geometry.views,
        geometry_nees=None if flight.geometry is None else geometry_nees(scenario, flight.geometry),
    )


def geometry_nees(scenario: Scenario, estimate: GeometryEstimate) -> float:
    """Return the normalized squared error of estimated joints and scale, per parameter."""
    scale, turns = true_geometry_errors(scenario)
    known = {
        f"{joint} {axis}": turn[k] for joint, turn in turns.items() for k, axis in enumerate("xyz")
    }
    known["scale"] = scale
    at = [k for k, name in enumerate(estimate.names) if name in known]
    off = np.array([estimate.values[k] - known[estimate.names[k]] for k in at])
    covariance = np.array(estimate.covariance).reshape(len(estimate.names), -1)[np.ix_(at, at)]
    return float(off @ np.linalg.solve(covariance, off)) / len(at)


def line_of(o: MarkerlessOutcome) -> str:
    """Return one line for people."""
    text = (
        f"{o.cause} at {o.time_s:.1f} s; steady {1e3 * o.steady_position_m:.2f} mm "
        f"{math.degrees(o.steady_orientation_rad):.3f} deg; "
        f"estimate {1e3 * o.estimate_rms_m:.2f} mm {math.degrees(o.estimate_rms_rad):.3f} deg, "
        f"NEES {o.nees:.1f} (position {o.nees_position:.1f}, rotation {o.nees_rotation:.1f}); "
        f"{o.tick_ms:.0f} ms a tick"
    )
    if o.touch_m is not None and o.touch_deg is not None:
        text += f"; contact {1e3 * o.touch_m:.2f} mm {o.touch_deg:.2f} deg"
    if o.geometry_nees is not None:
        text += (
            f"; geometry from {o.geometry_views} views, NEES {o.geometry_nees:.2f} per parameter"
        )
    return text + "".join(f"; retreat: {reason}" for reason in o.retreats)


def fly_part(part: str, options: Options) -> Figures:
    """Fly five seeds of a mission (``--quick``: one, 20 s, which cannot dock)."""
    changes = (*options.set, *(QUICK if options.quick else ()))
    results = KeptResults(
        options.results, {"flight": part, "set": list(changes)}, MarkerlessOutcome
    )
    outcomes = results.of(
        seeds_of(options, 5, 1),
        lambda seed: fly(seed, load_shipped(SCENARIOS[part], f"seed={seed}", *changes)),
        line_of,
    )

    def worst(of: Callable[[MarkerlessOutcome], float]) -> float:
        return max(map(of, outcomes))

    steady = [
        o.steady_position_m <= 0.003 and o.steady_orientation_rad <= STEADY_RAD for o in outcomes
    ]
    return {
        f"{part}_flights": len(outcomes),
        f"{part}_succeeded": sum(o.success for o in outcomes),
        f"{part}_collisions": sum(bool(o.contacts) for o in outcomes),
        f"{part}_steady_within_bar": sum(steady),
        f"{part}_steady_position_rms_m": worst(lambda o: o.steady_position_m),
        f"{part}_steady_orientation_rms_rad": worst(lambda o: o.steady_orientation_rad),
        f"{part}_estimate_rms_m": worst(lambda o: o.estimate_rms_m),
        f"{part}_estimate_rms_rad": worst(lambda o: o.estimate_rms_rad),
        f"{part}_nees_mean": float(np.mean([o.nees for o in outcomes])),
        f"{part}_nees_position_mean": float(np.mean([o.nees_position for o in outcomes])),
        f"{part}_nees_rotation_mean": float(np.mean([o.nees_rotation for o in outcomes])),
        f"{part}_geometry_views": min(o.geometry_views for o in outcomes),
        f"{part}_first_seen_s": worst(lambda o: max(o.first_seen_s)),
        f"{part}_unseen_s": worst(lambda o: max(o.unseen_s)),
        f"{part}_image_mean_s": 1e-3 * float(np.mean([o.image_mean_ms for o in outcomes])),
        f"{part}_image_max_s": 1e-3 * worst(lambda o: o.image_max_ms),
        f"{part}_render_s_per_tick": 1e-3 * float(np.mean([o.render_ms for o in outcomes])),
        f"{part}_perception_s_per_tick": 1e-3 * float(np.mean([o.perception_ms for o in outcomes])),
        f"{part}_controller_s_per_tick": 1e-3 * float(np.mean([o.controller_ms for o in outcomes])),
        f"{part}_s_per_tick": 1e-3 * float(np.mean([o.tick_ms for o in outcomes])),
        **{
            f"{part}_sighting_{name}": float(np.mean([o.sightings[name] for o in outcomes]))
            for name in outcomes[0].sightings
            if all(name in o.sightings for o in outcomes)
        },
    }


GROUP = Group(
    {
        f"flight-{name}": described(
            partial(fly_part, name), f"Fly {scenario}: outcome, accuracy, errors of sightings."
        )
        for name, scenario in SCENARIOS.items()
    },
    ("flights", "first", "set", "results"),
)
