# SPDX-License-Identifier: Apache-2.0
"""Bodies that are not rigid against Basilisk: a chaser with panels and fuel on springs flies from a
general state under pulses of force and torque, on both engines.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_protocol.shipped_scenarios import shipped_scenario
from chaserdock_world.physics.simulation import Physics
from chaserdock_world.plant import chaser_plant
from common import ROOT, BenchmarkFailed, Figures, Group, Options
from flights.engine_comparison import ENGINES
from peers.interpreter import run_in

REFERENCE = ROOT / "tests" / "world" / "basilisk_flexible.json"
BAR_SHARE = 1e-4
CHASER = "chaser/0"


def _carried(panels_hz: float | None, fuel_hz: float | None, damped: bool = True) -> str:
    """Return what the chaser carries: two panels that bend along Z, and fuel."""
    made = []
    for y in (0.3, -0.3) if panels_hz else ():
        at = f"position_m=[0.02,{y},0.01], frequency_hz=[2.0,3.0,{panels_hz}]"
        made.append(f"{{mass_share=0.04, {at}, damping_share={0.005 * damped}}}")
    if fuel_hz:
        at = f"position_m=[-0.05,0.02,0.03], frequency_hz={fuel_hz}"
        made.append(f"{{mass_share=0.2, {at}, damping_share={0.02 * damped}}}")
    return ",".join(made)


CASES = {
    "panels": _carried(0.3, None),
    "slosh": _carried(None, 0.5),
    "panels_and_slosh": _carried(0.1, 1.0),
}
"""What the chaser carries, by case."""

SECONDS, HZ = (1, 2, 5, 10, 20, 50, 100), 960
"""Times of the comparison, s, and physics steps in a second."""
START = BodyState(
    np.array([3.0, -2.0, 1.0]),
    np.array([0.01, 0.02, -0.03]),
    rotations.exp([0.3, -0.5, 0.8]),
    np.array([0.05, -0.08, 0.06]),
)
PULSES = (
    (960, 1440, (0.5, 0.3, -0.4, 0.02, 0.03, -0.01)),
    (9600, 9792, (-1.5, 1.5, 0.5, -0.05, 0.02, 0.15)),
    (40000, 44800, (0.0, 0.1, 0.2, 0.004, -0.003, 0.001)),
)
"""First and last physics step, and the wrench at CRF's origin (body axes), N and N m."""

BASILISK_EVERY = 4
"""Physics steps in a step of Basilisk (RK4)."""
LEAD_S = 0.5 / HZ
"""Half a step, by which loads of the engines act early: a step begins with a change of velocity for
the whole of it (engine.py). Basilisk starts so much earlier, and its results are led by it.
"""

# Runs in Basilisk's interpreter: cases on stdin, states at whole seconds on stdout. A mass on
# springs along three axes is a chain of three translations, of which the last has the mass.
_BASILISK = """
import json, sys
from Basilisk.simulation import extForceTorque, linearTranslationNDOFStateEffector as translation
from Basilisk.simulation import spacecraft, svIntegrators
from Basilisk.utilities import SimulationBaseClass, macros
given = json.load(sys.stdin)
SMALL = [[1e-12, 0.0, 0.0], [0.0, 1e-12, 0.0], [0.0, 0.0, 1e-12]]
UNIT = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
step = macros.sec2nano(1.0) / given["hz"]

def readings(chains):
    return [[message.read() for message in chain.translatingBodyOutMsgs] for chain in chains]

results = []
for case in given["cases"]:
    sim = SimulationBaseClass.SimBaseClass()
    process = sim.CreateNewProcess("p")
    body, hub = spacecraft.Spacecraft(), case["hub"]
    body.hub.mHub, body.hub.r_BcB_B = hub["mass"], [[x] for x in hub["centre"]]
    body.hub.IHubPntBc_B = hub["inertia"]
    body.hub.r_CN_NInit, body.hub.v_CN_NInit = case["position"], case["velocity"]
    body.hub.sigma_BNInit = [[x] for x in case["sigma"]]
    body.hub.omega_BN_BInit = [[x] for x in case["omega"]]
    chains = []
    for k, mass in enumerate(case["masses"]):
        chain = translation.LinearTranslationNDOFStateEffector()
        chain.ModelTag = f"chain{k}"
        for axis in range(3):
            link = translation.TranslatingBody()
            link.setMass(mass["mass"] if axis == 2 else 0.0)
            link.setIPntFc_F(SMALL)
            link.setFHat_P([[x] for x in UNIT[axis]])
            link.setR_F0P_P([[x] for x in (mass["place"] if axis == 0 else [0.0] * 3)])
            link.setR_FcF_F([[0.0]] * 3)
            link.setDCM_FP(UNIT)
            link.setK(mass["stiffness"][axis])
            link.setC(mass["damping"][axis])
            chain.addTranslatingBody(link)
        body.addStateEffector(chain)
        chains.append(chain)
    pull = extForceTorque.ExtForceTorque()
    body.addDynamicEffector(pull)
    body.setIntegrator(svIntegrators.svIntegratorRK4(body))
    process.addTask(sim.CreateNewTask("t", round(step * given["every"])))
    for module in (pull, body, *chains):
        sim.AddModelToTask("t", module)
    readings(chains)  # a message that nobody has read is not written
    sim.InitializeSimulation()
    samples = []
    marks = [(s * given["hz"], None) for s in given["seconds"]]
    for first, last, wrench in given["pulses"]:
        marks += [(first, wrench), (last, [0.0] * 6)]
    for at, wrench in sorted(marks, key=lambda mark: mark[0]):
        sim.ConfigureStopTime(round(step * (at + 0.5)))
        sim.ExecuteSimulation()
        if wrench is None:
            out = body.scStateOutMsg.read()
            bent = readings(chains)
            samples.append(
                {
                    "position": list(out.r_BN_N),
                    "velocity": list(out.v_BN_N),
                    "sigma": list(out.sigma_BN),
                    "omega": list(out.omega_BN_B),
                    "bent": [[m.rho for m in chain] for chain in bent],
                    "bending": [[m.rhoDot for m in chain] for chain in bent],
                }
            )
        else:
            pull.extForce_B = [[x] for x in wrench[:3]]
            pull.extTorquePntB_B = [[x] for x in wrench[3:]]
    results.append(samples)
print("RESULT" + json.dumps(results))
"""


