# SPDX-License-Identifier: Apache-2.0
"""A PD law in the place of the NMPC: same references, same limits, no look ahead and no regard for
obstacles.
"""

import numpy as np
from chaserdock_controller.nmpc import NmpcPlan
from chaserdock_models import rotations

KP, KD = 0.16, 0.72  # 1/s^2 and 1/s: 0.4 rad/s, damped 0.9


class Pd:
    def __init__(self, params, n, max_iterations=None):
        self.params = params

    def reset(self):
        """It remembers nothing."""

    def solve(self, problem, shift_s, ids=None):
        p, n = self.params, len(problem.states)
        inputs, states = np.zeros((n, p.stages, 6)), np.zeros((n, p.stages + 1, 13))
        for i in range(n):
            states[i, 0] = problem.states[i]
            for k in range(p.stages):
                u = problem.u_ref[i, k] + self.law(states[i, k], problem.references[i, k : k + 2])
                inputs[i, k] = np.clip(u, -problem.input_max[i], problem.input_max[i])
                states[i, k + 1] = self.step(states[i, k], inputs[i, k])
        none = np.zeros(n)
        return NmpcPlan(inputs, states, ("solved",) * n, none.astype(int), none, none)

    def law(self, x, reference):
        """Force and torque (6,), body axes, towards the two next reference poses (2, 7)."""
        p, dt = self.params, self.params.dt_s
        velocity = (reference[1, :3] - reference[0, :3]) / dt
        pull = KP * (reference[0, :3] - x[:3]) + KD * (velocity - x[3:6])
        error = rotations.log(rotations.multiply(rotations.conjugate(x[6:10]), reference[0, 3:]))
        rate = (
            rotations.log(
                rotations.multiply(rotations.conjugate(reference[0, 3:]), reference[1, 3:])
            )
            / dt
        )
        turn = np.array(p.inertia_kg_m2) @ (KP * error + KD * (rate - x[10:]))
        return np.concatenate([p.mass_kg * rotations.rotate_inverse(x[6:10], pull), turn])

    def step(self, x, u):
        """The state (13,) one step later, semi-implicit Euler."""
        p, dt, inertia = self.params, self.params.dt_s, np.array(self.params.inertia_kg_m2)
        v = x[3:6] + dt * rotations.rotate(x[6:10], u[:3]) / p.mass_kg
        w = x[10:] + dt * np.linalg.solve(inertia, u[3:] - np.cross(x[10:], inertia @ x[10:]))
        q = rotations.normalize(rotations.multiply(x[6:10], rotations.exp(dt * w)))
        return np.concatenate([x[:3] + dt * v, v, q, w])
