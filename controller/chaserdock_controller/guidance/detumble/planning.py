# SPDX-License-Identifier: Apache-2.0
"""Plans of least propellant that stop a stack within a given time while it turns. Pure functions.

States: momentum P, angular momentum H about the centre of mass (WRF), attitude q. Inputs: thrusts f
>= 0 of all thrusters, constant over each step. P' = R F, H' = R T, q' = q (0, w) / 2 with w = I^-1
R' H, and (F, T) = B f in TRF axes. The sum of all impulses is minimized, with an exact penalty on P
and H at the end.

Method: sequential linear programming with a trust region (S l1 LP; Nocedal and Wright, "Numerical
Optimization", section 18.5). Each programme is linearized about the flight of the last thrusts. Its
solutions are vertices: nearly all thrusters are off or fully on, which suits pulses.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, IntArray

from .allocation import units_of

_PENALTY = 30.0
"""Price of remaining momentum, relative to the impulse that removes it in the thrusters' best
direction.
"""
_LEAST_RADIUS = 0.002
"""Smallest trust region, as a share of a thruster's full range; the search ends below it."""
_ACCEPT = 0.05
"""Least ratio of actual to predicted improvement for a step to be accepted."""


@dataclass(frozen=True, eq=False)
class StackProblem:
    """A stack to stop.

    ``momentum`` (6,): P and H, WRF axes. ``wrenches`` (6, n): per 1 N of each thruster, TRF axes.
    ``groups``: number of each thruster's chaser. ``at_once``: thrusters of a chaser that may fire
    at the same time, None for all.
    """

    momentum: Array
    q_wxyz: Array
    inertia_kg_m2: Array
    wrenches: Array
    limits_N: Array
    groups: IntArray
    at_once: int | None = None


@dataclass(frozen=True, eq=False)
class StackPlan:
    """Thrusts ``thrusts_N`` (K, n) over K steps of ``step_s``.

    ``remaining`` (6,): momentum at the end, WRF axes, by the plan's own model. ``impulse_N_s``: of
    all thrusters. ``cost_N_s``: that impulse plus the penalty on the remaining momentum.
    ``radius``: trust region of the next programme, as a share of full thrust; 0 if no programme
    improves the plan.
    """

    thrusts_N: Array
    step_s: float
    remaining: Array
    cost_N_s: float
    radius: float = 1.0

    @property
    def impulse_N_s(self) -> float:
        return float(self.thrusts_N.sum()) * self.step_s

    @property
    def duration_s(self) -> float:
        return len(self.thrusts_N) * self.step_s


@dataclass(frozen=True, eq=False)
class _Flight:
    """Simulated flight of a stack.

    ``end`` (6,): momentum at the end; ``attitude``: there. At the middle of every step: rotation,
    rate and angular momentum (TRF axes).
    """

    end: Array
    attitude: Array
    rotations: Array
    rates: Array
    momenta: Array
    turned: Array


def plan_stop(problem: StackProblem, guess_N: Array, step_s: float, iterations: int) -> StackPlan:
    """Return the plan after at most ``iterations`` linear programmes from ``guess_N`` (K, n).

    Raises ValueError for numbers that are not finite or a step that is not positive.
    """
    return improve(problem, flown(problem, guess_N, step_s), iterations)


def flown(problem: StackProblem, thrusts_N: Array, step_s: float) -> StackPlan:
    """Evaluate thrusts (K, n), clipped to the limits, as a plan. Raises ValueError as
    ``plan_stop``.
    """
    if not (step_s > 0.0 and math.isfinite(step_s)):
        raise ValueError(f"step_s must be positive, not {step_s!r}")
    if not (np.isfinite(problem.momentum).all() and np.isfinite(problem.wrenches).all()):
        raise ValueError("momentum and wrenches must be finite")
    able = np.flatnonzero(problem.limits_N > 0.0)
    if not len(able):
        return StackPlan(np.zeros_like(thrusts_N), step_s, problem.momentum.copy(), math.inf, 0.0)
    thrusts = np.clip(thrusts_N, 0.0, problem.limits_N)
    end = fly(problem, thrusts, step_s).end
    return StackPlan(thrusts, step_s, end, _merit(end, thrusts, step_s, _price(problem, able)))


