# SPDX-License-Identifier: Apache-2.0
"""One tick of the joint filter: predict, update, start and restart the target, report. Pure
functions.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import Sighting
from msgspec.structs import replace
from threadpoolctl import ThreadpoolController

from chaserdock_controller.estimation.types import EstimatorEvent

from .covariance import with_chaser_noise
from .floor import keep_on_floor
from .hypotheses import (
    FilterState,
    TargetRates,
    before_restart,
    choose,
    count_measurements,
    is_lost,
    rate_variances,
    rates_of,
    unknown_rates,
    with_uncertain_rates,
)
from .measurements import CameraMounting
from .parameters import JointParameters, TargetParameters
from .prediction import predict
from .replay import FilterTick
from .state import (
    CHANNELS,
    RATES,
    SIGHTING_CHANNEL,
    JointState,
    empty_state,
    start_shape,
    with_body,
)
from .update import SightedPose, UpdateReport, sighted_pose, start_chaser, start_target, update

FAR_LOST_SHARE = 2e-3
"""Largest standard deviation of the position of a target beyond 100 m, as a share of its distance,
before it is lost.
"""
_BLAS = ThreadpoolController()
"""Limits BLAS to one thread: the last bits of a matrix product depend on the number of threads."""


def is_target_lost(state: JointState, covariance: Array, target: TargetParameters) -> bool:
    """Test whether the pose of the target with this covariance (12+, 12+) is too uncertain to be
    used at its distance from the chasers of ``state``.
    """
    return is_lost(covariance, target) and is_lost(covariance, _lost_limits(state, target))


def _lost_limits(state: JointState, target: TargetParameters) -> TargetParameters:
    """Return the parameters with the standard deviation of position beyond which the target is
    lost.

    For a far target it is at least `FAR_LOST_SHARE` of the distance from the nearest chaser, as the
    error of a camera's mounting grows with distance.
    """
    at = state.position_m.tolist()
    places = zip(state.positions_m.tolist(), state.alive.tolist(), strict=True)
    limit_m = FAR_LOST_SHARE * min(
        (math.dist(place, at) for place, alive in places if alive), default=0.0
    )
    return (
        target
        if limit_m <= target.lost_position_m
        else dataclasses.replace(target, lost_position_m=limit_m)
    )


def _all_lost(state: FilterState, target: TargetParameters) -> bool:
    """Test whether every hypothesis is too uncertain to be used."""
    best = state.hypotheses[0]
    return all(is_target_lost(best, h.covariance, target) for h in state.hypotheses)


def process_tick(
    before: FilterState | None,
    record: FilterTick,
    chasers: int,
    mounting: CameraMounting,
    p: JointParameters,
) -> tuple[FilterState, tuple[EstimatorEvent, ...]]:
    """Process a tick: return the filter's state after it, and its events.

    ``before``: the state after the previous tick; None at the first one.
    """
    events: list[EstimatorEvent] = []
    old = before
    if old is None:
        old = FilterState(record.time_ns, (_unknown(record.time_ns, chasers, p),))
    _report_restarts(old.hypotheses[0], record, p, events)
    hypotheses = [_propagate(h, record, p) for h in old.hypotheses]
    seen = {i: s for i, s in record.sightings.items() if s.solutions and hypotheses[0].alive[i]}
    results = [update(h, record.odometry, seen, mounting, p) for h in hypotheses]
    updated = tuple(r[0] for r in results)
    now = replace(
        old, time_ns=record.time_ns, hypotheses=updated, seen=(), rejected=(), innovations=()
    )
    if seen and not now.hypotheses[0].target_known:
        now = _start(now, seen, unknown_rates(p.target), mounting, p, "initialised", events)
    elif seen and _all_lost(now, p.target):
        now = _reacquire(now, seen, mounting, p, events)
    elif seen:
        report = max(results, key=lambda r: r[0].log_likelihood)[1]
        now = count_measurements(now, report.accepted, report.rejected, report.innovations)
        now = _check_cameras(now, old.hypotheses[0], report, seen, mounting, p, events)
    if p.floor is not None:
        level = tuple(keep_on_floor(h, p.floor) for h in now.hypotheses)
        now = replace(now, hypotheses=level)
    now = _report_odometry(now, p, events)
    return choose(now, p.target, events), tuple(events)


def _unknown(time_ns: int, chasers: int, p: JointParameters) -> JointState:
    """Return a state in which nothing is known."""
    return empty_state(time_ns, chasers, star=chasers > p.most_dense_chasers)


def _propagate(state: JointState, record: FilterTick, p: JointParameters) -> JointState:
    """Predict a hypothesis to the time of a tick. Start chasers that are unknown, and restart those
    that no measurement has supported for long.

    A state that contradicts all its measurements cannot recover by them, because none passes its
    gate.
    """
    state = with_body(state, p.target)
    latched = frozenset(c.chaser for c in record.chasers if c.latched)
    given = [c.impulse for c in record.chasers]
    state = predict(state, record.time_ns, given, p, latched, record.covered_s)
    newest = state.odometry_ns.copy()
    for i, odometry in record.odometry.items():
        if not state.alive[i] or min(newest[i], state.measured_ns[i]) < _stale_ns(record, p):
            state = start_chaser(state, i, odometry, p)
        newest[i] = record.time_ns
    variances = rate_variances(p.contact_velocity_m_s, p.contact_omega_rad_s)
    for c in record.chasers:
        if c.contact:
            state = with_chaser_noise(state, c.chaser, RATES, variances)
        if c.last_command is not None and state.alive[c.chaser] and not c.latched:
            state = _with_unknown_command(state, c.chaser, c.last_command, record.covered_s, p)
    return replace(state, odometry_ns=newest)


def _with_unknown_command(
    state: JointState, i: int, wrench: Array, period_s: float, p: JointParameters
) -> JointState:
    """Return the state with a chaser's rates widened for an unknown command: as large as
    ``wrench`` (6,), for one period.
    """
    velocity = float(np.linalg.norm(wrench[:3])) * period_s / p.body.mass_kg
    rate = float(np.linalg.norm(wrench[3:])) * period_s / min(p.inertia)
    return with_chaser_noise(state, i, RATES, rate_variances(velocity, rate))


def _stale_ns(record: FilterTick, p: JointParameters) -> int:
    """Return the time (ns) before which a measurement no longer supports a chaser's state."""
    return record.time_ns - round(p.restart_after_s * 1e9)


