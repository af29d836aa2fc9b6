# SPDX-License-Identifier: Apache-2.0
"""Target estimation with rendered images, in flights with all image effects: mean and worst figures
over the seeds.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import islice
from typing import Any

import msgspec
import numpy as np
from chaserdock_agents.chaser.perception import make_perception
from chaserdock_agents.chaser.sighting import look
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.interfaces import ChaserInputs, TickInputs, TickOutputs
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import Image, Sighting, TargetEstimate
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.physics.simulation import BodyState
from chaserdock_world.sensors.errors import true_camera
from common import Figures, Group, KeptResults, Options, described, seeds_of

from chaserdock.analysis.pose_errors import normalized_square, pose_covariance, pose_error
from chaserdock.experiments.in_process import InProcessMission, TickRecord
from chaserdock.experiments.perception import RenderedImages, States

Row = dict[str, Any]
SIDES = (((-1.0, 0.0, 0.0), 0.0), ((0.0, -1.0, 0.0), 90.0), ((1.0, 0.0, 0.0), 180.0))
"""Reference positions (TRF, m) of the chasers, and the yaw (degrees) with which each faces the
target.
"""
SETTLED_S = 6.0
"""From here on the estimate counts as settled."""


def scenario_of(target: str, number: int, seed: int, duration_s: float, **more: Any) -> Scenario:
    """Return a scenario with all image effects; sun, target attitude and starts are drawn from the
    seed.
    """
    rng = np.random.default_rng([seed, 4])
    sun = rotations.rotate(
        rotations.exp([0.0, 0.0, rng.uniform(-math.pi, math.pi)]),
        [1.0, 0.0, rng.uniform(-0.6, 0.9)],
    )
    flying = []
    for position, yaw_deg in SIDES[:number]:
        flying.append(
            {
                "position_m": position,
                "q_wxyz": tuple(rotations.exp([0.0, 0.0, math.radians(yaw_deg)]).tolist()),
                "start_offset_m": tuple((0.1 * rng.uniform(-1.0, 1.0, 3)).tolist()),
                "start_rotation_rad": tuple((0.08 * rng.uniform(-1.0, 1.0, 3)).tolist()),
            }
        )
    return Scenario.model_validate(
        {
            "name": f"estimation-{target}-{number}",
            "duration_s": duration_s,
            "settling_s": 0.0,
            "seed": seed,
            "navigation": {"grade": "exact"},
            "target": {
                "model": target,
                "q_wxyz": tuple(rotations.exp(rng.uniform(-0.2, 0.2, 3)).tolist()),
            },
            "camera": {
                "sun_direction": tuple(sun.tolist()),
                "ambient": 0.25,
                "earth": {"direction": (0.25, 0.5, -0.83), "radius_deg": 64.0},
                "intrinsics": {
                    "width_px": 1280, "height_px": 720,
                    "fx_px": 1105.0, "fy_px": 1107.0, "cx_px": 644.2, "cy_px": 356.8,
                    "distortion": (-0.18, 0.05, 0.0006, -0.0004, 0.0),
                },
                "effects": {"exposure_s": 0.003, "glare": 500.0},
            },
            "chasers": flying,
        }
        | more
    )  # fmt: skip


@dataclass
class EstimatorErrors:
    """An estimator's errors against ground truth, one value a tick.

    ``nees``: of the pose, 6 expected. ``inside``: share of its six components inside 3 sigma.
    """

    time_s: list[float] = field(default_factory=list)
    position_m: list[float] = field(default_factory=list)
    angle_rad: list[float] = field(default_factory=list)
    velocity_m_s: list[float] = field(default_factory=list)
    omega_rad_s: list[float] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    inside: list[float] = field(default_factory=list)
    status: list[str] = field(default_factory=list)

    def add(self, now_s: float, message: TargetEstimate, truth: BodyState) -> None:
        """Append one estimate."""
        covariance = pose_covariance(message.covariance)
        known = np.array(message.position_m), np.array(message.q_wxyz)
        pose = pose_error(truth.position_m, truth.q_wxyz, *known)
        self.time_s.append(now_s)
        self.position_m.append(float(np.linalg.norm(pose[:3])))
        self.angle_rad.append(float(np.linalg.norm(pose[3:])))
        self.velocity_m_s.append(float(np.linalg.norm(truth.velocity_m_s - message.velocity_m_s)))
        self.omega_rad_s.append(float(np.linalg.norm(truth.omega_rad_s - message.omega_rad_s)))
        self.nees.append(float(normalized_square(pose, covariance)))
        self.inside.append(float(np.mean(np.abs(pose) <= 3.0 * np.sqrt(np.diag(covariance)))))
        self.status.append(message.status)

    def array(self, name: str, from_s: float = 0.0, to_s: float = np.inf) -> Array:
        """Return one of the lists over a time span."""
        t = np.array(self.time_s)
        return np.array(getattr(self, name))[(t >= from_s - 1e-9) & (t < to_s)]

    def largest(self, name: str, from_s: float) -> float:
        """Return the largest value of a list from a time on, while there is an estimate."""
        known = self.array("status", from_s) != "none"
        return float(self.array(name, from_s)[known].max())

    def rms(self, name: str, from_s: float = 0.0, to_s: float = np.inf) -> float:
        """Return the root mean square of a list over a time span."""
        return float(np.sqrt(np.mean(np.square(self.array(name, from_s, to_s)))))


@dataclass
class EstimationFlight:
    """What a flight shows of its estimator.

    ``estimates``: its errors; ``parallel``: those of the estimators beside it, by name.
    ``tracking``: (time s, m, rad) of all chasers. ``events``: (time s, level, text).
    ``detections``: whether each image had one, by chaser. ``last``: outputs of the last tick.
    """

    estimates: EstimatorErrors
    parallel: dict[str, EstimatorErrors]
    tracking: list[tuple[float, float, float]]
    events: list[tuple[float, str, str]]
    detections: dict[int, list[bool]]
    last: TickOutputs
    reinitialisations: int

    def tracking_rms(self, from_s: float) -> tuple[float, float]:
        """Return the RMS tracking errors (m, rad) of all chasers from a time on."""
        errors = np.array([(m, rad) for time_s, m, rad in self.tracking if time_s >= from_s])
        m, rad = np.sqrt(np.mean(errors**2, axis=0)).tolist()
        return m, rad


class ParallelEstimator:
    """Perception and estimator of another scenario on the images of a flight, without influence on
    it.
    """

    def __init__(self, scenario: Scenario, own_perception: bool) -> None:
        self.errors = EstimatorErrors()
        self._perceptions = (
            [make_perception(scenario) for _ in scenario.chasers] if own_perception else []
        )
        self._core = ControllerCore(scenario, time.perf_counter)

    def update(self, record: TickRecord, images: dict[int, Image]) -> None:
        """Estimate the target from a tick's images and odometry."""
        sightings = record.sightings
        if self._perceptions and sightings:
            sightings = tuple(
                look(self._perceptions[i], image, None) for i, image in images.items()
            )
        received = tuple(ChaserInputs(i, odometry) for i, odometry in record.odometry.items())
        inputs = TickInputs(record.tick, record.time_ns, received, sightings)
        estimate = self._core.estimate(inputs)
        self.errors.add(record.time_s, estimate, record.states["target"])