def improve(problem: StackProblem, plan: StackPlan, iterations: int) -> StackPlan:
    """Return a better plan for the same problem after at most ``iterations`` more linear
    programmes.
    """
    if plan.radius == 0.0 or not iterations:
        return plan
    able, step_s = np.flatnonzero(problem.limits_N > 0.0), plan.step_s
    price = _price(problem, able)
    thrusts, merit, radius = plan.thrusts_N, plan.cost_N_s, plan.radius
    flight = fly(problem, thrusts, step_s)
    for _ in range(iterations):
        step, predicted = _linear_step(problem, flight, thrusts, step_s, able, price, radius)
        gain = merit - predicted
        if gain <= 1e-4 * (1.0 + abs(merit)):
            radius = 0.0
            break
        tried = np.clip(thrusts + step, 0.0, problem.limits_N)
        tried_flight = fly(problem, tried, step_s)
        tried_merit = _merit(tried_flight.end, tried, step_s, price)
        ratio = (merit - tried_merit) / gain
        if ratio > _ACCEPT:
            thrusts, flight, merit = tried, tried_flight, tried_merit
        radius = min(1.0, 2.0 * radius) if ratio > 0.75 else radius if ratio > 0.3 else radius / 3.0
        if radius < _LEAST_RADIUS:
            radius = 0.0
            break
    return StackPlan(thrusts, step_s, flight.end, merit, radius)


def fly(problem: StackProblem, thrusts_N: Array, step_s: float) -> _Flight:
    """Simulate a stack under thrusts (K, n) by the midpoint rule."""
    inverse = np.linalg.inv(problem.inertia_kg_m2)
    bodies = thrusts_N @ problem.wrenches.T  # force and torque (K, 6), TRF axes
    p, h, q = problem.momentum[:3].copy(), problem.momentum[3:].copy(), problem.q_wxyz
    count = len(thrusts_N)
    middles, rates, momenta = np.empty((count, 3, 3)), np.empty((count, 3)), np.empty((count, 3))
    for k in range(count):
        omega = inverse @ rotations.rotate_inverse(q, h)
        middle = rotations.to_matrix(rotations.multiply(q, rotations.exp(omega * (step_s / 2.0))))
        torque = middle @ bodies[k, 3:]
        own = middle.T @ (h + torque * (step_s / 2.0))
        omega = inverse @ own
        middles[k], rates[k], momenta[k] = middle, omega, own
        p = p + step_s * (middle @ bodies[k, :3])
        h = h + step_s * torque
        q = rotations.multiply(q, rotations.exp(omega * step_s))
    return _Flight(np.concatenate([p, h]), q, middles, rates, momenta, bodies)


def predicted(problem: StackProblem, thrusts_N: Array, step_s: float) -> StackProblem:
    """Return the problem of the same stack after thrusts (K, n)."""
    flight = fly(problem, thrusts_N, step_s)
    return replace(problem, momentum=flight.end, q_wxyz=flight.attitude)


