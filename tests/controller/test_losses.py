# SPDX-License-Identifier: Apache-2.0
"""What each process does about a message that has been lost on its way, in lock-step: the tick is answered."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import msgspec
import pytest
from chaserdock_agents.chaser.process import Chaser
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.process import Controller
from chaserdock_protocol import topics
from chaserdock_protocol.fault_injection import LostMessage
from chaserdock_protocol.messages import Image, Message, Odometry, Sighting, Tick, WrenchCommand
from chaserdock_protocol.replay_node import ReplayNode, SilentHeartbeat
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_protocol.topics import Topic
from chaserdock_protocol.transport import ReceivedMessage

ROOT = Path(__file__).resolve().parents[2]
ZERO = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario(ROOT / "scenarios" / "fault-drill.toml")


def odometry(scenario: Scenario, i: int, tick: int) -> Odometry:
    position, q = scenario.start_pose(i)
    return Odometry(
        tick=tick,
        sim_time_ns=scenario.timing.tick_time_ns(tick),
        chaser=i,
        position_m=tuple(position.tolist()),
        q_wxyz=tuple(q.tolist()),
        velocity_m_s=ZERO,
        omega_rad_s=ZERO,
    )


def tick_of(scenario: Scenario, tick: int, chasers: tuple[int, ...]) -> Tick:
    return Tick(
        tick=tick,
        sim_time_ns=scenario.timing.tick_time_ns(tick),
        images=True,
        chasers=chasers,
        controller=True,
    )


def tell(process: Any, topic: Topic, place: int | None, message: Any) -> list[tuple[Topic, Any]]:
    """Hands a process one message; what it says to that."""
    process.node.put(ReceivedMessage(topic, None if place is None else str(place), message, 0))
    process.listen()
    return [(t, m) for t, _, m in process.node.take_published()]


def lost(scenario: Scenario, tick: int) -> LostMessage:
    return LostMessage(tick, scenario.timing.tick_time_ns(tick))


# -- chaser -------------------------------------------------------------------------------------------------


@pytest.fixture
def chaser(scenario: Scenario) -> Chaser:
    made = Chaser(ReplayNode("chaser/0"), scenario, 0)  # type: ignore[arg-type]
    made.heartbeat = SilentHeartbeat()  # type: ignore[assignment]
    return made


def wrench(scenario: Scenario, tick: int, **values: Any) -> WrenchCommand:
    now_ns = scenario.timing.tick_time_ns(tick)
    given = {"mode": "nmpc", "force_N": (0.1, 0.0, 0.0), "torque_N_m": ZERO} | values
    return WrenchCommand(
        tick=tick,
        sim_time_ns=now_ns,
        chaser=0,
        effective_time_ns=scenario.timing.effective_ns(tick),
        expires_ns=now_ns + 500_000_000,
        **given,
    )


def actuated(said: list[tuple[Topic, Any]]) -> list[tuple[int, str]]:
    return [(m.tick, m.source) for t, m in said if t is topics.ACTUATORS]


@pytest.mark.parametrize("order", [(0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)])
@pytest.mark.parametrize("how", ["lost", "none", "expired"])
def test_a_chaser_without_its_command_answers_once(
    chaser: Chaser, scenario: Scenario, order: tuple[int, ...], how: str
) -> None:
    """In whatever order tick, odometry and the loss reach it."""
    commands = {
        "lost": lost(scenario, 1),
        "none": wrench(scenario, 1, mode="none"),
        "expired": msgspec.structs.replace(wrench(scenario, 1), expires_ns=0),
    }
    come = [
        (topics.TICK, None, tick_of(scenario, 1, (0,))),
        (topics.ODOMETRY, 0, odometry(scenario, 0, 1)),
        (topics.WRENCH, 0, commands[how]),
    ]
    said = [s for k in order for s in tell(chaser, *come[k])]
    assert [tick for tick, source in actuated(said)] == [1]
    assert [source for tick, source in actuated(said)] != ["command"]
    assert any(t is topics.EVENT for t, _ in said)


def test_a_lost_image_is_no_sighting_and_is_told(chaser: Chaser, scenario: Scenario) -> None:
    ((topic, sighting),) = tell(chaser, topics.IMAGE, 0, lost(scenario, 4))
    assert topic is topics.SIGHTING
    assert (sighting.tick, sighting.status, sighting.solutions) == (4, "bad_image", ())


def test_a_image_twice_is_looked_at_once(chaser: Chaser, scenario: Scenario) -> None:
    image = Image(tick=3, chaser=0, width_px=8, height_px=8, encoding="mono8", data=bytes(64))
    first = [m for t, m in tell(chaser, topics.IMAGE, 0, image) if t is topics.SIGHTING]
    assert len(first) == 1
    assert tell(chaser, topics.IMAGE, 0, image) == []
    assert chaser.node.counts.stale == 1


def test_lost_odometry_is_reckoned_and_not_braked_by_for_long(chaser: Chaser, scenario: Scenario) -> None:
    moving = msgspec.structs.replace(odometry(scenario, 0, 0), velocity_m_s=(0.5, 0.0, 0.0))
    tell(chaser, topics.ODOMETRY, 0, moving)
    forces = {}
    for tick in range(1, 9):
        tell(chaser, topics.TICK, None, tick_of(scenario, tick, (0,)))
        said = tell(chaser, topics.ODOMETRY, 0, lost(scenario, tick))
        said += tell(chaser, topics.WRENCH, 0, lost(scenario, tick))
        (command,) = [m for t, m in said if t is topics.ACTUATORS]
        forces[tick] = command.force_N
        assert chaser.odometry is not None
        assert chaser.odometry.tick == tick
    reckoned = chaser.odometry
    assert reckoned is not None
    assert abs(reckoned.position_m[0] - moving.position_m[0] - 0.5 * 0.8) < 1e-9
    assert any(forces[3])
    assert not any(forces[8])  # 0.8 s without knowing its own motion: it gives nothing


def test_older_odometry_does_not_take_the_newers_place(chaser: Chaser, scenario: Scenario) -> None:
    for tick in (2, 1):
        tell(chaser, topics.ODOMETRY, 0, odometry(scenario, 0, tick))
    assert chaser.odometry is not None
    assert chaser.odometry.tick == 2


# -- controller ---------------------------------------------------------------------------------------------


@pytest.fixture
def controller(scenario: Scenario) -> Controller:
    made = Controller(ReplayNode("controller"), scenario, ControllerCore(scenario, lambda: 0.0))  # type: ignore[arg-type]
    made.heartbeat = SilentHeartbeat()  # type: ignore[assignment]
    return made


def sighting(scenario: Scenario, i: int, tick: int) -> Sighting:
    return Sighting(
        tick=tick,
        sim_time_ns=scenario.timing.tick_time_ns(tick),
        chaser=i,
        status="nothing",
        solutions=(),
        marker_ids=(),
        corners_px=(),
        rejected_ids=(),
    )


def flown_tick(
    controller: Controller, scenario: Scenario, tick: int, without: dict[Topic, set[int]], chasers: int = 2
) -> dict[int, WrenchCommand]:
    """A tick of which some messages are lost; the commands by chaser."""
    said = tell(controller, topics.TICK, None, tick_of(scenario, tick, tuple(range(chasers))))
    makers: dict[Topic, Any] = {topics.ODOMETRY: odometry, topics.SIGHTING: sighting}
    for topic, make in makers.items():
        for i in range(chasers):
            gone = i in without.get(topic, set())
            message: Message | LostMessage = lost(scenario, tick) if gone else make(scenario, i, tick)
            said += tell(controller, topic, i, message)
    return {m.chaser: m for t, m in said if t is topics.WRENCH}


def test_a_tick_is_worked_out_without_what_was_lost(controller: Controller, scenario: Scenario) -> None:
    assert set(flown_tick(controller, scenario, 1, {})) == {0, 1}
    without = flown_tick(controller, scenario, 2, {topics.SIGHTING: {0, 1}})
    assert "none" not in {c.mode for c in without.values()}
    reckoned = flown_tick(controller, scenario, 3, {topics.ODOMETRY: {1}})
    assert {i: c.mode == "none" for i, c in reckoned.items()} == {0: False, 1: False}


def test_who_has_not_been_heard_of_for_long_gets_no_command(
    controller: Controller, scenario: Scenario
) -> None:
    flown_tick(controller, scenario, 1, {})
    modes = [flown_tick(controller, scenario, k, {topics.ODOMETRY: {1}})[1].mode for k in range(2, 10)]
    assert [mode == "none" for mode in modes] == [False] * 5 + [True] * 3  # a command's lifetime is 0.5 s
    assert flown_tick(controller, scenario, 10, {})[1].mode != "none"


def test_odometry_that_never_came_is_no_command_either(controller: Controller, scenario: Scenario) -> None:
    assert flown_tick(controller, scenario, 1, {topics.ODOMETRY: {1}})[1].mode == "none"


def test_no_tick_is_worked_out_before_its_loss_is_known(controller: Controller, scenario: Scenario) -> None:
    tell(controller, topics.TICK, None, tick_of(scenario, 1, (0,)))
    tell(controller, topics.ODOMETRY, 0, odometry(scenario, 0, 1))
    assert controller.done_tick == -1
    tell(controller, topics.SIGHTING, 0, lost(scenario, 1))
    assert controller.done_tick == 1


class Clock:
    """Wall time, set by hand (s)."""

    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def in_real_time(scenario: Scenario) -> tuple[Controller, Clock]:
    """A controller that waits for the sightings of tick 1."""
    clock = Clock()
    flight = ControllerCore(scenario, lambda: 0.0)
    made = Controller(ReplayNode("controller"), scenario, flight, realtime=True, now_s=clock)  # type: ignore[arg-type]
    made.heartbeat = SilentHeartbeat()  # type: ignore[assignment]
    tell(made, topics.TICK, None, tick_of(scenario, 1, (0, 1)))
    for i in (0, 1):
        tell(made, topics.ODOMETRY, i, odometry(scenario, i, 1))
    return made, clock


def test_in_real_time_a_tick_waits_for_its_sightings_and_not_for_ever(scenario: Scenario) -> None:
    controller, clock = in_real_time(scenario)
    said = tell(controller, topics.SIGHTING, 0, sighting(scenario, 0, 1))
    assert not [m for t, m in said if t is topics.WRENCH]
    clock.now_s = 0.9 / scenario.time.rate_hz
    controller.listen()  # nothing comes
    commands: list[Any] = [
        m for t, _, m in cast(ReplayNode, controller.node).take_published() if t is topics.WRENCH
    ]
    assert [(c.chaser, c.tick, c.mode != "none") for c in commands] == [(0, 1, True), (1, 1, True)]
    # The sighting that is late belongs to the next tick's estimate, and makes no second command.
    said = tell(controller, topics.SIGHTING, 1, sighting(scenario, 1, 1))
    assert not [m for t, m in said if t is topics.WRENCH]


def test_in_real_time_the_next_ticks_odometry_does_not_cost_a_tick_its_commands(scenario: Scenario) -> None:
    controller, _ = in_real_time(scenario)
    said = tell(controller, topics.ODOMETRY, 0, odometry(scenario, 0, 2))
    commands = [m for t, m in said if t is topics.WRENCH]
    assert [(c.chaser, c.tick, c.mode != "none") for c in commands] == [(0, 1, True), (1, 1, True)]