def fly(
    scenario: Scenario,
    parallel: Mapping[str, Scenario] | None = None,
    on_image: Callable[[Image], Image] = lambda image: image,
    on_sighting: Callable[[Sighting], Sighting] = lambda sighting: sighting,
    until: Callable[[EstimatorErrors], bool] = lambda errors: False,
) -> EstimationFlight:
    """Fly a scenario with rendered images to its end, or ``until`` the errors so far satisfy a
    condition.

    ``on_image`` changes an image before perception, ``on_sighting`` what a chaser reports of it.
    """
    images: dict[int, Image] = {}

    def keep_image(image: Image) -> Image:
        images[image.chaser] = on_image(image)
        return images[image.chaser]

    rendered = RenderedImages(scenario, keep_image)

    def perception(chaser: int, tick: int, time_ns: int, states: States) -> Sighting:
        return on_sighting(rendered(chaser, tick, time_ns, states))

    estimators = {
        name: ParallelEstimator(s, own_perception=s.perception.name != scenario.perception.name)
        for name, s in (parallel or {}).items()
    }
    errors, tracking = EstimatorErrors(), []
    detections: dict[int, list[bool]] = {i: [] for i in range(len(scenario.chasers))}
    outputs: TickOutputs | None = None
    with InProcessMission(scenario, perception) as mission:
        for record in mission.ticks():
            outputs = record.outputs
            assert outputs is not None
            errors.add(record.time_s, outputs.target, record.states["target"])
            for estimator in estimators.values():
                estimator.update(record, images)
            for sighting in record.sightings:
                detections[sighting.chaser].append(bool(sighting.solutions))
            tracking += [(record.time_s, *record.tracking_errors[i]) for i in outputs.references]
            if until(errors):
                break
        assert outputs is not None
        return EstimationFlight(
            errors,
            {name: estimator.errors for name, estimator in estimators.items()},
            tracking,
            mission.events,
            detections,
            outputs,
            mission.controller.estimator.reinitialisations,
        )