def scenario_of(case: str, engine: str) -> Scenario:
    """Return the scenario of a case: the chaser of ``docking-contact``, far from its target."""
    return _scenario(CASES[case], engine)


def _scenario(carried: str, engine: str) -> Scenario:
    overrides = (f"truth.oscillator=[{carried}]", f'world.engine="{engine}"')
    return load_scenario(shipped_scenario("docking-contact"), overrides)


def _basilisk_case(name: str) -> dict[str, Any]:
    """Return a case as Basilisk takes it: its hub is the rigid rest of the chaser."""
    scenario = scenario_of(name, "pybullet")
    physics, whole = Physics(scenario), chaser_plant(scenario, 0).centre_of_mass_m
    rest, carried = physics.plants[CHASER], physics.carried[CHASER]
    physics.close()
    masses = []
    stated = scenario.truth.oscillators("chaser")
    for oscillator, mass in zip(stated, carried.masses_kg.tolist(), strict=True):
        omega = 2.0 * math.pi * np.array(oscillator.frequencies_hz)
        masses.append(
            {
                "mass": mass,
                "place": oscillator.position_m,
                "stiffness": (mass * omega**2).tolist(),
                "damping": (2.0 * np.array(oscillator.damping_shares) * mass * omega).tolist(),
            }
        )
    q = rotations.multiply(START.q_wxyz, rotations.exp(-LEAD_S * START.omega_rad_s))
    velocity = START.velocity_m_s + rotations.rotate(q, np.cross(START.omega_rad_s, whole))
    position = START.position_m - LEAD_S * START.velocity_m_s + rotations.rotate(q, whole)
    return {
        "name": name,
        "hub": {
            "mass": rest.mass_kg,
            "centre": rest.centre_of_mass_m.tolist(),
            "inertia": rest.inertia_kg_m2.tolist(),
        },
        "masses": masses,
        "position": position.tolist(),
        "velocity": velocity.tolist(),
        "sigma": (q[1:] / (1.0 + q[0])).tolist(),
        "omega": START.omega_rad_s.tolist(),
    }


def fly_in_basilisk(python: str) -> dict[str, list[dict[str, Any]]]:
    """Return, by case, position, attitude and deflections in Basilisk at ``SECONDS``."""
    given = {
        "cases": [_basilisk_case(name) for name in CASES],
        "hz": HZ,
        "every": BASILISK_EVERY,
        "seconds": SECONDS,
        "pulses": PULSES,
    }
    flown = run_in(python, _BASILISK, given)
    return {
        name: [_led(row) | {"at_s": at} for at, row in zip(SECONDS, rows, strict=True)]
        for name, rows in zip(CASES, flown, strict=True)
    }


def _led(row: dict[str, Any]) -> dict[str, Any]:
    """Return a row of Basilisk, half a step later."""
    sigma, parts = np.array(row["sigma"]), {}
    square = float(sigma @ sigma)
    q = np.array([1.0 - square, *(2.0 * sigma)]) / (1.0 + square)
    for name, value, rate in (
        ("position_m", "position", "velocity"),
        ("deflections_m", "bent", "bending"),
    ):
        parts[name] = (np.array(row[value]) + LEAD_S * np.array(row[rate])).tolist()
    turned = rotations.multiply(q, rotations.exp(LEAD_S * np.array(row["omega"])))
    return {**parts, "q_wxyz": turned.tolist()}


def fly(physics: Physics, seconds: Sequence[int]) -> list[tuple[BodyState, Array]]:
    """Fly a case; return state and deflections (n, 3), m, of the chaser at these times."""
    physics.place(CHASER, START)
    changes = sorted({step for first, last, _ in PULSES for step in (first, last)})
    flown = []
    for at in seconds:
        while (step := physics.step_count) < at * HZ:
            end = min([at * HZ, *(c for c in changes if c > step)])
            acting = [np.array(wrench) for first, last, wrench in PULSES if first <= step < last]
            physics.advance(end - step, {CHASER: acting[0]} if acting else {})
        flown.append((physics.state(CHASER), physics.deflections_m(CHASER)))
    return flown


