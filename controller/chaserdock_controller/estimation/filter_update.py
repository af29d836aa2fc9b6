"""What one exposure does to the filter: start, update, choice between branches, re-initialisation.

``process`` is a pure function from state and measurements to state, so that a late measurement can be
put in by going back to the state before it and running the later exposures again.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

import numpy as np
from chaserdock_models import scalar_rotations as so3

from .hypothesis import Branch, absorb, agree, pose_sigmas, predict, start
from .parameters import MekfParameters
from .types import Array, EstimatorEvent, Measurement, PoseHypothesis, Shock


@dataclass(frozen=True, eq=False)
class FilterState:
    """All that the filter knows after the exposure at ``time_ns``.

    branches: none before the first sight, two while an ambiguous start (at ``ambiguous_since_ns``) is
    open, one otherwise; the likeliest first. recent: the latest measurement of each chaser, as it came.
    seen, rejected: chasers accepted and gated out at this exposure. frozen: covariance (6, 6) of the pose that comes of
    what does not average out of the last accepted measurements. The rest are counts since the start.
    """

    time_ns: int
    branches: tuple[Branch, ...] = ()
    ambiguous_since_ns: int = 0
    recent: tuple[Measurement, ...] = ()
    last_accepted_ns: int = 0
    seen: tuple[int, ...] = ()
    rejected: tuple[int, ...] = ()
    frozen: Array = field(default_factory=lambda: np.zeros((6, 6)))
    accepted: int = 0
    gated: int = 0
    reinitialisations: int = 0


def process(
    state: FilterState | None, time_ns: int, group: list[Measurement], p: MekfParameters
) -> tuple[FilterState, tuple[EstimatorEvent, ...]]:
    """The state after the exposure at ``time_ns`` with the measurements ``group``, sorted by chaser, and
    what happened. ``state`` is the state after the exposure before, None at the first."""
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
        branches=tuple(predict(b, time_ns, p) for b in before.branches),
        seen=(),
        rejected=(),
    )
    if not seen:
        return now, ()

    if not now.branches:
        velocity = np.zeros(3)
        rates = np.diag([p.initial_velocity_m_s**2] * 3 + [p.initial_omega_rad_s**2] * 3)
        now = _begin(now, seen, seen, (velocity, velocity, rates), p, "initialised", events)
    else:
        found = _find_again(now, seen, p, events) if all(is_lost(b, p) for b in now.branches) else None
        now = found if found is not None else _absorb_all(now, seen, p, events)
        if all(_mostly_gated(b, now, p) for b in now.branches):
            now = _restart(now, seen, p, events)
    now = replace(now, frozen=_frozen([m for m in seen if m.chaser in now.seen], p, now.frozen))
    return _choose(now, p, events), tuple(events)


def _frozen(believed: list[Measurement], p: MekfParameters, before: Array) -> Array:
    """Covariance (6, 6) of the part of the cameras' errors that stays while their view does: each camera's share of its
    measurement's covariance, independent of the other cameras'; ``before`` where nothing was believed."""
    if not believed or p.frozen_share == 0.0:
        return before
    information = np.zeros((6, 6))
    for m in believed:
        information += np.linalg.inv(m.hypotheses[0].covariance)
    return p.frozen_share**2 * np.asarray(np.linalg.inv(information), dtype=np.float64)


def shaken(state: FilterState, shocks: list[Shock]) -> FilterState:
    """The state with every branch's rates changed by ``shocks``, and their covariance by what these leave open."""
    i = np.array([3, 4, 5, 9, 10, 11])
    branches = list(state.branches)
    for shock in shocks:
        added = np.repeat([shock.sigma_velocity_m_s**2, shock.sigma_omega_rad_s**2], 3)
        for k, b in enumerate(branches):
            covariance = b.covariance.copy()
            covariance[i, i] += added
            branches[k] = replace(
                b,
                velocity_m_s=b.velocity_m_s + shock.velocity_m_s,
                omega_rad_s=b.omega_rad_s + shock.omega_rad_s,
                covariance=covariance,
            )
    return replace(state, branches=tuple(branches))


