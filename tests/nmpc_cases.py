# SPDX-License-Identifier: Apache-2.0
"""Chasers, problems and a closed loop for the tests of the NMPC."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from chaserdock_controller.guidance.reference import (
    feed_forward,
    predict_target,
    reference_state,
    reference_trajectory,
)
from chaserdock_controller.nmpc import (
    NmpcInput,
    NmpcParameters,
    NmpcPlan,
    NmpcSolver,
    kernels,
    make_solver,
)
from chaserdock_controller.nmpc.problem import model_of, settings_of, terms_of
from chaserdock_controller.parameters import nmpc_settings
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.scenario.schema import Controller, Limits

# The paper's chaser and tumble (paper/reference.toml).
MASS_KG = 30.0
_LONG, _FLAT = MASS_KG / 12 * (0.25**2 + 0.25**2), MASS_KG / 12 * (0.25**2 + 0.05**2)
INERTIA = ((_FLAT, 0.0, 0.0), (0.0, _FLAT, 0.0), (0.0, 0.0, _LONG))
SETTINGS = nmpc_settings(Controller(), Limits())
PARAMS = NmpcParameters(
    mass_kg=MASS_KG, inertia_kg_m2=INERTIA, force_max_N=2.0, torque_max_N_m=0.05, **SETTINGS
)


def with_settings(params: NmpcParameters, **changes: Any) -> NmpcParameters:
    """Return parameters with fields, or settings of terms, changed."""
    own = {name: changes.pop(name) for name in vars(params).keys() & changes}
    return replace(params, **own, terms=terms_of(settings_of(params.terms) | changes))


V_TARGET = np.array([1.5e-2, 0.75e-2, 3e-2])
W_TARGET = np.array([1.5e-2, 4.5e-2, 3e-2])
HALF = np.sqrt(0.5)
OFFSETS = np.array([[-1.0, 0, 0], [0, -1.0, 0], [0, 1.0, 0], [1.0, 0, 0]])
Q_OFFSETS = np.array([[1.0, 0, 0, 0], [HALF, 0, 0, HALF], [HALF, 0, 0, -HALF], [0, 0, 0, 1.0]])
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
D_MIN_M = 0.35


@cache
def solver(name: str, n: int, params: NmpcParameters = PARAMS) -> NmpcSolver:
    """One per kind: building is what costs time. Every user resets it."""
    return make_solver(name, params, n)


def fresh(name: str, n: int, params: NmpcParameters = PARAMS) -> NmpcSolver:
    chosen = solver(name, n, params)
    chosen.reset()
    return chosen


def at_rest(position: Array, q: Array = LEVEL) -> Array:
    return np.concatenate([position, np.zeros(3), q, np.zeros(3)])


def fixed_problem(
    states: Array,
    goals: Array,
    q_goal: Array = LEVEL,
    target: Array | None = None,
    d_target: float = D_MIN_M,
    d_chasers: float = D_MIN_M,
) -> NmpcInput:
    """Return a problem with constant references: goals (N, 3), attitude ``q_goal``."""
    n, d = len(states), PARAMS.stages
    pose = np.concatenate([goals, np.tile(q_goal, (n, 1))], axis=1)
    return NmpcInput(
        states=states,
        references=np.repeat(pose[:, None, :], d + 1, axis=1),
        u_ref=np.zeros((n, d, 6)),
        target_positions=np.tile(np.zeros(3) if target is None else target, (d + 1, 1)),
        min_distance_target_m=np.full(n, d_target),
        min_distance_chasers_m=d_chasers,
        input_max=np.tile(PARAMS.input_limits(), (n, 1)),
    )


def advance(states: Array, inputs: Array, duration_s: float, parts: int = 4) -> Array:
    """Propagate the states with a finer integration than the plan's."""
    x = np.empty((len(states), parts + 1, 13))
    x[:, 0] = states
    held = np.repeat(inputs[:, None], parts, axis=1)
    kernels.roll(model_of(PARAMS, duration_s / parts), x, held)
    return x[:, -1].copy()


