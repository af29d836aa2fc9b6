# SPDX-License-Identifier: Apache-2.0
"""Default estimator: one error-state Kalman filter of the target, the chasers, their sensors and their disturbances.

Mathematics: docs/estimation.md. Every tick is recorded with its inputs; a sighting that arrives late is inserted at its
exposure, and the later ticks are processed again, so the state does not depend on the order of arrival.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from chaserdock_models import scalar_rotations as so3
from chaserdock_models.arrays import Array, Matrix3
from chaserdock_protocol.messages import Odometry, Sighting
from threadpoolctl import ThreadpoolController

from chaserdock_controller.estimation.parameters import MekfParameters
from chaserdock_controller.estimation.types import (
    CameraError,
    EstimatorEvent,
    RelativePose,
    Shock,
    TargetState,
    no_estimate,
)

from .measurements import CameraMounting, mounting_of
from .parameters import JointParameters
from .prediction import predict, predict_target
from .state import (
    ATTITUDE,
    CHANNELS,
    FOCAL,
    POSITION,
    SIGHTING_CHANNEL,
    TARGET,
    TURN,
    JointState,
    block,
    empty_state,
)
from .update import (
    POSE,
    SightedPose,
    UpdateReport,
    agree,
    rate_covariance,
    sighted_pose,
    sigma_of,
    start_chaser,
    start_target,
    update,
    widen_target,
)

_BLAS = ThreadpoolController()
"""Products of matrices are computed by one thread, as their last bits depend on the number of threads."""


@dataclass(frozen=True)
class JointInputs:
    """Inputs of a tick: odometry and sightings (which may belong to earlier ticks) by chaser.

    impulses (N, 6): N s and N m s, body axes, that the chasers' actuators gave in the last ``covered_s``. latched: chasers
    whose latch holds the target. contacts: chasers with a contact since the tick before.
    """

    time_ns: int
    odometry: Mapping[int, Odometry]
    sightings: tuple[Sighting, ...]
    impulses: Array
    covered_s: float
    latched: frozenset[int] = frozenset()
    contacts: frozenset[int] = frozenset()


@dataclass
class TickRecord:
    """A tick's inputs, and the hypotheses after it. ``target`` applies from the tick before; ``shocks`` act after it."""

    time_ns: int
    odometry: dict[int, Odometry]
    sightings: dict[int, Sighting]
    impulses: Array
    covered_s: float
    latched: frozenset[int]
    contacts: frozenset[int]
    target: MekfParameters
    shocks: list[Shock] = field(default_factory=list)
    state: Hypotheses | None = None
    events: tuple[EstimatorEvent, ...] = ()


@dataclass(frozen=True, eq=False)
class Hypotheses:
    """Hypotheses after a tick, the likeliest first: two while an ambiguous start (at ``ambiguous_since_ns``) is unresolved.

    seen, rejected: chasers accepted and gated out at the newest exposure. accepted, gated, reinitialisations: counts.
    collective: ticks in a row in which most cameras were rejected.
    """

    hypotheses: tuple[JointState, ...]
    ambiguous_since_ns: int = 0
    last_accepted_ns: int = 0
    seen: tuple[int, ...] = ()
    rejected: tuple[int, ...] = ()
    accepted: int = 0
    gated: int = 0
    reinitialisations: int = 0
    collective: int = 0
    overconfident: frozenset[tuple[int, str]] = frozenset()
    dropped: frozenset[tuple[int, str]] = frozenset()


