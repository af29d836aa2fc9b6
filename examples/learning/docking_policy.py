# SPDX-License-Identifier: Apache-2.0
"""A learned policy in the place of the NMPC: from the command to approach on until the latch
closes. Before, and when a chaser retreats, the NMPC flies.

The policy is the file of the environment variable CHASERDOCK_POLICY, or ``docking.onnx`` beside
this module; train.py writes it.
"""

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
from chaserdock_controller.nmpc import NmpcPlan, make_solver
from chaserdock_models import rotations
from chaserdock_models.rigid_body import BodyState

from chaserdock.envs.observation import goal_of, observation_of
from chaserdock.envs.policy import Policy, PolicyError

FILE = "docking.onnx"
TASKS = ("hold", "come", "latch")


class PolicySolver:
    def __init__(self, params, n, max_iterations=None):
        self.params, self.limits = params, params.input_limits()
        self.others = make_solver("rti", params, n, max_iterations)
        self.goals = ()
        path = os.environ.get("CHASERDOCK_POLICY") or Path(__file__).with_name(FILE)
        self.policy = Policy(Path(path))

    def prepare(self, scenario):
        """Check the policy against the mission, and note where its chasers dock."""
        self.policy.check(scenario)
        if self.policy.task not in TASKS:
            raise PolicyError(
                f"{self.policy.path}: is for the task {self.policy.task!r}; this solver flies "
                f"{', '.join(TASKS)}"
            )
        if self.policy.action != "actuators":
            raise PolicyError(
                f"{self.policy.path}: its actions are of {self.policy.action!r}; this solver takes "
                "those of actuators"
            )
        if self.policy.actuation != "ideal":
            raise PolicyError(
                f"{self.policy.path}: commands {self.policy.actuation!r}; a solver plans wrenches, "
                'as a policy for chaser.actuation = "ideal" does'
            )
        chasers = range(len(scenario.chasers))
        self.goals = tuple(goal_of(scenario, i, self.policy.task) for i in chasers)

    def reset(self):
        self.others.reset()

    def solve(self, problem, shift_s, ids=None):
        chosen, n, d = problem.docking, len(problem.states), self.params.stages
        if len(chosen) == n:
            self.others.reset()  # its last plan is of no use when it is needed again
            none = np.zeros(n)
            plan = NmpcPlan(np.zeros((n, d, 6)), np.zeros((n, d + 1, 13)), ("solved",) * n,
                            none.astype(int), none, none)  # fmt: skip
        else:
            plan = self.others.solve(problem, shift_s, ids)
        status = tuple("solved" if k in chosen else word for k, word in enumerate(plan.status))
        inputs, states = np.array(plan.inputs), np.array(plan.states)
        for row in chosen:
            inputs[row], states[row] = self.flight(problem, row, row if ids is None else ids[row])
        return replace(plan, inputs=inputs, states=states, status=status)

    def flight(self, problem, row, number):
        """Return inputs (D, 6) and states (D + 1, 13) of a chaser that the policy flies, while all
        others and the target keep their rates.
        """
        d, dt = self.params.stages, self.params.dt_s
        inputs, states, target = np.zeros((d, 6)), np.zeros((d + 1, 13)), problem.target
        states[0] = problem.states[row]
        for k in range(d):
            apart_s = k * dt
            others = [s[:3] + apart_s * s[3:6] for j, s in enumerate(problem.states) if j != row][
                : len(self.goals) - 1
            ]
            moved = BodyState(
                target.position_m + apart_s * target.velocity_m_s,
                target.velocity_m_s,
                rotations.multiply(target.q_wxyz, rotations.exp(apart_s * target.omega_rad_s)),
                target.omega_rad_s,
            )
            x = states[k]
            own = BodyState(x[:3], x[3:6], x[6:10], x[10:])
            seen = observation_of(self.goals[number], own, moved, others)
            wrench = self.policy.actions(seen[None])[0] * self.limits
            most = problem.input_max[row]
            inputs[k] = np.clip(wrench, -most, most)
            states[k + 1] = self.step(x, inputs[k])
        return inputs, states

    def step(self, x, u):
        """The state (13,) one step later, semi-implicit Euler."""
        p, dt, inertia = self.params, self.params.dt_s, np.array(self.params.inertia_kg_m2)
        v = x[3:6] + dt * rotations.rotate(x[6:10], u[:3]) / p.mass_kg
        w = x[10:] + dt * np.linalg.solve(inertia, u[3:] - np.cross(x[10:], inertia @ x[10:]))
        q = rotations.normalize(rotations.multiply(x[6:10], rotations.exp(dt * w)))
        return np.concatenate([x[:3] + dt * v, v, q, w])
