# SPDX-License-Identifier: Apache-2.0
"""The optimal control problem in CasADi, following the paper (section 4, eq. 6 and 7).

State x = [p (3, WRF), v (3, WRF), q_wxyz (4, body to world), omega (3, body)], input u = [F (3),
tau (3)] in body axes. Every back end solves this problem: `ipopt` this graph, `rti` the same
functions in C (`native`), which the tests compare with these.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from chaserdock_models.scalar_rotations import product_components, rotated_components

from .slack import SLACK_L2
from .types import INTEGRATORS, NmpcParameters


def multiply(a: Any, b: Any) -> Any:
    """Return the Hamilton product of CasADi quaternions (4)."""
    return ca.vertcat(*product_components(*ca.vertsplit(a), *ca.vertsplit(b)))


def conjugate(q: Any) -> Any:
    """Return the conjugate of a CasADi quaternion (4)."""
    return ca.vertcat(q[0], -q[1:4])


def rotate(q: Any, v: Any) -> Any:
    """Return the body vector ``v`` (3) in world axes; ``q`` (4) body to world."""
    return ca.vertcat(*rotated_components(*ca.vertsplit(q), *ca.vertsplit(v)))


def derivative(x: Any, u: Any, params: NmpcParameters) -> Any:
    """Return x' (13) from the Newton-Euler equations (paper, eq. 1 and 2, with q' in the
    body-to-world convention).
    """
    inertia = ca.DM(np.array(params.inertia_kg_m2))
    v, q, omega = x[3:6], x[6:10], x[10:13]
    force, torque = u[0:3], u[3:6]
    return ca.vertcat(
        v,
        rotate(q, force) / params.mass_kg,
        0.5 * multiply(q, ca.vertcat(0, omega)),
        ca.inv(inertia) @ (torque - ca.cross(omega, inertia @ omega)),
    )


def dynamics(params: NmpcParameters, integrator: str | None = None) -> ca.Function:
    """Return the discrete dynamics (x (13), u (6)) -> x_next (13) over ``params.dt_s``, the input
    held.

    ``integrator``: "euler" (the paper's) or "rk4"; ``params.integrator`` if None. The quaternion is
    normalized after the step. Raises ValueError for another integrator.
    """
    integrator = params.integrator if integrator is None else integrator
    if integrator not in INTEGRATORS:
        raise ValueError(f"integrator must be one of {', '.join(INTEGRATORS)}, not {integrator!r}")
    x, u, h = ca.SX.sym("x", 13), ca.SX.sym("u", 6), params.dt_s
    k1 = derivative(x, u, params)
    if integrator == "euler":
        x_next = x + h * k1
    else:
        k2 = derivative(x + h / 2 * k1, u, params)
        k3 = derivative(x + h / 2 * k2, u, params)
        k4 = derivative(x + h * k3, u, params)
        x_next = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    q = x_next[6:10]
    x_next = ca.vertcat(x_next[0:6], q / ca.norm_2(q), x_next[10:13])
    return ca.Function("step", [x, u], [x_next], ["x", "u"], ["x_next"])


def pose_cost(x: Any, reference: Any, weight_position: Any, weight_orientation: Any) -> Any:
    """Return Q_p |p_ref - p|^2 + Q_q |vec(q (x) q_ref*)|^2; ``reference`` (7) is p, q_wxyz.

    The paper weights all four components of q (x) q_ref*, whose norm is always one. The vector part
    vanishes on the reference, and both signs of a quaternion cost the same.
    """
    error = multiply(x[6:10], conjugate(reference[3:7]))[1:4]
    return weight_position * ca.sumsqr(reference[0:3] - x[0:3]) + weight_orientation * ca.sumsqr(
        error
    )


@dataclass(frozen=True)
class Nlp:
    """The nonlinear program of ``n`` chasers over ``stages``, and its layout stage by stage.

    ``problem``: CasADi dictionary x, p, f, g. Multiple shooting: x = for k = 0..D: states of all
    chasers (13 each), inputs of all (6 each; not at D), slacks of the stage's distances (not at 0).
    g = for k = 0..D: the defects to stage k + 1 (not at D), the distances of the stage with slack;
    at 0 instead x - x_0. Single shooting: x is the inputs, stage by stage, chaser by chaser, and g
    the distances without slack. p = per chaser: x_0 (13), references (7 (D+1)), u_ref (6 D), target
    distances (D+1), corridors (5 (D+1)); then target positions (3 (D+1)), chaser distances (upper
    triangle, row by row), L1 weight (1). ``rows``: distances a stage: per chaser target, outer
    bound, corridor; then the pairs. ``stage_sizes``: (states, inputs and slacks, constraints
    besides the defects) of stages 0..D.
    """

    n: int
    stages: int
    problem: dict[str, Any]
    rows: int
    stage_sizes: tuple[tuple[int, int, int], ...]


def _norm(a: Any) -> Any:
    # The constant keeps the gradient finite where two points coincide; it changes 0.35 m by 1e-12
    # m.
    return ca.sqrt(ca.sumsqr(a) + 1e-12)


def _corridor(r: Any, corridor: Any) -> Any:
    """Return the distance from the surface of the corridor's cone, positive inside (`corridor_room`
    in native/planes.c)."""
    axis, half_angle, apex = corridor[0:3], corridor[3], corridor[4]
    along = ca.dot(axis, r)
    return ca.sin(half_angle) * (along - apex) - ca.cos(half_angle) * _norm(r - along * axis)


def _pose_cost_function() -> ca.Function:
    x, reference, weights = ca.SX.sym("x", 13), ca.SX.sym("reference", 7), ca.SX.sym("weights", 2)
    return ca.Function(
        "pose", [x, reference, weights], [pose_cost(x, reference, weights[0], weights[1])]
    )


def _distances(n: int, params: NmpcParameters) -> ca.Function:
    """Return the constraints of one stage: states (13, n), positions of references (3, n) and
    target (3), keep-out radii (n), corridors (5, n), pair distances -> margins; per chaser target,
    outer bound, corridor; then the pairs."""
    pairs = [(i, j) for i in range(n) for j in range(i + 1, n)]
    x, p_ref, target = ca.SX.sym("x", 13, n), ca.SX.sym("p_ref", 3, n), ca.SX.sym("target", 3)
    to_target, corridors, apart = (
        ca.SX.sym("d", n),
        ca.SX.sym("corridor", 5, n),
        ca.SX.sym("pair", len(pairs)),
    )
    out = []
    for i in range(n):
        r = x[0:3, i] - target
        out.append(_norm(r) - to_target[i])
        out.append(params.max_reference_distance_m - _norm(x[0:3, i] - p_ref[:, i]))
        out.append(_corridor(r, corridors[:, i]))
    for row, (i, j) in enumerate(pairs):
        out.append(_norm(x[0:3, i] - x[0:3, j]) - apart[row])
    return ca.Function(
        "distances", [x, p_ref, target, to_target, corridors, apart], [ca.vertcat(*out)]
    )


def _stage_sizes(n: int, k: int, stages: int, rows: int, multiple: bool) -> tuple[int, int, int]:
    """Return the numbers of states, inputs with slacks, and constraints besides the defects of
    stage ``k``.
    """
    inputs = 6 * n if k < stages else 0
    if not multiple:
        return 0, inputs, rows if k > 0 else 0
    return (13 * n, inputs + rows, rows) if k > 0 else (13 * n, inputs, 13 * n)


def build_nlp(
    n: int, params: NmpcParameters, shooting: str = "multiple", symbol: Any = ca.SX.sym
) -> Nlp:
    """Build eq. 6 and 7 for ``n`` chasers. Raises ValueError for n < 1.

    ``symbol``: ``ca.SX.sym`` for one graph of scalars, ``ca.MX.sym`` for calls of one function per
    stage, which generates much shorter C.

    The variable bounds contain the input box (4a). The distances (4b to 4d) apply at stages 1..D,
    as stage 0 cannot be changed. With ``shooting`` "multiple" each has a slack; with "single", for
    augmented-Lagrangian methods with their own penalty, they have none.
    """
    if n < 1:
        raise ValueError(f"n must be at least 1, not {n}")
    d, step = params.stages, dynamics(params)
    multiple = shooting == "multiple"
    position_weight, orientation_weight = params.stage_weights()
    input_weight = ca.DM([params.weight_force] * 3 + [params.weight_torque] * 3)
    n_pairs = n * (n - 1) // 2
    rows = 3 * n + n_pairs

    x0 = [symbol(f"x0_{i}", 13) for i in range(n)]
    references = [symbol(f"ref_{i}", 7, d + 1) for i in range(n)]
    u_ref = [symbol(f"u_ref_{i}", 6, d) for i in range(n)]
    to_target = [symbol(f"d_target_{i}", d + 1) for i in range(n)]
    corridors = [symbol(f"corridor_{i}", 5, d + 1) for i in range(n)]
    targets = symbol("p_tar", 3, d + 1)
    pair_distance = symbol("d_pair", n_pairs)
    slack_l1 = symbol("w1")

    pose_term, distance_terms = _pose_cost_function(), _distances(n, params)

    def distances(k: int, x: list[Any]) -> Any:
        return distance_terms(
            ca.horzcat(*x), ca.horzcat(*(r[0:3, k] for r in references)), targets[:, k],
            ca.vertcat(*(d[k] for d in to_target)), ca.horzcat(*(c[:, k] for c in corridors)), pair_distance,
        )  # fmt: skip

    variables: list[Any] = []
    constraints: list[Any] = []
    cost: Any = 0
    x = [symbol(f"x_{i}_0", 13) for i in range(n)] if multiple else x0
    for k in range(d + 1):
        state = x
        variables += state if multiple else []
        for i in range(n):
            weights = ca.DM([position_weight[k], orientation_weight[k]])
            cost += pose_term(state[i], references[i][:, k], weights)
        if k < d:
            inputs = [symbol(f"u_{i}_{k}", 6) for i in range(n)]
            variables += inputs
            for i in range(n):
                cost += ca.dot(input_weight, (u_ref[i][:, k] - inputs[i]) ** 2)
            x = [step(a, u) for a, u in zip(state, inputs, strict=True)]
            if multiple:
                propagated, x = x, [symbol(f"x_{i}_{k + 1}", 13) for i in range(n)]
                # fatrop requires the next state first, with positive sign.
                constraints += [b - a for a, b in zip(propagated, x, strict=True)]
                if k == 0:
                    constraints += [a - b for a, b in zip(state, x0, strict=True)]
        if k > 0:
            margin = distances(k, state)
            if multiple:
                s = symbol(f"s_{k}", rows)
                variables.append(s)
                cost += slack_l1 * ca.sum1(s) + 0.5 * SLACK_L2 * ca.sumsqr(s)
                margin += s
            constraints.append(margin)

    parameters: list[Any] = []
    for i in range(n):
        parameters += [
            x0[i],
            ca.vec(references[i]),
            ca.vec(u_ref[i]),
            to_target[i],
            ca.vec(corridors[i]),
        ]
    return Nlp(
        n=n,
        stages=d,
        problem={
            "x": ca.vertcat(*variables),
            "p": ca.vertcat(*parameters, ca.vec(targets), pair_distance, slack_l1),
            "f": cost,
            "g": ca.vertcat(*constraints),
        },
        rows=rows,
        stage_sizes=tuple(_stage_sizes(n, k, d, rows, multiple) for k in range(d + 1)),
    )
