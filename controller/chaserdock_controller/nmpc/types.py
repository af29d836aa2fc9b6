# SPDX-License-Identifier: Apache-2.0
"""Inputs and outputs of a solve, independent of the back end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

from chaserdock_models.arrays import Array, IntArray
from chaserdock_models.passive_safety import CoastCertificate, CoastModel, DisturbedMotion
from chaserdock_models.rigid_body import BodyState

INTEGRATORS = ("rk4", "euler")

STATUSES = ("solved", "iteration_limit", "budget", "infeasible_relaxed", "failed")
SOLVED, ITERATION_LIMIT, BUDGET, INFEASIBLE_RELAXED, FAILED = STATUSES

# Violation, m, of a keep-out ball or the outer bound above which a plan has the status
# "infeasible_relaxed".
VIOLATION_TOLERANCE_M = 1e-4


@dataclass(frozen=True)
class CoastSafety:
    """Passive safety to keep: the coasts from all stages stay outside a sphere about the target.

    ``motions``: what is known of a chaser's motion, by row of the problem; rows without one are not
    restricted. ``sigmas``: the margin, in standard deviations along the line from the target.
    ``target_velocity_m_s`` (3,): WRF.
    """

    coast: CoastModel
    keep_out_m: float
    sigmas: float
    target_velocity_m_s: Array
    motions: Mapping[int, DisturbedMotion]


@dataclass(frozen=True)
class NmpcInput:
    """The problem of one tick for N chasers over D stages.

    states (N, 13): p (WRF, m), v (WRF, m/s), q_wxyz (body to world), omega (body, rad/s).
    references (N, D+1, 7): p (WRF, m), q_wxyz; stage 0 is now.
    u_ref (N, D, 6): force (N) and torque (N m), body axes; reference of the input cost.
    target_positions (D+1, 3): WRF, m.
    min_distance_target_m: (N,) or, for each stage, (N, D+1); 0 switches it off.
    min_distance_chasers_m: one float or a symmetric (N, N), diagonal ignored; 0 switches it off.
    input_max (N, 6): N and N m, body axes; may change from tick to tick.
    corridors (N, D+1, 5) or None: cone about an axis through the target, in which a chaser stays at
        a stage. Axis (3; WRF, unit, from the target outwards; zero: no corridor), half angle (rad,
        between 0 and pi/2), distance of the apex from the target's centre along the axis (m; may be
        negative). Applies in addition to the keep-out ball, which is smaller or 0 for a docking
        chaser.
    boxes (D+1, C, 15) or None: cuboids of the target's shape at each stage. Centre (3; WRF, m),
        rotation cuboid to WRF (9, row-major), half edges (3; m).
    box_clearance_m (N,) or None: distance that each chaser keeps from the cuboids; 0 switches it
        off. Of its shape if there is a chaser_shape, else of its centre.
    chaser_shape (S, 15) or None: cuboids of a chaser, as boxes but in body axes.
    min_distance_shapes_m (N, N), symmetric: distance between the shapes of two chasers, in addition
        to that of centres; 0 switches it off.
    coast_safety: passive safety to keep, or None. Where a plan without it is unsafe, `rti`
        linearizes it about its start into coasts.
    coasts (N, D+1, C, 7): half-spaces a' p + b' v >= d of position and velocity at a stage,
        [a (3), b (3), d]; a and b are zero for none (`terms.coast`).
    target: estimated motion of the target at stage 0; None in a problem without a mission. Back
        ends need no more of it than is stated above; solvers that are installed may.
    docking: rows of the chasers on their way to dock.

    Only the back end `rti` keeps distances from cuboids and between shapes, and passive safety.
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
    target: BodyState | None = None
    docking: tuple[int, ...] = ()


@dataclass(frozen=True)
class NmpcPlan:
    """Solution for N chasers, rows in the order of the input.

    inputs (N, D, 6): N and N m, body axes, within ``input_max``.
    states (N, D+1, 13): of these inputs through the nonlinear model.
    status of each chaser:
        "solved";
        "iteration_limit": best point within the solver's limit;
        "budget": best point within the iteration budget; may violate distances;
        "infeasible_relaxed": the plan enters a keep-out zone by ``max_violation_m``, because no
            input avoids it or the start lies inside;
        "failed": numerical breakdown; the inputs are the shifted previous plan.
    iterations (N,): interior-point iterations, 0 if none is needed.
    cost (N,): eq. 6 on ``states``.
    coasts: certificates of the plans of the rows in ``coast_safety``.
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
