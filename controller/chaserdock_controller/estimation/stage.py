# SPDX-License-Identifier: Apache-2.0
"""Second stage of a tick: estimate the states of the target and of the chasers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import replace

import msgspec
import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.relative_motion import cw_wrench
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import CameraCalibration, Odometry
from chaserdock_protocol.scenario import FlightScenario

from chaserdock_controller.ingest.latency_compensation import predict_state
from chaserdock_controller.ingest.sensor_consistency import SensorConsistency
from chaserdock_controller.interfaces import (
    AppliedImpulse,
    ChaserEstimate,
    ChaserObservation,
    IdentifiedStack,
    LogEntry,
    Observation,
    OwnMotion,
    TargetEstimation,
    TargetState,
)

from .composite_body import CompositeBody
from .identification.stage import StackIdentification
from .target_shape import ShapeEstimation, shape_parameters
from .types import ChaserMotion, Estimator, EstimatorInputs, MeasuredChaser

_NOTHING = np.zeros(6)
_AT_REST = AppliedImpulse.steady(_NOTHING)


class EstimationStage:
    """Runs the estimator and keeps the body that the target forms with latched chasers."""

    def __init__(self, scenario: FlightScenario, estimator: Estimator) -> None:
        self.estimator = estimator
        self.composite = CompositeBody(scenario, estimator)
        self.consistency = tuple(SensorConsistency(i) for i in range(len(scenario.chasers)))
        self._body, self._period_s = scenario.chaser, 1.0 / scenario.time.rate_hz
        orbit = scenario.orbit
        self._passive_safety = scenario.limits.passive_safety != "off"
        self._mean_motion_rad_s = 0.0 if orbit is None else orbit.elements.mean_motion_rad_s
        self._camera = scenario.camera_model()
        parameters = shape_parameters(scenario)
        self.shape = ShapeEstimation(scenario, parameters) if parameters else None
        enabled = scenario.detumble.identification.enabled
        self.identification = StackIdentification(scenario) if enabled else None

    def run(self, observation: Observation, inspecting: Set[int] = frozenset()) -> TargetEstimation:
        """Estimate from a tick's inputs.

        Order: contacts and impulses from before the tick, the estimator, the geometry by pairs of
        images and by images of chasers that were ``inspecting`` after the previous tick, then the
        identification of the stack. The estimator uses its result from the next tick on.
        """
        estimation = self._estimate(observation)
        if self.shape is not None:
            estimation = replace(estimation, shape=self.shape.update(observation, inspecting))
        if self.identification is None:
            return estimation
        estimation = self.identification.identified(observation, estimation)
        refined = self.identification.refined_target(observation)
        if refined is not None:
            self.composite.refine_target(refined)
        return estimation

    def _estimate(self, observation: Observation) -> TargetEstimation:
        o, latched_before = observation, self.composite.latched
        self.composite.disturb(o)
        found = self.estimator.update(self._inputs(o, latched_before))
        target, motions = found.target, {m.chaser: m for m in found.chasers}
        known = target.is_known
        own = tuple(_estimated(c.odometry, motions.get(c.chaser)) for c in o.chasers)
        if known:
            self.composite.update_body(target, own)
        seeing = {s.chaser for s in o.sightings if s.solutions}
        events: list[LogEntry] = [(e.level, e.text) for e in found.events]
        events += self._follow_consistency(o, seeing, target)
        cameras = camera_calibrations(found.chasers, self._camera)
        return TargetEstimation(
            target=target,
            at_effect=self.estimator.estimate_at(o.effective_ns) if known else None,
            chasers=tuple(
                self._chaser(c, state, motions.get(c.chaser), known, seeing, cameras)
                for c, state in zip(o.chasers, own, strict=True)
            ),
            body=self.composite.moving,
            events=tuple(events),
            innovations=found.innovations,
            stack=self._free_target(target) if known else None,
        )

    def _follow_consistency(
        self, o: Observation, seeing: Set[int], target: TargetState
    ) -> list[LogEntry]:
        """Track whether the sightings of each chaser agree with the estimate. Returns the
        events.
        """
        for c in o.chasers:
            if c.interrupted:
                self.consistency[c.chaser].interrupt(o.time_s)
        rejected = set(target.rejected)
        events = [self.consistency[i].update(o.time_s, True) for i in sorted(seeing - rejected)]
        events += [self.consistency[i].update(o.time_s, False) for i in sorted(rejected)]
        return [event for event in events if event is not None]

    def _chaser(
        self,
        c: ChaserObservation,
        state: Odometry | None,
        motion: ChaserMotion | None,
        known: bool,
        seeing: Set[int],
        cameras: Mapping[int, CameraCalibration],
    ) -> ChaserEstimate:
        """Return what is known of a chaser with the estimated ``state``. ``known``: the target's
        pose is known.
        """
        i, latched = c.chaser, c.chaser in self.composite.latched
        own = relative = disturbed = None
        if state is not None:
            disturbance = self._disturbance(state, motion, latched)
            at_effect = predict_state(state, c.ahead, disturbance, self._body)
            own = OwnMotion(state, at_effect, disturbance)
            relative = None if motion is None else motion.relative
            if motion is not None and known and self._passive_safety:
                disturbed = self.estimator.disturbed_motion(i)
        return ChaserEstimate(
            chaser=i,
            own=own,
            disturbed=disturbed,
            relative=relative,
            camera=cameras.get(i),
            visible=i in seeing,
            latched=latched,
            doubtful=self.consistency[i].doubtful,
        )

    def _free_target(self, target: TargetState) -> IdentifiedStack | None:
        """Return the mass properties that the target's motion shows while no chaser is latched to
        it.
        """
        if self.composite.latched or self.estimator.shape is None:
            return None
        motion = BodyState(
            target.position_m, target.velocity_m_s, target.q_wxyz, target.omega_rad_s
        )
        found = self.composite.target
        return IdentifiedStack(found, found, (), motion, frozenset(), tuple)

    def _inputs(self, o: Observation, latched_before: frozenset[int]) -> EstimatorInputs:
        latched = self.composite.latched
        changed = latched ^ latched_before
        chasers = tuple(
            MeasuredChaser(
                chaser=c.chaser,
                impulse=_AT_REST if c.impulse is None else c.impulse,
                odometry=c.measured,
                outdated=c.outdated,
                last_command=c.last_command,
                latched=c.chaser in latched,
                contact=c.touches or c.chaser in changed,
            )
            for c in o.chasers
        )
        return EstimatorInputs(o.time_ns, self._period_s, chasers, o.sightings)

    def _disturbance(self, own: Odometry, motion: ChaserMotion | None, latched: bool) -> Array:
        """Return the wrench of the orbit on a chaser plus its estimated disturbance; zero for a
        latched chaser, whose motion is the target's.
        """
        if latched:
            return _NOTHING
        estimated = _NOTHING if motion is None else motion.disturbance
        if not self._mean_motion_rad_s:
            return estimated
        orbital = self._orbital_wrench(own)
        return orbital if motion is None else orbital + estimated

    def _orbital_wrench(self, o: Odometry) -> Array:
        state = np.array([*o.position_m, *o.velocity_m_s, *o.q_wxyz, *o.omega_rad_s])
        return cw_wrench(self._mean_motion_rad_s, state, self._body.mass_kg, self._body.inertia)


def _estimated(odometry: Odometry | None, motion: ChaserMotion | None) -> Odometry | None:
    """Return a chaser's odometry with its state replaced by the estimate, if there is one."""
    if odometry is None or motion is None:
        return odometry
    return msgspec.structs.replace(
        odometry,
        position_m=vector(motion.position_m),
        velocity_m_s=vector(motion.velocity_m_s),
        q_wxyz=vector(motion.q_wxyz),
        omega_rad_s=vector(motion.omega_rad_s),
    )


