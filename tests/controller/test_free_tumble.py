# SPDX-License-Identifier: Apache-2.0
"""The shape of a target that tumbles freely, from measured poses."""

from __future__ import annotations

import math

import numpy as np
import pytest
from chaserdock_controller.estimation.identification.composite import (
    IdentificationParameters,
    prior_of,
    properties_of,
)
from chaserdock_controller.estimation.identification.free_tumble import TumbleIdentification
from chaserdock_controller.estimation.target_body import TargetBody
from chaserdock_controller.estimation.types import CameraPose, Measurement, PoseHypothesis
from chaserdock_models import rotations
from chaserdock_models.rigid_body import BodyState, free_rotation
from chaserdock_protocol.scenario.navigation import NavigationSection
from detumble_cases import target_alone

SIGMA_M, SIGMA_RAD, STEP_S = 0.001, 0.002, 0.2


def watch(omega: list[float], seconds: float = 60.0) -> tuple[TumbleIdentification, TargetBody]:
    """Measure the pose of a tumbling target with two cameras that are turned by 1 mrad, at 5 Hz."""
    rng, body = np.random.default_rng(1), target_alone()
    count = round(seconds / STEP_S)
    qs, omegas, _ = free_rotation([1.0, 0.0, 0.0, 0.0], np.radians(omega), body.inertia_kg_m2, STEP_S, count)
    errors = [rotations.exp(np.array([1e-3, 0.0, -1e-3])), rotations.exp(np.array([0.0, 1e-3, 0.0]))]
    covariance = np.diag([SIGMA_M**2] * 3 + [SIGMA_RAD**2] * 3)
    stated = TargetBody(150.0, 20.0 * np.eye(3), np.zeros(3))
    found = None
    for k, (q, rate) in enumerate(zip(qs, omegas, strict=True)):
        position = -rotations.rotate(q, body.centre_trf_m)
        measurements = []
        for i, error in enumerate(errors):
            turn = rotations.exp(rng.normal(0.0, SIGMA_RAD, 3))
            measured = rotations.multiply(rotations.multiply(q, error), turn)
            pose = PoseHypothesis(position + rng.normal(0.0, SIGMA_M, 3), measured, covariance)
            away = PoseHypothesis(
                pose.position_m, rotations.multiply(measured, [0.0, 1.0, 0.0, 0.0]), covariance
            )
            camera = CameraPose(np.array([1.5, 0.0, 0.0]), np.array([1.0, 0.0, 0.0, 0.0]))
            measurements.append(Measurement(i, 0, (away, pose), 1, camera))
        if found is None:
            moving = -np.cross(rotations.rotate(q, rate), rotations.rotate(q, body.centre_trf_m))
            start = BodyState(position, moving + 0.003, q, rate + 0.002)
            sensors = NavigationSection(grade="exact").errors()
            parameters = IdentificationParameters()
            found = TumbleIdentification(prior_of(stated, parameters), (0, 1), start, sensors, parameters)
        found.step(measurements, STEP_S, first=k == 0)
    assert found is not None
    return found, body


@pytest.fixture(scope="module")
def tumble() -> tuple[TumbleIdentification, TargetBody]:
    return watch([4.0, -3.0, 5.0])


def test_a_tumble_shows_ratios_and_centre_but_not_the_scale(
    tumble: tuple[TumbleIdentification, TargetBody],
) -> None:
    found, body = tumble
    ratios, covariance = found.ratios
    true = properties_of(body)[4:]
    error = ratios - true / true[:3].sum()
    assert np.abs(error).max() < 0.01 * 25.0 / 60.0
    nees = error @ np.linalg.pinv(covariance, rcond=1e-6, hermitian=True) @ error / 5.0
    assert nees < 3.0
    assert np.linalg.norm(found.target.body.centre_trf_m - body.centre_trf_m) < 0.002
    trace = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    assert math.sqrt(trace @ found.target.covariance[4:, 4:] @ trace) > 0.1 * 60.0
    assert math.sqrt(found.target.covariance[0, 0]) == pytest.approx(0.3 * 150.0, rel=0.01)


def test_a_spin_about_a_principal_axis_leaves_the_ratios_unknown(
    tumble: tuple[TumbleIdentification, TargetBody],
) -> None:
    axis = np.linalg.eigh(target_alone().inertia_kg_m2)[1][:, 2]
    found, _ = watch((7.0 * axis).tolist(), 20.0)
    assert np.trace(found.ratios[1]) > 100.0 * np.trace(tumble[0].ratios[1])
