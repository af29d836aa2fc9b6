# SPDX-License-Identifier: Apache-2.0
"""Passive safety as rows of the QP: half-spaces of position and velocity that keep a plan's coasts
outside the keep-out.

The coast from a stage is linear in the state there (chaserdock_models/passive_safety.py). At the
times of its closest approaches the keep-out sphere, enlarged by the covariance, is replaced by its
tangent plane across the line from the target. This condition is linear in the state and sufficient
at that time. Only chasers whose plans are unsafe without these rows have them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from ctypes import c_int64
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.passive_safety import CoastCertificate

from chaserdock_controller.nmpc.term import Constraint, address_of, pointer
from chaserdock_controller.nmpc.types import CoastSafety, NmpcInput

COASTS = 3
"""Number of closest approaches per coast that are restricted."""
SPARE_SHARE = 0.05
"""Share of the required margin that plans keep in addition, because approaches and planes move as a
plan is bent.
"""


@dataclass(frozen=True)
class PassiveCoasts(Constraint):
    """Keeps the coast from every stage outside the keep-out, by half-spaces of position and
    velocity.

    `rti` adds them where a plan without them is unsafe; other back ends do not keep them.
    """

    MEMBERS = (("n_coasts", c_int64), pointer("coasts"))

    def native(self, problem: NmpcInput) -> Sequence[Any]:
        """Return the number of coasts per stage, and their address."""
        coasts = problem.coasts
        return (0, None) if coasts is None else (coasts.shape[2], address_of(coasts))


def certify(safety: CoastSafety, states: Array, targets: Array) -> dict[int, CoastCertificate]:
    """Return the certificates of the restricted rows of plans ``states`` (N, D+1, 13). ``targets``:
    as in ``coast_rows``.
    """
    origin = _origin(safety, targets)
    return {
        i: safety.coast.certify(states[i, :, :6] - origin, motion, safety.keep_out_m)
        for i, motion in safety.motions.items()
    }


def unsafe_rows(safety: CoastSafety, found: Mapping[int, CoastCertificate]) -> CoastSafety | None:
    """Return the restriction of the rows whose certificates ``found`` lack the margin; None if none
    does.
    """
    least = _planned_sigmas(safety)
    kept = {i: m for i, m in safety.motions.items() if not found[i].margin_sigmas >= least}
    return replace(safety, motions=kept) if kept else None


def _planned_sigmas(safety: CoastSafety) -> float:
    return (1.0 + SPARE_SHARE) * safety.sigmas


def _origin(safety: CoastSafety, targets: Array) -> Array:
    """Return the target's positions and velocities (K, 6) for its positions (K, 3)."""
    return np.concatenate([targets, np.tile(safety.target_velocity_m_s, (len(targets), 1))], axis=1)


def coast_rows(safety: CoastSafety, states: Array, targets: Array, horizon_s: float) -> Array:
    """Return half-spaces (N, D+1, C, 7) as in `NmpcInput`, linearized about plans ``states`` (N,
    D+1, 13).

    ``targets`` (D+1, 3): positions of the target. Rows are scaled so that a displacement by 1 m, or
    the change of velocity that causes it within the horizon, changes a row by about 1 at most. They
    are thus priced like the distances.
    """
    n, nodes, _ = states.shape
    rows = np.zeros((n, nodes, COASTS, 7))
    origin, sigmas = _origin(safety, targets[1:]), _planned_sigmas(safety)
    for i, motion in safety.motions.items():
        relative = states[i, 1:, :6] - origin
        planes = safety.coast.tangent_planes(relative, motion, safety.keep_out_m, sigmas, COASTS)
        planes[..., 6] += np.einsum("kcj,kj->kc", planes[..., :6], origin)
        by_velocity = np.linalg.norm(planes[..., 3:6], axis=2) / horizon_s
        scale = np.maximum(np.linalg.norm(planes[..., :3], axis=2), by_velocity)
        rows[i, 1:] = planes / np.where(scale > 0.0, scale, 1.0)[..., None]
    return rows
