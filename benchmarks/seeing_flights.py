"""What flights with images show of the target's estimate: ``python benchmarks/seeing_flights.py PART [--json FILE]``.

Parts: ``exact`` (all effects, cameras as calibrated; both targets, one and two chasers; the paper's perception and
estimator on the same images), ``errors`` (calibration errors drawn for each seed, heavy noise), ``calibrate`` (the
manoeuvre that finds a camera's mounting), ``acquire`` (starts off the reference, the target often out of view), ``faults``.

One line of JSON a flight goes to ``--flights FILE``; flights that are there already are not flown again, so that a run
that was stopped goes on where it was.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
from chaserdock_models import rotations
from chaserdock_protocol.messages import Image, Sighting
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.sensors.errors import true_camera
from results import options_of, write_json
from seen_loop import Estimates, Flown, changed, fly

Row = dict[str, Any]
DEG = math.degrees(1.0)
SIDES = (((-1.0, 0.0, 0.0), 0.0), ((0.0, -1.0, 0.0), 90.0), ((1.0, 0.0, 0.0), 180.0))
"""Reference places (TRF, m) of chasers round the target, and the yaw (degrees) with which each faces it."""
SETTLED_S = 6.0


def scenario_of(target: str, number: int, seed: int, duration_s: float, **more: Any) -> Scenario:
    """A flight in which all effects are on; the sun, the target's attitude and the starts are drawn from the seed."""
    rng = np.random.default_rng([seed, 4])
    sun = rotations.rotate(
        rotations.exp([0.0, 0.0, rng.uniform(-math.pi, math.pi)]), [1.0, 0.0, rng.uniform(-0.6, 0.9)]
    )
    flying = []
    for place, yaw_deg in SIDES[:number]:
        flying.append(
            {
                "position_m": place,
                "q_wxyz": tuple(rotations.exp([0.0, 0.0, math.radians(yaw_deg)]).tolist()),
                "start_offset_m": tuple((0.1 * rng.uniform(-1.0, 1.0, 3)).tolist()),
                "start_rotation_rad": tuple((0.08 * rng.uniform(-1.0, 1.0, 3)).tolist()),
            }
        )
    return Scenario.model_validate(
        {
            "name": f"seeing-{target}-{number}",
            "duration_s": duration_s,
            "settling_s": 0.0,
            "seed": seed,
            "target": {
                "model": target,
                "q_wxyz": tuple(rotations.exp(rng.uniform(-0.2, 0.2, 3)).tolist()),
            },
            "camera": {
                "sun_direction": tuple(sun.tolist()),
                "ambient": 0.25,
                "earth": {"direction": (0.25, 0.5, -0.83), "radius_deg": 64.0},
                "intrinsics": {
                    "width_px": 1280, "height_px": 720, "fx_px": 1105.0, "fy_px": 1107.0, "cx_px": 644.2, "cy_px": 356.8,
                    "distortion": (-0.18, 0.05, 0.0006, -0.0004, 0.0),
                },
                "effects": {"exposure_s": 0.003, "glare": 500.0},
            },
            "chasers": flying,
        }
        | more
    )  # fmt: skip


ERRORS = {"focal_length_share": 1e-3, "centre_px": 0.5, "mounting_deg": 0.3}
HEAVY = {
    "exposure_s": 0.003,
    "glare": 500.0,
    "read_noise": 4.0,
    "shot_noise": 0.08,
    "point_spread_px": 0.9,
    "jpeg_quality": 75,
}
TOLD = {"camera_bias_attitude_deg": 0.3, "camera_bias_focal_share": 1e-3, "camera_bias_position_m": 5e-4}


def with_errors(scenario: Scenario) -> Scenario:
    """Calibration errors and heavy noise; the filter is told their size."""
    camera = scenario.camera.model_dump() | {"calibration_error": ERRORS, "effects": HEAVY}
    return changed(scenario, camera=camera, estimator=TOLD)


def figures(flown: Flown, from_s: float) -> Row:
    """What is told of a flight."""
    e = flown.estimates
    m, rad = flown.tracking_rms(from_s)
    row: Row = {
        "fused_m": e.rms("position_m", from_s),
        "fused_rad": e.rms("angle_rad", from_s),
        "fused_max_rad_after_1s": e.largest("angle_rad", 1.0),
        "fused_max_m_after_1s": e.largest("position_m", 1.0),
        "nees": float(e.array("nees", from_s).mean()),
        "inside_3_sigma": float(e.array("inside", from_s).mean()),
        "tracking_m": m,
        "tracking_rad": rad,
        "reinitialisations": flown.reinitialisations,
        "seen": float(np.mean([v for seen in flown.seen.values() for v in seen])),
        "events": [f"{t:.2f} {text}" for t, _, text in flown.events][:40],
    }
    for name, shadow in flown.shadows.items():
        row[f"{name}_m"] = shadow.rms("position_m", from_s)
        row[f"{name}_rad"] = shadow.rms("angle_rad", from_s)
        row[f"{name}_max_rad_after_1s"] = shadow.largest("angle_rad", 1.0)
    return row