@dataclass
class ClosedLoopRun:
    states: Array  # (ticks + 1, N, 13)
    plans: list[NmpcPlan]
    cost: float  # stage cost of eq. 6 along the true motion, times the control period

    def between(self) -> float:
        p = self.states[:, :, :3]
        return float(np.min(np.linalg.norm(p[:, 0] - p[:, 1], axis=-1)))

    def from_target(self, target: Array | None = None) -> float:
        centre = np.zeros(3) if target is None else target
        return float(np.min(np.linalg.norm(self.states[:, :, :3] - centre, axis=-1)))


def fly(
    chosen: NmpcSolver,
    problem_at: Callable[[Array, float], NmpcInput],
    states: Array,
    control_s: float,
    time_s: float,
) -> ClosedLoopRun:
    history, plans, cost = [states], [], 0.0
    for k in range(round(time_s / control_s)):
        problem = problem_at(states, k * control_s)
        plan = chosen.solve(problem, control_s if k else 0.0)
        plans.append(plan)
        assert np.all(np.abs(plan.inputs) <= problem.input_max[:, None, :])
        for x, u, ref, free in zip(
            states, plan.inputs[:, 0], problem.references[:, 0], problem.u_ref[:, 0], strict=True
        ):
            error = rotations.multiply(x[6:10], rotations.conjugate(ref[3:]))[1:]
            cost += control_s * (65.0 * np.sum((x[:3] - ref[:3]) ** 2) + 35.0 * np.sum(error**2))
            cost += control_s * np.sum(np.array([3.5] * 3 + [40.0] * 3) * (u - free) ** 2)
        states = advance(states, plan.inputs[:, 0], control_s)
        history.append(states)
    return ClosedLoopRun(np.array(history), plans, float(cost))


def tumbling(n: int, feed: bool = True) -> tuple[Callable[[Array, float], NmpcInput], Array]:
    """Return the paper's tracking problem as a function of state and time, and states on the
    references.
    """
    d = PARAMS.stages
    times = PARAMS.dt_s * np.arange(d + 1)

    def problem_at(states: Array, now_s: float) -> NmpcInput:
        p, q = (a[0] for a in predict_target(np.zeros(3), V_TARGET, LEVEL, W_TARGET, [now_s]))
        references = [
            reference_trajectory(p, V_TARGET, q, W_TARGET, OFFSETS[i], Q_OFFSETS[i], times)
            for i in range(n)
        ]
        zero = np.zeros((d, 3))
        wrench = [
            feed_forward(
                W_TARGET, np.tile(OFFSETS[i], (d, 1)), zero, zero, Q_OFFSETS[i], MASS_KG, INERTIA
            )
            for i in range(n)
        ]
        return NmpcInput(
            states=states,
            references=np.array(references),
            u_ref=np.array(wrench) * feed,
            target_positions=predict_target(p, V_TARGET, q, W_TARGET, times)[0],
            min_distance_target_m=np.full(n, D_MIN_M),
            min_distance_chasers_m=D_MIN_M,
            input_max=np.tile(PARAMS.input_limits(), (n, 1)),
        )

    start = [
        reference_state(
            np.zeros(3), V_TARGET, LEVEL, W_TARGET, OFFSETS[i], np.zeros(3), Q_OFFSETS[i]
        )
        for i in range(n)
    ]
    return problem_at, np.array(start)


def far_start(n: int) -> tuple[Callable[[Array, float], NmpcInput], Array]:
    problem_at, states = tumbling(n)
    states[:, :3] += np.array([-0.6, 0.3, 0.2])
    for x in states:
        x[6:10] = rotations.multiply(x[6:10], rotations.exp([0.575, 0, 0]))
    return problem_at, states


def swap(
    side_m: float = 0.0, half_m: float = 0.8
) -> tuple[Callable[[Array, float], NmpcInput], Array]:
    """Return a problem of two chasers that swap positions head-on, 2 m from the target, and their
    states.
    """
    a, b = np.array([-half_m, 2.0, 0.0]), np.array([half_m, 2.0, side_m])
    return (lambda x, _t: fixed_problem(x, np.array([b, a]))), np.array([at_rest(a), at_rest(b)])