def is_lost(branch: Branch, p: MekfParameters) -> bool:
    """Whether the branch is too uncertain to be of use."""
    x, y, z, _, _, _, a, b, c = branch.covariance.diagonal()[:9].tolist()
    if x + y + z <= p.lost_position_m**2 and a + b + c <= p.lost_attitude_rad**2:
        return False  # no eigenvalue is larger than the sum of all
    position, attitude = pose_sigmas(branch.covariance)
    return position > p.lost_position_m or attitude > p.lost_attitude_rad


def weights(branches: tuple[Branch, ...]) -> list[float]:
    """Probabilities of the branches, from their likelihoods and equal priors."""
    top = max(b.log_likelihood for b in branches)
    w = [math.exp(b.log_likelihood - top) for b in branches]
    return [x / sum(w) for x in w]


def mixture_covariance(branches: tuple[Branch, ...]) -> Array:
    """Covariance (12, 12) about the first branch, with the spread between branches in it."""
    first = branches[0]
    if len(branches) == 1:
        return first.covariance[:12, :12].copy()
    total = np.zeros((12, 12))
    for weight, b in zip(weights(branches), branches, strict=True):
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


def _absorb_all(
    now: FilterState, seen: list[Measurement], p: MekfParameters, events: list[EstimatorEvent]
) -> FilterState:
    before = now.branches
    results = [absorb(b, seen, p) for b in before]
    best = max(range(len(results)), key=lambda k: (results[k][0].log_likelihood, -k))
    for chaser in results[best][2]:
        if results[best][0].misses[chaser] == p.sustained_rejections:
            events.append(
                EstimatorEvent(
                    now.time_ns, "warning", f"chaser {chaser} gated out: {p.sustained_rejections} in a row"
                )
            )
    for chaser in results[best][1]:
        if before[best].misses.get(chaser, 0) >= p.sustained_rejections:
            events.append(EstimatorEvent(now.time_ns, "info", f"chaser {chaser} accepted again"))
    accepted, rejected = results[best][1:]
    return replace(
        now,
        branches=tuple(r[0] for r in results),
        last_accepted_ns=now.time_ns if accepted else now.last_accepted_ns,
        seen=tuple(sorted({*now.seen, *accepted})),
        rejected=rejected,
        accepted=now.accepted + len(accepted),
        gated=now.gated + len(rejected),
    )


def _choose(now: FilterState, p: MekfParameters, events: list[EstimatorEvent]) -> FilterState:
    """Puts the likeliest branch first and drops what evidence or time has ruled out."""
    if len(now.branches) < 2:
        return now
    ranked = sorted(now.branches, key=lambda b: -b.log_likelihood)
    top = ranked[0]
    kept = [b for b in ranked if top.log_likelihood - b.log_likelihood < p.ambiguity_log_odds]
    if len(kept) == 1:
        events.append(EstimatorEvent(now.time_ns, "info", "ambiguity resolved"))
    elif now.time_ns - now.ambiguous_since_ns > p.ambiguity_timeout_s * 1e9:
        kept = [top]
        events.append(EstimatorEvent(now.time_ns, "info", "ambiguity timed out: kept the likelier attitude"))
    return replace(now, branches=tuple(kept))


def _opinions(now: FilterState) -> list[Measurement]:
    """What each camera said last, moved to the present by the first branch's rates."""
    velocity, omega = now.branches[0].velocity_m_s, now.branches[0].omega_rad_s
    opinions: list[Measurement] = []
    for m in now.recent:
        dt = (now.time_ns - m.time_ns) * 1e-9
        moved = tuple(
            PoseHypothesis(
                h.position_m + velocity * dt, so3.multiply(h.q_wxyz, so3.exp(omega * dt)), h.covariance
            )
            for h in m.hypotheses
        )
        opinions.append(replace(m, hypotheses=moved))
    return [m for m in opinions if m.hypotheses]


