# SPDX-License-Identifier: Apache-2.0
"""Default estimator: one error-state Kalman filter of the target, the chasers, their sensors and
their disturbances.

Mathematics: docs/estimation.md. Every tick is recorded with its inputs; a sighting that arrives
late is inserted at its exposure, and the later ticks are processed again, so the state does not
depend on the order of arrival.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from chaserdock_models import scalar_rotations as so3
from chaserdock_models.arrays import Array, IntArray
from chaserdock_protocol.messages import Odometry, Sighting
from msgspec.structs import replace
from threadpoolctl import ThreadpoolController

from chaserdock_controller.estimation.body_shape import SHAPE, BodyShape
from chaserdock_controller.estimation.parameters import MekfParameters
from chaserdock_controller.estimation.replay import ReplayingFilter, ReplayRecord
from chaserdock_controller.estimation.target_hypotheses import (
    POSE,
    HypothesisSet,
    TargetRates,
    all_lost,
    before_restart,
    choose,
    count_measurements,
    is_lost,
    mixture_covariance,
    poses_agree,
    rate_variances,
    rates_of,
    target_state,
    unknown_rates,
    widened,
    with_uncertain_rates,
)
from chaserdock_controller.estimation.types import (
    CameraError,
    EstimatorEvent,
    RelativePose,
    TargetState,
    no_estimate,
)

from .measurements import CameraMounting, mounting_of
from .parameters import JointParameters
from .prediction import predict, predict_target
from .state import (
    CHANNELS,
    CHASER,
    FOCAL,
    SIGHTING_CHANNEL,
    TARGET,
    TURN,
    VELOCITY,
    JointState,
    block,
    empty_state,
    start_shape,
    with_body,
)
from .update import SightedPose, UpdateReport, sighted_pose, start_chaser, start_target, update

_IDENTITY_3 = np.eye(3)
FAR_LOST_SHARE = 2e-3
"""Largest standard deviation of the position of a target beyond 100 m, as a share of its distance.
"""
_BLAS = ThreadpoolController()
"""Products of matrices are computed by one thread, as their last bits depend on the number of
threads.
"""


@dataclass(frozen=True)
class JointInputs:
    """Inputs of a tick: measured odometry by chaser, and sightings, which may belong to earlier
    ticks.

    impulses (N, 6): N s and N m s, body axes, that the chasers' actuators gave in the last
    ``covered_s``. latched: chasers whose latch holds the target. contacts: chasers with a contact
    since the tick before. last_commands: last commands (6,), N and N m, of chasers without odometry
    in this tick, which fly by plans that the controller does not know. outdated: newest odometry of
    chasers that have none of this tick, with the times of the ticks at which it was measured.
    """

    time_ns: int
    odometry: Mapping[int, Odometry]
    sightings: tuple[Sighting, ...]
    impulses: Array
    covered_s: float
    latched: frozenset[int] = frozenset()
    contacts: frozenset[int] = frozenset()
    last_commands: Mapping[int, Array] = field(default_factory=dict)
    outdated: Mapping[int, Odometry] = field(default_factory=dict)


class JointFilterState(HypothesisSet[JointState], frozen=True, eq=False):
    """State of the filter after the tick at ``time_ns``.

    collective: ticks in a row in which most cameras were rejected. overconfident, dropped: reported
    channels of odometry, by chaser and name.
    """

    collective: int = 0
    overconfident: frozenset[tuple[int, str]] = frozenset()
    dropped: frozenset[tuple[int, str]] = frozenset()


@dataclass(kw_only=True)
class JointTickRecord(ReplayRecord[JointFilterState]):
    """A tick's inputs without sightings and outdated odometry, and the sightings that were exposed
    at it, by chaser.
    """

    inputs: JointInputs
    sightings: dict[int, Sighting] = field(default_factory=dict)


class JointEstimator(ReplayingFilter[JointTickRecord, JointFilterState]):
    """Estimate the target and the chasers from odometry, sightings and commands.

    Sightings that belong to no tick count as ``late_dropped``, too.
    """

    def __init__(self, parameters: JointParameters, chasers: int) -> None:
        super().__init__(parameters.target)
        self.parameters = parameters
        self.chasers = chasers
        self._mounting = mounting_of(parameters.camera)

    @property
    def state(self) -> JointState | None:
        """Return the likeliest state after the newest tick."""
        return self._buffer.newest.hypotheses[0] if self._buffer.newest else None

    @property
    def shape(self) -> tuple[BodyShape, Array] | None:
        """Return the shape of the body that the target is from now on, and its covariance (8, 8);
        None if it is not estimated.
        """
        state = None if self.state is None else with_body(self.state, self.target)
        if state is None or state.shape is None:
            return None
        return state.shape, state.covariance[-SHAPE:, -SHAPE:]

    def update(self, inputs: JointInputs) -> TargetState:
        """Process a tick and return the target's estimate at its time. Ticks must come in order."""
        records, own = self._buffer.records, dataclasses.replace(inputs, sightings=(), outdated={})
        records.append(JointTickRecord(time_ns=inputs.time_ns, parameters=self.target, inputs=own))
        first = len(records) - 1
        for sighting in sorted(inputs.sightings, key=lambda s: (s.sim_time_ns, s.chaser)):
            first = min(first, self._insert(sighting))
        for odometry in inputs.outdated.values():
            first = min(first, self._insert_odometry(odometry))
        self._buffer.replay(first, self._process)
        self._buffer.trim(self.parameters.target.buffer_s)
        return self._reported(self.estimate_at(inputs.time_ns))

    def estimate_at(self, time_ns: int) -> TargetState:
        """Return the target's estimate for ``time_ns`` from the ticks up to then; changes no state.

        Raises ValueError for a time before the oldest state still held.
        """
        state = self._buffer.state_at(time_ns)
        if state is None or not state.hypotheses[0].target_known:
            return no_estimate(time_ns)
        if time_ns < state.time_ns:
            raise ValueError(
                f"no state for {time_ns} ns in the buffer; the oldest is {state.time_ns} ns"
            )
        p = self._with(self.target)
        predicted = [predict_target(with_body(h, p.target), time_ns, p) for h in state.hypotheses]
        hypotheses, covariances = zip(*predicted, strict=True)
        covariance = mixture_covariance(hypotheses, covariances)
        lost = is_lost(covariance, lost_limits(state.hypotheses[0], p.target))
        return target_state(state, time_ns, hypotheses[0], covariance, lost, p.target)

    def relative_poses(self) -> tuple[RelativePose, ...]:
        """Return the poses of the chasers relative to the target after the newest tick, if the
        target is known.
        """
        s = self.state
        if s is None or not s.target_known:
            return ()
        return tuple(relative_poses(s, np.flatnonzero(s.alive).tolist()))

    def motion_covariance(self, chaser: int) -> Array | None:
        """Return the covariance (6, 6) of a chaser's position and velocity relative to the target,
        WRF, if both are known.
        """
        s = self.state
        if s is None or not s.target_known or not s.alive[chaser]:
            return None
        size = VELOCITY.stop
        own, target = slice(block(chaser).start, block(chaser).start + size), slice(0, size)
        p, cross = s.covariance, s.covariance[own, target]
        return p[own, own] + p[target, target] - cross - cross.T

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

    def _with(self, target: MekfParameters) -> JointParameters:
        """Return the parameters with another model of the target."""
        p = self.parameters
        return p if target is p.target else dataclasses.replace(p, target=target)

    def _insert(self, sighting: Sighting) -> int:
        """Add a sighting to the record of its exposure; return the record's index, or that of the
        newest record.
        """
        newest = len(self._buffer.records) - 1
        i, record = self._buffer.find(sighting.sim_time_ns)
        if record is None:
            self.late_dropped += 1
            return newest
        if sighting.chaser in record.sightings:
            self.duplicates += 1
            return newest
        record.sightings[sighting.chaser] = sighting
        return i

    def _insert_odometry(self, odometry: Odometry) -> int:
        """Add odometry to the record of its tick, if that is known without it; return the record's
        index, or that of the newest.
        """
        i, record = self._buffer.find(odometry.sim_time_ns)
        if record is None or odometry.chaser in record.inputs.odometry:
            return len(self._buffer.records) - 1
        known = dict(sorted({**record.inputs.odometry, odometry.chaser: odometry}.items()))
        record.inputs = dataclasses.replace(record.inputs, odometry=known)
        return i

    def _process(
        self, before: JointFilterState | None, record: JointTickRecord
    ) -> tuple[JointFilterState, tuple[EstimatorEvent, ...]]:
        return process_tick(
            before, record, self.chasers, self._mounting, self._with(record.parameters)
        )


