# SPDX-License-Identifier: Apache-2.0
"""Hypotheses of the target's state: rates, loss, shocks, selection, mixture. Pure functions.

After a start from an ambiguous view two hypotheses run in parallel until one is ruled out.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from chaserdock_models import scalar_rotations as so3
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import Innovation
from msgspec import Struct
from msgspec.structs import replace

from chaserdock_controller.estimation.types import EstimatorEvent, Shock
from chaserdock_controller.interfaces import TargetState

from .covariance import with_target_noise
from .parameters import TargetParameters
from .state import RATES, JointState


class FilterState(Struct, frozen=True, eq=False):
    """State of the filter after the tick at ``time_ns``.

    ``hypotheses``: the likeliest first; two while an ambiguous start (at ``ambiguous_since_ns``) is
    unresolved. ``seen``, ``rejected``: chasers whose sightings were accepted and gated out at this
    time, with ``innovations`` of both. ``accepted``, ``gated``, ``reinitialisations``: counts since
    the start. ``collective``: consecutive ticks in which most cameras were rejected.
    ``overconfident``, ``dropped``: channels of odometry for which this was reported, by chaser and
    name.
    """

    time_ns: int
    hypotheses: tuple[JointState, ...]
    ambiguous_since_ns: int = 0
    last_accepted_ns: int = 0
    seen: tuple[int, ...] = ()
    rejected: tuple[int, ...] = ()
    innovations: tuple[Innovation, ...] = ()
    accepted: int = 0
    gated: int = 0
    reinitialisations: int = 0
    collective: int = 0
    overconfident: frozenset[tuple[int, str]] = frozenset()
    dropped: frozenset[tuple[int, str]] = frozenset()


class TargetRates(NamedTuple):
    """Velocity (3,) in WRF and rate (3,) in TRF, with their covariance (6, 6)."""

    velocity_m_s: Array
    omega_rad_s: Array
    covariance: Array


def rate_variances(velocity_m_s: float, omega_rad_s: float) -> Array:
    """Return the variances (6,) of velocity and rate for these sigmas."""
    return np.repeat([velocity_m_s**2, omega_rad_s**2], 3)


def unknown_rates(p: TargetParameters) -> TargetRates:
    """Return the rates assumed before the first measurement."""
    variances = rate_variances(p.initial_velocity_m_s, p.initial_omega_rad_s)
    return TargetRates(np.zeros(3), np.zeros(3), np.diag(variances))


def rates_of(h: JointState) -> TargetRates:
    """Return the rates of a hypothesis."""
    return TargetRates(h.velocity_m_s, h.omega_rad_s, h.covariance[np.ix_(RATES, RATES)])


def with_uncertain_rates(h: JointState, p: TargetParameters) -> JointState:
    """Return the hypothesis with its rates widened by the variances of a reinitialization."""
    added = rate_variances(p.reinitialised_velocity_m_s, p.reinitialised_omega_rad_s)
    return with_target_noise(h, RATES, added)


def apply_shocks(state: FilterState, shocks: Sequence[Shock]) -> FilterState:
    """Add the known part of ``shocks`` to the rates of every hypothesis, and the unknown part to
    the covariance.
    """
    for shock in shocks:
        added = rate_variances(shock.sigma_velocity_m_s, shock.sigma_omega_rad_s)
        hypotheses = tuple(
            replace(
                with_target_noise(h, RATES, added),
                velocity_m_s=h.velocity_m_s + shock.velocity_m_s,
                omega_rad_s=h.omega_rad_s + shock.omega_rad_s,
            )
            for h in state.hypotheses
        )
        state = replace(state, hypotheses=hypotheses)
    return state


def is_lost(covariance: Array, p: TargetParameters) -> bool:
    """Test whether a pose with this covariance (12+, 12+) is too uncertain to be used."""
    v = covariance.diagonal().tolist()
    if v[0] + v[1] + v[2] <= p.lost_position_m**2 and v[6] + v[7] + v[8] <= p.lost_attitude_rad**2:
        return False  # no eigenvalue exceeds the trace
    position_m, attitude_rad = (_largest_sigma(covariance[k : k + 3, k : k + 3]) for k in (0, 6))
    return position_m > p.lost_position_m or attitude_rad > p.lost_attitude_rad


def _weights(hypotheses: Sequence[JointState]) -> list[float]:
    """Return the probabilities of the hypotheses from their likelihoods and equal priors."""
    top = max(h.log_likelihood for h in hypotheses)
    w = [math.exp(h.log_likelihood - top) for h in hypotheses]
    return [x / sum(w) for x in w]


def mixture_covariance(hypotheses: Sequence[JointState], covariances: Sequence[Array]) -> Array:
    """Return the target's covariance (12, 12) about the first hypothesis, with the spread between
    hypotheses.

    ``covariances``: (12, 12) of the target's state, one per hypothesis.
    """
    if len(hypotheses) == 1:
        return covariances[0].copy()
    total = np.zeros((12, 12))
    for weight, h, covariance in zip(_weights(hypotheses), hypotheses, covariances, strict=True):
        d = _target_difference(hypotheses[0], h)
        total += weight * (covariance + np.outer(d, d))
    return total


def _target_difference(a: JointState, b: JointState) -> Array:
    """Return the target's error (12,) that takes ``a`` to ``b``."""
    turn = so3.log(so3.inverse_multiply(a.q_wxyz, b.q_wxyz))
    moved = (
        b.position_m - a.position_m,
        b.velocity_m_s - a.velocity_m_s,
        turn,
        b.omega_rad_s - a.omega_rad_s,
    )
    return np.concatenate(moved)