class JointEstimator:
    """Estimate the target and the chasers from odometry, sightings and commands.

    Counters: ``accepted`` and ``gated`` sightings, ``reinitialisations``; ``late_dropped`` (older than the buffer or without
    a tick), ``duplicates`` (same chaser and time as an earlier one).
    """

    def __init__(self, parameters: JointParameters, chasers: int) -> None:
        self.parameters = parameters
        self.target = parameters.target
        self.chasers = chasers
        self.late_dropped = 0
        self.duplicates = 0
        self._mounting = mounting_of(parameters.camera)
        self._records: list[TickRecord] = []
        self._base: Hypotheses | None = None  # the state just before the records
        self._pending: list[EstimatorEvent] = []
        self._drained: set[EstimatorEvent] = set()
        self._was_lost = False

    @property
    def accepted(self) -> int:
        """Sightings accepted so far."""
        return 0 if self._newest is None else self._newest.accepted

    @property
    def gated(self) -> int:
        """Sightings gated out so far."""
        return 0 if self._newest is None else self._newest.gated

    @property
    def reinitialisations(self) -> int:
        """Number of re-initializations of the target's pose."""
        return 0 if self._newest is None else self._newest.reinitialisations

    @property
    def _newest(self) -> Hypotheses | None:
        return self._records[-1].state if self._records else self._base

    @property
    def state(self) -> JointState | None:
        """Return the likeliest state after the newest tick."""
        return None if self._newest is None else self._newest.hypotheses[0]

    def update(self, inputs: JointInputs) -> TargetState:
        """Process a tick and return the target's estimate at its time. Ticks must come in order."""
        record = TickRecord(
            inputs.time_ns,
            dict(inputs.odometry),
            {},
            inputs.impulses,
            inputs.covered_s,
            inputs.latched,
            inputs.contacts,
            self.target,
        )
        self._records.append(record)
        first = len(self._records) - 1
        for sighting in sorted(inputs.sightings, key=lambda s: (s.sim_time_ns, s.chaser)):
            first = min(first, self._insert(sighting))
        with _BLAS.limit(limits=1, user_api="blas"):
            self._replay(first)
        self._trim()
        estimate = self.estimate_at(inputs.time_ns)
        lost = estimate.status == "lost"
        if lost and not self._was_lost:
            self._pending.append(EstimatorEvent(inputs.time_ns, "info", "lost"))
        self._was_lost = lost
        return estimate

    def estimate_at(self, time_ns: int) -> TargetState:
        """Return the target's estimate for ``time_ns`` from the ticks up to then; changes no state.

        Raises ValueError for a time before the oldest state still held.
        """
        i = bisect_right(self._records, time_ns, key=lambda r: r.time_ns)
        state = self._records[i - 1].state if i > 0 else self._base
        if state is None or not state.hypotheses[0].target_known:
            return no_estimate(time_ns)
        if time_ns < state.hypotheses[0].time_ns:
            raise ValueError(f"no state for {time_ns} ns; the oldest is {state.hypotheses[0].time_ns} ns")
        p = self._with(self.target)
        best, covariance = predict_target(state.hypotheses[0], time_ns, p)
        for other in state.hypotheses[1:]:
            covariance = _with_spread(best, covariance, predict_target(other, time_ns, p))
        if is_lost(covariance, p):
            status = "lost"
        elif time_ns - state.last_accepted_ns <= p.target.tracking_s * 1e9:
            status = "tracking"
        else:
            status = "predicting"
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

    def relative_poses(self) -> tuple[RelativePose, ...]:
        """Return the poses of the chasers relative to the target after the newest tick, if the target is known."""
        s = self.state
        if s is None or not s.target_known:
            return ()
        return tuple(relative_pose(s, i) for i in np.flatnonzero(s.alive).tolist())

    def cameras(self) -> tuple[CameraError, ...]:
        """Return the estimated calibration errors of the cameras after the newest tick."""
        s, errors = self.state, []
        if s is None or not s.target_known or self.parameters.camera_turn_rad == 0.0:
            return ()
        for i in np.flatnonzero(s.alive).tolist():
            part = slice(block(i).start + TURN.start, block(i).start + FOCAL.stop)
            e = s.of(i, slice(TURN.start, FOCAL.stop))
            errors.append(CameraError(i, e[:3], e[3:6], float(e[6]), s.covariance[part, part]))
        return tuple(errors)

    def disturb(self, shock: Shock) -> None:
        """Apply a sudden change of the target's rates after the newest tick."""
        if self._records:
            newest = self._records[-1]
            newest.shocks.append(shock)
            if newest.state is not None:
                newest.state = apply_shocks(newest.state, [shock])

    def change_body(self, inertia: Matrix3, centre_trf_m: tuple[float, float, float]) -> None:
        """Model the target from the newest tick on as a torque-free rigid body with other mass properties.

        ``inertia``: TRF, rows, about the centre of mass, up to a factor. ``centre_trf_m``: centre of mass in TRF.
        Raises ValueError for an inertia that no rigid body has.
        """
        self.target = replace(
            self.target, motion_model="torque_free", inertia_ratios=inertia, centre_of_mass_trf_m=centre_trf_m
        )

    def drain_events(self) -> list[EstimatorEvent]:
        """Return the events since the last call, in order of time."""
        fresh = [e for r in self._records for e in r.events if e not in self._drained]
        self._drained.update(fresh)
        events = sorted([*self._pending, *fresh], key=lambda e: e[0])
        self._pending = []
        return events

    def _with(self, target: MekfParameters) -> JointParameters:
        """Return the parameters with another model of the target."""
        p = self.parameters
        return p if target is p.target else replace(p, target=target)

    def _insert(self, sighting: Sighting) -> int:
        """Add a sighting to the record of its exposure; return the record's index, or that of the newest record."""
        newest = len(self._records) - 1
        i = bisect_left(self._records, sighting.sim_time_ns, key=lambda r: r.time_ns)
        if i > newest or self._records[i].time_ns != sighting.sim_time_ns:
            self.late_dropped += 1
            return newest
        if sighting.chaser in self._records[i].sightings:
            self.duplicates += 1
            return newest
        self._records[i].sightings[sighting.chaser] = sighting
        return i

    def _replay(self, first: int) -> None:
        state = self._records[first - 1].state if first > 0 else self._base
        for record in self._records[first:]:
            p = self._with(record.target)
            state, record.events = process_tick(state, record, self.chasers, self._mounting, p)
            record.state = state = apply_shocks(state, record.shocks)

    def _trim(self) -> None:
        horizon = self._records[-1].time_ns - round(self.parameters.target.buffer_s * 1e9)
        while self._records[0].time_ns < horizon:
            old = self._records.pop(0)
            self._base = old.state
            self._pending += [e for e in old.events if e not in self._drained]
            self._drained.difference_update(old.events)