def changed(scenario: Scenario, **sections: Any) -> Scenario:
    """Return a scenario with some fields replaced and validated; dictionaries are merged into their
    sections.
    """
    values = scenario.model_dump()
    for name, value in sections.items():
        merge = isinstance(value, dict) and isinstance(values[name], dict)
        values[name] = values[name] | value if merge else value
    return Scenario.model_validate(values)


ERRORS = {
    "camera_focal_share": 1e-3,
    "camera_centre_px": 0.5,
    "camera_turn_deg": 0.3,
    "camera_shift_m": 5e-4,
}
"""Calibration errors of a camera, one sigma."""
HEAVY = {
    "exposure_s": 0.003,
    "glare": 500.0,
    "read_noise": 4.0,
    "shot_noise": 0.08,
    "point_spread_px": 0.9,
    "jpeg_quality": 75,
}
"""Image effects beyond the defaults."""


def with_errors(scenario: Scenario) -> Scenario:
    """Return the scenario with calibration errors and heavy noise, whose sigmas the filter has as
    parameters.
    """
    return changed(scenario, camera={"effects": HEAVY}, navigation=ERRORS)


def figures(flown: EstimationFlight, from_s: float) -> Row:
    """Return the figures of a flight: RMS from ``from_s`` on, maxima from 1 s on."""
    e = flown.estimates
    m, rad = flown.tracking_rms(from_s)
    row: Row = {
        "estimate_position_rms_m": e.rms("position_m", from_s),
        "estimate_angle_rms_rad": e.rms("angle_rad", from_s),
        "estimate_angle_max_rad": e.largest("angle_rad", 1.0),
        "estimate_position_max_m": e.largest("position_m", 1.0),
        "nees": float(e.array("nees", from_s).mean()),
        "inside_3_sigma": float(e.array("inside", from_s).mean()),
        "tracking_position_rms_m": m,
        "tracking_angle_rms_rad": rad,
        "reinitializations": flown.reinitialisations,
        "detected": float(np.mean([v for each in flown.detections.values() for v in each])),
        "events": [f"{t:.2f} {text}" for t, _, text in flown.events][:40],
    }
    for name, other in flown.parallel.items():
        row[f"{name}_position_rms_m"] = other.rms("position_m", from_s)
        row[f"{name}_angle_rms_rad"] = other.rms("angle_rad", from_s)
        row[f"{name}_angle_max_rad"] = other.largest("angle_rad", 1.0)
    return row


def paper_of(scenario: Scenario) -> dict[str, Scenario]:
    """Return the scenario of a parallel estimator with the paper's perception and estimator."""
    return {"paper": changed(scenario, perception={"name": "paper"}, estimator={"name": "paper"})}


def exact(target: str, chasers: int, seed: int) -> Row:
    """Fly with cameras as calibrated."""
    scenario = scenario_of(target, chasers, seed, 12.0)
    return figures(fly(scenario, paper_of(scenario)), SETTLED_S)


