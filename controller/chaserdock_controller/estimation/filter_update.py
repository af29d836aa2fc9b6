# SPDX-License-Identifier: Apache-2.0
"""Update of the filter by one exposure: initialization, update, choice between hypotheses,
re-initialization.

``process`` is a pure function from state and measurements to state. A late measurement is handled
by a rollback to the state before it and a replay of the later exposures.
"""

from __future__ import annotations

import dataclasses

import numpy as np
from chaserdock_models import scalar_rotations as so3
from msgspec import field
from msgspec.structs import replace

from .hypothesis import StateHypothesis, measurements_agree, predict, start, update_hypothesis
from .parameters import MekfParameters
from .target_hypotheses import (
    HypothesisSet,
    TargetRates,
    all_lost,
    before_restart,
    choose,
    count_measurements,
    rates_of,
    unknown_rates,
    with_uncertain_rates,
)
from .types import Array, EstimatorEvent, Measurement, PoseHypothesis


class FilterState(HypothesisSet[StateHypothesis], frozen=True, eq=False):
    """Complete state of the filter after the exposure at ``time_ns``; no hypotheses before the
    first measurement.

    recent: the latest measurement of each chaser. considered: covariance (6, 6) of the pose error
    of the last accepted measurements that does not average out.
    """

    recent: tuple[Measurement, ...] = ()
    considered: Array = field(default_factory=lambda: np.zeros((6, 6)))