def lost_limits(state: JointState, target: MekfParameters) -> MekfParameters:
    """Return the parameters with the standard deviation of the target's position beyond which it is
    lost: of a far target at least `FAR_LOST_SHARE` of its distance from the nearest chaser, as the
    error of a camera's mounting grows with the distance."""
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


def process_tick(
    before: JointFilterState | None,
    record: JointTickRecord,
    chasers: int,
    mounting: CameraMounting,
    p: JointParameters,
) -> tuple[JointFilterState, tuple[EstimatorEvent, ...]]:
    """Return the state after a tick, and the events. ``before``: after the previous tick, None at
    the first.
    """
    events: list[EstimatorEvent] = []
    old = before
    if old is None:
        old = JointFilterState(record.time_ns, (empty_state(record.time_ns, chasers),))
    _report_restarts(old.hypotheses[0], record, p, events)
    hypotheses = [_propagate(h, record, p) for h in old.hypotheses]
    seen = {i: s for i, s in record.sightings.items() if s.solutions and hypotheses[0].alive[i]}
    results = [update(h, record.inputs.odometry, seen, mounting, p) for h in hypotheses]
    updated = tuple(r[0] for r in results)
    now = replace(old, time_ns=record.time_ns, hypotheses=updated, seen=(), rejected=())
    if seen and not now.hypotheses[0].target_known:
        now = _start(now, seen, unknown_rates(p.target), mounting, p, "initialised", events)
    elif seen and all_lost(now, lost_limits(now.hypotheses[0], p.target)):
        now = _reacquire(now, seen, mounting, p, events)
    elif seen:
        report = max(results, key=lambda r: r[0].log_likelihood)[1]
        now = count_measurements(now, report.accepted, report.rejected)
        now = _check_cameras(now, old.hypotheses[0], report, seen, mounting, p, events)
    now = _report_odometry(now, p, events)
    return choose(now, p.target, events), tuple(events)


