# SPDX-License-Identifier: Apache-2.0
"""Detumbling in flight, from latched chasers on: the stack stops and stays, or the command is
refused with the figures.
"""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from chaserdock_controller.bodies.target_body import TargetBody
from chaserdock_controller.estimation.joint import JointEstimator
from chaserdock_controller.guidance.detumble.control import observed_motion
from chaserdock_controller.interfaces import TargetState
from chaserdock_models import rotations
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import CommandReply, Odometry, OperatorCommand
from chaserdock_protocol.scenario import Scenario, ScenarioError
from flights import load_shipped
from flights.detumble_flights import StackMission, stack_scenario
from flights.latched_stack import moving_with, stack_motion
from hypothesis import given, settings
from hypothesis import strategies as st

from chaserdock.experiments.perception import RenderedImages

SETTLED_S = 2.0


def at_command(scenario: Scenario, *chasers: int) -> tuple[StackMission, list[CommandReply]]:
    """Fly until the estimate has settled and command these chasers to detumble; return the
    replies.
    """
    mission = StackMission(scenario, RenderedImages(scenario))
    while mission.time_s < SETTLED_S:
        mission.step()
    out = mission.step(
        tuple(OperatorCommand(command="detumble", chaser=i) for i in chasers)
    ).outputs
    assert out is not None
    return mission, out.replies


@pytest.mark.slow
@pytest.mark.parametrize("chasers", [(0, 1, 2, 3), (0, 3)])
def test_a_tumbling_stack_stops_and_holds_without_propellant(chasers: tuple[int, ...]) -> None:
    mission, replies = at_command(stack_scenario(2, chasers), *range(len(chasers)))
    assert all(reply.accepted for reply in replies), replies
    while mission.phase(0) != "stack_hold":
        out = mission.step().outputs
        assert mission.time_s < SETTLED_S + 12.0, mission.events
        assert out is not None
        assert {w.mode for w in out.wrenches.values()} == {"detumble"}
    fired = 0
    for _ in range(30):
        record = mission.step()
        speed, rate = mission.truth(record.states)[2].rates(mission.truth(record.states)[0])
        assert speed < 0.001
        assert math.degrees(rate) < 0.05
        assert record.outputs is not None
        fired += sum(any(w.thrusts_N) for w in record.outputs.wrenches.values())
    assert fired == 0
    assert mission.contacts == set()
    mission.close()


@pytest.mark.slow
def test_no_thruster_fires_at_the_target() -> None:
    mission, _ = at_command(stack_scenario(1, (0, 3)), 0, 1)
    thrusters, fired = mission.scenario.chaser.thrusters, set()
    for _ in range(30):
        commands = mission.step().commands
        fired |= {p.thruster for c in commands.values() for p in c.pulses}
    mission.close()
    assert fired
    assert all(
        thrusters[k].direction[0] > 0.0 for k in fired
    )  # each pushes its chaser towards the port


@pytest.mark.parametrize(
    ("chasers", "changes", "reason"),
    [
        ((0,), (), r"\(6 of 12 of chaser 0\) cannot push and turn the stack in every direction"),
        ((0, 1), (), r"cannot push and turn the stack in every direction"),
        (
            (0, 3),
            ("detumble.timeout_s=1.0",),
            r"stopping the stack takes at least \d+ s; detumble.timeout_s is 1 s",
        ),
    ],
)
def test_a_set_that_cannot_stop_the_stack_is_refused(
    chasers: tuple[int, ...], changes: tuple[str, ...], reason: str
) -> None:
    mission, replies = at_command(stack_scenario(1, chasers, changes), *range(len(chasers)))
    assert not any(reply.accepted for reply in replies)
    for reply in replies:
        assert re.search(reason, reply.reason), reply.reason
    assert mission.phase(0) == "verified"
    mission.close()


