# SPDX-License-Identifier: Apache-2.0
"""The optimal control problem of a tick: the sum of its terms (`terms`).

From here it goes to a solver. `rti`: linearization, quadratic programme and interior point in C
(native/problem.c, planes.c, dynamics.c, ipm.c). `ipopt`: the same terms in CasADi
(`casadi_problem`). Then `plan_monitor`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from ctypes import Structure, c_double, c_int64
from dataclasses import dataclass, fields, replace
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from chaserdock_models.arrays import Array, Matrix3

from .kernels import Model, normalize_rows
from .native import LIBRARY
from .term import (
    Constraint,
    CostTerm,
    Term,
    address_of,
    checked_array,
    pointer,
    require_not_negative,
    require_positive,
)
from .terms import TERMS
from .types import INTEGRATORS, NmpcInput

QUATERNION_NORM_TOLERANCE = 0.1
"""Largest deviation of a quaternion's length from 1. Measured quaternions are normalized, so that a
larger one is an error, not rounding.
"""


RK_NODES = {"euler": (0.0,), "rk4": (0.0, 0.5, 0.5, 1.0)}
RK_WEIGHTS = {"euler": (1.0,), "rk4": (1.0 / 6.0, 2.0 / 6.0, 2.0 / 6.0, 1.0 / 6.0)}
"""Weights of explicit Runge-Kutta methods by name; their tableaus have one subdiagonal."""

T = TypeVar("T", bound=Term)


@dataclass(frozen=True)
class NmpcParameters:
    """Constant parameters of the problem. SI units, radians.

    ``inertia_kg_m2`` is the full matrix about the centre of mass in body axes. ``force_max_N`` and
    ``torque_max_N_m`` are per body axis. ``falloff`` is alpha of eq. 6, 0 to 1. ``terms``: costs
    and constraints with their settings, as `terms_of` makes them. Raises ValueError, naming
    the field, for an invalid value.
    """

    mass_kg: float
    inertia_kg_m2: Matrix3
    force_max_N: float
    torque_max_N_m: float
    horizon_s: float
    dt_s: float
    falloff: float
    integrator: str
    terms: tuple[Term, ...]

    def __post_init__(self) -> None:
        require_positive(self, "mass_kg", "dt_s")
        require_not_negative(self, "force_max_N", "torque_max_N_m")
        if not (math.isfinite(self.horizon_s) and round(self.horizon_s / self.dt_s) >= 1):
            raise ValueError(
                f"horizon_s={self.horizon_s!r} is shorter than one step of dt_s={self.dt_s!r}"
            )
        if not 0.0 <= self.falloff <= 1.0:
            raise ValueError(f"falloff must lie between 0 and 1, not {self.falloff!r}")
        if self.integrator not in INTEGRATORS:
            raise ValueError(
                f"integrator must be one of {', '.join(INTEGRATORS)}, not {self.integrator!r}"
            )
        self._check_inertia()

    def _check_inertia(self) -> None:
        inertia = np.asarray(self.inertia_kg_m2, dtype=float)
        if inertia.shape != (3, 3) or not np.all(np.isfinite(inertia)):
            raise ValueError("inertia_kg_m2 must be a finite 3 x 3 matrix")
        if not np.allclose(inertia, inertia.T, rtol=1e-9, atol=0.0):
            raise ValueError("inertia_kg_m2 must be symmetric")
        if np.linalg.eigvalsh(inertia)[0] <= 0.0:
            raise ValueError("inertia_kg_m2 must be positive definite")

    @property
    def stages(self) -> int:
        """Number of prediction steps D = round(T / dt)."""
        return round(self.horizon_s / self.dt_s)

    @cached_property
    def weights(self) -> Mapping[CostTerm, Array]:
        """Weights (D+1,) or (D+1, W) of each term of the cost; C reads these arrays."""
        costs = self.of_kind(CostTerm)
        falling = self.falling()
        return {t: np.ascontiguousarray(t.weights(falling), dtype=np.float64) for t in costs}

    def of_kind(self, kind: type[T]) -> tuple[T, ...]:
        """Return the terms of a kind, in order."""
        return tuple(t for t in self.terms if isinstance(t, kind))

    def falling(self) -> Array:
        """Return the factors (D+1,) by which stage weights fall off along the horizon (eq. 6)."""
        return 1.0 - self.falloff * np.arange(self.stages + 1) / self.stages

    def input_limits(self) -> Array:
        """Return the input box (6,): force (N) and torque (N m) per body axis."""
        return np.array([self.force_max_N] * 3 + [self.torque_max_N_m] * 3)


def terms_of(settings: Mapping[str, float]) -> tuple[Term, ...]:
    """Return all terms with these settings. Raises ValueError for one that is missing, is out of
    range, or that no term has.
    """
    names = {f.name for term in TERMS for f in fields(term)}
    if unread := settings.keys() - names:
        raise ValueError(f"no term of the NMPC reads {', '.join(sorted(unread))}")
    if missing := names - settings.keys():
        raise ValueError(f"the NMPC needs {', '.join(sorted(missing))}")
    return tuple(term(**{f.name: settings[f.name] for f in fields(term)}) for term in TERMS)


def settings_of(terms: Sequence[Term]) -> dict[str, float]:
    """Return the settings of terms, the inverse of `terms_of`."""
    return {f.name: getattr(term, f.name) for term in terms for f in fields(term)}


def model_of(params: NmpcParameters, step_s: float | None = None) -> Model:
    """Return body and discretization for C. The step is ``params.dt_s`` by default."""
    inertia = np.array(params.inertia_kg_m2, dtype=float)
    nodes, weights = RK_NODES[params.integrator], RK_WEIGHTS[params.integrator]
    return Model(
        params.dt_s if step_s is None else step_s, params.mass_kg, 1.0 / params.mass_kg,
        (c_double * 9)(*inertia.ravel()),
        (c_double * 9)(*np.linalg.inv(inertia).ravel()), (c_double * 4)(*nodes),
        (c_double * 4)(*weights), len(nodes),
    )  # fmt: skip


@LIBRARY.structure("Problem")
class NativeProblem(Structure):
    """`Problem` of native/problem.c: members that all terms use, then those of each term."""

    n_boxes: int
    n_coasts: int
    _fields_ = [
        ("n", c_int64),
        ("stages", c_int64),
        ("step_s", c_double),
        pointer("references"),
        pointer("targets"),
        pointer("u_ref"),
        *(member for term in TERMS for member in term.MEMBERS),
    ]


def native_problem(problem: NmpcInput, params: NmpcParameters) -> NativeProblem:
    """Return a checked problem for C. It holds addresses of arrays of ``problem`` and
    ``params``.
    """
    values: list[Any] = [len(problem.states), params.stages, params.dt_s]
    values += map(address_of, (problem.references, problem.target_positions, problem.u_ref))
    for term in params.terms:
        if isinstance(term, CostTerm):
            values.append(address_of(params.weights[term]))
        elif isinstance(term, Constraint):
            values += term.native(problem)
    return NativeProblem(*values)


def check_input(problem: NmpcInput, params: NmpcParameters, n_max: int) -> NmpcInput:
    """Check a problem. Returns a copy with contiguous arrays, unit quaternions and all optional
    values expanded by their terms.

    Raises ValueError for a wrong shape, a value that is not finite, a quaternion more than 10 % off
    unit length, a negative distance or limit, an asymmetric distance matrix, an invalid corridor,
    or more than ``n_max`` chasers.
    """
    states = np.asarray(problem.states, dtype=np.float64)
    if states.ndim != 2 or not 1 <= len(states) <= n_max:
        raise ValueError(
            f"states must have shape (N, 13) with N from 1 to {n_max}, not {states.shape}"
        )
    n, d = len(states), params.stages
    checked = {
        "states": checked_array("states", states, (n, 13), negative=True),
        "references": checked_array("references", problem.references, (n, d + 1, 7), negative=True),
        "target_positions": checked_array(
            "target_positions", problem.target_positions, (d + 1, 3), negative=True
        ),
        "u_ref": checked_array("u_ref", problem.u_ref, (n, d, 6), negative=True),
    }
    for name, first in (("states", 6), ("references", 3)):
        if normalize_rows(checked[name], first, QUATERNION_NORM_TOLERANCE):
            raise ValueError(f"{name} holds a quaternion that is not of unit length")
    for term in params.terms:
        checked |= term.check(problem, n, d)
    return replace(problem, coasts=None, **checked)


def with_obstacles(
    problem: NmpcInput,
    params: NmpcParameters,
    states: Array,
    references: Array,
    margins_m: Sequence[float],
) -> NmpcInput:
    """Append a row for each lost chaser to a problem that is not checked yet.

    ``states``: (13,) of each. ``references``: where it is expected at the stages (D+1, 7).
    ``margins_m``: added to the others' distances from it, as each term states.
    """
    u_ref = problem.u_ref
    extended: dict[str, Any] = {
        "states": np.concatenate([problem.states, states]),
        "references": np.concatenate([problem.references, references]),
        "u_ref": np.concatenate([u_ref, np.zeros((len(states), *u_ref.shape[1:]))]),
    }
    for term in params.terms:
        extended |= term.of_lost(problem, margins_m)
    return replace(problem, **extended)