def _propagate(state: JointState, record: JointTickRecord, p: JointParameters) -> JointState:
    """Predict a hypothesis to a tick; start chasers whose state is not known, or was not measured
    for long.

    A state that contradicts all of its measurements for long cannot recover by them, as none passes
    its gate.
    """
    inputs = record.inputs
    state = with_body(state, p.target)
    state = predict(state, record.time_ns, inputs.impulses, p, inputs.latched, inputs.covered_s)
    newest = state.odometry_ns.copy()
    for i, odometry in inputs.odometry.items():
        if not state.alive[i] or min(newest[i], state.measured_ns[i]) < _stale_ns(record, p):
            state = start_chaser(state, i, odometry, p)
        newest[i] = record.time_ns
    variances = rate_variances(p.contact_velocity_m_s, p.contact_omega_rad_s)
    for i in inputs.contacts:
        state = replace(state, covariance=widened(state.covariance, variances, block(i).start))
    for i, wrench in inputs.last_commands.items():
        if state.alive[i] and i not in inputs.latched:
            state = replace(
                state,
                covariance=_with_unknown_command(state.covariance, i, wrench, inputs.covered_s, p),
            )
    return replace(state, odometry_ns=newest)


def _with_unknown_command(
    covariance: Array, i: int, wrench: Array, period_s: float, p: JointParameters
) -> Array:
    """Return the covariance with the rates of a chaser uncertain by a command as large as
    ``wrench`` (6,) for a period.
    """
    velocity = float(np.linalg.norm(wrench[:3])) * period_s / p.body.mass_kg
    rate = float(np.linalg.norm(wrench[3:])) * period_s / min(p.inertia)
    return widened(covariance, rate_variances(velocity, rate), block(i).start)


def _stale_ns(record: JointTickRecord, p: JointParameters) -> int:
    """Return the time before which a measurement is too old for a chaser's state to rest on it."""
    return record.time_ns - round(p.restart_after_s * 1e9)