def errors(target: str, chasers: int, seed: int) -> Row:
    """Fly with errors; ``naive`` is the same filter with zero calibration sigmas."""
    scenario = with_errors(scenario_of(target, chasers, seed, 12.0))
    naive = changed(scenario, navigation=dict.fromkeys(ERRORS, 0.0))
    return figures(fly(scenario, {"naive": naive}), SETTLED_S)


def calibrate(target: str, seed: int) -> Row:
    """Fly one chaser with a mounting error of 0.3 degrees (one sigma, each axis); it calibrates
    from 5 s on, for 30 s.
    """
    scenario = scenario_of(target, 1, seed, 46.0)
    scenario = changed(
        scenario,
        navigation={"camera_turn_deg": 0.3},
        timeline=[{"at_s": 5.0, "command": "calibrate", "chasers": (0,)}],
    )
    flown = fly(scenario)
    nominal, true = scenario.camera_model(), true_camera(scenario, 0)
    turn = rotations.multiply(true.q_crf_irf_wxyz, rotations.conjugate(nominal.q_crf_irf_wxyz))
    estimate = flown.last.target.cameras[0]
    left = float(rotations.angle_between(rotations.exp(estimate.turn_rad), turn))
    return figures(flown, 39.0) | {
        "mounting_error_before_rad": float(np.linalg.norm(rotations.log(turn))),
        "mounting_error_after_rad": left,
        "mounting_sigma_rad": float(np.linalg.norm(estimate.turn_sigma_rad)),
        "estimate_before_position_rms_m": flown.estimates.rms("position_m", 3.0, 5.0),
        "estimate_before_angle_rms_rad": flown.estimates.rms("angle_rad", 3.0, 5.0),
        "good": float(left <= math.radians(0.05)),
    }


LOCKED_S = 3.0
"""The estimate must be right for so long to count as found."""


def acquire(seed: int) -> Row:
    """Fly one chaser that starts up to 0.5 m and 20 degrees off, until the estimate is right for 3
    s, at most 30 s.
    """
    rng = np.random.default_rng([seed, 11])
    offset, turn = (v / np.linalg.norm(v) for v in rng.normal(size=(2, 3)))
    start = {
        "position_m": SIDES[0][0],
        "q_wxyz": (1.0, 0.0, 0.0, 0.0),
        "start_offset_m": tuple((offset * rng.uniform(0.0, 0.5)).tolist()),
        "start_rotation_rad": tuple((turn * math.radians(rng.uniform(0.0, 20.0))).tolist()),
    }
    target = ("servicer", "paper")[seed % 2]
    scenario = scenario_of(target, 1, seed, 30.0, chasers=[start])

    def locked(e: EstimatorErrors) -> bool:
        n = round(LOCKED_S * scenario.time.rate_hz)
        right = np.array(e.position_m[-n:]) < 0.02, np.array(e.angle_rad[-n:]) < math.radians(3.0)
        return (
            len(e.status) >= n
            and set(e.status[-n:]) == {"tracking"}
            and bool((right[0] & right[1]).all())
        )

    flown = fly(scenario, until=locked)
    e = flown.estimates
    done = locked(e)
    off = (np.array(e.position_m) > 0.1) | (np.array(e.angle_rad) > math.radians(10.0))
    wrong = off & (np.array(e.status) == "tracking") & (np.array(e.nees) > 40.0)
    return {
        "found": float(done),
        "locked_s": e.time_s[-1] - LOCKED_S if done else 99.0,
        "wrong_lock_ticks": int(wrong.sum()),
        "in_view_at_start": float(flown.detections[0][0]),
        "searched": float(
            any(text.endswith("searching (from acquire)") for _, _, text in flown.events)
        ),
        "lost": float("lost" in e.status),
        "events": [f"{t:.2f} {text}" for t, _, text in flown.events][:20],
    }


WRONG_IRF_M, WRONG_RAD = (0.2, 0.0, 0.0), (0.0, 0.0, math.radians(15.0))
"""Error of the poses that a chaser reports wrongly."""