def _support(h: PoseHypothesis, seen: Measurement, opinions: list[Measurement], p: MekfParameters) -> int:
    return sum(
        any(agree(h, seen.eye, other, m.eye, p) for other in m.hypotheses)
        for m in opinions
        if m.chaser != seen.chaser
    )


def _ranking(m: Measurement, opinions: list[Measurement], p: MekfParameters) -> tuple[int, bool, int, float]:
    """How good a measurement is to begin with: agreement, no ambiguity, markers, small covariance."""
    support = max(_support(h, m, opinions, p) for h in m.hypotheses)
    return support, len(m.hypotheses) == 1, m.markers, -float(np.trace(m.hypotheses[0].covariance))


def _begin(
    now: FilterState,
    seen: list[Measurement],
    opinions: list[Measurement],
    rates: tuple[Array, Array, Array],
    p: MekfParameters,
    verb: str,
    events: list[EstimatorEvent],
) -> FilterState:
    """Branches from the camera that most others agree with; the other cameras follow as updates."""
    seed = max(seen, key=lambda m: (*_ranking(m, opinions, p), -m.chaser))
    supports = [_support(h, seed, opinions, p) for h in seed.hypotheses]
    kept = [h for h, s in zip(seed.hypotheses, supports, strict=True) if s == max(supports)]
    branches = tuple(start(now.time_ns, seed, h, rates, p) for h in kept)
    text = f"{verb} by chaser {seed.chaser}"
    events.append(
        EstimatorEvent(now.time_ns, "info", text + (", ambiguous: two hypotheses" if len(kept) > 1 else ""))
    )
    now = replace(
        now,
        branches=branches,
        ambiguous_since_ns=now.time_ns,
        last_accepted_ns=now.time_ns,
        seen=(seed.chaser,),
        accepted=now.accepted + 1,
    )
    others = [m for m in seen if m is not seed]
    return _absorb_all(now, others, p, events) if others else now


def _mostly_gated(branch: Branch, now: FilterState, p: MekfParameters) -> bool:
    """Whether more than half of the cameras that see the target have long been gated out."""
    active = [m.chaser for m in now.recent if m.hypotheses]
    out = sum(branch.misses.get(chaser, 0) >= p.sustained_rejections for chaser in active)
    return 2 * out > len(active)


def _rates(branch: Branch) -> tuple[Array, Array, Array]:
    r = np.array([3, 4, 5, 9, 10, 11])
    return branch.velocity_m_s, branch.omega_rad_s, branch.covariance[np.ix_(r, r)]


def _find_again(
    now: FilterState, seen: list[Measurement], p: MekfParameters, events: list[EstimatorEvent]
) -> FilterState | None:
    """Begins anew from the state "lost", with the rates and their covariance as they are; None if the
    measurements by themselves are no better than lost (then they had better add up)."""
    told: list[EstimatorEvent] = []
    again = replace(now, reinitialisations=now.reinitialisations + 1)
    again = _begin(again, seen, _opinions(now), _rates(now.branches[0]), p, "found again", told)
    if all(is_lost(b, p) for b in again.branches):
        return None
    events += told
    return again


def _restart(
    now: FilterState, seen: list[Measurement], p: MekfParameters, events: list[EstimatorEvent]
) -> FilterState:
    """Begins anew where most cameras say the target is, keeping its rates with a wider covariance.

    If a camera that is not in this exposure has more agreement, its turn comes within its period.
    """
    opinions = _opinions(now)
    best = max(_ranking(m, opinions, p)[0] for m in opinions)
    if max(_ranking(m, opinions, p)[0] for m in seen) < best:
        return now
    velocity, omega, covariance = _rates(now.branches[0])
    wider = np.diag([p.reinitialised_velocity_m_s**2] * 3 + [p.reinitialised_omega_rad_s**2] * 3)
    # What this exposure counted before is counted again below.
    now = replace(
        now,
        accepted=now.accepted - len(now.seen),
        gated=now.gated - len(now.rejected),
        seen=(),
        rejected=(),
        reinitialisations=now.reinitialisations + 1,
    )
    return _begin(now, seen, opinions, (velocity, omega, covariance + wider), p, "re-initialised", events)
