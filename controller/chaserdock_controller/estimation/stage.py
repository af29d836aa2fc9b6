# SPDX-License-Identifier: Apache-2.0
"""Second stage of a tick: estimate the states of the target and of the chasers."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
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
    IdentifiedStack,
    LogEntry,
    Observation,
    TargetEstimation,
)

from .composite_body import CompositeBody
from .identification.stage import StackIdentification
from .target_shape import ShapeEstimation, shape_parameters
from .types import CameraError, ChaserMotion, Estimator, EstimatorInputs, TargetState

_NO_DISTURBANCE = np.zeros(6)


class EstimationStage:
    """The estimator, with the body that the target forms with latched chasers."""

    def __init__(self, scenario: FlightScenario, estimator: Estimator) -> None:
        self.estimator = estimator
        self.composite = CompositeBody(scenario, estimator)
        self.consistency = SensorConsistency()
        self._body, self._period_s = scenario.chaser, 1.0 / scenario.time.rate_hz
        self._count, orbit = len(scenario.chasers), scenario.orbit
        self._passive_safety = scenario.limits.passive_safety != "off"
        self._mean_motion_rad_s = 0.0 if orbit is None else orbit.elements.mean_motion_rad_s
        self._camera = scenario.camera_model()
        parameters = shape_parameters(scenario)
        self.shape = ShapeEstimation(scenario, parameters) if parameters else None
        enabled = scenario.detumble.identification.enabled
        self.identification = StackIdentification(scenario) if enabled else None

    def run(self, observation: Observation, inspecting: Collection[int] = ()) -> TargetEstimation:
        """Update the estimator with a tick's inputs, and with contacts and impulses from before
        them; then the geometry by pairs of images and those of the chasers that were ``inspecting``
        after the tick before, and the identification of the stack, whose result the estimator takes
        from the next tick on."""
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
        o, before = observation, self.composite.latched
        self.composite.disturb(o.docking, o.odometry, o.impulses, o.time_ns)
        found = self.estimator.update(self._inputs(o, before))
        target, motions = found.target, {m.chaser: m for m in found.chasers}
        own = {i: _estimated(odometry, motions.get(i)) for i, odometry in o.odometry.items()}
        known = target.status in ("tracking", "predicting")
        if known:
            self.composite.update_body(target, own)
        disturbances = self._disturbances(own, motions)
        visible_to = frozenset(s.chaser for s in o.sightings if s.solutions)
        events: list[LogEntry] = [(e.level, e.text) for e in found.events]
        accepted, rejected = sorted(visible_to - set(target.rejected)), sorted(target.rejected)
        events += self.consistency.update(o.time_s, accepted, rejected, o.interrupted)
        return TargetEstimation(
            target=target,
            at_effect=self.estimator.estimate_at(o.effective_ns) if known else None,
            own=own,
            own_at_effect={
                i: predict_state(own[i], o.ahead[i], disturbances[i], self._body) for i in own
            },
            disturbances=disturbances,
            motion_covariances={
                i: m.motion_covariance
                for i, m in motions.items()
                if known and self._passive_safety and i in own and m.motion_covariance is not None
            },
            relative=tuple(m.relative for m in found.chasers if m.relative is not None),
            visible_to=visible_to,
            doubtful=self.consistency.doubtful,
            cameras=camera_calibrations(
                [m.camera for m in found.chasers if m.camera is not None], self._camera
            ),
            latched=self.composite.latched,
            body=self.composite.moving,
            events=tuple(events),
            stack=self._free_target(target) if known else None,
        )

    def _free_target(self, target: TargetState) -> IdentifiedStack | None:
        """Return what the motion of the target shows of its mass properties while no chaser is
        latched to it.
        """
        if self.composite.latched or self.estimator.shape is None:
            return None
        motion = BodyState(
            target.position_m, target.velocity_m_s, target.q_wxyz, target.omega_rad_s
        )
        found = self.composite.target
        return IdentifiedStack(found, found, {}, motion, {}, {}, tuple)

    def _inputs(self, o: Observation, latched_before: frozenset[int]) -> EstimatorInputs:
        impulses = np.zeros((self._count, 6))
        for i, applied in o.impulses.items():
            impulses[i] = applied.impulse
        touched = {i for i, s in o.docking.items() if s.contact and not s.latched}
        latched = self.composite.latched
        return EstimatorInputs(
            time_ns=o.time_ns,
            odometry=o.measured,
            sightings=o.sightings,
            impulses=impulses,
            covered_s=self._period_s,
            last_commands=o.last_commands,
            outdated=o.outdated,
            latched=latched,
            contacts=frozenset(touched | (latched ^ latched_before)),
        )

    def _disturbances(
        self, own: Mapping[int, Odometry], motions: Mapping[int, ChaserMotion]
    ) -> dict[int, Array]:
        """Return the wrench of the orbit on each chaser, with the estimated disturbance; none on a
        latched one, whose motion is the target's."""
        found = dict.fromkeys(own, _NO_DISTURBANCE)
        if self._mean_motion_rad_s:
            found |= {i: self._orbital_wrench(own[i]) for i in own.keys() - self.composite.latched}
        for i in own.keys() & motions.keys() - self.composite.latched:
            estimated = motions[i].disturbance
            found[i] = found[i] + estimated if self._mean_motion_rad_s else estimated
        return found

    def _orbital_wrench(self, o: Odometry) -> Array:
        state = np.array([*o.position_m, *o.velocity_m_s, *o.q_wxyz, *o.omega_rad_s])
        return cw_wrench(self._mean_motion_rad_s, state, self._body.mass_kg, self._body.inertia)


def _estimated(odometry: Odometry, motion: ChaserMotion | None) -> Odometry:
    """Return a chaser's estimated state in place of its odometry, where it is known."""
    if motion is None:
        return odometry
    return msgspec.structs.replace(
        odometry,
        position_m=vector(motion.position_m),
        velocity_m_s=vector(motion.velocity_m_s),
        q_wxyz=vector(motion.q_wxyz),
        omega_rad_s=vector(motion.omega_rad_s),
    )


def camera_calibrations(
    errors: Sequence[CameraError], camera: Camera
) -> tuple[CameraCalibration, ...]:
    """Return the estimated errors of the cameras in CRF axes; ``camera``: the nominal calibration."""
    if not errors:
        return ()
    axes = rotations.to_matrix(camera.q_crf_irf_wxyz)
    covariances = np.array([e.covariance for e in errors])
    turns, shifts = (axes @ covariances[:, i : i + 3, i : i + 3] @ axes.T for i in (0, 3))
    diagonals = [np.einsum("nii->ni", part) for part in (turns, shifts, covariances[:, 6:, 6:])]
    sigmas = np.sqrt(np.concatenate(diagonals, axis=1)).tolist()
    return tuple(
        CameraCalibration(
            chaser=e.chaser,
            turn_rad=vector(axes @ e.turn_rad),
            turn_sigma_rad=(t1, t2, t3),
            shift_m=vector(axes @ e.shift_m),
            shift_sigma_m=(s1, s2, s3),
            focal_share=e.focal_share,
            focal_sigma_share=focal,
        )
        for e, (t1, t2, t3, s1, s2, s3, focal) in zip(errors, sigmas, strict=True)
    )
