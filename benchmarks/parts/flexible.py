# SPDX-License-Identifier: Apache-2.0
"""Bodies that are not rigid against Basilisk: a chaser with panels and fuel on springs flies from a
general state under pulses of force and torque, on both engines.
"""

from __future__ import annotations

import json
import math
import subprocess
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

REFERENCE = ROOT / "tests" / "world" / "basilisk_flexible.json"
BAR_SHARE = 1e-4

_PANELS = (
    "{{mass_share=0.04, position_m=[0.02,0.3,0.01], frequency_hz=[2.0,3.0,{hz}]}},"
    "{{mass_share=0.04, position_m=[0.02,-0.3,0.01], frequency_hz=[2.0,3.0,{hz}]}}"
)
_SLOSH = "{{mass_share=0.2, position_m=[-0.05,0.02,0.03], frequency_hz={hz}, damping_share=0.02}}"
CASES = {
    "panels": _PANELS.format(hz=0.3),
    "slosh": _SLOSH.format(hz=0.5),
    "panels_and_slosh": f"{_PANELS.format(hz=0.1)},{_SLOSH.format(hz=1.0)}",
}
"""What the chaser carries: panels that bend along Z at the given frequency, and fuel."""

DURATION_S, HZ = 100, 960
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
