# SPDX-License-Identifier: Apache-2.0
"""Relative orbital motion against Basilisk and Clohessy-Wiltshire: two spacecraft 100 m apart fly
one orbit under two-body gravity, and with J2.
"""

from __future__ import annotations

import json
import math
import tempfile
from argparse import ArgumentParser
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from chaserdock_models.orbit import (
    EARTH_J2,
    EARTH_MU_M3_S2,
    EARTH_RADIUS_M,
    OrbitalElements,
    OrbitState,
    from_eci,
    state_of,
    to_eci,
)
from chaserdock_models.relative_motion import cw_transition, propagate_relative
from common import ROOT, Figures, Group, Options
from peers.interpreter import run_in

REFERENCE = ROOT / "tests" / "models" / "basilisk_relative_orbit.json"

ORBITS = {
    "circular": (OrbitalElements(EARTH_RADIUS_M + 4e5, 0.0, 0.9), 0.0),
    "circular_j2": (OrbitalElements(EARTH_RADIUS_M + 4e5, 0.0, 0.9, 0.4), EARTH_J2),
    "polar_j2": (OrbitalElements(EARTH_RADIUS_M + 8e5, 0.001, 1.72, 0.4, 0.3, 1.0), EARTH_J2),
    "eccentric_j2": (OrbitalElements(9e6, 0.2, 1.1, 0.2, 1.0, 0.3), EARTH_J2),
}
STARTS = {"radial": (100.0, 0.0, 0.0), "along": (0.0, -100.0, 0.0), "cross": (0.0, 0.0, 100.0)}
"""Start in the Hill frame, m."""

# Runs in Basilisk's interpreter: cases on stdin, final ECI states of both spacecraft on stdout.
_BASILISK = """
import json, sys
from Basilisk.simulation import gravityEffector, spacecraft, svIntegrators
from Basilisk.utilities import SimulationBaseClass, macros
given = json.load(sys.stdin)
results = []
for case in given["cases"]:
    sim = SimulationBaseClass.SimBaseClass()
    process = sim.CreateNewProcess("p")
    step_ns = macros.sec2nano(case["duration_s"] / case["steps"])
    process.addTask(sim.CreateNewTask("t", step_ns))
    bodies = []
    for k, (position, velocity) in enumerate(case["states"]):
        earth = gravityEffector.GravBodyData()
        earth.planetName, earth.mu, earth.radEquator = "earth", given["mu"], given["radius"]
        earth.isCentralBody = True
        if case["j2"]:
            earth.useSphericalHarmonicsGravityModel(given["coefficients"], 2)
        body = spacecraft.Spacecraft()
        body.ModelTag = f"body{k}"
        body.hub.r_CN_NInit, body.hub.v_CN_NInit = position, velocity
        body.gravField.gravBodies = spacecraft.GravBodyVector([earth])
        body.setIntegrator(svIntegrators.svIntegratorRKF78(body))
        sim.AddModelToTask("t", body)
        bodies.append((body, earth))
    sim.InitializeSimulation()
    sim.ConfigureStopTime(step_ns * case["steps"])
    sim.ExecuteSimulation()
    states = []
    for body, _ in bodies:
        out = body.scStateOutMsg.read()
        states.append([list(out.r_BN_N), list(out.v_BN_N)])
    results.append({"duration_s": step_ns * case["steps"] * 1e-9, "states": states})
print("RESULT" + json.dumps(results))
"""


def cases() -> list[dict[str, Any]]:
    """Return the cases: orbit, J2, and start in the Hill frame, with the speed that keeps the
    distance along track bounded.
    """
    made: list[dict[str, Any]] = []
    for orbit, (elements, j2) in ORBITS.items():
        for name, start in STARTS.items():
            made.append(
                {
                    "name": f"{orbit}_{name}",
                    "elements": asdict(elements),
                    "j2": j2,
                    "position_m": start,
                    "velocity_m_s": (0.0, -2.0 * elements.mean_motion_rad_s * start[0], 0.01),
                    "duration_s": round(elements.period_s),
                }
            )
    return made


def fly_in_basilisk(python: str, folder: Path) -> list[dict[str, Any]]:
    """Return the cases with their final relative positions in Basilisk."""
    coefficients = folder / "j2.csv"
    # Normalized C20 of the same J2; the format of Basilisk's files of coefficients.
    rows = [f"{EARTH_RADIUS_M},{EARTH_MU_M3_S2},0,2,2,1,0,0", "0,0,1,0", "1,0,0,0", "1,1,0,0"]
    rows += [f"2,0,{-EARTH_J2 / math.sqrt(5):.17g},0", "2,1,0,0", "2,2,0,0"]
    coefficients.write_text("\n".join(rows) + "\n")
    flown = cases()
    given = {
        "mu": EARTH_MU_M3_S2,
        "radius": EARTH_RADIUS_M,
        "coefficients": str(coefficients),
        "cases": [],
    }
    for case in flown:
        orbit = state_of(OrbitalElements(**case["elements"]))
        body = to_eci(orbit, case["position_m"], case["velocity_m_s"], case["j2"])
        states = [[s.position_m.tolist(), s.velocity_m_s.tolist()] for s in (orbit, body)]
        given["cases"].append(
            {
                "states": states,
                "j2": case["j2"],
                "duration_s": case["duration_s"],
                "steps": case["duration_s"],
            }
        )
    results = run_in(python, _BASILISK, given)
    for case, result in zip(flown, results, strict=True):
        orbit, body = (OrbitState(*map(np.array, s)) for s in result["states"])
        case["duration_s"] = result["duration_s"]
        case["end_position_m"] = from_eci(orbit, body, case["j2"])[0].tolist()
    return flown


def orbit(options: Options) -> Figures:
    """Compare one orbit of two spacecraft at 100 m with Basilisk (recorded, or flown by
    ``--basilisk``), and Clohessy-Wiltshire with it. ``--quick``: a third of the cases.
    """
    if options.basilisk:
        with tempfile.TemporaryDirectory() as folder:
            flown = fly_in_basilisk(options.basilisk, Path(folder))
        if options.write:
            REFERENCE.write_text(json.dumps({"cases": flown}, indent=1) + "\n")
    else:
        flown = json.loads(REFERENCE.read_text())["cases"]
    figures: Figures = {}
    for case in flown[:: 3 if options.quick else 1]:
        elements = OrbitalElements(**case["elements"])
        start = (case["position_m"], case["velocity_m_s"])
        position, _ = propagate_relative(state_of(elements), *start, case["duration_s"], case["j2"])
        figures[f"{case['name']}_to_basilisk_m"] = math.dist(position, case["end_position_m"])
        transition = cw_transition(elements.mean_motion_rad_s, case["duration_s"])
        linear = transition @ np.concatenate(start)
        figures[f"{case['name']}_cw_error_m"] = math.dist(linear[:3], case["end_position_m"])
    return figures


def add_options(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--basilisk",
        metavar="PYTHON",
        help="of orbit and flexible: interpreter of an environment of its own, in which bsk is "
        "installed",
    )
    parser.add_argument(
        "--write", action="store_true", help="record Basilisk's results for the tests"
    )


GROUP = Group({"orbit": orbit}, add_options=add_options)
