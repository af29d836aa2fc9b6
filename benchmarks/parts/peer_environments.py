# SPDX-License-Identifier: Apache-2.0
"""Speed of other simulators for training, beside the environments of ``chaserdock.envs``.

Each flies bodies with six degrees of freedom under random actions. Seconds are of the processor, of
all threads; a step is that of one agent.
"""

from __future__ import annotations

from argparse import ArgumentParser

from common import Figures, Group, Options
from peers.interpreter import run_in

from .environments import steps_per_s, task_scenario

_LOOP = """
import json, sys, time
given = json.load(sys.stdin)

def measure(step, agents):
    for _ in range(3):
        step()
    count, begin_s = 0, time.process_time()
    while time.process_time() - begin_s < given["seconds"]:
        step()
        count += agents
    return count / (time.process_time() - begin_s)
"""
_MUJOCO = """
import mujoco, numpy as np
mass = '<inertial pos="0 0 0" mass="30" diaginertia="1 1 1"/>'
body = '<body pos="{0} 0 0"><freejoint/>' + mass + '</body>'
model = mujoco.MjModel.from_xml_string(
    '<mujoco><option gravity="0 0 0" timestep="%r"/><worldbody>%s%s</worldbody></mujoco>'
    % (1.0 / (15.0 * given["substeps"]), body.format(0), body.format(1)))
data, rng = mujoco.MjData(model), np.random.default_rng(0)

def step():
    data.xfrc_applied[1] = rng.uniform(-1.0, 1.0, 6)
    mujoco.mj_step(model, data, given["substeps"])
    return np.concatenate([data.qpos, data.qvel])
print("RESULT", measure(step, 1))
"""
_BASILISK = """
import numpy as np
from Basilisk.architecture import messaging
from Basilisk.simulation import extForceTorque, spacecraft
from Basilisk.utilities import SimulationBaseClass, macros
interval = macros.sec2nano(1.0 / (15.0 * given["substeps"]))
sim = SimulationBaseClass.SimBaseClass()
sim.CreateNewProcess("p").addTask(sim.CreateNewTask("t", interval))
crafts, load = [spacecraft.Spacecraft(), spacecraft.Spacecraft()], extForceTorque.ExtForceTorque()
for craft in crafts:
    craft.hub.mHub, craft.hub.IHubPntBc_B = 30.0, np.eye(3).tolist()
    sim.AddModelToTask("t", craft)
crafts[0].addDynamicEffector(load)
sim.AddModelToTask("t", load)
sim.InitializeSimulation()
rng, tick = np.random.default_rng(0), 0

def step():
    global tick
    tick += given["substeps"]
    wrench = rng.uniform(-1.0, 1.0, (6, 1))
    load.extForce_B, load.extTorquePntB_B = wrench[:3].tolist(), wrench[3:].tolist()
    sim.ConfigureStopTime(tick * interval)
    sim.ExecuteSimulation()
    return [craft.scStateOutMsg.read().r_BN_N for craft in crafts]
print("RESULT", measure(step, 1))
"""
_CRAZYFLOW = """
import jax, numpy as np
from crazyflow.envs import ReachPosEnv
env = ReachPosEnv(num_envs=given["environments"], freq=50)
env.reset(seed=0)
actions = env.action_space.sample()

def step():
    return jax.block_until_ready(env.step(actions)[:2])
print("RESULT", measure(step, given["environments"]))
"""
_SAFE_AUTONOMY = """
from safe_autonomy_sims.gym.inspection import sixdof_inspection_v0
env = sixdof_inspection_v0.WeightedSixDofInspectionEnv()
env.reset(seed=0)

def step():
    done = env.step(env.action_space.sample())
    if done[2] or done[3]:
        env.reset()
print("RESULT", measure(step, 1))
"""
PEERS = {
    "mujoco": (_MUJOCO, 64),
    "basilisk": (_BASILISK, 64),
    "basilisk_one_substep": (_BASILISK, 1),
    "crazyflow": (_CRAZYFLOW, 0),
    "safe_autonomy_sims": (_SAFE_AUTONOMY, 0),
}
"""Script of each, and physics steps in a step; 0: its own."""


def peer_environments(options: Options) -> Figures:
    """Agent steps in a second of processor time: docking of ``chaserdock.envs`` (64 physics steps
    each, observation and reward included), two free bodies in MuJoCo and in Basilisk (as many; one
    of Basilisk's RK4), crazyflow's ``ReachPosEnv`` and safe-autonomy-sims' inspection with six
    degrees of freedom. ``--peers-python``: an interpreter that has them.
    """
    seconds = 2.0 if options.quick else 10.0
    rate, _ = steps_per_s(task_scenario("ideal", "truth", options.set), options.environments, 3)
    figures: Figures = {"chaserdock_steps_per_s": rate}
    print(f"chaserdock {rate:12.0f}")
    for name, (script, substeps) in PEERS.items():
        given = {
            "seconds": seconds, "substeps": substeps, "environments": options.environments,
        }  # fmt: skip
        rate = run_in(options.peers_python, _LOOP + script, given)
        print(f"{name} {rate:12.0f}", flush=True)
        figures[f"{name}_steps_per_s"] = rate
    return figures


def _add_options(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--peers-python",
        default="python3",
        metavar="PYTHON",
        help="interpreter with mujoco, bsk, crazyflow, safe-autonomy-sims (default: python3)",
    )


GROUP = Group(
    {"peer-environments": peer_environments},
    ("set",),
    _add_options,
    on_request=("peer-environments",),
)