def process_tick(
    before: Hypotheses | None, record: TickRecord, chasers: int, mounting: CameraMounting, p: JointParameters
) -> tuple[Hypotheses, tuple[EstimatorEvent, ...]]:
    """Return the state after a tick, and the events. ``before``: after the previous tick, None at the first."""
    now_ns = record.time_ns
    events: list[EstimatorEvent] = []
    old = before if before is not None else Hypotheses((empty_state(now_ns, chasers),))
    hypotheses = [_propagate(h, record, p) for h in old.hypotheses]
    seen = {i: s for i, s in record.sightings.items() if s.solutions and hypotheses[0].alive[i]}
    results = [update(h, record.odometry, seen, mounting, p) for h in hypotheses]
    now = replace(
        old,
        hypotheses=tuple(r[0] for r in results),
        seen=(),
        rejected=(),
    )
    report = results[0][1]
    if seen and not now.hypotheses[0].target_known:
        rates = (
            np.zeros(3),
            np.zeros(3),
            rate_covariance(p.target.initial_velocity_m_s, p.target.initial_omega_rad_s),
        )
        now = _start(now, seen, rates, mounting, p, now_ns, "initialised", events)
    elif seen and _all_lost(now, p):
        now = _reacquire(now, seen, mounting, p, now_ns, events)
    elif seen:
        best = max(range(len(results)), key=lambda k: (results[k][0].log_likelihood, -k))
        report = results[best][1]
        now = _counted(now, report, now_ns)
        now = _check_cameras(now, old.hypotheses[0], report, seen, mounting, p, now_ns, events)
    now = _report_odometry(now, p, now_ns, events)
    return _choose(now, p, now_ns, events), tuple(events)


