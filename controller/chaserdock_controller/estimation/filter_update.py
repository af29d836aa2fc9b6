# SPDX-License-Identifier: Apache-2.0
"""Update of the filter by one exposure: initialization, update, choice between hypotheses, re-initialization.

``process`` is a pure function from state and measurements to state. A late measurement is handled by a rollback to the
state before it and a replay of the later exposures.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from chaserdock_models import scalar_rotations as so3

from .hypothesis import StateHypothesis, pose_sigmas, poses_agree, predict, start, update_hypothesis
from .parameters import MekfParameters
from .types import Array, EstimatorEvent, Measurement, PoseHypothesis, Shock


@dataclass(frozen=True, eq=False)
class FilterState:
    """Complete state of the filter after the exposure at ``time_ns``.

    hypotheses: none before the first measurement, two while an ambiguous start (at ``ambiguous_since_ns``) is
    unresolved, one otherwise; the likeliest first. recent: the latest measurement of each chaser. seen, rejected:
    chasers accepted and gated out at this exposure. considered: covariance (6, 6) of the pose error of the last
    accepted measurements that does not average out. accepted, gated, reinitialisations: counts since the start.
    """

    time_ns: int
    hypotheses: tuple[StateHypothesis, ...] = ()
    ambiguous_since_ns: int = 0
    recent: tuple[Measurement, ...] = ()
    last_accepted_ns: int = 0
    seen: tuple[int, ...] = ()
    rejected: tuple[int, ...] = ()
    considered: Array = field(default_factory=lambda: np.zeros((6, 6)))
    accepted: int = 0
    gated: int = 0
    reinitialisations: int = 0


def process_exposure(
    state: FilterState | None, time_ns: int, group: list[Measurement], p: MekfParameters
) -> tuple[FilterState, tuple[EstimatorEvent, ...]]:
    """Return the state after the exposure at ``time_ns`` and the events.

    ``group``: its measurements, sorted by chaser. ``state``: after the previous exposure, None at the first.
    """
    before = state if state is not None else FilterState(time_ns)
    events: list[EstimatorEvent] = []
    seen = [m for m in group if m.hypotheses]
    named = {m.chaser for m in group}
    recent = [m for m in before.recent if m.chaser not in named] + group
    horizon = time_ns - round(p.recent_s * 1e9)
    now = replace(
        before,
        time_ns=time_ns,
        recent=tuple(sorted((m for m in recent if m.time_ns >= horizon), key=lambda m: m.chaser)),
        hypotheses=tuple(predict(b, time_ns, p) for b in before.hypotheses),
        seen=(),
        rejected=(),
    )
    if not seen:
        return now, ()

    if not now.hypotheses:
        velocity = np.zeros(3)
        rates = np.diag([p.initial_velocity_m_s**2] * 3 + [p.initial_omega_rad_s**2] * 3)
        now = _initialize(now, seen, seen, (velocity, velocity, rates), p, "initialised", events)
    else:
        lost = all(is_lost(b, p) for b in now.hypotheses)
        reacquired = _reacquire(now, seen, p, events) if lost else None
        now = reacquired if reacquired is not None else _update_hypotheses(now, seen, p, events)
        if all(_mostly_gated(b, now, p) for b in now.hypotheses):
            now = _reinitialize(now, seen, p, events)
    now = replace(
        now, considered=_considered_covariance([m for m in seen if m.chaser in now.seen], p, now.considered)
    )
    return _choose(now, p, events), tuple(events)


def _considered_covariance(used: list[Measurement], p: MekfParameters, before: Array) -> Array:
    """Return the covariance (6, 6) of the camera errors that stay constant while the view does.

    Each camera's part is a fixed ratio of its measurement's sigma, independent of the other cameras'. Without an
    accepted measurement ``before`` is returned.
    """
    if not used or p.considered_ratio == 0.0:
        return before
    information = np.zeros((6, 6))
    for m in used:
        information += np.linalg.inv(m.hypotheses[0].covariance)
    return p.considered_ratio**2 * np.asarray(np.linalg.inv(information), dtype=np.float64)


def apply_shocks(state: FilterState, shocks: list[Shock]) -> FilterState:
    """Add the known part of ``shocks`` to the rates of every hypothesis, and the unknown part to the covariance."""
    i = np.array([3, 4, 5, 9, 10, 11])
    hypotheses = list(state.hypotheses)
    for shock in shocks:
        added = np.repeat([shock.sigma_velocity_m_s**2, shock.sigma_omega_rad_s**2], 3)
        for k, b in enumerate(hypotheses):
            covariance = b.covariance.copy()
            covariance[i, i] += added
            hypotheses[k] = replace(
                b,
                velocity_m_s=b.velocity_m_s + shock.velocity_m_s,
                omega_rad_s=b.omega_rad_s + shock.omega_rad_s,
                covariance=covariance,
            )
    return replace(state, hypotheses=tuple(hypotheses))


def is_lost(hypothesis: StateHypothesis, p: MekfParameters) -> bool:
    """Test whether the hypothesis is too uncertain to use."""
    x, y, z, _, _, _, a, b, c = hypothesis.covariance.diagonal()[:9].tolist()
    if x + y + z <= p.lost_position_m**2 and a + b + c <= p.lost_attitude_rad**2:
        return False  # no eigenvalue exceeds the trace
    position, attitude = pose_sigmas(hypothesis.covariance)
    return position > p.lost_position_m or attitude > p.lost_attitude_rad


def weights(hypotheses: tuple[StateHypothesis, ...]) -> list[float]:
    """Return the probabilities of the hypotheses from their likelihoods and equal priors."""
    top = max(b.log_likelihood for b in hypotheses)
    w = [math.exp(b.log_likelihood - top) for b in hypotheses]
    return [x / sum(w) for x in w]


def mixture_covariance(hypotheses: tuple[StateHypothesis, ...]) -> Array:
    """Return the covariance (12, 12) about the first hypothesis, including the spread between hypotheses."""
    first = hypotheses[0]
    if len(hypotheses) == 1:
        return first.covariance[:12, :12].copy()
    total = np.zeros((12, 12))
    for weight, b in zip(weights(hypotheses), hypotheses, strict=True):
        d = np.concatenate(
            [
                b.position_m - first.position_m,
                b.velocity_m_s - first.velocity_m_s,
                so3.log(so3.inverse_multiply(first.q_wxyz, b.q_wxyz)),
                b.omega_rad_s - first.omega_rad_s,
            ]
        )
        total += weight * (b.covariance[:12, :12] + np.outer(d, d))
    return total


def _update_hypotheses(
    now: FilterState, seen: list[Measurement], p: MekfParameters, events: list[EstimatorEvent]
) -> FilterState:
    before = now.hypotheses
    results = [update_hypothesis(b, seen, p) for b in before]
    best = max(range(len(results)), key=lambda k: (results[k][0].log_likelihood, -k))
    for chaser in results[best][2]:
        if results[best][0].rejections[chaser] == p.sustained_rejections:
            events.append(
                EstimatorEvent(
                    now.time_ns, "warning", f"chaser {chaser} gated out: {p.sustained_rejections} in a row"
                )
            )
    for chaser in results[best][1]:
        if before[best].rejections.get(chaser, 0) >= p.sustained_rejections:
            events.append(EstimatorEvent(now.time_ns, "info", f"chaser {chaser} accepted again"))
    accepted, rejected = results[best][1:]
    return replace(
        now,
        hypotheses=tuple(r[0] for r in results),
        last_accepted_ns=now.time_ns if accepted else now.last_accepted_ns,
        seen=tuple(sorted({*now.seen, *accepted})),
        rejected=rejected,
        accepted=now.accepted + len(accepted),
        gated=now.gated + len(rejected),
    )


def _choose(now: FilterState, p: MekfParameters, events: list[EstimatorEvent]) -> FilterState:
    """Sort the hypotheses by likelihood and drop those ruled out by log odds or timeout."""
    if len(now.hypotheses) < 2:
        return now
    ranked = sorted(now.hypotheses, key=lambda b: -b.log_likelihood)
    top = ranked[0]
    kept = [b for b in ranked if top.log_likelihood - b.log_likelihood < p.ambiguity_log_odds]
    if len(kept) == 1:
        events.append(EstimatorEvent(now.time_ns, "info", "ambiguity resolved"))
    elif now.time_ns - now.ambiguous_since_ns > p.ambiguity_timeout_s * 1e9:
        kept = [top]
        events.append(EstimatorEvent(now.time_ns, "info", "ambiguity timed out: kept the likelier attitude"))
    return replace(now, hypotheses=tuple(kept))


def _recent_measurements(now: FilterState) -> list[Measurement]:
    """Return the latest measurement of each camera, propagated to now with the rates of the first hypothesis."""
    velocity, omega = now.hypotheses[0].velocity_m_s, now.hypotheses[0].omega_rad_s
    candidates: list[Measurement] = []
    for m in now.recent:
        dt = (now.time_ns - m.time_ns) * 1e-9
        moved = tuple(
            PoseHypothesis(
                h.position_m + velocity * dt, so3.multiply(h.q_wxyz, so3.exp(omega * dt)), h.covariance
            )
            for h in m.hypotheses
        )
        candidates.append(replace(m, hypotheses=moved))
    return [m for m in candidates if m.hypotheses]


def _support(h: PoseHypothesis, seen: Measurement, candidates: list[Measurement], p: MekfParameters) -> int:
    return sum(
        any(poses_agree(h, seen.camera, other, m.camera, p) for other in m.hypotheses)
        for m in candidates
        if m.chaser != seen.chaser
    )


def _ranking(
    m: Measurement, candidates: list[Measurement], p: MekfParameters
) -> tuple[int, bool, int, float]:
    """Rank a measurement as a starting point: agreement, no ambiguity, markers, small covariance."""
    support = max(_support(h, m, candidates, p) for h in m.hypotheses)
    return support, len(m.hypotheses) == 1, m.markers, -float(np.trace(m.hypotheses[0].covariance))


def _initialize(
    now: FilterState,
    seen: list[Measurement],
    candidates: list[Measurement],
    rates: tuple[Array, Array, Array],
    p: MekfParameters,
    action: str,
    events: list[EstimatorEvent],
) -> FilterState:
    """Initialize from the camera that most others poses_agree with; apply the other cameras as updates."""
    seed = max(seen, key=lambda m: (*_ranking(m, candidates, p), -m.chaser))
    supports = [_support(h, seed, candidates, p) for h in seed.hypotheses]
    kept = [h for h, s in zip(seed.hypotheses, supports, strict=True) if s == max(supports)]
    hypotheses = tuple(start(now.time_ns, seed, h, rates, p) for h in kept)
    text = f"{action} by chaser {seed.chaser}"
    events.append(
        EstimatorEvent(now.time_ns, "info", text + (", ambiguous: two hypotheses" if len(kept) > 1 else ""))
    )
    now = replace(
        now,
        hypotheses=hypotheses,
        ambiguous_since_ns=now.time_ns,
        last_accepted_ns=now.time_ns,
        seen=(seed.chaser,),
        accepted=now.accepted + 1,
    )
    others = [m for m in seen if m is not seed]
    return _update_hypotheses(now, others, p, events) if others else now


def _mostly_gated(hypothesis: StateHypothesis, now: FilterState, p: MekfParameters) -> bool:
    """Test whether more than half of the cameras that see the target have sustained rejections."""
    active = [m.chaser for m in now.recent if m.hypotheses]
    out = sum(hypothesis.rejections.get(chaser, 0) >= p.sustained_rejections for chaser in active)
    return 2 * out > len(active)


def _rates(hypothesis: StateHypothesis) -> tuple[Array, Array, Array]:
    r = np.array([3, 4, 5, 9, 10, 11])
    return hypothesis.velocity_m_s, hypothesis.omega_rad_s, hypothesis.covariance[np.ix_(r, r)]


def _reacquire(
    now: FilterState, seen: list[Measurement], p: MekfParameters, events: list[EstimatorEvent]
) -> FilterState | None:
    """Initialize from the status "lost", keeping the rates and their covariance.

    Returns None if the measurements alone would be "lost" as well; then they accumulate as updates.
    """
    new_events: list[EstimatorEvent] = []
    state = replace(now, reinitialisations=now.reinitialisations + 1)
    state = _initialize(
        state, seen, _recent_measurements(now), _rates(now.hypotheses[0]), p, "reacquired", new_events
    )
    if all(is_lost(b, p) for b in state.hypotheses):
        return None
    events += new_events
    return state


def _reinitialize(
    now: FilterState, seen: list[Measurement], p: MekfParameters, events: list[EstimatorEvent]
) -> FilterState:
    """Initialize at the pose that most cameras poses_agree on, keeping the rates with a larger covariance.

    Does nothing if a camera outside this exposure has more agreement; its next exposure will re-initialize.
    """
    candidates = _recent_measurements(now)
    best = max(_ranking(m, candidates, p)[0] for m in candidates)
    if max(_ranking(m, candidates, p)[0] for m in seen) < best:
        return now
    velocity, omega, covariance = _rates(now.hypotheses[0])
    wider = np.diag([p.reinitialised_velocity_m_s**2] * 3 + [p.reinitialised_omega_rad_s**2] * 3)
    # _initialize counts the measurements of this exposure again.
    now = replace(
        now,
        accepted=now.accepted - len(now.seen),
        gated=now.gated - len(now.rejected),
        seen=(),
        rejected=(),
        reinitialisations=now.reinitialisations + 1,
    )
    return _initialize(
        now, seen, candidates, (velocity, omega, covariance + wider), p, "re-initialised", events
    )
