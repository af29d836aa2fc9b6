# SPDX-License-Identifier: Apache-2.0
"""Default estimator: one error-state Kalman filter of the target, the chasers, their sensor errors
and disturbances.

Mathematics: docs/estimation.md. Every tick is recorded with its inputs. A sighting that arrives
late is inserted at its exposure, also between two ticks, and the later ticks are processed again.
The state therefore does not depend on the order of arrival.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import msgspec
import numpy as np
from chaserdock_models import scalar_rotations as so3
from chaserdock_models.arrays import Array
from chaserdock_models.passive_safety import DisturbedMotion
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import Innovation, Odometry, Sighting

from chaserdock_controller.bodies.body_shape import SHAPE, BodyShape
from chaserdock_controller.bodies.target_body import TargetBody
from chaserdock_controller.estimation.types import (
    CameraError,
    ChaserMotion,
    Estimate,
    Estimator,
    EstimatorEvent,
    EstimatorInputs,
    Shock,
    no_estimate,
)
from chaserdock_controller.interfaces import RelativePose, TargetState

from .between_ticks import split_tick
from .covariance import between, of_chaser, within
from .hypotheses import FilterState, mixture_covariance, target_state
from .measurements import mounting_of
from .parameters import JointParameters, TargetParameters, rows_of
from .prediction import disturbance, predict_target
from .replay import FilterTick, ReplayBuffer
from .state import (
    ATTITUDE,
    FOCAL,
    FORCE,
    POSE,
    POSITION_DRIFT,
    TARGET,
    TURN,
    VELOCITY,
    VIEW,
    JointState,
    with_body,
)
from .tick import is_target_lost, process_tick

_IDENTITY_3 = np.eye(3)
_NO_DISTURBANCE = np.zeros(6)
_POSES = np.concatenate([POSE, TARGET + POSE])
"""Components of a pair that hold the poses of target and chaser."""


class JointEstimator(Estimator):
    """Estimates the target and the chasers from odometry, sightings and commands.

    ``target``: model of the target from now on. It is replaced when chasers latch or release.
    """

    def __init__(self, parameters: JointParameters, chasers: int) -> None:
        self.parameters = parameters
        self.target = parameters.target
        self.chasers = chasers
        self._mounting = mounting_of(parameters.camera)
        self._buffer = ReplayBuffer()
        self._was_lost = False

    @property
    def newest(self) -> FilterState | None:
        """Return the filter's state after the newest tick."""
        return self._buffer.newest

    @property
    def state(self) -> JointState | None:
        """Return the likeliest state after the newest tick."""
        return self.newest.hypotheses[0] if self.newest else None

    @property
    def reinitialisations(self) -> int:
        """Return how often the estimate of the target's pose was restarted."""
        return self.newest.reinitialisations if self.newest else 0

    @property
    def shape(self) -> tuple[BodyShape, Array] | None:
        """Return the shape of the target's present body and its covariance (8, 8); None if it is
        not estimated.
        """
        state = None if self.state is None else with_body(self.state, self.target)
        if state is None or state.shape is None:
            return None
        return state.shape, state.covariance[-SHAPE:, -SHAPE:]

    def update(self, inputs: EstimatorInputs) -> Estimate:
        """Process a tick. Sightings and odometry of ticks that are no longer buffered are
        ignored.
        """
        records = self._buffer.records
        record = FilterTick(
            time_ns=inputs.time_ns,
            parameters=self.target,
            covered_s=inputs.covered_s,
            chasers=tuple(
                c if c.outdated is None else dataclasses.replace(c, outdated=None)
                for c in inputs.chasers
            ),
        )
        records.append(record)
        first = len(records) - 1
        for sighting in sorted(inputs.sightings, key=lambda s: (s.sim_time_ns, s.chaser)):
            first = min(first, self._insert(sighting))
        for chaser in inputs.chasers:
            if chaser.outdated is not None:
                first = min(first, self._insert_odometry(chaser.outdated))
        self._buffer.replay(first, self._process)
        innovations = self._innovations(inputs.sightings)
        self._buffer.trim(self.parameters.target.buffer_s)
        target = self.estimate_at(inputs.time_ns)
        lost = target.status == "lost"
        if lost and not self._was_lost:
            self._buffer.pending.append(EstimatorEvent(target.time_ns, "info", "lost"))
        self._was_lost = lost
        return Estimate(
            target, self._chasers(inputs), tuple(self._buffer.drain_events()), innovations
        )

    def _innovations(self, sightings: Sequence[Sighting]) -> tuple[Innovation, ...]:
        """Return the innovations of sightings that have just been processed."""
        found: list[Innovation] = []
        for time_ns, chaser in sorted({(s.sim_time_ns, s.chaser) for s in sightings}):
            i, _ = self._buffer.find(time_ns)
            state = self._buffer.records[i].state if i < len(self._buffer.records) else None
            known = () if state is None else state.innovations
            found += [x for x in known if (x.sim_time_ns, x.chaser) == (time_ns, chaser)]
        return tuple(found)

    def estimate_at(self, time_ns: int) -> TargetState:
        """Return the target's estimate for ``time_ns`` from the ticks up to then. The state is
        unchanged.

        Raises ValueError for a time before the oldest buffered state.
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
        lost = is_target_lost(state.hypotheses[0], covariance, p.target)
        return target_state(state, time_ns, hypotheses[0], covariance, lost, p.target)

    def disturb(self, shock: Shock) -> None:
        """Apply a sudden change of the target's rates after the newest tick."""
        self._buffer.disturb(shock)

    def change_body(self, body: TargetBody, covariance: Array) -> None:
        """Treat the target from the newest tick on as a torque-free rigid body with other mass
        properties.
        """
        xx, yy, zz = body.inertia_kg_m2.tolist()
        x, y, z = body.centre_trf_m.tolist()
        self.target = dataclasses.replace(
            self.target,
            motion_model="torque_free",
            inertia_ratios=(tuple(xx), tuple(yy), tuple(zz)),
            centre_of_mass_trf_m=(x, y, z),
            body_covariance=rows_of(covariance),
        )

    def without_drift(self, odometry: Odometry) -> Odometry:
        """Return odometry less the drift of its position, as estimated up to now."""
        if self.state is None:
            return odometry
        position = np.array(odometry.position_m) - self.state.of(odometry.chaser, POSITION_DRIFT)
        return msgspec.structs.replace(odometry, position_m=vector(position))

    def _chasers(self, inputs: EstimatorInputs) -> tuple[ChaserMotion, ...]:
        """Return the motions of the chasers with a known state, after the newest tick."""
        s = self.state
        if s is None:
            return ()
        relative, cameras = self.relative_poses(), self.cameras()
        for i, pose in relative.items():
            if inputs.chasers[i].latched:
                relative[i] = dataclasses.replace(pose, random_covariance=random_covariance(s, i))
        return tuple(
            ChaserMotion(
                i,
                s.positions_m[i],
                s.velocities_m_s[i],
                s.attitudes_wxyz[i],
                s.omegas_rad_s[i],
                _NO_DISTURBANCE
                if inputs.chasers[i].latched
                else disturbance(
                    s, i, inputs.chasers[i].impulse.impulse / inputs.covered_s, self.parameters
                ),
                relative.get(i),
                cameras.get(i),
            )
            for i in np.flatnonzero(s.alive).tolist()
        )

    def relative_poses(self) -> dict[int, RelativePose]:
        """Return the poses of the chasers relative to the target after the newest tick, by chaser;
        empty while the target is unknown.
        """
        s = self.state
        if s is None or not s.target_known:
            return {}
        chasers = np.flatnonzero(s.alive).tolist()
        return dict(zip(chasers, relative_poses(s, chasers), strict=True))

    def disturbed_motion(self, chaser: int) -> DisturbedMotion | None:
        """Return what decides where a chaser coasts besides its position and velocity; None if it
        or the target is unknown.

        The force that lasts without thrust is known by the estimate and by its own size: in Bayes'
        rule the prior ``lasting_force_N`` takes the place of ``disturbance_force_N``.
        """
        s, p = self.state, self.parameters
        if s is None or not s.target_known or not s.alive[chaser]:
            return None
        own = np.r_[: VELOCITY.stop, ATTITUDE, FORCE] + TARGET
        known = np.concatenate([np.arange(VELOCITY.stop), own])
        # Of the target's position and velocity, then the chaser's, its attitude, its force.
        covariance = between(s, chaser, known, known)
        prior_N2 = p.disturbance_force_N**2
        lasting_N2 = min(p.lasting_force_N**2, prior_N2)
        stated = lasting_N2 * prior_N2 * np.eye(3)
        share = np.linalg.solve(stated + (prior_N2 - lasting_N2) * covariance[15:, 15:], stated)
        covariance[15:] = share @ covariance[15:]
        covariance[:15, 15:] = covariance[15:, :15].T
        force = share @ s.of(chaser, FORCE)
        per_N = so3.to_matrix(s.attitudes_wxyz[chaser]) / p.body.mass_kg
        j = np.zeros((9, 18))
        j[:6, :6], j[:6, 6:12] = -np.eye(6), np.eye(6)
        j[6:, 12:15], j[6:, 15:] = -per_N @ so3.skew(force), per_N
        return DisturbedMotion(per_N @ force, j @ covariance @ j.T)

    def cameras(self) -> dict[int, CameraError]:
        """Return the estimated calibration errors of the cameras after the newest tick, by
        chaser.
        """
        s, errors = self.state, {}
        if s is None or not s.target_known or self.parameters.camera_turn_rad == 0.0:
            return {}
        for i in np.flatnonzero(s.alive).tolist():
            part = slice(TURN.start, FOCAL.stop)
            e = s.of(i, part)
            errors[i] = CameraError(e[:3], e[3:6], float(e[6]), of_chaser(s, i)[part, part])
        return errors

    def _with(self, target: TargetParameters) -> JointParameters:
        """Return the parameters with another model of the target."""
        p = self.parameters
        return p if target is p.target else dataclasses.replace(p, target=target)

    def _insert(self, sighting: Sighting) -> int:
        """Add a sighting to the record of its exposure, or of the first tick after it. Returns the
        index of that record, or of the newest one if nothing was added.
        """
        records = self._buffer.records
        i, record = self._buffer.find(sighting.sim_time_ns)
        if record is None:
            is_buffered = 0 < i < len(records)
            return i if is_buffered and records[i].insert_between(sighting) else len(records) - 1
        if sighting.chaser in record.sightings:
            return len(records) - 1
        record.sightings[sighting.chaser] = sighting
        return i

    def _insert_odometry(self, odometry: Odometry) -> int:
        """Add odometry to the record of its tick unless that has one. Returns the index of that
        record, or of the newest one if nothing was added.
        """
        i, record = self._buffer.find(odometry.sim_time_ns)
        k = odometry.chaser
        if record is None or record.chasers[k].odometry is not None:
            return len(self._buffer.records) - 1
        known = dataclasses.replace(record.chasers[k], odometry=odometry)
        record.chasers = (*record.chasers[:k], known, *record.chasers[k + 1 :])
        return i

    def _process(
        self, before: FilterState | None, record: FilterTick
    ) -> tuple[FilterState, tuple[EstimatorEvent, ...]]:
        if before is None or not record.between:
            return self._process_part(before, record)
        state, events = before, ()
        seen, rejected = set[int](), set[int]()
        innovations: tuple[Innovation, ...] = ()
        for part in split_tick(before.time_ns, record):
            state, own = self._process_part(state, part)
            events += own
            seen.update(state.seen)
            rejected.update(state.rejected)
            innovations += state.innovations
        counted = msgspec.structs.replace(
            state,
            seen=tuple(sorted(seen)),
            rejected=tuple(sorted(rejected - seen)),
            innovations=innovations,
        )
        return counted, events

    def _process_part(
        self, before: FilterState | None, record: FilterTick
    ) -> tuple[FilterState, tuple[EstimatorEvent, ...]]:
        return process_tick(
            before, record, self.chasers, self._mounting, self._with(record.parameters)
        )