def fault(which: str, seed: int) -> Row:
    """Fly with a fault from 8 s to 28 s (both cameras blind: to 13 s); wrong poses are reported
    from the start.
    """
    n = 3 if which == "wrong_poses" else 2
    scenario = scenario_of("servicer", n, seed, 14.0 if which == "wrong_poses" else 32.0)
    if which == "sun":
        camera = scenario.camera.model_dump()
        # Chaser 0 looks along +X of the target, which is nearly that of the world.
        camera |= {
            "sun_direction": (1.0, -0.1, 0.12),
            "effects": camera["effects"] | {"glare": 3000.0},
        }
        scenario = changed(scenario, camera=camera)

    def on_image(image: Image) -> Image:
        t = image.sim_time_ns / 1e9
        dark = (which == "one_blind" and image.chaser == 1 and 8.0 <= t < 28.0) or (
            which == "both_blind" and 8.0 <= t < 13.0
        )
        black = bytes(image.width_px * image.height_px)
        return msgspec.structs.replace(image, encoding="mono8", data=black) if dark else image

    def on_sighting(s: Sighting) -> Sighting:
        if which != "wrong_poses" or s.chaser != 2:
            return s
        wrong = tuple(
            msgspec.structs.replace(
                x,
                position_m=tuple((np.array(x.position_m) + WRONG_IRF_M).tolist()),
                q_wxyz=tuple(rotations.multiply(x.q_wxyz, rotations.exp(WRONG_RAD)).tolist()),
            )
            for x in s.solutions
        )
        return msgspec.structs.replace(s, solutions=wrong)

    flown = fly(scenario, on_image=on_image, on_sighting=on_sighting)
    named = any(level == "warning" and "chaser 2" in text for _, level, text in flown.events)
    return figures(flown, SETTLED_S) | {
        "lost_ticks": sum(s == "lost" for s in flown.estimates.status),
        "named": float(named),
    }


TARGETS = ("servicer", "paper")
LOWEST_IS_WORST = ("inside_3_sigma", "detected", "found", "good", "named")


def flights_of(
    part: str, kinds: Mapping[str, Callable[[int], Row]], number: int, quick: int
) -> Callable[[Options], Figures]:
    """Return a part that flies each kind with ``number`` seeds (with ``--quick`` the first
    with ``quick``): mean and worst of each figure over the seeds.
    """

    def fly_kinds(options: Options) -> Figures:
        out: Figures = {}
        for kind, flight in islice(kinds.items(), 1 if options.quick else None):
            results = KeptResults(options.results, {"estimation": f"{part} {kind}"}, dict[str, Any])
            rows = results.of(seeds_of(options, number, quick), flight, shown)
            key = f"{part} {kind}".strip().replace(" ", "_")
            out[f"{key}_flights"] = len(rows)
            for figure, first in rows[0].items():
                if isinstance(first, int | float):
                    values = [float(row[figure]) for row in rows]
                    worst = min if figure in LOWEST_IS_WORST else max
                    out[f"{key}_{figure}_mean"] = float(np.mean(values))
                    out[f"{key}_{figure}_worst"] = worst(values)
        return out

    return fly_kinds


def shown(row: Row) -> str:
    """Return the figures of a flight for people."""
    return str({key: round(value, 6) for key, value in row.items() if isinstance(value, float)})


FAULTS = ("wrong_poses", "one_blind", "both_blind", "sun")
GROUP = Group(
    {
        "exact": described(
            flights_of(
                "exact", {f"{t} {n}": partial(exact, t, n) for n in (2, 1) for t in TARGETS}, 20, 1
            ),
            "Fly with cameras as calibrated, beside the paper's perception and estimator.",
        ),
        "errors": described(
            flights_of("errors", {f"{t} 2": partial(errors, t, 2) for t in TARGETS}, 20, 1),
            "Fly with drawn calibration errors and heavy noise.",
        ),
        "calibrate": described(
            flights_of("calibrate", {"servicer 1": partial(calibrate, "servicer")}, 20, 1),
            "Fly the manoeuvre that estimates a camera's mounting.",
        ),
        "acquire": described(
            flights_of("acquire", {"": acquire}, 200, 8),
            "Start off the reference, with the target often out of view.",
        ),
        "faults": described(
            flights_of("faults", {w: partial(fault, w) for w in FAULTS}, 1, 1),
            "Fly with blind cameras, glare, and a chaser that reports wrong poses.",
        ),
    },
    ("flights", "first", "results"),
)
