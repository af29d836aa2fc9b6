# SPDX-License-Identifier: Apache-2.0
"""What the joint filter finds of a target that tumbles freely, from what the chasers' cameras
see.
"""

from __future__ import annotations

import math
from dataclasses import replace

import msgspec
import numpy as np
import pytest
from chaserdock_controller.estimation.joint import parameters_of
from chaserdock_controller.estimation.joint.prediction import predict_target
from chaserdock_controller.estimation.joint.state import (
    JointState,
    empty_state,
    start_shape,
    with_body,
)
from chaserdock_controller.redundancy.serialization import decode, encode
from chaserdock_protocol.scenario import Scenario, flight_scenario
from detumble_cases import target_alone
from flights.detumble_flights import stack_scenario
from flights.free_tumble_flights import TumbleOutcome, watch_tumble
from flights.rigid_control import wrong_knowledge


def scenario_of(omega_deg_s: list[float], *more: str) -> Scenario:
    """Return ``detumble`` with two chasers, and a target of which mass, inertia and centre are
    stated wrong.
    """
    scenario = stack_scenario(1, [0, 1], [*wrong_knowledge(1), *more])
    target = scenario.target.model_copy(
        update={"omega_rad_s": tuple(np.radians(omega_deg_s).tolist())}
    )
    return scenario.model_copy(update={"target": target})


@pytest.fixture(scope="module")
def tumble() -> TumbleOutcome:
    return watch_tumble(scenario_of([8.0, -6.0, 10.0]), 20.0)


@pytest.mark.slow
def test_a_tumble_shows_ratios_and_centre(tumble: TumbleOutcome) -> None:
    assert tumble.stated_error > 0.1
    assert tumble.ratio_error < 0.3 * tumble.stated_error
    assert tumble.centre_m < 0.003
    assert tumble.ratio_nees < 20.5  # 0.999 quantile, 5 degrees of freedom
    assert tumble.centre_nees < 16.3


def test_relative_poses_are_consistent_although_the_inertia_is_wrong(tumble: TumbleOutcome) -> None:
    assert 0.5 < tumble.nees < 15.0
    sure = ("target.inertia_sigma_share=1e-6", "target.centre_of_mass_sigma_m=1e-6")
    wrong = watch_tumble(scenario_of([4.0, -3.0, 5.0], *sure), 13.0).nees
    assert wrong > 3.0 * tumble.nees, (wrong, tumble.nees)


def test_a_spin_about_a_principal_axis_leaves_the_ratios_unknown(tumble: TumbleOutcome) -> None:
    """The stated axes are right here, so that the target spins about an axis of the stated
    inertia.
    """
    axis = np.linalg.eigh(target_alone().inertia_kg_m2)[1][:, 2]
    values = "{target=true,mass_kg=150.0,inertia_kg_m2=[20.0,22.0,25.0,0.0,0.0,0.0]}"
    changes = [
        f"truth.values=[{values}]",
        "target.inertia_kg_m2=[22.0,20.0,25.0]",
        f"seed={axis.size}",
    ]
    spin = watch_tumble(scenario_of([0.0, 0.0, 7.0], *changes), 8.0)
    assert spin.ratio_error > 0.5 * spin.stated_error
    assert spin.ratio_nees < 20.5


def test_a_change_of_the_body_restarts_its_shape() -> None:
    """A prediction beyond a latch uses the new body, with the uncertainty that is stated of it."""
    flight = flight_scenario(scenario_of([4.0, -3.0, 5.0]))
    p = parameters_of(flight)
    state = msgspec.structs.replace(
        start_shape(empty_state(0, 2), p.target),
        target_known=True,
        omega_rad_s=np.radians([4.0, -3.0, 5.0]),
    )
    assert with_body(state, p.target) is state
    rows = tuple(tuple(row) for row in (1e-2 * np.eye(9)).tolist())
    other = replace(
        p.target, inertia_ratios=((10.0, 0, 0), (0, 20.0, 0), (0, 0, 25.0)), body_covariance=rows
    )
    after = with_body(state, other)
    assert after.shape is not None
    assert np.diag(after.shape.inertia) == pytest.approx(np.array([10.0, 20.0, 25.0]) / 55.0)
    wide, narrow = (
        predict_target(s, 2_000_000_000, replace(p, target=t))[1]
        for s, t in ((state, p.target), (after, other))
    )
    assert np.trace(wide[9:, 9:]) > 4.0 * np.trace(narrow[9:, 9:])
    assert math.isfinite(np.trace(wide))


def test_a_checkpoint_keeps_the_shape() -> None:
    p = parameters_of(flight_scenario(scenario_of([4.0, -3.0, 5.0])))
    state = start_shape(empty_state(0, 2), p.target)
    again = decode(encode(state), JointState)
    assert state.shape is not None
    assert again.shape is not None
    assert again.shape.inertia.tobytes() == state.shape.inertia.tobytes()
    assert with_body(again, p.target) is again
