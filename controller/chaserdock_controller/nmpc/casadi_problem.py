# SPDX-License-Identifier: Apache-2.0
"""The problem in CasADi, as the sum of the terms of `rti`. Used by `ipopt`, by `open`, and by tests
that compare with C.

Terms that only `rti` keeps are left out. The distances (4b to 4d of the paper) apply at stages
1..D, since stage 0 cannot be changed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np

from .casadi_model import dynamics
from .problem import NmpcParameters
from .slack import SLACK_L2, slack_l1_weight
from .term import ChaserConstraint, ChaserStage, CostTerm, PairConstraint
from .types import Array, NmpcInput


@dataclass(frozen=True)
class Nlp:
    """Nonlinear program of ``n`` chasers over ``stages``, and its layout.

    ``problem``: CasADi dictionary x, p, f, g; parameters p as in `pack`.

    Multiple shooting, for k = 0..D:
        x: states of all chasers (13 each), inputs of all (6 each; not at D), slacks of the stage's
            constraints (not at 0).
        g: defects to stage k + 1 (not at D), margins of the stage with slack; at 0 instead x - x_0.
    Single shooting:
        x: inputs, stage by stage, chaser by chaser.
        g: margins without slack.

    ``rows``: margins per stage; those of each chaser's constraints, then those of the pairs.
    ``stage_sizes``: (states, inputs and slacks, constraints besides the defects) of stages 0..D.
    """

    n: int
    stages: int
    problem: dict[str, Any]
    rows: int
    stage_sizes: tuple[tuple[int, int, int], ...]


def _stage_symbols() -> ChaserStage:
    return ChaserStage(
        x=ca.SX.sym("x", 13),
        reference=ca.SX.sym("reference", 7),
        target=ca.SX.sym("target", 3),
        u=ca.SX.sym("u", 6),
        u_ref=ca.SX.sym("u_ref", 6),
    )


def cost_function(params: NmpcParameters) -> ca.Function:
    """Return the cost of a chaser at a stage: (x, reference, target, u, u_ref, weights) -> cost;
    ``weights`` as the columns of `stage_weights`.
    """
    at, terms = _stage_symbols(), params.of_kind(CostTerm)
    weights = [ca.SX.sym("w", params.weights[t].size // (params.stages + 1)) for t in terms]
    total = sum(t.cost(at, w) for t, w in zip(terms, weights, strict=True))
    symbols = [at.x, at.reference, at.target, at.u, at.u_ref, ca.vertcat(*weights)]
    return ca.Function("cost", symbols, [total])


def stage_weights(params: NmpcParameters) -> Array:
    """Return the weights of all terms of the cost, (D+1, W)."""
    return np.column_stack([params.weights[t] for t in params.of_kind(CostTerm)])


def _margins(n: int, params: NmpcParameters) -> ca.Function:
    """Return the margins of a stage as a function of states (13, n), references (7, n), target (3),
    and the data of the chasers' constraints (W, n) and of the pairs.
    """
    terms, pair_terms = params.of_kind(ChaserConstraint), params.of_kind(PairConstraint)
    x, references, target = ca.SX.sym("x", 13, n), ca.SX.sym("reference", 7, n), ca.SX.sym("t", 3)
    data = ca.SX.sym("data", sum(t.DATA for t in terms), n)
    pairs = [(i, j) for i in range(n) for j in range(i + 1, n)]
    pair_data = ca.SX.sym("pair", len(pairs) * len(pair_terms))
    out = []
    for i in range(n):
        at = ChaserStage(x[:, i], references[:, i], target, None, None)
        parts = ca.vertsplit(data[:, i], [0, *np.cumsum([t.DATA for t in terms]).tolist()])
        out += [t.margin(at, own) for t, own in zip(terms, parts, strict=True)]
    for number, term in enumerate(pair_terms):
        for row, (i, j) in enumerate(pairs, start=number * len(pairs)):
            out.append(term.margin(x[:, i], x[:, j], pair_data[row]))
    return ca.Function("margins", [x, references, target, data, pair_data], [ca.vertcat(*out)])


def pack(params: NmpcParameters, problem: NmpcInput) -> Array:
    """Return the parameters p of `Nlp` for a checked problem.

    Per chaser: x_0 (13), references (7 (D+1)), u_ref (6 D), data of its constraints (W (D+1)). Then
    target positions (3 (D+1)), data of the pairs (upper triangle, row by row), L1 weight of the
    slacks (1).
    """
    data = np.concatenate([t.data(problem) for t in params.of_kind(ChaserConstraint)], axis=-1)
    parts: list[Any] = []
    for i in range(len(problem.states)):
        own = (problem.states[i], problem.references[i], problem.u_ref[i], data[i])
        parts += [values.ravel() for values in own]
    parts.append(problem.target_positions.ravel())
    upper = np.triu_indices(len(problem.states), 1)
    parts += [t.data(problem)[upper] for t in params.of_kind(PairConstraint)]
    away = problem.states[:, :3] - problem.references[:, -1, :3]
    farthest_m = np.max(np.linalg.norm(away, axis=-1), keepdims=True)
    return np.concatenate([*parts, slack_l1_weight(params, farthest_m)])


NO_CONSTRAINT_M = -1e4
"""Lower bound, m, of a margin that does not apply: chasers never come so close to it."""


def row_floor(nlp: Nlp, params: NmpcParameters, problem: NmpcInput) -> Array:
    """Return the lower bounds (D, rows) of the margins: zero, or `NO_CONSTRAINT_M`."""
    floor = np.zeros((nlp.stages, nlp.rows))
    terms = params.of_kind(ChaserConstraint)
    for number, term in enumerate(terms):
        free = ~term.applies(problem)[:, 1:].T
        floor[:, number : len(terms) * nlp.n : len(terms)][free] = NO_CONSTRAINT_M
    return floor


def _stage_sizes(n: int, k: int, stages: int, rows: int, multiple: bool) -> tuple[int, int, int]:
    """Return the numbers of states, of inputs with slacks, and of constraints besides the defects
    at stage ``k``.
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

    The variable bounds contain the input box (4a). With ``shooting`` "multiple" each margin has a
    slack; with "single", for augmented-Lagrangian methods with their own penalty, none has.
    """
    if n < 1:
        raise ValueError(f"n must be at least 1, not {n}")
    d, step = params.stages, dynamics(params)
    multiple = shooting == "multiple"
    cost_of, margins_of, weights = cost_function(params), _margins(n, params), stage_weights(params)
    rows, width = margins_of.size1_out(0), margins_of.size1_in(3)

    x0 = [symbol(f"x0_{i}", 13) for i in range(n)]
    references = [symbol(f"ref_{i}", 7, d + 1) for i in range(n)]
    u_ref = [symbol(f"u_ref_{i}", 6, d) for i in range(n)]
    data = [symbol(f"data_{i}", width, d + 1) for i in range(n)]
    targets = symbol("p_tar", 3, d + 1)
    pair_data = symbol("pairs", margins_of.size1_in(4))
    slack_l1 = symbol("w1")

    variables: list[Any] = []
    constraints: list[Any] = []
    cost: Any = 0
    x = [symbol(f"x_{i}_0", 13) for i in range(n)] if multiple else x0
    for k in range(d + 1):
        state = x
        variables += state if multiple else []
        inputs = [symbol(f"u_{i}_{k}", 6) for i in range(n)] if k < d else [ca.DM.zeros(6)] * n

        for i in range(n):
            aim = u_ref[i][:, k] if k < d else ca.DM.zeros(6)
            at = (state[i], references[i][:, k], targets[:, k], inputs[i], aim)
            cost += cost_of(*at, ca.DM(weights[k]))

        if k < d:
            variables += inputs
            x = [step(a, u) for a, u in zip(state, inputs, strict=True)]
            if multiple:
                propagated, x = x, [symbol(f"x_{i}_{k + 1}", 13) for i in range(n)]
                # The next state comes first with positive sign, as structured solvers require.
                constraints += [b - a for a, b in zip(propagated, x, strict=True)]
                if k == 0:
                    constraints += [a - b for a, b in zip(state, x0, strict=True)]

        if k > 0:
            margin = margins_of(
                ca.horzcat(*state),
                ca.horzcat(*(r[:, k] for r in references)),
                targets[:, k],
                ca.horzcat(*(own[:, k] for own in data)),
                pair_data,
            )
            if multiple:
                s = symbol(f"s_{k}", rows)
                variables.append(s)
                cost += slack_l1 * ca.sum1(s) + 0.5 * SLACK_L2 * ca.sumsqr(s)
                margin += s
            constraints.append(margin)

    parameters: list[Any] = []
    for i in range(n):
        parameters += [x0[i], *map(ca.vec, (references[i], u_ref[i], data[i]))]
    return Nlp(
        n=n,
        stages=d,
        problem={
            "x": ca.vertcat(*variables),
            "p": ca.vertcat(*parameters, ca.vec(targets), pair_data, slack_l1),
            "f": cost,
            "g": ca.vertcat(*constraints),
        },
        rows=rows,
        stage_sizes=tuple(_stage_sizes(n, k, d, rows, multiple) for k in range(d + 1)),
    )