def _report_restarts(
    state: JointState, record: FilterTick, p: JointParameters, events: list[EstimatorEvent]
) -> None:
    """Report chasers that are restarted although their odometry has arrived."""
    stale = _stale_ns(record, p)
    for i in record.odometry:
        if state.alive[i] and state.measured_ns[i] < stale <= state.odometry_ns[i]:
            text = (
                f"chaser {i}: no measurement supported its estimate for {p.restart_after_s:g} s; "
                "started again from its odometry"
            )
            events.append(EstimatorEvent(record.time_ns, "warning", text))


def _check_cameras(
    now: FilterState, before: JointState, report: UpdateReport, seen: Mapping[int, Sighting],
    mounting: CameraMounting, p: JointParameters, events: list[EstimatorEvent],
) -> FilterState:  # fmt: skip
    """Report cameras that are dropped or used again, and react when most cameras are rejected."""
    best = max(now.hypotheses, key=lambda h: h.log_likelihood)
    limit, k = p.rejections_to_drop, SIGHTING_CHANNEL
    for i in sorted(seen):
        was, count = int(before.rejections[i, k]), int(best.rejections[i, k])
        if count == limit and was == limit - 1:
            events.append(
                EstimatorEvent(now.time_ns, "warning", f"chaser {i} gated out: {limit} in a row")
            )
        elif was >= limit and count == 0:
            events.append(EstimatorEvent(now.time_ns, "info", f"chaser {i} accepted again"))
    if 2 * len(report.rejected) <= len(seen):
        return replace(now, collective=0)
    collective = now.collective + 1
    now = replace(now, collective=collective)
    if collective == p.collective_rejections and len(seen) >= p.collective_cameras:
        return replace(
            now, hypotheses=tuple(with_uncertain_rates(h, p.target) for h in now.hypotheses)
        )
    if collective >= p.target.sustained_rejections:
        rates = rates_of(with_uncertain_rates(now.hypotheses[0], p.target))
        if p.target.motion_model == "torque_free":
            now = replace(now, hypotheses=tuple(start_shape(h, p.target) for h in now.hypotheses))
        return _start(before_restart(now), seen, rates, mounting, p, "re-initialised", events)
    return now