def paper_of(scenario: Scenario) -> dict[str, Scenario]:
    """The paper's perception and estimator on the same images."""
    return {"paper": changed(scenario, perception={"name": "paper"}, estimator={"name": "paper"})}


def exact(target: str, chasers: int, seed: int) -> Row:
    scenario = scenario_of(target, chasers, seed, 12.0)
    return figures(fly(scenario, paper_of(scenario)), SETTLED_S)


def errors(target: str, chasers: int, seed: int) -> Row:
    """Beside it: the same filter that is not told of the errors (``naive``)."""
    scenario = with_errors(scenario_of(target, chasers, seed, 12.0))
    naive = changed(scenario, estimator=dict.fromkeys(TOLD, 0.0))
    return figures(fly(scenario, {"naive": naive}), SETTLED_S)


def calibrate(target: str, seed: int) -> Row:
    """One chaser whose camera is turned by 0.3 degrees (one sigma, each axis) turns about from 5 s on, for 30 s."""
    scenario = scenario_of(target, 1, seed, 46.0)
    camera = scenario.camera.model_dump() | {"calibration_error": {"mounting_deg": 0.3}}
    scenario = changed(
        scenario,
        camera=camera,
        estimator={"camera_bias_attitude_deg": 0.3},
        timeline=[{"at_s": 5.0, "command": "calibrate", "chasers": (0,)}],
    )
    flown = fly(scenario)
    told, true = scenario.camera_model(), true_camera(scenario, 0)
    turn = rotations.multiply(true.q_crf_irf_wxyz, rotations.conjugate(told.q_crf_irf_wxyz))
    found = flown.last.target.cameras[0]
    left = float(rotations.angle_between(rotations.exp(found.turn_rad), turn))
    return figures(flown, 39.0) | {
        "mounting_error_before_rad": float(np.linalg.norm(rotations.log(turn))),
        "mounting_error_after_rad": left,
        "mounting_sigma_rad": float(np.linalg.norm(found.turn_sigma_rad)),
        "before_fused_m": flown.estimates.rms("position_m", 3.0, 5.0),
        "before_fused_rad": flown.estimates.rms("angle_rad", 3.0, 5.0),
        "good": float(left <= math.radians(0.05)),
    }


LOCKED_S = 3.0


def acquire(seed: int) -> Row:
    """One chaser that starts up to 0.5 m and 20 degrees off; until the estimate has been right for 3 s, or 30 s."""
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

    def locked(now_s: float, e: Estimates) -> bool:
        n = round(LOCKED_S * scenario.time.rate_hz)
        right = np.array(e.position_m[-n:]) < 0.02, np.array(e.angle_rad[-n:]) < math.radians(3.0)
        return len(e.status) >= n and set(e.status[-n:]) == {"tracking"} and bool((right[0] & right[1]).all())

    flown = fly(scenario, until=locked)
    e = flown.estimates
    done = locked(0.0, e)
    off = (np.array(e.position_m) > 0.1) | (np.array(e.angle_rad) > math.radians(10.0))
    wrong = off & (np.array(e.status) == "tracking") & (np.array(e.nees) > 40.0)
    return {
        "found": float(done),
        "locked_s": e.time_s[-1] - LOCKED_S if done else 99.0,
        "wrong_lock_ticks": int(wrong.sum()),
        "in_view_at_start": float(flown.seen[0][0]),
        "searched": float(any(text.endswith("searching (from acquire)") for _, _, text in flown.events)),
        "lost": float("lost" in e.status),
        "events": [f"{t:.2f} {text}" for t, _, text in flown.events][:20],
    }


LIE_IRF_M, LIE_RAD = (0.2, 0.0, 0.0), (0.0, 0.0, math.radians(15.0))


