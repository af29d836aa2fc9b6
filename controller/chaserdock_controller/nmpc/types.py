# SPDX-License-Identifier: Apache-2.0
"""Inputs and outputs of a solve, independent of the back end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from chaserdock_models.arrays import Array, IntArray
from chaserdock_models.passive_safety import CoastCertificate, CoastModel

INTEGRATORS = ("rk4", "euler")

STATUSES = ("solved", "iteration_limit", "budget", "infeasible_relaxed", "failed")
SOLVED, ITERATION_LIMIT, BUDGET, INFEASIBLE_RELAXED, FAILED = STATUSES

# A plan that enters a keep-out ball or leaves the outer bound by more than this is relaxed.
VIOLATION_TOLERANCE_M = 1e-4


@dataclass(frozen=True)
class CoastSafety:
    """Passive safety to keep: the coasts from all stages stay outside of a sphere about the target.

    ``covariances``: of a chaser's position and velocity relative to the target (6, 6), by row of
    the problem; other rows are free. ``sigmas``: the margin, in standard deviations along the line
    from the target. ``target_velocity_m_s`` (3,): WRF.
    """

    coast: CoastModel
    keep_out_m: float
    sigmas: float
    target_velocity_m_s: Array
    covariances: Mapping[int, Array]


@dataclass(frozen=True)
class NmpcInput:
    """The problem of one tick for N chasers over D stages.

    states (N, 13): p (WRF, m), v (WRF, m/s), q_wxyz (body to world), omega (body, rad/s).
    references (N, D+1, 7): p (WRF, m), q_wxyz; stage 0 is now. u_ref (N, D, 6): force (N) and
    torque (N m), body axes, the reference of the input cost. target_positions (D+1, 3): WRF, m.
    min_distance_target_m (N,) or, for each stage, (N, D+1); min_distance_chasers_m: one float or a
    symmetric (N, N), diagonal ignored; 0 switches a constraint off. input_max (N, 6): N and N m,
    body axes; may change from tick to tick. corridors (N, D+1, 5) or None: an approach corridor of
    a chaser at a stage: a cone about an axis through the target, [axis (3; WRF, unit, from the
    target outwards; zero: no corridor), half angle (rad, above 0 and below pi/2), distance of the
    apex from the target's centre along the axis (m; may be negative)]. It applies in addition to
    the keep-out ball, which is smaller or 0 for a docking chaser. boxes (D+1, C, 15) or None:
    cuboids of the target's shape at each stage: centre (3; WRF, m), rotation cuboid to WRF (9,
    row-major), half edges (3; m). box_clearance_m (N,) or None: distance that each chaser's centre
    keeps from them; 0 switches it off. chaser_shape (S, 15) or None: cuboids of a chaser, as boxes
    but in body axes: then that distance, and min_distance_shapes_m (N, N), symmetric, between two
    chasers, 0 for none, are between shapes, in addition to those between centres. Only the back end
    `rti` keeps these. coast_safety: passive safety to keep, or None. Where a plan without it is not
    safe, the back end `rti` linearizes it about its start into coasts (N, D+1, C, 7): half-spaces
    a' p + b' v >= d of position and velocity at a stage, [a (3), b (3), d]; a and b zero for none
    (`terms.coast`). Other back ends do not keep it.
    """

    states: Array
    references: Array
    u_ref: Array
    target_positions: Array
    min_distance_target_m: Array
    min_distance_chasers_m: Array | float
    input_max: Array
    corridors: Array | None = None
    boxes: Array | None = None
    box_clearance_m: Array | None = None
    chaser_shape: Array | None = None
    min_distance_shapes_m: Array | None = None
    coast_safety: CoastSafety | None = None
    coasts: Array | None = None


@dataclass(frozen=True)
class NmpcPlan:
    """Solution for N chasers, rows in the order of the input.

    inputs (N, D, 6): N and N m, body axes, within ``input_max``. states (N, D+1, 13): those inputs
    through the nonlinear model. status per chaser: "solved"; "iteration_limit" (best point within
    the solver's limit); "budget" (best point within the iteration budget, which may violate
    distances: see ``max_violation_m``); "infeasible_relaxed" (the plan enters a keep-out zone by
    ``max_violation_m``: no input avoids it, or the start lies inside); "failed" (numerical
    breakdown: the inputs are the shifted previous plan). iterations (N,): interior-point
    iterations, 0 if none is needed. cost (N,): eq. 6 on ``states``. coasts: certificates of the
    plans of the rows in ``coast_safety``.
    """

    inputs: Array
    states: Array
    status: tuple[str, ...]
    iterations: IntArray
    cost: Array
    max_violation_m: Array
    coasts: Mapping[int, CoastCertificate] = field(default_factory=dict)


class NmpcSolver(Protocol):
    """Interface of the back ends."""

    def solve(
        self, problem: NmpcInput, shift_s: float, ids: Sequence[int] | None = None
    ) -> NmpcPlan: ...

    def reset(self) -> None: ...
