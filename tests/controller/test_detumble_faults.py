# SPDX-License-Identifier: Apache-2.0
"""A stack that loses a latch, a chaser or a thruster while it is stopped ends safe, with a named
reason.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.guidance.activities.detumble import detumbling_of
from chaserdock_controller.guidance.detumble.control import StackTask
from chaserdock_controller.guidance.detumble.stack import StackMotion
from chaserdock_controller.guidance.stage import GuidanceStage
from chaserdock_controller.interfaces import TickInputs, TickOutputs
from chaserdock_controller.redundancy.checkpoint import Checkpoint, CheckpointError
from chaserdock_models import rotations
from chaserdock_protocol.messages import OperatorCommand
from chaserdock_protocol.scenario import flight_scenario
from flights.detumble_flights import StackMission, stack_scenario, with_load_limits
from flights.rigid_control import (
    ControlledStack,
    FlightEvents,
    fly_controlled,
    wrong_knowledge,
)

from chaserdock.experiments.perception import RenderedImages


@pytest.mark.slow
def test_a_latch_that_opens_frees_its_chaser_which_backs_out_along_its_axis() -> None:
    fault = "fault=[{kind='latch_open',process='chaser/1',at_s=2.5,duration_s=1.0}]"
    changes = [*wrong_knowledge(1), "truth.values=[]", "target.mass_kg=150.0", fault]
    mission = StackMission(
        stack_scenario(1, (0, 1, 3), changes), RenderedImages(stack_scenario(1, (0, 1, 3)))
    )
    while mission.time_s < 1.5:
        mission.step()
    mission.step(tuple(OperatorCommand(command="detumble", chaser=i) for i in range(3)))
    axis = np.array(mission.scenario.docking.ports[1].axis)
    places = []
    while mission.time_s < 6.0:
        record = mission.step()
        if record.outputs is not None and mission.phase(1) == "retreat":
            target, own = record.states["target"], record.states["chaser/1"]
            places.append(
                rotations.rotate_inverse(target.q_wxyz, own.position_m - target.position_m)
            )
    assert places
    moved = places[-1] - places[0]
    assert mission.retreats(1) == ["from detumble: the latch opened"]
    assert float(moved @ axis) > 0.01
    assert np.linalg.norm(moved - (moved @ axis) * axis) < 0.5 * float(moved @ axis)
    assert not mission.physics.latches["chaser/1"].latched
    # The other two, at opposite ports, go on.
    assert {mission.phase(0), mission.phase(2)} <= {"detumble", "stack_hold"}
    assert any(what == "the stack coasts while chaser 1 backs out" for _, _, what in mission.events)
    mission.close()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "expected"), [("stuck_off", "stuck off"), ("stuck_on", "stuck on")]
)
def test_a_stuck_thruster_is_found_on_the_stack_and_isolated(kind: str, expected: str) -> None:
    failure = f"thruster_failure=[{{chaser=0,thruster=2,at_s=1.0,kind='{kind}'}}]"
    flight = fly_controlled(stack_scenario(1, (0, 1, 2, 3), [*wrong_knowledge(1), failure]), 15.0)
    assert flight.time_s is not None
    assert (
        flight.failed
        == f"chaser 0: thruster 2 {expected}, seen in the motion of the stack, isolated"
    )


class WatchedMission(StackMission):
    """A mission that a second controller follows from ``follow`` on; ``outputs`` of both for every
    tick since.
    """

    follower: ControllerCore | None = None
    outputs: list[tuple[TickOutputs | None, TickOutputs]]

    def follow(self) -> None:
        """Let a standby join: it starts from the present state of the controller."""
        state = Checkpoint(self.controller, self._validations).save()
        self.follower, self.outputs = (
            ControllerCore(flight_scenario(self.scenario), lambda: 0.0),
            [],
        )
        Checkpoint(self.follower, self._validations).restore(state)

    def _control(self, inputs: TickInputs) -> TickOutputs | None:
        own = super()._control(inputs)
        if self.follower is not None:
            self.outputs.append((own, self.follower.step(inputs)))
        return own


@pytest.mark.slow
@pytest.mark.parametrize("joins_s", [1.9, 3.3])
def test_a_standby_that_joins_while_the_stack_is_stopped_commands_the_same(joins_s: float) -> None:
    """Also in the search for the first plan, while the stack coasts."""
    limits = "docking.ports.0.force_limit_N=3.0"
    scenario = stack_scenario(
        1, (0, 3), [*wrong_knowledge(1, 0.1, False), "detumble.plan_s=6", limits]
    )
    with WatchedMission(scenario, RenderedImages(scenario)) as mission:
        while mission.time_s < 1.5:
            mission.step()
        mission.step(tuple(OperatorCommand(command="detumble", chaser=i) for i in range(2)))
        while mission.time_s < joins_s:
            mission.step()
        planner = detumbling_of(mission.controller.guidance.activities).control.planner
        assert planner.active is not None
        assert planner.search is not None
        assert bool(planner.active.plan.thrusts_N.any()) == (joins_s > 2.5)
        mission.follow()
        while mission.time_s < 5.0:
            mission.step()
        assert mission.phase(0) == "detumble"
        fired = 0.0
        for own, other in mission.outputs:
            assert own is not None
            assert {i: w.thrusts_N for i, w in own.wrenches.items()} == {
                i: w.thrusts_N for i, w in other.wrenches.items()
            }
            assert own.stack == other.stack
            fired += sum(sum(w.thrusts_N) for w in own.wrenches.values())
        assert fired > 0.0
        state = Checkpoint(mission.controller, mission._validations).save()
    other = ControllerCore(flight_scenario(stack_scenario(1, (0, 3))), lambda: 0.0)
    with pytest.raises(CheckpointError, match="of another mission"):
        Checkpoint(other, mission._validations).restore(state)


def test_a_thruster_that_an_operator_restores_fires_again() -> None:
    flight = flight_scenario(stack_scenario(1, (0, 3), wrong_knowledge(1)))
    stage = GuidanceStage(flight)
    state = ControlledStack(stack_scenario(1, (0, 3), wrong_knowledge(1))).state()
    failed = replace(state, failed=frozenset({(0, 2), (0, 3), (1, 7)}))
    restore = OperatorCommand(command="restore", chaser=0, thruster=3)
    stage.chasers[0].thrusters.command(restore, 0.0)
    found = detumbling_of(stage.activities).with_trusted(failed)
    assert found is not None
    assert found.failed == {(0, 2), (1, 7)}


@pytest.mark.slow
def test_the_others_stop_the_stack_when_a_chaser_dies() -> None:
    flight = fly_controlled(
        stack_scenario(2, (0, 1, 2, 3), wrong_knowledge(2)),
        15.0,
        events=FlightEvents(loss=(1.0, 1)),
    )
    assert flight.time_s is not None
    assert flight.failed == ""


@pytest.mark.slow
def test_a_stack_of_sixteen_chasers_is_stopped() -> None:
    """Four at each of four faces, side by side. Their thrusters stop it within a few seconds."""
    four = stack_scenario(1, (0, 1, 2, 3), wrong_knowledge(1))
    ports, chasers = [], []
    for i in range(16):
        port, chaser = four.docking.ports[i % 4], four.chasers[i % 4]
        aside, up = ((-0.22, -0.22), (0.22, 0.22), (-0.22, 0.22), (0.22, -0.22))[i // 4]
        shift = np.array([-aside * port.axis[1], aside * port.axis[0], up])
        at_port = {"chaser": i, "position_m": tuple(np.add(port.position_m, shift).tolist())}
        ports.append(port.model_copy(update=at_port))
        place = np.add(chaser.position_m, shift).tolist()  # type: ignore[arg-type]
        chasers.append(chaser.model_copy(update={"position_m": tuple(place)}))
    docking = four.docking.model_copy(update={"ports": tuple(ports)})
    flight = fly_controlled(
        four.model_copy(
            update={
                "docking": docking,
                "chasers": tuple(chasers),
                # Side by side they are latched already: none has to wait for another.
                "limits": four.limits.model_copy(update={"min_distance_chasers_m": 0.3}),
            }
        ),
        5.0,
    )
    assert flight.time_s is not None
    assert flight.time_s < 4.0
    assert flight.least is not None
    assert flight.impulse_N_s < flight.least.impulse_N_s


@pytest.mark.slow
def test_a_stopped_stack_turns_to_its_commanded_attitude_and_keeps_it() -> None:
    q = rotations.exp(np.array([0.3, -0.2, 0.1]))
    scenario = stack_scenario(1, (0, 3), wrong_knowledge(1, share=0.1))
    start = np.array(scenario.target.q_wxyz)
    wanted = rotations.multiply(start, q)
    detumble = scenario.detumble.model_copy(
        update={"attitude_wxyz": tuple(wanted.tolist()), "slew_deg_s": 2.0}
    )
    still = scenario.target.model_copy(
        update={"omega_rad_s": (0.002, 0.0, -0.001), "velocity_m_s": (0.0, 0.002, 0.0)}
    )
    flight = scenario.model_copy(update={"detumble": detumble, "target": still})
    stack = ControlledStack(flight)
    hold(stack, 35.0)
    assert math.degrees(float(rotations.angle_between(stack.stack.q_wxyz, wanted))) < 0.8
    assert math.degrees(stack.stack.rates()[1]) < 0.1
    assert stack.stack.rates()[0] < 0.001


def test_no_port_exceeds_its_limits_in_any_physics_step() -> None:
    """Pulses of one carrier period do not last into the next one, in which others fire; with pulse
    scatter.
    """
    scenario = with_load_limits(stack_scenario(0, (0, 1, 2, 3), wrong_knowledge(0)), 2.5, 0.9)
    stack = ControlledStack(scenario)
    before, peaks = np.linalg.norm(stack.state().motion.momentum), np.zeros(2)
    for k in range(60):
        observation, estimation = stack.estimate()
        flown = stack.step(StackTask.STOP if k > 2 else None, observation, estimation)
        peaks = np.maximum(peaks, [flown.peak_force_N, flown.peak_torque_N_m])
    assert (peaks < [2.5, 0.9]).all()
    assert (peaks > [1.5, 0.6]).all()
    assert np.linalg.norm(stack.state().motion.momentum) < 0.75 * before


def test_a_stack_at_rest_is_stopped_again_before_it_exceeds_the_limits() -> None:
    """Where disturbances act, the estimate is late and the thrusters take time."""
    stack = ControlledStack(stack_scenario(1, (0, 3)))
    state, limit_rad_s = stack.state(), math.radians(0.05)
    for share, stopped, moves in ((0.35, True, False), (0.45, False, False), (0.7, False, True)):
        angular = state.body.inertia_kg_m2 @ (share * limit_rad_s * np.array([0.6, 0.0, 0.8]))
        at = replace(state, motion=StackMotion(np.zeros(3), angular))
        stack.control.reset()
        stack.control.follow(at)
        assert stack.control.is_stopped(at) == stopped
        assert stack.control.moves_again(at) == moves


def test_rest_is_judged_by_the_mean_motion_not_by_noise_of_single_ticks() -> None:
    """Noise of half of the limit in every tick; the stack itself turns at a fifth of it."""
    stack, rng = ControlledStack(stack_scenario(1, (0, 3))), np.random.default_rng(4)
    state, limit_rad_s = stack.state(), math.radians(0.05)
    single, mean = [], []
    for k in range(60):
        omega = limit_rad_s * (np.array([0.2, 0.0, 0.0]) + rng.normal(0.0, 0.3, 3))
        at = replace(state, motion=StackMotion(np.zeros(3), state.body.inertia_kg_m2 @ omega))
        stack.control.follow(at)
        if k >= 20:
            single.append(stack.control.share_of_limits(at) < 0.4)
            mean.append(stack.control.is_stopped(at))
            assert not stack.control.moves_again(at)
    assert sum(mean) > 0.8 * len(mean)
    assert sum(single) < 0.5 * len(single)


def hold(stack: ControlledStack, seconds: float) -> None:
    """Stop a stack for three seconds, then hold it."""
    rate_hz = stack.scenario.time.rate_hz
    for k in range(round(seconds * rate_hz)):
        observation, estimation = stack.estimate()
        stack.step(StackTask.STOP if k < 3 * rate_hz else StackTask.HOLD, observation, estimation)