def camera_calibrations(
    motions: Sequence[ChaserMotion], camera: Camera
) -> dict[int, CameraCalibration]:
    """Return the estimated errors of the chasers' cameras in CRF axes, by chaser. ``camera``:
    nominal calibration.
    """
    found = [(m.chaser, m.camera) for m in motions if m.camera is not None]
    if not found:
        return {}
    axes = rotations.to_matrix(camera.q_crf_irf_wxyz)
    covariances = np.array([e.covariance for _, e in found])
    turns, shifts = (axes @ covariances[:, i : i + 3, i : i + 3] @ axes.T for i in (0, 3))
    diagonals = [np.einsum("nii->ni", part) for part in (turns, shifts, covariances[:, 6:, 6:])]
    sigmas = np.sqrt(np.concatenate(diagonals, axis=1)).tolist()
    return {
        i: CameraCalibration(
            chaser=i,
            turn_rad=vector(axes @ e.turn_rad),
            turn_sigma_rad=(t1, t2, t3),
            shift_m=vector(axes @ e.shift_m),
            shift_sigma_m=(s1, s2, s3),
            focal_share=e.focal_share,
            focal_sigma_share=focal,
        )
        for (i, e), (t1, t2, t3, s1, s2, s3, focal) in zip(found, sigmas, strict=True)
    }