def _start(
    now: FilterState, seen: Mapping[int, Sighting], rates: TargetRates,
    mounting: CameraMounting, p: JointParameters, action: str, events: list[EstimatorEvent],
) -> FilterState:  # fmt: skip
    """Start the target from the sighting with which most others agree, then update by the
    others.
    """
    s = now.hypotheses[0]
    with _BLAS.limit(limits=1, user_api="blas"):
        poses = {
            i: [
                sighted_pose(s, i, x, len(sighting.marker_ids), mounting, p)
                for x in sighting.solutions
            ]
            for i, sighting in seen.items()
        }

    def support(i: int, pose: SightedPose) -> int:
        others = (poses[k] for k in poses if k != i)
        return sum(any(pose.agrees(x, p.gate_sighting) for x in other) for other in others)

    def rank(i: int) -> tuple[int, bool, int, float, int]:
        most = max(support(i, pose) for pose in poses[i])
        return (
            most,
            len(poses[i]) == 1,
            len(seen[i].marker_ids),
            -float(np.trace(poses[i][0].covariance)),
            -i,
        )

    first = max(sorted(seen), key=rank)
    supports = [support(first, pose) for pose in poses[first]]
    kept = [pose for pose, n in zip(poses[first], supports, strict=True) if n == max(supports)]
    scale = p.target.single_marker_scale**2 if len(seen[first].marker_ids) == 1 else 1.0

    others = {i: sighting for i, sighting in seen.items() if i != first}
    results = []
    for pose in kept:
        results.append(update(start_target(s, pose, rates, scale), {}, others, mounting, p))

    report = max(results, key=lambda r: r[0].log_likelihood)[1]
    ambiguous = ", ambiguous: two hypotheses" if len(kept) > 1 else ""
    events.append(EstimatorEvent(now.time_ns, "info", f"{action} by chaser {first}{ambiguous}"))

    started = tuple(r[0] for r in results)
    now = replace(now, hypotheses=started, ambiguous_since_ns=now.time_ns, collective=0)
    accepted = (first, *report.accepted)
    return count_measurements(now, accepted, report.rejected, report.innovations)


def _reacquire(
    now: FilterState, seen: Mapping[int, Sighting], mounting: CameraMounting, p: JointParameters,
    events: list[EstimatorEvent],
) -> FilterState:  # fmt: skip
    """Reinitialize a target in status "lost" and keep its rates, unless it would be lost again at
    once.
    """
    new_events: list[EstimatorEvent] = []
    fresh = _start(now, seen, rates_of(now.hypotheses[0]), mounting, p, "reacquired", new_events)
    if _all_lost(fresh, p.target):
        return now
    events += new_events
    return replace(fresh, reinitialisations=now.reinitialisations + 1)


def _report_odometry(
    now: FilterState, p: JointParameters, events: list[EstimatorEvent]
) -> FilterState:
    """Report odometry channels that are dropped, used again, or noisier than stated."""
    s = now.hypotheses[0]
    dropped, overconfident = set(now.dropped), set(now.overconfident)
    for i, (alive, rejections, nis) in enumerate(
        zip(s.alive.tolist(), s.rejections.tolist(), s.nis.tolist(), strict=True)
    ):
        if not alive:
            continue
        for name, count, mean in zip(CHANNELS[1:], rejections[1:], nis, strict=True):
            key = (i, name)
            if count >= p.rejections_to_drop and key not in dropped:
                dropped.add(key)
                text = f"chaser {i}: odometry {name} contradicts the estimate; not used"
                events.append(EstimatorEvent(now.time_ns, "warning", text))
            elif count == 0 and key in dropped:
                dropped.discard(key)
                events.append(
                    EstimatorEvent(now.time_ns, "info", f"chaser {i}: odometry {name} used again")
                )
            if (
                mean > 3.0 * p.overconfident_ratio
                and key not in overconfident
                and key not in dropped
            ):
                overconfident.add(key)
                text = (
                    f"chaser {i}: odometry {name} is overconfident: its noise is larger than "
                    f"stated (NIS {mean:.1f} of 3)"
                )
                events.append(EstimatorEvent(now.time_ns, "warning", text))
            elif mean < 1.5 * 3.0:
                overconfident.discard(key)
    return replace(now, dropped=frozenset(dropped), overconfident=frozenset(overconfident))
