# SPDX-License-Identifier: Apache-2.0
"""Second stage of a tick: estimate the target's state from the sightings of all chasers."""

from __future__ import annotations

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.camera import Camera
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import CameraCalibration
from chaserdock_protocol.scenario import FlightScenario

from chaserdock_controller.ingest.sensor_consistency import SensorConsistency
from chaserdock_controller.interfaces import LogEntry, Observation, TargetEstimation

from .composite_body import CompositeBody
from .measurements import SightingConverter
from .mekf import Mekf
from .types import Estimator


class EstimationStage:
    """The estimator, with the body that the target forms with latched chasers."""

    def __init__(self, scenario: FlightScenario, estimator: Estimator) -> None:
        self.estimator = estimator
        self.composite = CompositeBody(scenario, estimator)
        self.consistency = SensorConsistency()
        self._camera = scenario.camera_model()
        self._converter = SightingConverter(self._camera)

    def run(self, observation: Observation) -> TargetEstimation:
        """Update the estimator with a tick's sightings, and with contacts and impulses from before them."""
        o, now_ns = observation, observation.time_ns
        self._converter.add_odometry(o.odometry, now_ns)
        self.composite.disturb(o.docking, o.odometry, o.impulses, now_ns)
        target = self.estimator.update(self._converter.measurements(o.sightings), now_ns)
        known = target.status in ("tracking", "predicting")
        if known:
            self.composite.update_body(target, o.odometry)
        visible_to = frozenset(s.chaser for s in o.sightings if s.solutions)
        events: list[LogEntry] = [(e.level, e.text) for e in self.estimator.drain_events()]
        accepted, rejected = sorted(visible_to - set(target.rejected)), sorted(target.rejected)
        events += self.consistency.update(o.time_s, accepted, rejected)
        return TargetEstimation(
            target=target,
            at_effect=self.estimator.estimate_at(o.effective_ns) if known else None,
            visible_to=visible_to,
            cameras=camera_calibrations(self.estimator, self._camera),
            latched=self.composite.latched,
            body=self.composite.body,
            events=tuple(events),
        )


def camera_calibrations(estimator: Estimator, camera: Camera) -> tuple[CameraCalibration, ...]:
    """Return the estimated errors of the cameras used so far, in CRF axes; ``camera``: the nominal calibration."""
    if not isinstance(estimator, Mekf):
        return ()
    axes = rotations.to_matrix(camera.q_crf_irf_wxyz)
    calibrations = []
    for e in estimator.cameras():
        turn, shift = (axes @ e.covariance[i : i + 3, i : i + 3] @ axes.T for i in (0, 3))
        calibrations.append(
            CameraCalibration(
                chaser=e.chaser,
                turn_rad=vector(axes @ e.turn_rad),
                turn_sigma_rad=vector(np.sqrt(np.diag(turn))),
                shift_m=vector(axes @ e.shift_m),
                shift_sigma_m=vector(np.sqrt(np.diag(shift))),
                focal_share=e.focal_share,
                focal_sigma_share=float(np.sqrt(e.covariance[6, 6])),
            )
        )
    return tuple(calibrations)