def _propagate(state: JointState, record: TickRecord, p: JointParameters) -> JointState:
    """Predict a hypothesis to a tick; start chasers whose state is not known, or was not measured for long."""
    state = predict(state, record.time_ns, record.impulses, p, record.latched, record.covered_s)
    stale = record.time_ns - round(p.restart_after_s * 1e9)
    newest = state.odometry_ns.copy()
    for i, odometry in record.odometry.items():
        if not state.alive[i] or newest[i] < stale:
            state = start_chaser(state, i, odometry, p)
        newest[i] = record.time_ns
    if record.contacts:
        covariance = state.covariance.copy()
        for i in record.contacts:
            first = block(i).start
            k = first + np.array([3, 4, 5, 9, 10, 11])
            covariance[k, k] += np.repeat([p.contact_velocity_m_s**2, p.contact_omega_rad_s**2], 3)
        state = replace(state, covariance=covariance)
    return replace(state, odometry_ns=newest)


def _counted(now: Hypotheses, report: UpdateReport, time_ns: int) -> Hypotheses:
    return replace(
        now,
        seen=report.accepted,
        rejected=report.rejected,
        last_accepted_ns=time_ns if report.accepted else now.last_accepted_ns,
        accepted=now.accepted + len(report.accepted),
        gated=now.gated + len(report.rejected),
    )


def _check_cameras(
    now: Hypotheses, before: JointState, report: UpdateReport, seen: Mapping[int, Sighting],
    mounting: CameraMounting, p: JointParameters, time_ns: int, events: list[EstimatorEvent],
) -> Hypotheses:  # fmt: skip
    """Report cameras that were dropped or are used again; react to the rejection of most cameras."""
    best = max(now.hypotheses, key=lambda h: h.log_likelihood)
    limit, k = p.rejections_to_drop, SIGHTING_CHANNEL
    for i in sorted(seen):
        was, count = int(before.rejections[i, k]), int(best.rejections[i, k])
        if count == limit and was == limit - 1:
            events.append(EstimatorEvent(time_ns, "warning", f"chaser {i} gated out: {limit} in a row"))
        elif was >= limit and count == 0:
            events.append(EstimatorEvent(time_ns, "info", f"chaser {i} accepted again"))
    if 2 * len(report.rejected) <= len(seen):
        return replace(now, collective=0)
    collective = now.collective + 1
    now = replace(now, collective=collective)
    if collective == p.collective_rejections:
        return replace(now, hypotheses=tuple(widen_target(h, p) for h in now.hypotheses))
    if collective >= p.target.sustained_rejections:
        t, s = p.target, now.hypotheses[0]
        wider = rate_covariance(t.reinitialised_velocity_m_s, t.reinitialised_omega_rad_s)
        rates = (s.velocity_m_s, s.omega_rad_s, _rate_block(s) + wider)
        now = replace(
            now,
            accepted=now.accepted - len(now.seen),
            gated=now.gated - len(now.rejected),
            reinitialisations=now.reinitialisations + 1,
        )
        return _start(now, seen, rates, mounting, p, time_ns, "re-initialised", events)
    return now


def _rate_block(s: JointState) -> Array:
    r = np.array([3, 4, 5, 9, 10, 11])
    return s.covariance[np.ix_(r, r)]