def relative_poses(s: JointState, chasers: Sequence[int]) -> list[RelativePose]:
    """Return the poses of chasers in TRF with their covariances (6, 6): position in TRF, rotation
    in CRF.
    """
    places, j = _relative_jacobians(s, chasers)
    covariances = j @ within(s, chasers, _POSES) @ j.transpose(0, 2, 1)
    return [
        RelativePose(place, so3.inverse_multiply(s.q_wxyz, s.attitudes_wxyz[i]), covariance)
        for i, place, covariance in zip(chasers, places, covariances, strict=True)
    ]


def random_covariance(s: JointState, chaser: int) -> Array:
    """Return the covariance (6, 6) of a chaser's pose relative to the target given the errors that
    persist while its view stays the same: those of its camera and of the view.

    Between two times in one view these errors cancel. Axes as in ``RelativePose``.
    """
    kept = TARGET + np.arange(TURN.start, VIEW.stop)
    j = _relative_jacobians(s, (chaser,))[1][0]
    shared = j @ between(s, chaser, _POSES, kept)
    own = np.linalg.pinv(between(s, chaser, kept, kept), rcond=1e-12, hermitian=True)
    return j @ between(s, chaser, _POSES, _POSES) @ j.T - shared @ own @ shared.T


def _relative_jacobians(s: JointState, chasers: Sequence[int]) -> tuple[list[Array], Array]:
    """Return the centres (3,) of chasers in TRF, and the derivatives (n, 6, 12) of their relative
    poses by the poses of target and chaser.
    """
    rt, n = so3.to_matrix(s.q_wxyz), len(chasers)
    c = np.array([so3.matrix_components(*s.attitudes_wxyz[i].tolist()) for i in chasers]).reshape(
        n, 3, 3
    )
    places = [rt.T @ (s.positions_m[i] - s.position_m) for i in chasers]
    j = np.zeros((n, 6, 12))
    j[:, 0:3, 0:3], j[:, 0:3, 6:9], j[:, 3:6, 9:12] = -rt.T, rt.T, _IDENTITY_3
    j[:, 3:6, 3:6] = -(c.transpose(0, 2, 1) @ rt)
    for row, place in enumerate(places):
        j[row, 0:3, 3:6] = so3.skew(place)
    return places, j