def test_hold_ends_the_detumbling_and_abort_releases_the_latch() -> None:
    mission, _ = at_command(stack_scenario(1, (0, 3)), 0, 1)
    out = mission.step((OperatorCommand(command="hold", chaser=0),)).outputs
    assert out is not None
    assert out.replies[0].accepted
    assert mission.phase(0) == "verified"
    # The other one alone cannot stop the stack.
    out = mission.step().outputs
    assert out is not None
    assert mission.phase(1) == "verified"
    assert any("cannot push and turn" in what for _, _, what in mission.events)
    assert {w.mode for w in out.wrenches.values()} == {"coast"}
    mission.step((OperatorCommand(command="abort", chaser=1),))
    mission.step()
    assert mission.phase(1) == "abort"
    assert not mission.physics.latches["chaser/1"].latched
    mission.close()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            (
                "docking.ports=[{chaser=0,position_m=[-0.5,0,-0.05],axis=[-1,0,0]}]",
                "success.latched=[]",
            ),
            "has no port",
        ),
        (
            ("detumble.plan_s=60.0",),
            "detumble.plan_s: a plan of 60 s does not end before detumble.timeout_s, 60 s",
        ),
        (
            ("timeline=[{at_s=10.0,command='identify',chasers=[0]}]",),
            "timeline.0: identify needs detumble.identification.enabled = true",
        ),
        (("chaser.actuation='ideal'",), 'detumble needs chaser.actuation = "thrusters"'),
        (("detumble.plume_deg=89.0",), "none of the 12 thrusters of chaser 0 may fire at its port"),
        (
            ("target.mass_kg=60000.0", "target.inertia_kg_m2=[16.73e3,20.29e3,22.98e3]"),
            "timeline.1: stopping the stack of 6.007e+04 kg takes at least",
        ),
        (
            (
                "docking.ports.0.force_limit_N=0.05",
                "target.inertia_kg_m2=[16.73,20.29,22.98]",
            ),
            "docking.ports.0.force_limit_N: 0.05 N is less than the",
        ),
        (("target.inertia_products_kg_m2=[40.0,0.0,0.0]",), "too large for a body's inertia"),
        (
            ("target.inertia_products_kg_m2=[9.0,9.0,9.0]",),
            "no principal moment may exceed the sum",
        ),
    ],
)
def test_a_scenario_that_cannot_be_flown_is_refused(changes: tuple[str, ...], message: str) -> None:
    with pytest.raises(ScenarioError) as error:
        load_shipped("detumble", *changes)
    assert message in str(error.value)


@settings(deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_exact_states_give_the_exact_momentum_whatever_the_weights(seed: int) -> None:
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(3, 3))
    body = TargetBody(200.0, root @ root.T + np.eye(3), rng.normal(size=3))
    q = rotations.normalize(rng.normal(size=4))
    covariance = rng.normal(size=(12, 12))
    target = TargetState(
        0,
        rng.normal(size=3),
        rng.normal(size=3),
        q,
        rng.normal(size=3),
        covariance @ covariance.T,
        "tracking",
        1,
        (),
    )
    moving = BodyState(target.position_m, target.velocity_m_s, q, target.omega_rad_s)
    own = []
    for i in range(3):
        state = moving_with(moving, rng.normal(size=3), rotations.normalize(rng.normal(size=4)))
        fields = {
            name: vector(getattr(state, name))
            for name in Odometry.__struct_fields__
            if hasattr(state, name)
        }
        own.append(Odometry(chaser=i, **fields))
    found = observed_motion(body, target, own, (1e-6, 1e-6))
    exact = stack_motion(body, target.velocity_m_s, q, target.omega_rad_s)
    assert found.momentum == pytest.approx(exact.momentum, abs=1e-8)


def test_the_body_of_a_stack_is_as_uncertain_as_the_masses_of_its_chasers() -> None:
    """Ten per cent of a chaser's mass at a port 0.85 m from the middle move the common centre of
    mass by a centimetre.
    """
    scenario = stack_scenario(0, (0, 3), ("perception.name=statistical",))
    with StackMission(scenario, RenderedImages(scenario)) as mission:
        for _ in range(20):
            mission.step()
        estimator = mission.controller.estimator
        assert isinstance(estimator, JointEstimator)
        known = np.array(estimator.target.body_covariance)
    chaser, target = scenario.chaser.mass_kg, scenario.target.mass_kg
    expected = math.sqrt(2.0) * 0.1 * chaser * 0.85 / (target + 2.0 * chaser)
    assert math.sqrt(known[0, 0]) == pytest.approx(expected, rel=0.15)
