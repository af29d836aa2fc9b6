"""The controller's bars in closed loop: ``python benchmarks/missions.py [--part NAME ...] [--quick] [--json FILE]``.

Whole missions in one process (``offline.py``: the world, the eyes and the controller that fly, without Zenoh), or of the
flight code on perfect knowledge (``chaserdock study``'s loop). Parts:

- ``avoidance``: 20 seeded variations of ``collision-avoidance`` with images of 640 x 360 (``--full-images``: the
  scenario's own, four times as many pixels and so easier), every fourth exactly symmetric;
- ``swap``: 20 of ``swap``, the target seen with noise of 2 mm and 0.1 degrees; seed 0 is exactly head-on;
- ``swap-seen``: the first ``--seen`` of them with images;
- ``tracking``: the paper's tumble on perfect knowledge, with and without feed-forward, and with stronger actuators;
- ``tracking-seen``: the same with the scenarios' own images: the servicer, two chasers on the paper's target, stronger
  actuators;
- ``table``: every row of the paper's single-chaser table on perfect knowledge.

``--first`` and ``--flights`` choose seeds, ``--quick`` flies two variations, shorter runs and no row twice. Distances are
between centres, true, at every tick.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from chaserdock_controller.evaluation.closed_loop import Trace, fly_offline
from chaserdock_controller.evaluation.perfect_knowledge import PerfectEstimator
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.attitude_reference import facing_attitudes
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_world.physics.simulation import TARGET
from offline import CameraPose, Offline, seeing_eye, statistical_eye
from results import options_of, write_json

from chaserdock.reproduce.paper import ROWS
from chaserdock.reproduce.plan import COLUMNS, SCENARIO, STARTS

ROOT = Path(__file__).resolve().parents[1]
SYMMETRIC_EVERY = 4
NOISE_M, NOISE_RAD = 0.002, math.radians(0.1)
SMALL = {"width_px": 640, "height_px": 360}
STEADY_FROM_S = 40.0
"""From here on the transient of a start 0.85 m away has faded."""


def shipped(name: str, *overrides: str) -> Scenario:
    return load_scenario(ROOT / "scenarios" / f"{name}.toml", overrides)


def avoidance(seed: int, full_images: bool = False) -> Scenario:
    """``collision-avoidance`` turned and scattered by the seed; every fourth seed exactly symmetric.

    Symmetric: chaser 0 at rest on an axis of TRF (another one each time), its goal exactly opposite, chaser 1 at right
    angles to both; seeds above 11 with the whole scene turned at random in WRF. Otherwise starts, goal and chaser 1's
    place are scattered by up to 10 cm (the goal up to 5 cm), attitudes by 0.1 rad.
    """
    rng, scenario = np.random.default_rng([seed, 0xA701]), shipped("collision-avoidance", f"seed={seed}")
    symmetric = seed % SYMMETRIC_EVERY == 0
    turned = seed > 11 or not symmetric
    attitude = rotations.normalize(rng.normal(size=4)) if turned else np.array([1.0, 0.0, 0.0, 0.0])
    way = np.roll([1.0, 0.0, 0.0], seed // SYMMETRIC_EVERY if symmetric else 0)
    aside = np.roll([0.0, 1.0, 0.0], seed // SYMMETRIC_EVERY if symmetric else 0)
    places, scatter = [-way, -aside], np.zeros((2, 3))
    if not symmetric:
        scatter = rng.uniform(-0.1, 0.1, (2, 3))
        places[1] = places[1] + rng.uniform(-0.1, 0.1, 3)
    nominal = scenario.chasers[0]
    chasers = tuple(
        nominal.model_copy(
            update={
                "position_m": tuple(place.tolist()),
                "q_wxyz": tuple(facing_attitudes(nominal.position_m, nominal.q_wxyz, place)[0].tolist()),
                "start_offset_m": tuple(offset.tolist()),
                "start_rotation_rad": tuple([0.0] * 3 if symmetric else rng.uniform(-0.1, 0.1, 3).tolist()),
            }
        )
        for place, offset in zip(places, scatter, strict=True)
    )
    goal = way if symmetric else way + rng.uniform(-0.05, 0.05, 3)
    (entry,) = scenario.timeline
    return scenario.model_copy(
        update={
            "camera": scenario.camera if full_images else scenario.camera.model_copy(update=SMALL),
            "target": scenario.target.model_copy(update={"q_wxyz": tuple(attitude.tolist())}),
            "chasers": chasers,
            "timeline": (entry.model_copy(update={"offset_m": tuple(goal.tolist())}),),
        }
    )


def swap(seed: int) -> Scenario:
    """``swap``; but for seed 0 with starts scattered by 5 cm (one sigma, each axis) and the tumble turned at random."""
    rng, scenario = np.random.default_rng([seed, 0x5A]), shipped("swap", f"seed={seed}")
    if seed == 0:
        return scenario
    omega = rotations.rotate(rotations.normalize(rng.normal(size=4)), np.array(scenario.target.omega_rad_s))
    chasers = tuple(
        c.model_copy(update={"start_offset_m": tuple(rng.normal(0.0, 0.05, 3).tolist())})
        for c in scenario.chasers
    )
    target = scenario.target.model_copy(update={"omega_rad_s": tuple(omega.tolist())})
    return scenario.model_copy(update={"chasers": chasers, "target": target})


@dataclass
class Flown:
    """One flight: least distances, m; when the last of those sent was at its goal for good, s after the command (NaN if
    never); how far from its goal the farthest ended, m; solves that failed or gave way."""

    seed: int
    to_target_m: float = math.inf
    between_m: float = math.inf
    reached_s: float = math.nan
    end_m: float = math.inf
    failed: int = 0
    relaxed: int = 0
    touched: int = 0
    solve_s: list[float] = field(default_factory=list)

    def line(self) -> str:
        return (
            f"{self.seed:3d}  target {self.to_target_m:.4f} m  chasers {self.between_m:.4f} m  "
            f"there after {self.reached_s:.1f} s, {self.end_m * 1e3:.1f} mm  failed {self.failed}  "
            f"relaxed {self.relaxed}  touched {self.touched}"
        )


def fly(seed: int, scenario: Scenario, eye: CameraPose) -> Flown:
    """Flies to the end and keeps account of distances and goals, on ground truth."""
    flight, n = Offline(scenario, eye), len(scenario.chasers)
    out, goals = Flown(seed), {i: g for i in range(n) if (g := scenario.goal_of(i)) is not None}
    away: dict[int, float] = {}
    while True:
        states = flight.states()
        places = np.array([states[f"chaser/{i}"].position_m for i in range(n)])
        there = states[TARGET]
        out.to_target_m = min(out.to_target_m, float(np.linalg.norm(places - there.position_m, axis=1).min()))
        gaps = np.linalg.norm(places[:, None] - places[None], axis=-1) + 9.0 * np.eye(n)
        out.between_m = min(out.between_m, float(gaps.min()))
        ends = {}
        for i, (sent_s, offset) in goals.items():
            goal = there.position_m + rotations.rotate(there.q_wxyz, np.array(offset))
            ends[i] = float(np.linalg.norm(places[i] - goal))
            if ends[i] > scenario.success.reached_position_m or flight.time_s < sent_s:
                away[i] = flight.time_s - sent_s
        if flight.tick >= scenario.ticks:
            break
        solver = flight.step().solver
        if solver is not None:
            out.failed += solver.status.count("failed")
            out.relaxed += solver.status.count("infeasible_relaxed")
    step_s, left_s = 1.0 / scenario.time.rate_hz, scenario.duration_s
    out.end_m = max(ends.values())
    if all(away[i] < left_s - sent_s - step_s for i, (sent_s, _) in goals.items()):
        out.reached_s = max(away.values()) + step_s
    out.touched = len(flight.touched)
    flight.close()
    return out


def noisy(scenario: Scenario) -> CameraPose:
    return statistical_eye(scenario, scenario.seed, NOISE_M, NOISE_RAD)


def variations(
    name: str,
    seeds: Iterable[int],
    scenario_of: Callable[[int], Scenario],
    eye_of: Callable[[Scenario], CameraPose],
) -> dict[str, float]:
    """Flies every seed; the worst of each figure."""
    flown = []
    print(name)
    for seed in seeds:
        scenario = scenario_of(seed)
        flown.append(fly(seed, scenario, eye_of(scenario)))
        print(f"  {flown[-1].line()}", flush=True)
    limits = scenario_of(0).limits
    safe = [
        f.to_target_m >= limits.min_distance_target_m and f.between_m >= limits.min_distance_chasers_m
        for f in flown
    ]
    key = name.replace("-", "_")
    return {
        f"{key}_flights": len(flown),
        f"{key}_kept_their_distances": sum(safe),
        f"{key}_reached": sum(not math.isnan(f.reached_s) for f in flown),
        f"{key}_least_distance_to_target_m": min(f.to_target_m for f in flown),
        f"{key}_least_distance_between_chasers_m": min(f.between_m for f in flown),
        f"{key}_longest_time_to_goal_s": max(
            math.inf if math.isnan(f.reached_s) else f.reached_s for f in flown
        ),
        f"{key}_failed_solves": sum(f.failed for f in flown),
        f"{key}_touched": sum(f.touched for f in flown),
    }


def rms(position_m: Array, angle_rad: Array) -> tuple[float, float]:
    """Of errors: m and degrees."""
    p, a = (float(np.sqrt(np.mean(np.square(e)))) for e in (position_m, angle_rad))
    return p, math.degrees(a)


def steady(trace: Trace) -> tuple[float, float]:
    late = trace.time_s >= STEADY_FROM_S
    return rms(trace.position_error_m[late], trace.orientation_error_rad[late])


def told(out: dict[str, float], name: str, figures: tuple[float, float]) -> None:
    out[f"{name}_position_rms_m"], out[f"{name}_orientation_rms_deg"] = figures
    print(f"  {name:45} {figures[0] * 1e3:9.4f} mm  {figures[1]:8.5f} deg", flush=True)


def tracking(length_s: float) -> dict[str, float]:
    """Steady errors at the paper's tumble on perfect knowledge, from 0.85 m behind."""
    out: dict[str, float] = {}
    print(f"tracking, perfect knowledge, RMS from {STEADY_FROM_S:g} s on")
    length = f"duration_s={length_s}"
    for name, overrides, gain in (
        ("feed_forward", (), 1.0),
        ("u_ref_0", ("controller.feed_forward=false",), 1.0),
        ("actuators_5_percent_stronger", (), 1.05),
        ("actuators_5_percent_weaker", (), 0.95),
    ):
        trace = fly_offline(shipped("single", length, *overrides), actuator_gain=gain)
        told(out, f"tracking_{name}", steady(trace))
    return out


