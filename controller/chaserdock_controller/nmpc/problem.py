"""The optimal control problem, written once, in CasADi, to be read beside the paper (section 4, eq. 3 and 4).

State x = [p (3, WRF), v (3, WRF), q_wxyz (4, body to world), omega (3, body)], input u = [F (3), tau (3)] in
body axes. Every back end solves this problem; `ipopt` this very graph, `rti` the same functions written for
Numba, which the tests hold against these.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from chaserdock_controller.nmpc.slack import SLACK_L2
from chaserdock_controller.nmpc.types import INTEGRATORS, NmpcParameters


def multiply(a: Any, b: Any) -> Any:
    """Hamilton product of CasADi quaternions (4), scalar first."""
    aw, av, bw, bv = a[0], a[1:4], b[0], b[1:4]
    return ca.vertcat(aw * bw - ca.dot(av, bv), aw * bv + bw * av + ca.cross(av, bv))


def conjugate(q: Any) -> Any:
    """Conjugate of a CasADi quaternion (4), scalar first."""
    return ca.vertcat(q[0], -q[1:4])


def rotate(q: Any, v: Any) -> Any:
    """Body vector ``v`` (3) in world axes; ``q`` (4) body to world."""
    t = 2 * ca.cross(q[1:4], v)
    return v + q[0] * t + ca.cross(q[1:4], t)


def derivative(x: Any, u: Any, params: NmpcParameters) -> Any:
    """Newton-Euler equations (paper, eq. 1 and 2, with q' in the body-to-world convention), x' (13)."""
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
    """Discrete dynamics (x (13), u (6)) -> x_next (13) over ``params.dt_s``, the input held.

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


def pose_cost(x: Any, reference: Any, weight_position: float, weight_orientation: float) -> Any:
    """Q_p |p_ref - p|^2 + Q_q |vec(q (x) q_ref*)|^2; ``reference`` (7) is p, q_wxyz.

    The paper weights all four components of q (x) q_ref*, whose norm is always one; its vector part is what
    vanishes on the reference, and both signs of a quaternion cost the same.
    """
    error = multiply(x[6:10], conjugate(reference[3:7]))[1:4]
    return weight_position * ca.sumsqr(reference[0:3] - x[0:3]) + weight_orientation * ca.sumsqr(error)


@dataclass(frozen=True)
class Nlp:
    """The nonlinear programme of ``n`` chasers and where its parts lie.

    ``problem``: CasADi dictionary x, p, f, g. x = per chaser, per stage: u_0, x_1, u_1 ... x_D; then the
    slacks. p = per chaser: x_0 (13), references (7 (D+1)), u_ref (6 D); then target positions (3 (D+1)),
    target distances (n), chaser distances (upper triangle, row by row), L1 weight (1).
    g: ``n_equal`` dynamics defects, to be zero, then the distances with slack, to be >= 0.
    ``chaser_size`` is the number of variables per chaser; ``n_slack`` the number of slacks.
    """

    n: int
    problem: dict[str, Any]
    chaser_size: int
    n_slack: int
    n_equal: int


def _distance(a: Any, b: Any) -> Any:
    # The tiny term keeps the gradient finite where two points coincide; it changes 0.35 m by 1e-12 m.
    return ca.sqrt(ca.sumsqr(a - b) + 1e-12)


def build_nlp(n: int, params: NmpcParameters) -> Nlp:
    """Eq. 3 and 4 for ``n`` chasers by multiple shooting. Raises ValueError for n < 1.

    The input box (4a) is left to the variable bounds, the distances (4b to 4d) carry a slack each, at stages
    1..D (stage 0 cannot be changed).
    """
    if n < 1:
        raise ValueError(f"n must be at least 1, not {n}")
    d, step = params.stages, dynamics(params)
    position_weight, orientation_weight = params.stage_weights()
    input_weight = ca.DM([params.weight_force] * 3 + [params.weight_torque] * 3)

    targets = ca.SX.sym("p_tar", 3, d + 1)
    target_distance = ca.SX.sym("d_target", n)
    pairs = [(i, j) for i in range(n) for j in range(i + 1, n)]
    pair_distance = ca.SX.sym("d_pair", len(pairs))
    slack_l1 = ca.SX.sym("w1")

    variables: list[Any] = []
    parameters: list[Any] = []
    defects: list[Any] = []
    distances: list[Any] = []
    trajectories: list[list[Any]] = []
    references: list[Any] = []
    cost: Any = 0
    for i in range(n):
        x0 = ca.SX.sym(f"x0_{i}", 13)
        reference = ca.SX.sym(f"ref_{i}", 7, d + 1)
        u_ref = ca.SX.sym(f"u_ref_{i}", 6, d)
        parameters += [x0, ca.vec(reference), ca.vec(u_ref)]
        references.append(reference)
        x, states = x0, [x0]
        cost += pose_cost(x, reference[:, 0], position_weight[0], orientation_weight[0])
        for k in range(d):
            u = ca.SX.sym(f"u_{i}_{k}", 6)
            x_next = ca.SX.sym(f"x_{i}_{k + 1}", 13)
            variables += [u, x_next]
            defects.append(step(x, u) - x_next)
            cost += ca.dot(input_weight, (u_ref[:, k] - u) ** 2)
            x = x_next
            states.append(x)
            cost += pose_cost(x, reference[:, k + 1], position_weight[k + 1], orientation_weight[k + 1])
        trajectories.append(states)

    for k in range(1, d + 1):
        for i in range(n):
            p = trajectories[i][k][0:3]
            distances.append(_distance(p, targets[:, k]) - target_distance[i])
            distances.append(params.max_reference_distance_m - _distance(p, references[i][0:3, k]))
        for row, (i, j) in enumerate(pairs):
            gap = _distance(trajectories[i][k][0:3], trajectories[j][k][0:3])
            distances.append(gap - pair_distance[row])
    slack = ca.SX.sym("s", len(distances))
    cost += slack_l1 * ca.sum1(slack) + 0.5 * SLACK_L2 * ca.sumsqr(slack)

    n_equal = 13 * d * n
    return Nlp(
        n=n,
        problem={
            "x": ca.vertcat(*variables, slack),
            "p": ca.vertcat(*parameters, ca.vec(targets), target_distance, pair_distance, slack_l1),
            "f": cost,
            "g": ca.vertcat(*defects, ca.vertcat(*distances) + slack),
        },
        chaser_size=19 * d,
        n_slack=len(distances),
        n_equal=n_equal,
    )