def count_measurements(
    state: FilterState,
    accepted: Sequence[int],
    rejected: Sequence[int],
    innovations: tuple[Innovation, ...],
) -> FilterState:
    """Return the state with the chasers whose measurements were accepted or rejected at its time,
    and the innovations of these.
    """
    return replace(
        state,
        last_accepted_ns=state.time_ns if accepted else state.last_accepted_ns,
        seen=tuple(sorted({*state.seen, *accepted})),
        rejected=tuple(rejected),
        innovations=innovations,
        accepted=state.accepted + len(accepted),
        gated=state.gated + len(rejected),
    )


def before_restart(state: FilterState) -> FilterState:
    """Return the state before the measurements of its time are counted, with one more
    reinitialization.
    """
    return replace(
        state,
        seen=(),
        rejected=(),
        innovations=(),
        accepted=state.accepted - len(state.seen),
        gated=state.gated - len(state.rejected),
        reinitialisations=state.reinitialisations + 1,
    )


def choose(state: FilterState, p: TargetParameters, events: list[EstimatorEvent]) -> FilterState:
    """Sort the hypotheses by likelihood. Drop those ruled out by log odds or timeout, and append an
    event for each.
    """
    if len(state.hypotheses) < 2:
        return state
    ranked = sorted(state.hypotheses, key=lambda h: -h.log_likelihood)
    top = ranked[0]
    kept = [h for h in ranked if top.log_likelihood - h.log_likelihood < p.ambiguity_log_odds]
    if len(kept) == 1:
        events.append(EstimatorEvent(state.time_ns, "info", "ambiguity resolved"))
    elif state.time_ns - state.ambiguous_since_ns > p.ambiguity_timeout_s * 1e9:
        kept = [top]
        events.append(
            EstimatorEvent(state.time_ns, "info", "ambiguity timed out: kept the likelier attitude")
        )
    return replace(state, hypotheses=tuple(kept))


def target_state(
    state: FilterState,
    time_ns: int,
    best: JointState,
    covariance: Array,
    lost: bool,
    p: TargetParameters,
) -> TargetState:
    """Return the published estimate for ``time_ns``. ``best``, ``covariance`` (12, 12): predicted
    from the filter's ``state``.
    """
    status = "predicting"
    if lost:
        status = "lost"
    elif time_ns - state.last_accepted_ns <= p.tracking_s * 1e9:
        status = "tracking"
    return TargetState(
        time_ns,
        best.position_m.copy(),
        best.velocity_m_s.copy(),
        best.q_wxyz.copy(),
        best.omega_rad_s.copy(),
        covariance,
        status,
        len(state.seen),
        state.rejected,
    )


def _largest_sigma(covariance: Array) -> float:
    """Return the largest standard deviation of a covariance (3, 3)."""
    return math.sqrt(max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0))