def fault(which: str, seed: int) -> Row:
    """A fault between 8 s and 28 s (both cameras blind: 8 s to 13 s); the liar lies from the start."""
    n = 3 if which == "liar" else 2
    scenario = scenario_of("servicer", n, seed, 14.0 if which == "liar" else 32.0)
    if which == "sun":
        camera = scenario.camera.model_dump()
        # Chaser 0 looks along +X of the target, which is nearly that of the world.
        camera |= {"sun_direction": (1.0, -0.1, 0.12), "effects": camera["effects"] | {"glare": 3000.0}}
        scenario = changed(scenario, camera=camera)

    def on_image(image: Image) -> Image | None:
        t = image.sim_time_ns / 1e9
        dark = (which == "one_blind" and image.chaser == 1 and 8.0 <= t < 28.0) or (
            which == "both_blind" and 8.0 <= t < 13.0
        )
        return None if dark else image

    def on_sighting(s: Sighting) -> Sighting:
        if which != "liar" or s.chaser != 2:
            return s
        lies = tuple(
            msgspec.structs.replace(
                x,
                position_m=tuple((np.array(x.position_m) + LIE_IRF_M).tolist()),
                q_wxyz=tuple(rotations.multiply(x.q_wxyz, rotations.exp(LIE_RAD)).tolist()),
            )
            for x in s.solutions
        )
        return msgspec.structs.replace(s, solutions=lies)

    flown = fly(scenario, on_image=on_image, on_sighting=on_sighting)
    named = any(level == "warning" and "chaser 2" in text for _, level, text in flown.events)
    return figures(flown, SETTLED_S) | {
        "max_m": flown.estimates.largest("position_m", 1.0),
        "lost_ticks": sum(s == "lost" for s in flown.estimates.status),
        "named": float(named),
    }


def _jobs(part: str, seeds: range) -> list[tuple[str, Callable[[], Row]]]:
    jobs: list[tuple[str, Callable[[], Row]]] = []
    for seed in seeds:
        match part:
            case "exact":
                for target, n in (("servicer", 2), ("paper", 2), ("servicer", 1), ("paper", 1)):
                    jobs.append((f"exact {target} {n} {seed}", lambda a=(target, n, seed): exact(*a)))
            case "errors":
                for target in ("servicer", "paper"):
                    jobs.append((f"errors {target} 2 {seed}", lambda a=(target, 2, seed): errors(*a)))
            case "calibrate":
                jobs.append((f"calibrate servicer 1 {seed}", lambda seed=seed: calibrate("servicer", seed)))
            case "acquire":
                jobs.append((f"acquire {seed}", lambda seed=seed: acquire(seed)))
            case _:
                for which in ("one_blind", "both_blind", "sun", "liar"):
                    jobs.append((f"faults {which} {seed}", lambda a=(which, seed): fault(*a)))
    return jobs


def _told(part: str, rows: dict[str, Row]) -> dict[str, float]:
    """The flat figures of a part: for each kind of flight, medians and the worst of all seeds."""
    out: dict[str, float] = {}
    kinds = sorted({name.rsplit(" ", 1)[0] for name in rows if name.startswith(part)})
    for kind in kinds:
        each = [row for name, row in rows.items() if name.rsplit(" ", 1)[0] == kind]
        label = kind.replace(" ", "_")
        out[f"{label}_flights"] = len(each)
        for key, value in each[0].items():
            if isinstance(value, int | float):
                values = np.array([float(row[key]) for row in each])
                out[f"{label}_{key}_mean"] = float(values.mean())
                worst = (
                    values.min()
                    if key in ("inside_3_sigma", "seen", "found", "good", "named")
                    else values.max()
                )
                out[f"{label}_{key}_worst"] = float(worst)
    return out


def main() -> None:
    parser = options_of(__doc__)
    parser.add_argument("part", choices=("exact", "errors", "calibrate", "acquire", "faults"))
    parser.add_argument("--flights", type=Path, default=None, help="JSON lines, one a flight; is added to")
    parser.add_argument("--seeds", type=int, default=None, help="so many")
    parser.add_argument("--first", type=int, default=0, help="from this seed on")
    options = parser.parse_args()
    cv2.setNumThreads(1)
    most, few = {"acquire": (200, 8), "faults": (1, 1)}.get(options.part, (20, 2))
    seeds = options.seeds or (few if options.quick else most)
    rows: dict[str, Row] = {}
    flights: Path | None = options.flights
    if flights is not None and flights.exists():
        for line in flights.read_text(encoding="utf-8").splitlines():
            row = json.loads(line)
            rows[row.pop("flight")] = row
    wanted = _jobs(options.part, range(options.first, options.first + seeds))
    for name, job in wanted:
        if name in rows:
            continue
        begun = time.monotonic()
        rows[name] = job()
        shown = {k: round(v, 6) for k, v in rows[name].items() if isinstance(v, float)}
        print(f"{name}  ({time.monotonic() - begun:.0f} s wall) {shown}", flush=True)
        if flights is not None:
            with flights.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"flight": name} | rows[name]) + "\n")
    result = _told(options.part, {name: rows[name] for name, _ in wanted})
    for key, value in result.items():
        print(f"{key:62}  {value:.4g}", flush=True)
    write_json(options.json, result)


if __name__ == "__main__":
    main()