def _report_restarts(
    state: JointState, record: JointTickRecord, p: JointParameters, events: list[EstimatorEvent]
) -> None:
    """Report chasers that are started again although their odometry has arrived."""
    stale = _stale_ns(record, p)
    for i in sorted(record.inputs.odometry):
        if state.alive[i] and state.measured_ns[i] < stale <= state.odometry_ns[i]:
            text = f"chaser {i}: no measurement supported its estimate for {p.restart_after_s:g} s; started again from its odometry"
            events.append(EstimatorEvent(record.time_ns, "warning", text))


def _check_cameras(
    now: JointFilterState, before: JointState, report: UpdateReport, seen: Mapping[int, Sighting],
    mounting: CameraMounting, p: JointParameters, events: list[EstimatorEvent],
) -> JointFilterState:  # fmt: skip
    """Report cameras that were dropped or are used again; react to the rejection of most cameras."""
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
    if collective == p.collective_rejections:
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
    now: JointFilterState, seen: Mapping[int, Sighting], rates: TargetRates,
    mounting: CameraMounting, p: JointParameters, action: str, events: list[EstimatorEvent],
) -> JointFilterState:  # fmt: skip
    """Start the target at the sighting with which most others agree, and apply the others as
    updates.
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
        return sum(
            any(
                poses_agree(pose, x, pose.covariance + x.covariance, p.gate_sighting) for x in other
            )
            for other in others
        )

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
    return count_measurements(now, (first, *report.accepted), report.rejected)


def _reacquire(
    now: JointFilterState, seen: Mapping[int, Sighting], mounting: CameraMounting, p: JointParameters,
    events: list[EstimatorEvent],
) -> JointFilterState:  # fmt: skip
    """Reinitialize the target from the status "lost", keeping its rates; unless it would be lost
    again.
    """
    new_events: list[EstimatorEvent] = []
    fresh = _start(now, seen, rates_of(now.hypotheses[0]), mounting, p, "reacquired", new_events)
    if all_lost(fresh, lost_limits(fresh.hypotheses[0], p.target)):
        return now
    events += new_events
    return replace(fresh, reinitialisations=now.reinitialisations + 1)


def _report_odometry(
    now: JointFilterState, p: JointParameters, events: list[EstimatorEvent]
) -> JointFilterState:
    """Report channels of odometry that are dropped, used again, or noisier than they state."""
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
                text = f"chaser {i}: odometry {name} is overconfident: its noise is larger than stated (NIS {mean:.1f} of 3)"
                events.append(EstimatorEvent(now.time_ns, "warning", text))
            elif mean < 1.5 * 3.0:
                overconfident.discard(key)
    return replace(now, dropped=frozenset(dropped), overconfident=frozenset(overconfident))


@lru_cache(maxsize=64)
def _pose_rows(chasers: tuple[int, ...]) -> IntArray:
    """Return the rows (n, 12) of a covariance with the poses of the target and of each chaser."""
    ids = np.array(chasers, dtype=np.int64)
    poses = np.broadcast_to(POSE, (len(ids), 6))
    return np.concatenate([poses, TARGET + CHASER * ids[:, None] + POSE], axis=1)


def relative_poses(s: JointState, chasers: Sequence[int]) -> list[RelativePose]:
    """Return the poses of chasers in TRF with their covariances (6, 6): position in TRF, rotation
    in CRF.
    """
    rows = _pose_rows(tuple(chasers))
    rt, n = so3.to_matrix(s.q_wxyz), len(rows)
    c = np.array([so3.matrix_components(*s.attitudes_wxyz[i].tolist()) for i in chasers]).reshape(
        n, 3, 3
    )
    places = [rt.T @ (s.positions_m[i] - s.position_m) for i in chasers]
    j = np.zeros((n, 6, 12))
    j[:, 0:3, 0:3], j[:, 0:3, 6:9], j[:, 3:6, 9:12] = -rt.T, rt.T, _IDENTITY_3
    j[:, 3:6, 3:6] = -(c.transpose(0, 2, 1) @ rt)
    for row, place in enumerate(places):
        j[row, 0:3, 3:6] = so3.skew(place)
    covariances = j @ s.covariance[rows[:, :, None], rows[:, None, :]] @ j.transpose(0, 2, 1)
    return [
        RelativePose(i, place, so3.inverse_multiply(s.q_wxyz, s.attitudes_wxyz[i]), covariance)
        for i, place, covariance in zip(chasers, places, covariances, strict=True)
    ]
