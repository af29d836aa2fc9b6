# SPDX-License-Identifier: Apache-2.0
"""The physics engines against each other: the cases of ``flights.engine_comparison`` in open loop,
and whole missions in closed loop.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
from chaserdock_models import rotations
from chaserdock_protocol.shipped_scenarios import shipped_scenario
from common import Figures, Group, Options, described, seeds_of
from flights.engine_comparison import CASES, ENGINES, difference, fly_case

from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.motion import Track
from chaserdock.analysis.summary import summary_of
from chaserdock.simulation.mission import simulate

MISSIONS = {
    "four-chaser-docking": ("duration_s=30.0",),
    "docking-contact": ("duration_s=50.0",),
    "four-chaser-capture": ("duration_s=75.0",),
}
QUICK = ("duration_s=10.0", "settling_s=5.0", "steady_until_s=10.0", "timeline=[]", "success={}")
WITHOUT_LOADS = ("free", "capture")


def compare(name: str, options: Options) -> Figures:
    """Return the largest differences of any body and port in a case, the change of momentum on each
    engine where no load acts, and the processor time of a physics step.
    """
    duration_s = 5.0 if options.quick else 30.0
    flights = {engine: fly_case(CASES[name](0), engine, duration_s) for engine in ENGINES}
    apart = difference(*flights.values())
    figures = {
        f"{name}_position_m": apart.position_m,
        f"{name}_attitude_deg": math.degrees(apart.angle_rad),
        f"{name}_port_force_N": apart.force_N,
        f"{name}_port_torque_N_m": apart.torque_N_m,
    }
    for engine, flight in flights.items():
        figures[f"{name}_{engine}_step_s"] = flight.step_s
        if name in WITHOUT_LOADS:
            figures[f"{name}_{engine}_momentum_share"] = flight.momentum_error
            figures[f"{name}_{engine}_angular_momentum_share"] = flight.angular_momentum_error
    return figures


def missions(options: Options) -> Figures:
    """Fly ``four-chaser-docking`` (30 s), ``docking-contact`` (50 s) and ``four-chaser-capture``
    (75 s) as ``simulate`` does on each engine, with statistical perception: successes, and the
    largest differences of any body. ``--quick``: the first of them for 10 s.
    """
    flown = {"four-chaser-docking": QUICK} if options.quick else MISSIONS
    seeds = seeds_of(options, 1, 1)
    figures: Figures = {}
    for name, overrides in flown.items():
        successes, apart_m, apart_deg = dict.fromkeys(ENGINES, 0), 0.0, 0.0
        for seed in seeds:
            flights = {}
            for engine in ENGINES:
                flights[engine], failures = fly_mission(name, engine, seed, overrides)
                successes[engine] += not failures
                print(
                    f"  {name}, {engine}, seed {seed}: {'; '.join(failures) or 'success'}",
                    flush=True,
                )
            distance_m, angle_deg = tracks_apart(*flights.values())
            apart_m, apart_deg = max(apart_m, distance_m), max(apart_deg, angle_deg)
        figures |= {
            f"{name}_{engine}_success_share": n / len(seeds) for engine, n in successes.items()
        }
        figures |= {f"{name}_position_m": apart_m, f"{name}_attitude_deg": apart_deg}
    return figures


def fly_mission(
    name: str, engine: str, seed: int, overrides: tuple[str, ...]
) -> tuple[Mapping[str, Track], list[str]]:
    """Fly a mission in this process; return the true motion of its bodies, and why it is no
    success.
    """
    settings = (*overrides, f"seed={seed}", f"world.engine={engine}", "perception.name=statistical")
    with tempfile.TemporaryDirectory() as folder:
        flight = simulate(shipped_scenario(name), Path(folder), settings)
        if flight.crashes or flight.stalled:
            raise SystemExit("\n".join([*flight.crashes.values(), *flight.stalled]))
        recorded = load_flight(Path(folder) / "mission.mcap")
        return recorded.motion, summary_of(recorded)["failures"]


def tracks_apart(a: Mapping[str, Track], b: Mapping[str, Track]) -> tuple[float, float]:
    """Return the largest differences of position (m) and attitude (degrees) of any body at one
    time.
    """
    distance_m = angle_rad = 0.0
    for name, track in a.items():
        other = b[name]
        distance_m = max(
            distance_m, float(np.linalg.norm(track.position_m - other.position_m, axis=1).max())
        )
        angle_rad = max(
            angle_rad, float(np.max(rotations.angle_between(track.q_wxyz, other.q_wxyz)))
        )
    return distance_m, math.degrees(angle_rad)


GROUP = Group(
    {
        **{
            name: described(partial(compare, name), f"Compare: {case.__doc__}")
            for name, case in CASES.items()
        },
        "missions": missions,
    },
    ("flights", "first"),
)