def _start(
    now: Hypotheses, seen: Mapping[int, Sighting], rates: tuple[Array, Array, Array],
    mounting: CameraMounting, p: JointParameters, time_ns: int, action: str, events: list[EstimatorEvent],
) -> Hypotheses:  # fmt: skip
    """Start the target at the sighting with which most others agree, and apply the others as updates."""
    s = now.hypotheses[0]
    poses = {
        i: [sighted_pose(s, i, x, mounting, p) for x in sighting.solutions] for i, sighting in seen.items()
    }

    def support(i: int, pose: SightedPose) -> int:
        others = (poses[k] for k in poses if k != i)
        return sum(any(agree(pose, x, p.gate_sighting) for x in other) for other in others)

    def rank(i: int) -> tuple[int, bool, int, float, int]:
        most = max(support(i, pose) for pose in poses[i])
        return most, len(poses[i]) == 1, len(seen[i].marker_ids), -float(np.trace(poses[i][0].covariance)), -i

    first = max(sorted(seen), key=rank)
    supports = [support(first, pose) for pose in poses[first]]
    kept = [pose for pose, n in zip(poses[first], supports, strict=True) if n == max(supports)]
    scale = p.target.single_marker_scale**2 if len(seen[first].marker_ids) <= 1 else 1.0
    others = {i: sighting for i, sighting in seen.items() if i != first}
    results = []
    for pose in kept:
        started = replace(start_target(s, pose, rates, scale), log_likelihood=0.0)
        results.append(update(started, {}, others, mounting, p))
    best = max(results, key=lambda r: r[0].log_likelihood)
    ambiguous = ", ambiguous: two hypotheses" if len(kept) > 1 else ""
    events.append(EstimatorEvent(time_ns, "info", f"{action} by chaser {first}{ambiguous}"))
    return replace(
        now,
        hypotheses=tuple(r[0] for r in results),
        ambiguous_since_ns=time_ns,
        last_accepted_ns=time_ns,
        seen=tuple(sorted((first, *best[1].accepted))),
        rejected=best[1].rejected,
        accepted=now.accepted + 1 + len(best[1].accepted),
        gated=now.gated + len(best[1].rejected),
        collective=0,
    )


def _all_lost(now: Hypotheses, p: JointParameters) -> bool:
    return all(is_lost(h.covariance[:TARGET, :TARGET], p) for h in now.hypotheses)


def _reacquire(
    now: Hypotheses, seen: Mapping[int, Sighting], mounting, p: JointParameters, time_ns: int,
    events: list[EstimatorEvent],
) -> Hypotheses:  # fmt: skip
    """Start the target anew from the status "lost", with its rates; unless it would be lost again."""
    s, new_events = now.hypotheses[0], []
    rates = (s.velocity_m_s, s.omega_rad_s, _rate_block(s))
    fresh = _start(now, seen, rates, mounting, p, time_ns, "reacquired", new_events)
    if _all_lost(fresh, p):
        return now
    events += new_events
    return replace(fresh, reinitialisations=now.reinitialisations + 1)


def _report_odometry(
    now: Hypotheses, p: JointParameters, time_ns: int, events: list[EstimatorEvent]
) -> Hypotheses:
    """Report channels of odometry that are dropped, used again, or noisier than they state."""
    s = now.hypotheses[0]
    dropped, overconfident = set(now.dropped), set(now.overconfident)
    for i in np.flatnonzero(s.alive).tolist():
        for k, name in enumerate(CHANNELS[1:]):
            key, count, mean = (i, name), int(s.rejections[i, k + 1]), float(s.nis[i, k])
            if count >= p.rejections_to_drop and key not in dropped:
                dropped.add(key)
                text = f"chaser {i}: odometry {name} contradicts the estimate; not used"
                events.append(EstimatorEvent(time_ns, "warning", text))
            elif count == 0 and key in dropped:
                dropped.discard(key)
                events.append(EstimatorEvent(time_ns, "info", f"chaser {i}: odometry {name} used again"))
            if mean > 3.0 * p.overconfident_ratio and key not in overconfident and key not in dropped:
                overconfident.add(key)
                text = f"chaser {i}: odometry {name} is overconfident: its noise is larger than stated (NIS {mean:.1f} of 3)"
                events.append(EstimatorEvent(time_ns, "warning", text))
            elif mean < 1.5 * 3.0:
                overconfident.discard(key)
    return replace(now, dropped=frozenset(dropped), overconfident=frozenset(overconfident))