def sensitivity(problem: StackProblem, flight: _Flight, step_s: float, able: IntArray) -> Array:
    """Return the Jacobian (6, K a) of the final momentum by the thrusts of the a thrusters ``able``
    in every step.
    """
    inverse = np.linalg.inv(problem.inertia_kg_m2)
    own = problem.wrenches[:, able]
    count, half = len(flight.rates), step_s / 2.0
    rows = np.empty((count, 6, len(able)))
    # Sensitivities of the final momentum, going backwards: by the momentum at the beginning of a
    # step it is the identity; by the attitude (TRF axes) ``by_turn``; and, through the rate, by the
    # angular momentum ``by_spin``.
    by_turn, by_spin = np.zeros((6, 3)), np.zeros((6, 3))
    for k in range(count - 1, -1, -1):
        r, omega, h = flight.rotations[k], flight.rates[k], flight.momenta[k]
        force, torque = flight.turned[k, :3], flight.turned[k, 3:]
        pushed = np.concatenate([-r @ rotations.skew(force), -r @ rotations.skew(torque)]) * step_s
        total = np.zeros((6, 3))
        total[3:] = np.eye(3)
        # By the attitude in the middle of the step, and by the rate there.
        by_rate = step_s * by_turn
        middle = (
            pushed
            + by_spin @ pushed[3:]
            + by_rate @ inverse @ (rotations.skew(h) - half * rotations.skew(torque))
        )
        direct = np.concatenate([r @ own[:3], r @ own[3:]]) * step_s
        rows[k] = direct + by_spin @ direct[3:] + by_rate @ inverse @ (half * own[3:])
        back = rotations.to_matrix(rotations.exp(-omega * half))
        spin = inverse @ r.T
        by_spin = by_spin + by_rate @ spin + middle @ (half * spin)
        by_turn = by_turn @ back @ back + middle @ back
    return rows.transpose(1, 0, 2).reshape(6, -1)


def _price(problem: StackProblem, able: IntArray) -> Array:
    """Return the penalty (6,) per N s and per N m s of remaining momentum."""
    force, torque = units_of(problem.wrenches[:, able], problem.limits_N[able])
    thrust = float(problem.limits_N[able].max())
    return _PENALTY * thrust / np.repeat([force, torque], 3)


def _merit(end: Array, thrusts_N: Array, step_s: float, price: Array) -> float:
    return float(thrusts_N.sum()) * step_s + float(price @ np.abs(end))


def _linear_step(
    problem: StackProblem,
    flight: _Flight,
    thrusts_N: Array,
    step_s: float,
    able: IntArray,
    price: Array,
    radius: float,
) -> tuple[Array, float]:
    """Solve the linear programme within the trust region. Returns the change of the thrusts (K, n)
    and the merit that it predicts.
    """
    from scipy.optimize import (
        linprog,
    )  # as slow to import as the controller, and needed for plans only

    count, a = len(thrusts_N), len(able)
    jacobian = sensitivity(problem, flight, step_s, able)
    now = thrusts_N[:, able].reshape(-1)
    limits = np.tile(problem.limits_N[able], count)
    lower, upper = np.maximum(0.0, now - radius * limits), np.minimum(limits, now + radius * limits)
    # As shares of full thrust and of the price, all numbers are near one.
    rows = jacobian * limits * price[:, None]
    right = price * (jacobian @ now - flight.end)
    cost = np.concatenate([step_s * limits, np.ones(12)])
    slack = np.hstack([-np.eye(6), np.eye(6)])
    bounds = np.concatenate(
        [np.stack([lower / limits, upper / limits], axis=1), np.tile([0.0, np.inf], (12, 1))]
    )
    sequencing, most = _sequencing(problem, able, count)
    found = linprog(
        cost,
        A_ub=sequencing,
        b_ub=most,
        A_eq=np.hstack([rows, slack]),
        b_eq=right,
        bounds=bounds,
        method="highs-ds",
    )
    if found.status != 0:
        return np.zeros_like(thrusts_N), math.inf
    step = np.zeros_like(thrusts_N)
    step[:, able] = (found.x[: count * a] * limits - now).reshape(count, a)
    return step, float(found.fun)


def _sequencing(problem: StackProblem, able: IntArray, count: int) -> tuple[Any, Array | None]:
    """Return the constraint rows (sparse) that let at most ``at_once`` thrusters of a chaser fire
    in a step; None without a limit.
    """
    if problem.at_once is None:
        return None, None
    from scipy.sparse import csr_array, eye_array, hstack, kron

    groups = problem.groups[able]
    own = csr_array(np.array([groups == g for g in np.unique(groups)], dtype=float))
    number = count * len(np.unique(groups))
    rows = hstack([kron(eye_array(count), own), csr_array((number, 12))], format="csr")
    return rows, np.full(number, float(problem.at_once))