def seen(scenario: Scenario, gain: float = 1.0) -> tuple[float, float]:
    """The worst chaser's steady errors from its reference pose on the true target, with images."""
    flight, n = Offline(scenario, seeing_eye(scenario), actuator_gain=gain), len(scenario.chasers)
    errors: list[list[tuple[float, float]]] = [[] for _ in range(n)]
    while flight.tick < scenario.ticks:
        states, there = flight.states(), flight.physics.state(TARGET)
        for i in range(n) if flight.time_s >= STEADY_FROM_S else ():
            c, own = scenario.chasers[i], states[f"chaser/{i}"]
            place = there.position_m + rotations.rotate(there.q_wxyz, np.array(c.position_m))
            turned = rotations.multiply(there.q_wxyz, c.q_wxyz)
            angle = float(rotations.angle_between(turned, own.q_wxyz))
            errors[i].append((float(np.linalg.norm(own.position_m - place)), angle))
        flight.step()
    flight.close()
    each = [rms(*np.array(e).T) for e in errors]
    return max(p for p, _ in each), max(a for _, a in each)


def tracking_seen(length_s: float) -> dict[str, float]:
    """Steady errors at the paper's tumble with images; the worst chaser of each flight."""
    out: dict[str, float] = {}
    print(f"tracking with images, worst chaser's RMS from {STEADY_FROM_S:g} s on")
    length = f"duration_s={length_s}"
    for name, scenario, gain in (
        ("servicer", shipped("single", "target.model='servicer'", length), 1.0),
        ("two_chasers_paper_target", shipped("two-chaser-tracking", length), 1.0),
        (
            "servicer_actuators_5_percent_stronger",
            shipped("single", "target.model='servicer'", length),
            1.05,
        ),
    ):
        told(out, f"tracking_seen_{name}", seen(scenario, gain))
    return out