def apart(
    flown: Sequence[tuple[BodyState, Array]], reference: Sequence[dict[str, Any]]
) -> tuple[float, float, float]:
    """Return the largest differences of position, attitude and deflection at any time.

    As shares of the largest travel, of half a turn, and of the largest deflection.
    """
    differences = [
        (
            float(np.linalg.norm(state.position_m - row["position_m"])),
            float(rotations.angle_between(state.q_wxyz, row["q_wxyz"])),
            float(np.abs(deflections - row["deflections_m"]).max()),
        )
        for (state, deflections), row in zip(flown, reference, strict=True)
    ]
    travel = max(float(np.linalg.norm(r["position_m"] - START.position_m)) for r in reference)
    bent = max(float(np.abs(r["deflections_m"]).max()) for r in reference)
    position, angle, deflection = np.max(differences, axis=0).tolist()
    return position / travel, angle / math.pi, deflection / bent


def _totals(physics: Physics, held_rad_s: Array) -> tuple[Array, Array, float]:
    """Return momentum (3,), angular momentum (3,) about WRF's origin and energy of the chaser.

    With what it carries; ``held_rad_s`` (n, 3): frequencies while it is held.
    """
    rest, state = physics.plants[CHASER], physics.state(CHASER)
    arm = rotations.rotate(state.q_wxyz, rest.centre_of_mass_m)
    omega = rotations.rotate(state.q_wxyz, state.omega_rad_s)
    velocity = state.velocity_m_s + np.cross(omega, arm)
    spin = rest.inertia_kg_m2 @ state.omega_rad_s
    masses, places, velocities = physics.carried[CHASER].momenta()
    momentum = rest.mass_kg * velocity + masses @ velocities
    angular = rest.mass_kg * np.cross(state.position_m + arm, velocity)
    angular = angular + rotations.rotate(state.q_wxyz, spin)
    angular = angular + (masses[:, None] * np.cross(places, velocities)).sum(axis=0)
    stretch = held_rad_s * physics.deflections_m(CHASER)
    energy = rest.mass_kg * velocity @ velocity + state.omega_rad_s @ spin
    energy += masses @ (velocities**2 + stretch**2).sum(axis=1)
    return momentum, angular, 0.5 * float(energy)


def conserved(engine: str, seconds: int) -> Figures:
    """Return the changes of momentum and angular momentum, and of the energy's mean over five
    seconds, as shares, of a free chaser without damping that was set swinging.
    """
    scenario = _scenario(_carried(0.1, 1.0, damped=False), engine)
    physics, stated = Physics(scenario), scenario.truth.oscillators("chaser")
    held = 2.0 * math.pi * np.array([o.frequencies_hz for o in stated])
    physics.place(CHASER, START)
    physics.advance(HZ // 2, {CHASER: np.array(PULSES[0][2])})
    rows = [_totals(physics, held)]
    for _ in range(20 * seconds):
        physics.advance(HZ // 20, {})
        rows.append(_totals(physics, held))
    physics.close()
    (first, first_angular, _), (last, last_angular, _) = rows[0], rows[-1]
    energies = np.array([row[2] for row in rows])
    return {
        f"{engine}_momentum_share": float(np.linalg.norm(last - first) / np.linalg.norm(first)),
        f"{engine}_angular_momentum_share": float(
            np.linalg.norm(last_angular - first_angular) / np.linalg.norm(first_angular)
        ),
        f"{engine}_energy_share": float(energies[-100:].mean() / energies[:100].mean() - 1.0),
    }


def flexible(options: Options) -> Figures:
    """Compare a chaser with panels and fuel on springs with Basilisk (recorded, or flown by
    ``--basilisk``) over 100 s, on each engine: shares of travel, half a turn and the largest
    deflection (bar: 1e-4). Then, without damping, what should be conserved. ``--quick``: 5 and
    10 s.
    """
    reference: dict[str, list[dict[str, Any]]] = json.loads(REFERENCE.read_text())
    if options.basilisk:
        reference = fly_in_basilisk(options.basilisk)
        if options.write:
            REFERENCE.write_text(json.dumps(reference, indent=1) + "\n")
    figures: Figures = {}
    for name, rows in reference.items():
        known = [row for row in rows if row["at_s"] <= (5 if options.quick else math.inf)]
        for engine in ENGINES:
            physics = Physics(scenario_of(name, engine))
            shares = apart(fly(physics, [row["at_s"] for row in known]), known)
            physics.close()
            for what, share in zip(("position", "attitude", "deflection"), shares, strict=True):
                figures[f"{name}_{engine}_{what}_share"] = share
    for engine in ENGINES:
        figures |= conserved(engine, 10 if options.quick else 100)
    if max(figures.values()) > BAR_SHARE:
        raise BenchmarkFailed(f"differs from Basilisk by more than {BAR_SHARE:g}", figures)
    return figures


GROUP = Group({"flexible": flexible})