def _choose(now: Hypotheses, p: JointParameters, time_ns: int, events: list[EstimatorEvent]) -> Hypotheses:
    """Sort the hypotheses by likelihood and drop those ruled out by log odds or timeout."""
    if len(now.hypotheses) < 2:
        return now
    ranked = sorted(now.hypotheses, key=lambda h: -h.log_likelihood)
    top, t = ranked[0], p.target
    kept = [h for h in ranked if top.log_likelihood - h.log_likelihood < t.ambiguity_log_odds]
    if len(kept) == 1:
        events.append(EstimatorEvent(time_ns, "info", "ambiguity resolved"))
    elif time_ns - now.ambiguous_since_ns > t.ambiguity_timeout_s * 1e9:
        kept = [top]
        events.append(EstimatorEvent(time_ns, "info", "ambiguity timed out: kept the likelier attitude"))
    return replace(now, hypotheses=tuple(kept))


def apply_shocks(state: Hypotheses, shocks: list[Shock]) -> Hypotheses:
    """Add the known part of ``shocks`` to the target's rates in every hypothesis, and the unknown part to the covariance."""
    i = np.array([3, 4, 5, 9, 10, 11])
    hypotheses = list(state.hypotheses)
    for shock in shocks:
        added = np.repeat([shock.sigma_velocity_m_s**2, shock.sigma_omega_rad_s**2], 3)
        for k, h in enumerate(hypotheses):
            if not h.target_known:
                continue
            covariance = h.covariance.copy()
            covariance[i, i] += added
            hypotheses[k] = replace(
                h,
                velocity_m_s=h.velocity_m_s + shock.velocity_m_s,
                omega_rad_s=h.omega_rad_s + shock.omega_rad_s,
                covariance=covariance,
            )
    return replace(state, hypotheses=tuple(hypotheses))


def relative_pose(s: JointState, i: int) -> RelativePose:
    """Return the pose of a chaser in TRF with its covariance (6, 6): position in TRF, rotation in CRF."""
    rt, c = so3.to_matrix(s.q_wxyz), so3.to_matrix(s.attitudes_wxyz[i])
    place = rt.T @ (s.positions_m[i] - s.position_m)
    own = block(i)
    rows = np.concatenate([POSE, own.start + POSE])
    j = np.zeros((6, 12))
    j[0:3, 0:3], j[0:3, 3:6] = -rt.T, so3.skew(place)
    j[0:3, 6:9] = rt.T
    j[3:6, 3:6], j[3:6, 9:12] = -(c.T @ rt), np.eye(3)
    covariance = j @ s.covariance[np.ix_(rows, rows)] @ j.T
    return RelativePose(i, place, so3.inverse_multiply(s.q_wxyz, s.attitudes_wxyz[i]), covariance)


def is_lost(covariance: Array, p: JointParameters) -> bool:
    """Test whether the target, with this covariance (12, 12), is too uncertain to use."""
    t = p.target
    position, attitude = covariance[POSITION, POSITION], covariance[ATTITUDE, ATTITUDE]
    if np.trace(position) <= t.lost_position_m**2 and np.trace(attitude) <= t.lost_attitude_rad**2:
        return False  # no eigenvalue exceeds the trace
    return sigma_of(position) > t.lost_position_m or sigma_of(attitude) > t.lost_attitude_rad


def _with_spread(best: JointState, covariance: Array, other: tuple[JointState, Array]) -> Array:
    """Return the covariance (12, 12) of two hypotheses about the first one's mean."""
    h, own = other
    odds = np.exp(min(0.0, h.log_likelihood - best.log_likelihood))
    weight = odds / (1.0 + odds)
    d = np.concatenate(
        [
            h.position_m - best.position_m,
            h.velocity_m_s - best.velocity_m_s,
            so3.log(so3.inverse_multiply(best.q_wxyz, h.q_wxyz)),
            h.omega_rad_s - best.omega_rad_s,
        ]
    )
    return (1.0 - weight) * covariance + weight * (own + np.outer(d, d))