def table(length_s: float, quick: bool) -> dict[str, float]:
    """Every row of the paper's table, from every start and in both columns of ``chaserdock reproduce``."""
    out: dict[str, float] = {}
    failed = rows = 0
    print(
        "the paper's table, perfect knowledge: position MSE, orientation MSE, failed solves, nearest to the target"
    )
    for start, turned in STARTS.items():
        for column, settings in COLUMNS.items():
            if quick and (start, column) != ("receding", "paper"):
                continue
            for row in ROWS:
                length = f"duration_s={length_s}"
                scenario = shipped(SCENARIO, *row.overrides, *settings, *turned, length)
                trace = fly_offline(scenario)
                name = f"{start}, {column}, {row.label}"
                errors = trace.position_error_m[:, 0], trace.orientation_error_rad[:, 0]
                p, a = (float(np.mean(e**2)) for e in errors)
                truth = PerfectEstimator(scenario.target)
                there = np.array([truth.estimate_at(round(t * 1e9)).position_m for t in trace.time_s])
                nearest = float(np.linalg.norm(trace.states[:, 0, :3] - there, axis=1).min())
                whole = trace.failed_solves == 0 and nearest >= scenario.limits.min_distance_target_m
                rows, failed = rows + 1, failed + (not whole)
                print(
                    f"  {name:35} {p:.4e} m^2  {a:.3e} rad^2  {trace.failed_solves:3d}  {nearest:.2f} m",
                    flush=True,
                )
    out["table_rows_flown"], out["table_rows_failed"] = rows, failed
    return out


