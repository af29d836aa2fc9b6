# SPDX-License-Identifier: Apache-2.0
"""Errors of sightings by shape in the joint filter: they persist, while the stated covariance
changes from image to image.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from chaserdock_controller.estimation.joint import JointEstimator
from chaserdock_controller.estimation.joint.parameters import SHAPE, JointParameters, SightingNoise
from chaserdock_controller.estimation.joint.state import POSE, SIGHTING_CHANNEL
from chaserdock_controller.estimation.types import EstimatorInputs
from chaserdock_models import rotations
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import Sighting
from flight_cases import scenario
from joint_cases import PERIOD_S, SIGHTING_SIGMAS, SyntheticFlight, navigation, parameters

SCENARIO = scenario()
CHASERS, FLIGHT_S, FLIGHTS = 3, 40.0, 6
REJECTIONS = JointParameters.rejections_to_new_view
SPREAD, SPREAD_TIME_S = 0.5, 2.0
"""Relative spread of the stated sigmas of position and rotation, and its time constant."""


class ShapeFlight(SyntheticFlight):
    """A flight whose sightings state no markers, and have an error that persists for
    ``SHAPE.view_time_s``.
    """

    def __init__(self, seed: int) -> None:
        super().__init__(SCENARIO, navigation("lab"), CHASERS, seed)
        self.view_rng = np.random.default_rng([seed, 1])
        self.persistent = (
            SHAPE.view_ratio * SIGHTING_SIGMAS * self.view_rng.normal(size=(CHASERS, 6))
        )
        self.logarithms = SPREAD * self.view_rng.normal(size=(CHASERS, 2))

    def inputs(self) -> EstimatorInputs:
        """Return the measurements, with the persistent errors of now."""
        fade = math.exp(-PERIOD_S / SHAPE.view_time_s)
        sigmas = SHAPE.view_ratio * math.sqrt(1.0 - fade**2) * SIGHTING_SIGMAS
        self.persistent = fade * self.persistent + sigmas * self.view_rng.normal(size=(CHASERS, 6))
        fade = math.exp(-PERIOD_S / SPREAD_TIME_S)
        more = SPREAD * math.sqrt(1.0 - fade**2) * self.view_rng.normal(size=(CHASERS, 2))
        self.logarithms = fade * self.logarithms + more
        inputs = super().inputs()
        sightings = tuple(self._by_shape(s) for s in inputs.sightings)
        return replace(inputs, sightings=sightings)

    def _by_shape(self, sighting: Sighting) -> Sighting:
        error, scale = (
            self.persistent[sighting.chaser],
            np.repeat(np.exp(self.logarithms[sighting.chaser]), 3),
        )
        solution = sighting.solutions[0]
        solution = msgspec.structs.replace(
            solution,
            position_m=vector(np.array(solution.position_m) + error[:3]),
            q_wxyz=vector(rotations.multiply(np.array(solution.q_wxyz), rotations.exp(error[3:]))),
            covariance=vector(np.diag((scale * SIGHTING_SIGMAS) ** 2)),
        )
        return msgspec.structs.replace(sighting, solutions=(solution,), marker_ids=())


def target_nees(flight: ShapeFlight, noise: SightingNoise) -> tuple[float, float]:
    """Fly; return the mean NEES of the target's position and of its rotation in the second half, 3
    expected of each.
    """
    estimator = JointEstimator(parameters(SCENARIO, flight.errors, shape=noise), CHASERS)
    values = []
    for k in range(round(FLIGHT_S / PERIOD_S)):
        estimate = estimator.update(flight.inputs()).target
        if k * PERIOD_S >= FLIGHT_S / 2.0 and k % 15 == 0:
            turn = rotations.multiply(rotations.conjugate(flight.target[6:10]), estimate.q_wxyz)
            e = np.concatenate([estimate.position_m - flight.target[:3], rotations.log(turn)])
            pose = estimate.covariance[np.ix_(POSE, POSE)]
            values.append(
                [e[p] @ np.linalg.solve(pose[p, p], e[p]) for p in (slice(0, 3), slice(3, 6))]
            )
        flight.step()
    position, rotation = np.mean(values, axis=0).tolist()
    return position, rotation


@pytest.mark.slow
def test_persistent_errors_are_expected_while_the_stated_covariance_changes() -> None:
    """Six flights with three slow components each: three standard deviations of the mean."""
    nees = [target_nees(ShapeFlight(seed), SHAPE) for seed in range(FLIGHTS)]
    margin = 3.0 * math.sqrt(6.0 / FLIGHTS)
    assert np.mean(nees, axis=0) == pytest.approx([3.0, 3.0], abs=margin)
    assert np.mean(nees, axis=0).min() > 1.0


@pytest.mark.slow
def test_an_error_in_units_of_each_image_would_seem_observable() -> None:
    newest = SHAPE._replace(units_time_s=0.0)
    nees = [target_nees(ShapeFlight(seed), newest)[1] for seed in range(FLIGHTS)]
    assert np.mean(nees) > 9.0


def test_an_invalid_covariance_does_not_change_the_units() -> None:
    flight = ShapeFlight(0)
    estimator = JointEstimator(parameters(SCENARIO, flight.errors, shape=SHAPE), CHASERS)
    for _ in range(10):
        estimator.update(flight.inputs())
        flight.step()
    before = estimator.state
    inputs = flight.inputs()
    solution = inputs.sightings[0].solutions[0]
    invalid = msgspec.structs.replace(solution, covariance=vector(-np.eye(6)))
    spoilt = msgspec.structs.replace(inputs.sightings[0], solutions=(invalid,))
    estimator.update(replace(inputs, sightings=(spoilt, *inputs.sightings[1:])))
    after = estimator.state
    assert before is not None
    assert after is not None
    assert np.array_equal(after.view_units[0], before.view_units[0])
    assert not np.array_equal(after.view_units[1], before.view_units[1])


@pytest.mark.slow
@pytest.mark.parametrize(("sigmas", "follows"), [(3.0, True), (40.0, False)])
def test_error_that_jumps_as_with_a_new_view_is_followed(sigmas: float, follows: bool) -> None:
    """A jump by some stated sigmas per axis is a new view; a far larger one is a fault of the
    camera, and is reported.
    """
    flight = ShapeFlight(3)
    estimator = JointEstimator(parameters(SCENARIO, flight.errors), CHASERS)
    ticks, jump_tick, rejections = round(15.0 / PERIOD_S), round(10.0 / PERIOD_S), []
    warnings: list[str] = []
    for k in range(ticks):
        if k == jump_tick:
            flight.persistent[1] = sigmas * SIGHTING_SIGMAS * [1.0, -1.0, 1.0, -1.0, 1.0, -1.0]
        events = estimator.update(flight.inputs()).events
        warnings += [e.text for e in events if e.level == "warning"]
        state = estimator.state
        assert state is not None
        rejections.append(int(state.rejections[1, SIGHTING_CHANNEL]))
        flight.step()
    assert max(rejections[:jump_tick]) <= 1
    assert (max(rejections[jump_tick:]) == REJECTIONS - 1) is follows
    assert warnings == ([] if follows else ["chaser 1 gated out: 5 in a row"])


@pytest.mark.slow
def test_pushed_target_is_no_new_view() -> None:
    """Where most cameras disagree with the estimate, the target has moved: its motion is followed
    as without this rule.
    """
    velocities: list[list[list[float]]] = []
    for rejections in (REJECTIONS, 1000):
        flight = ShapeFlight(2)
        p = dataclasses.replace(
            parameters(SCENARIO, flight.errors), rejections_to_new_view=rejections
        )
        estimator = JointEstimator(p, CHASERS)
        velocities.append([])
        for k in range(round(14.0 / PERIOD_S)):
            if k == round(10.0 / PERIOD_S):
                flight.target[3:6] += [0.02, -0.01, 0.0]
            velocities[-1].append(estimator.update(flight.inputs()).target.velocity_m_s.tolist())
            flight.step()
    assert velocities[0] == velocities[1]
    assert np.linalg.norm(velocities[0][-1] - flight.target[3:6]) < 1e-3
