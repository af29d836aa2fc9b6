# SPDX-License-Identifier: Apache-2.0
"""Plumes in the world and in the allocation: a chaser that brakes pushes the target, and prefers
thrusters that do not.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from chaserdock_agents.chaser.thrusters.allocation import allocator_of
from chaserdock_agents.chaser.thrusters.plume_avoidance import PlumeAvoidance
from chaserdock_models.wrench_set import wrench_matrix
from chaserdock_protocol.messages import (
    ActuatorCommand,
    Odometry,
    RelativeEstimate,
    TargetEstimate,
    ThrusterPulse,
)
from chaserdock_protocol.scenario import Scenario, ScenarioError, flight_scenario, parse_scenario
from chaserdock_world.actuators.ideal import fly_to
from chaserdock_world.actuators.thrusters import make_actuators
from chaserdock_world.physics.simulation import Physics

CORNERS = [(x, y, z) for x in (-0.15, 0.15) for y in (-0.15, 0.15) for z in (-0.15, 0.15)]
THRUSTERS = [
    {
        "position_m": list(corner),
        "direction": [-np.sign(corner[axis]) * float(k == axis) for k in range(3)],
        "thrust_N": 1.0,
    }
    for corner in CORNERS
    for axis in range(3)
]
"""Three at each corner of a cube: other than with twelve, most wrenches can be given in several
ways.
"""


def scenario(**changes: Any) -> Scenario:
    values: dict[str, Any] = {
        "name": "test",
        "duration_s": 10.0,
        "plume": {},
        "chaser": {"actuation": "thrusters", "thrusters": THRUSTERS},
        "target": {
            "motion": "torque_free",
            "velocity_m_s": [0.0, 0.0, 0.0],
            "omega_rad_s": [0.0, 0.0, 0.0],
        },
        "chasers": [{"position_m": [-1.0, 0.0, 0.0], "look_at": "target"}],
    }
    return parse_scenario(values | changes, "test")


def fire_all(s: Scenario) -> tuple[Physics, float]:
    """Open all thrusters for 0.5 s; return the physics after 0.6 s, and the momentum of all bodies
    along X.
    """
    physics = Physics(s)
    actuators = {"chaser/0": make_actuators(s, 0)}
    pulses = tuple(
        ThrusterPulse(thruster=k, open_ns=0, close_ns=500_000_000)
        for k in range(len(s.chaser.thrusters))
    )
    zero = (0.0, 0.0, 0.0)
    command = ActuatorCommand(
        chaser=0,
        effective_time_ns=0,
        source="command",
        force_N=zero,
        torque_N_m=zero,
        pulses=pulses,
    )
    actuators["chaser/0"].command(command, 0, 0)
    fly_to(round(0.6 * s.time.physics_hz), physics, actuators, 1.0 / s.time.physics_hz)
    given = actuators["chaser/0"].take_output(physics.step_count).impulse
    return physics, float(given[0])


def test_plumes_push_the_target_by_what_they_report_and_without_the_section_not_at_all() -> None:
    s = scenario()
    physics, _ = fire_all(s)
    assert physics.plumes is not None
    taken = physics.plumes.take("target")
    velocity = physics.state("target").velocity_m_s
    assert taken.impulse[0] > 1e-3  # away from the chaser
    assert taken.peak_force_N > 0.0
    np.testing.assert_allclose(s.target.mass_kg * velocity, taken.impulse[:3], rtol=2e-2, atol=1e-5)
    assert not physics.plumes.take("target").impulse.any()  # taken once
    physics.close()
    physics, _ = fire_all(scenario(plume=None))
    assert physics.plumes is None
    assert not physics.state("target").velocity_m_s.any()
    physics.close()


def test_allocation_fires_thrusters_at_the_target_only_where_it_must() -> None:
    s = flight_scenario(scenario())
    assert s.plume is not None
    q, zero, eye = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), tuple(np.eye(12).ravel().tolist())
    own = Odometry(
        chaser=0, position_m=(-1.0, 0.0, 0.0), velocity_m_s=zero, q_wxyz=q, omega_rad_s=zero
    )
    head = {
        "position_m": zero,
        "velocity_m_s": zero,
        "q_wxyz": q,
        "omega_rad_s": zero,
        "covariance": eye,
    }
    target = TargetEstimate(status="tracking", accepted=(0,), rejected=(), **head)
    factors = PlumeAvoidance(s).cost_factors(own, target)
    assert factors is not None
    towards = np.flatnonzero(factors > 1.0)
    assert 0 < len(towards) < len(factors)
    allocator, full = allocator_of(s.chaser), np.array([t.thrust_N for t in s.chaser.thrusters])
    rng = np.random.default_rng(4)
    less = 0.0
    for _ in range(40):
        wrench = np.array([0.0, 0.0, 0.0, 0.0, *rng.uniform(-0.05, 0.05, 2)])
        plain, avoiding = (allocator.allocate(wrench, full, f) for f in (None, factors))
        if not (plain.exact and avoiding.exact):
            continue
        np.testing.assert_allclose(
            wrench_matrix(s.chaser.thrusters) @ avoiding.thrusts_N, wrench, atol=1e-6
        )
        spared = plain.thrusts_N[towards].sum() - avoiding.thrusts_N[towards].sum()
        assert spared > -1e-4
        less += spared
    assert less > 0.05
    far = Odometry(
        chaser=0, position_m=(-50.0, 0.0, 0.0), velocity_m_s=zero, q_wxyz=q, omega_rad_s=zero
    )
    assert PlumeAvoidance(s).cost_factors(far, target) is None


def test_allocation_spares_other_chasers_whose_poses_are_known() -> None:
    q, zero, eye = (1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0), tuple(np.eye(12).ravel().tolist())
    s = flight_scenario(scenario())
    assert s.plume is not None
    avoidance = PlumeAvoidance(s)
    own = Odometry(
        chaser=0, position_m=(-40.0, 0.0, 0.0), velocity_m_s=zero, q_wxyz=q, omega_rad_s=zero
    )
    head = {
        "position_m": zero,
        "velocity_m_s": zero,
        "q_wxyz": q,
        "omega_rad_s": zero,
        "covariance": eye,
    }

    def factors(*places: tuple[int, tuple[float, float, float]]) -> Any:
        relative = tuple(
            RelativeEstimate(
                chaser=i,
                position_m=place,
                q_wxyz=q,
                covariance=tuple(np.eye(6).ravel().tolist()),
                force_N=zero,
                torque_N_m=zero,
            )
            for i, place in places
        )
        target = TargetEstimate(
            status="tracking", accepted=(0,), rejected=(), relative=relative, **head
        )
        return avoidance.cost_factors(own, target)

    assert (
        factors((0, (-40.0, 0.0, 0.0))) is None
    )  # alone: the target is out of reach, and it does not hit itself
    assert factors((0, (-40.0, 0.0, 0.0)), (1, (-40.0, 20.0, 0.0))) is None
    beside = factors((0, (-40.0, 0.0, 0.0)), (1, (-40.0, 1.0, 0.0)))
    forces = np.array([t.direction for t in s.chaser.thrusters])
    # Only thrusters that blow towards +Y, where the other one is: they push towards -Y.
    assert set(np.flatnonzero(beside > 1.0)) == set(np.flatnonzero(forces[:, 1] < -0.5))


def test_plumes_need_thrusters() -> None:
    with pytest.raises(ScenarioError, match=r"plume: only thrusters have plumes"):
        scenario(chaser={"actuation": "ideal"})