PARTS = ("avoidance", "swap", "swap-seen", "tracking", "tracking-seen", "table")


def main() -> None:
    parser = options_of(__doc__)
    parser.add_argument("--part", action="append", choices=PARTS, help="repeatable; all by default")
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--flights", type=int, default=20, help="how many seeds")
    parser.add_argument("--seen", type=int, default=2, help="how many seeds of swap with images")
    parser.add_argument("--full-images", action="store_true", help="the scenario's own in avoidance")
    options = parser.parse_args()
    flights, length_s = (2, 60.0) if options.quick else (options.flights, 120.0)
    seeds = range(options.first, options.first + flights)
    run: dict[str, Callable[[], dict[str, float]]] = {
        "avoidance": lambda: variations(
            "avoidance", seeds, lambda seed: avoidance(seed, options.full_images), seeing_eye
        ),
        "swap": lambda: variations("swap", seeds, swap, noisy),
        "swap-seen": lambda: variations("swap-seen", seeds[: options.seen], swap, seeing_eye),
        "tracking": lambda: tracking(length_s),
        "tracking-seen": lambda: tracking_seen(min(length_s, 80.0)),
        "table": lambda: table(length_s, options.quick),
    }
    result: dict[str, float] = {}
    begun_s = time.perf_counter()
    for part in options.part or PARTS:
        result |= run[part]()
    width = max(map(len, result), default=0)
    for name, value in result.items():
        print(f"{name:{width}}  {value:.5g}")
    print(f"{time.perf_counter() - begun_s:.0f} s", file=sys.stderr)
    write_json(options.json, result)


if __name__ == "__main__":
    main()