def process_exposure(
    state: FilterState | None, time_ns: int, group: list[Measurement], p: MekfParameters
) -> tuple[FilterState, tuple[EstimatorEvent, ...]]:
    """Return the state after the exposure at ``time_ns`` and the events.

    ``group``: its measurements, sorted by chaser. ``state``: after the previous exposure, None at
    the first.
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
        now = _initialize(now, seen, seen, unknown_rates(p), p, "initialised", events)
    else:
        reacquired = _reacquire(now, seen, p, events) if all_lost(now, p) else None
        now = reacquired if reacquired is not None else _update_hypotheses(now, seen, p, events)
        if all(_mostly_gated(b, now, p) for b in now.hypotheses):
            now = _reinitialize(now, seen, p, events)
    now = replace(
        now,
        considered=_considered_covariance(
            [m for m in seen if m.chaser in now.seen], p, now.considered
        ),
    )
    return choose(now, p, events), tuple(events)


def _considered_covariance(used: list[Measurement], p: MekfParameters, before: Array) -> Array:
    """Return the covariance (6, 6) of the camera errors that stay constant while the view does.

    Each camera's part is a fixed ratio of its measurement's sigma, independent of the other
    cameras'. Without an accepted measurement ``before`` is returned.
    """
    if not used or p.considered_ratio == 0.0:
        return before
    information = np.zeros((6, 6))
    for m in used:
        information += np.linalg.inv(m.hypotheses[0].covariance)
    return p.considered_ratio**2 * np.asarray(np.linalg.inv(information), dtype=np.float64)


def _update_hypotheses(
    now: FilterState, seen: list[Measurement], p: MekfParameters, events: list[EstimatorEvent]
) -> FilterState:
    before = now.hypotheses
    results = [update_hypothesis(b, seen, p) for b in before]
    best = max(range(len(results)), key=lambda k: results[k][0].log_likelihood)
    hypothesis, accepted, rejected = results[best]
    for chaser in rejected:
        if hypothesis.rejections[chaser] == p.sustained_rejections:
            events.append(
                EstimatorEvent(
                    now.time_ns,
                    "warning",
                    f"chaser {chaser} gated out: {p.sustained_rejections} in a row",
                )
            )
    for chaser in accepted:
        if before[best].rejections.get(chaser, 0) >= p.sustained_rejections:
            events.append(EstimatorEvent(now.time_ns, "info", f"chaser {chaser} accepted again"))
    now = replace(now, hypotheses=tuple(r[0] for r in results))
    return count_measurements(now, accepted, rejected)


def _recent_measurements(now: FilterState) -> list[Measurement]:
    """Return the latest measurement of each camera, propagated to now with the rates of the first
    hypothesis.
    """
    velocity, omega = now.hypotheses[0].velocity_m_s, now.hypotheses[0].omega_rad_s
    candidates: list[Measurement] = []
    for m in now.recent:
        dt = (now.time_ns - m.time_ns) * 1e-9
        moved = tuple(
            PoseHypothesis(
                h.position_m + velocity * dt,
                so3.multiply(h.q_wxyz, so3.exp(omega * dt)),
                h.covariance,
            )
            for h in m.hypotheses
        )
        candidates.append(dataclasses.replace(m, hypotheses=moved))
    return [m for m in candidates if m.hypotheses]


def _support(
    h: PoseHypothesis, seen: Measurement, candidates: list[Measurement], p: MekfParameters
) -> int:
    return sum(
        any(measurements_agree(h, seen.camera, other, m.camera, p) for other in m.hypotheses)
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
    rates: TargetRates,
    p: MekfParameters,
    action: str,
    events: list[EstimatorEvent],
) -> FilterState:
    """Initialize from the camera with which most others agree; apply the other cameras as updates."""
    seed = max(seen, key=lambda m: (*_ranking(m, candidates, p), -m.chaser))
    supports = [_support(h, seed, candidates, p) for h in seed.hypotheses]
    kept = [h for h, s in zip(seed.hypotheses, supports, strict=True) if s == max(supports)]
    hypotheses = tuple(start(now.time_ns, seed, h, rates, p) for h in kept)
    text = f"{action} by chaser {seed.chaser}"
    events.append(
        EstimatorEvent(
            now.time_ns, "info", text + (", ambiguous: two hypotheses" if len(kept) > 1 else "")
        )
    )
    now = replace(now, hypotheses=hypotheses, ambiguous_since_ns=now.time_ns)
    now = count_measurements(now, (seed.chaser,), ())
    others = [m for m in seen if m is not seed]
    return _update_hypotheses(now, others, p, events) if others else now


def _mostly_gated(hypothesis: StateHypothesis, now: FilterState, p: MekfParameters) -> bool:
    """Test whether more than half of the cameras that see the target have sustained rejections."""
    active = [m.chaser for m in now.recent if m.hypotheses]
    out = sum(hypothesis.rejections.get(chaser, 0) >= p.sustained_rejections for chaser in active)
    return 2 * out > len(active)


def _reacquire(
    now: FilterState, seen: list[Measurement], p: MekfParameters, events: list[EstimatorEvent]
) -> FilterState | None:
    """Initialize from the status "lost", keeping the rates and their covariance.

    Returns None if the measurements alone would be "lost" as well; then they accumulate as updates.
    """
    new_events: list[EstimatorEvent] = []
    state = replace(now, reinitialisations=now.reinitialisations + 1)
    rates = rates_of(now.hypotheses[0])
    state = _initialize(state, seen, _recent_measurements(now), rates, p, "reacquired", new_events)
    if all_lost(state, p):
        return None
    events += new_events
    return state


def _reinitialize(
    now: FilterState, seen: list[Measurement], p: MekfParameters, events: list[EstimatorEvent]
) -> FilterState:
    """Initialize at the pose that most cameras agree on, keeping the rates with a larger
    covariance.

    Does nothing if a camera outside this exposure has more agreement; its next exposure will
    re-initialize.
    """
    candidates = _recent_measurements(now)
    best = max(_ranking(m, candidates, p)[0] for m in candidates)
    if max(_ranking(m, candidates, p)[0] for m in seen) < best:
        return now
    rates = rates_of(with_uncertain_rates(now.hypotheses[0], p))
    return _initialize(before_restart(now), seen, candidates, rates, p, "re-initialised", events)
