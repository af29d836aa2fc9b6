# SPDX-License-Identifier: Apache-2.0
"""A stack whose controller is silent is stopped by its chasers, each by itself."""

from __future__ import annotations

import math

import numpy as np
import pytest
from chaserdock_protocol.messages import Sighting
from chaserdock_world.rendering.cameras import States
from flights.detumble_flights import StackMission, stack_scenario
from flights.rigid_control import FlightEvents, fly_controlled
from flights.rigid_stack import RigidStack


def no_sight(chaser: int, tick: int, time_ns: int, states: States) -> Sighting:
    """Return the sighting of a camera that sees nothing: a silent controller needs none."""
    return Sighting(
        tick=tick,
        sim_time_ns=time_ns,
        chaser=chaser,
        status="nothing",
        solutions=(),
        marker_ids=(),
        corners_px=(),
        rejected_ids=(),
    )


@pytest.mark.slow
def test_four_chasers_stop_the_stack_without_a_controller() -> None:
    scenario = stack_scenario(0, (0, 1, 2, 3))
    outcome = fly_controlled(scenario, 120.0, events=FlightEvents(silent_from_s=0.0))
    assert outcome.time_s is not None
    assert outcome.time_s < 60.0
    assert outcome.final_rate_deg_s < 0.05
    assert outcome.final_speed_m_s < 0.001
    assert outcome.held_N_s < 0.5


@pytest.mark.slow
def test_the_rigid_stack_keeps_its_momentum_and_moves_as_in_the_physics_engine() -> None:
    scenario = stack_scenario(1, (0, 3))
    stack = RigidStack(scenario)
    before = stack.body.inertia_kg_m2 @ stack.omega_rad_s
    for _ in range(30):
        stack.step({})
    after = stack.body.inertia_kg_m2 @ stack.omega_rad_s
    assert math.isclose(float(np.linalg.norm(after)), float(np.linalg.norm(before)), rel_tol=1e-9)
    stack = RigidStack(scenario)
    with StackMission(scenario, no_sight, silent_from_s=0.0) as mission:
        start = stack.rates()
        peaks = np.zeros((2, 2))
        for _ in range(45):
            flown = stack.step(stack.damping())
            loads = mission.step().loads.values()
            force_N, torque_N_m = (
                max(getattr(x, name) for x in loads) for name in ("peak_force_N", "peak_torque_N_m")
            )
            found = [[flown.peak_force_N, flown.peak_torque_N_m], [force_N, torque_N_m]]
            peaks = np.maximum(peaks, found)
        body, _, motion = mission.truth(mission.states())
        speed, rate = motion.rates(body)
    assert stack.rates()[1] < 0.8 * start[1]
    np.testing.assert_allclose(stack.rates(), [speed, rate], rtol=0.05)
    assert peaks[0, 0] > 2.0
    np.testing.assert_allclose(peaks[0], peaks[1], rtol=0.1)
