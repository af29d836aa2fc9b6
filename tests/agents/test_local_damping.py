# SPDX-License-Identifier: Apache-2.0
"""Damping law of a latched chaser without a controller: it takes energy, and noise at rest fires
nothing.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from chaser_cases import deliver
from chaserdock_agents.chaser.core import ChaserCore
from chaserdock_agents.chaser.local_damping import LocalDamping
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.wrench_set import wrench_matrix
from chaserdock_protocol import topics
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import DockingStatus, Odometry, Tick, WrenchCommand
from chaserdock_protocol.scenario import FlightScenario, flight_scenario
from chaserdock_protocol.scenario.mounting import plume_free_thrusters
from flights import load_shipped


def scenario_of(*changes: str) -> FlightScenario:
    return flight_scenario(load_shipped("detumble", *changes))


def odometry(scenario: FlightScenario, tick: int, rates: Array, q: Array | None = None) -> Odometry:
    """Return the state of chaser 0 with velocity (CRF) and rate (6,)."""
    attitude = np.array([1.0, 0.0, 0.0, 0.0]) if q is None else q
    return Odometry(
        tick=tick,
        sim_time_ns=scenario.timing.tick_time_ns(tick),
        chaser=0,
        position_m=(0.0, 0.0, 0.0),
        velocity_m_s=vector(rotations.rotate(attitude, rates[:3])),
        q_wxyz=vector(attitude),
        omega_rad_s=vector(rates[3:]),
    )


@pytest.mark.parametrize("seed", range(20))
def test_every_thruster_that_fires_takes_energy_and_hits_nothing(seed: int) -> None:
    scenario, rng = scenario_of(), np.random.default_rng(seed)
    rates, q = rng.normal(size=6) * 0.05, rotations.normalize(rng.normal(size=4))
    rates[0] = -abs(rates[0])  # away from the port, against which its free thrusters push
    thrusts = LocalDamping(scenario, 0).thrusts_N(odometry(scenario, 0, rates, q))
    speeds = wrench_matrix(scenario.chaser.thrusters).T @ rates
    free = plume_free_thrusters(scenario, {0, 1, 2, 3})[0]
    fires = thrusts > 0.0
    assert fires.any()
    assert (speeds[fires] < 0.0).all()
    assert not fires[~free].any()
    assert (thrusts <= [t.thrust_N for t in scenario.chaser.thrusters]).all()


@pytest.mark.parametrize("grade", ["lab", "orbit", "poor"])
def test_noise_at_rest_fires_nothing_and_motion_above_the_deadband_does(grade: str) -> None:
    scenario = scenario_of(f"navigation.grade={grade}")
    errors, rng = scenario.navigation.errors(), np.random.default_rng(3)
    damping = LocalDamping(scenario, 0)
    sigmas = np.repeat([errors.velocity_noise_m_s, errors.omega_noise_rad_s], 3)
    ticks, fired = 60 * scenario.time.rate_hz, 0
    for k in range(ticks):
        fired += damping.thrusts_N(odometry(scenario, k, sigmas * rng.normal(size=6))).any()
    assert fired <= 0.005 * ticks  # the first ticks, before the filter has settled
    away = np.array([-2.0 * damping.fires_m_s, 0.0, 0.0, 0.0, 0.0, 0.0])
    thrusts = np.zeros(12)
    for k in range(ticks, ticks + 3 * scenario.time.rate_hz):
        thrusts = damping.thrusts_N(odometry(scenario, k, away + sigmas * rng.normal(size=6)))
    assert thrusts.any()


def test_the_same_odometry_gives_the_same_thrusts() -> None:
    scenario = scenario_of()
    damping, rates = LocalDamping(scenario, 0), np.array([0.0, 0.0, 0.02, 0.0, 0.0, 0.0])
    damping.thrusts_N(odometry(scenario, 0, 0.0 * rates))
    first = damping.thrusts_N(odometry(scenario, 1, rates))
    np.testing.assert_array_equal(damping.thrusts_N(odometry(scenario, 1, rates)), first)


@pytest.mark.parametrize(("mode", "fires"), [("detumble", True), ("coast", False)])
def test_a_latched_chaser_left_by_its_controller_damps_only_if_it_was_detumbling(
    mode: Any, fires: bool
) -> None:
    scenario = scenario_of()
    chaser = ChaserCore(scenario, 0)
    rates = np.array([-0.03, 0.01, 0.02, 0.05, -0.1, 0.02])
    last = WrenchCommand(
        tick=0,
        sim_time_ns=0,
        chaser=0,
        effective_time_ns=scenario.timing.effective_ns(0),
        expires_ns=500_000_000,
        mode=mode,
        force_N=(0.0, 0.0, 0.0),
        torque_N_m=(0.0, 0.0, 0.0),
        thrusts_N=(0.0,) * 12 if mode == "detumble" else (),
        term=1,
        commander="controller",
        instance="c",
    )
    published: list[tuple[Any, Any]] = []
    for k in range(4):
        now: dict[str, Any] = {"tick": k, "sim_time_ns": scenario.timing.tick_time_ns(k)}
        controllers = {"controller": "c"} if k == 0 else {}
        tick = Tick(revision=0, images=False, chasers=(0,), controllers=controllers, **now)
        published += deliver(chaser, topics.TICK, tick)
        status = DockingStatus(chaser=0, contact=True, armed=False, latched=True, **now)
        published += deliver(chaser, topics.DOCKING, status)
        published += deliver(chaser, topics.ODOMETRY, odometry(scenario, k, rates))
        if k == 0:
            published += deliver(chaser, topics.WRENCH, last)
    commands = [m for t, m in published if t is topics.ACTUATORS]
    assert [c.source for c in commands] == ["command", "brake", "brake", "brake"]
    assert any(c.pulses for c in commands[1:]) == fires
    assert any(any(c.force_N) for c in commands[1:]) == fires
    events = [m.what for t, m in published if t is topics.EVENT]
    assert events.count("fallback: brake") == fires
