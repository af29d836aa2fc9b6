# SPDX-License-Identifier: Apache-2.0
"""Lost messages: the controller completes the tick without them."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import msgspec
import pytest
from chaser_cases import ZERO, docking, lost, odometry, tick_of
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.estimation.joint import JointEstimator
from chaserdock_controller.ingest.tick_inputs import TickInputCollector
from chaserdock_controller.process import ControllerProcess
from chaserdock_protocol import topics
from chaserdock_protocol.fault_injection import LostMessage
from chaserdock_protocol.messages import (
    Lease,
    Message,
    Sighting,
    ThrusterReport,
    WrenchCommand,
)
from chaserdock_protocol.replay_node import ReplayNode, SilentHeartbeat
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_protocol.topics import Topic
from chaserdock_protocol.transport import ReceivedMessage
from flight_cases import tick_inputs

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario(ROOT / "scenarios" / "fault-drill.toml")


def deliver(process: Any, topic: Topic, place: int | None, message: Any) -> list[tuple[Topic, Any]]:
    """Hand a process one message; return what it publishes."""
    process.node.put(ReceivedMessage(topic, None if place is None else str(place), message, 0))
    process.listen()
    return [(t, m) for t, _, m in process.node.take_published()]


@pytest.fixture(scope="module")
def capture() -> Scenario:
    return load_scenario(ROOT / "scenarios" / "docking-contact.toml")


def test_controller_keeps_the_newest_docking_status_and_thruster_report(capture: Scenario) -> None:
    """A tick is complete once both have arrived, whatever older messages follow."""
    inputs, tick = TickInputCollector(capture), tick_of(capture, 2, (0,))
    report = ThrusterReport(
        chaser=0,
        force_max_N=ZERO,
        torque_max_N_m=ZERO,
        coming_impulse_N_s=ZERO,
        coming_angular_impulse_N_m_s=ZERO,
        thrusters=(),
    )
    inputs.add_odometry(odometry(capture, 0, 2))
    inputs.add_sighting(sighting(capture, 0, 2))
    assert inputs.add_docking(docking(capture, 2, latched=True))
    assert inputs.add_thruster_report(msgspec.structs.replace(report, tick=2))
    assert not inputs.add_docking(docking(capture, 1))
    assert not inputs.add_thruster_report(msgspec.structs.replace(report, tick=1))
    assert inputs.is_complete(tick)
    taken = inputs.take(tick, ())
    own = taken.chasers[0]
    assert own.docking is not None
    assert own.docking.latched
    assert own.thrusters is not None
    assert own.thrusters.tick == 2


@pytest.fixture
def controller(scenario: Scenario) -> ControllerProcess:
    node: Any = ReplayNode("controller")
    made = ControllerProcess(node, scenario, ControllerCore(scenario, lambda: 0.0))
    made.heartbeat = SilentHeartbeat()  # type: ignore[assignment]
    made.standby.join("c")
    made.standby.update(tick_of(scenario, 0, (0, 1)))
    made.done_tick = 0
    return made


def lease(scenario: Scenario, i: int, tick: int) -> Lease:
    return Lease(
        tick=tick,
        sim_time_ns=scenario.timing.tick_time_ns(tick),
        chaser=i,
        holder="controller",
        instance="c",
        term=1,
        from_tick=0,
        until_tick=tick + 1,
    )


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


def run_tick(
    controller: ControllerProcess,
    scenario: Scenario,
    tick: int,
    without: dict[Topic, set[int]],
    chasers: int = 2,
) -> dict[int, WrenchCommand]:
    """Run a tick without some of its messages; return the commands by chaser."""
    published = deliver(
        controller, topics.TICK, None, tick_of(scenario, tick, tuple(range(chasers)))
    )
    makers: dict[Topic, Any] = {
        topics.LEASE: lease,
        topics.ODOMETRY: odometry,
        topics.SIGHTING: sighting,
    }
    for topic, make in makers.items():
        for i in range(chasers):
            missing = i in without.get(topic, set())
            message: Message | LostMessage = (
                lost(scenario, tick) if missing else make(scenario, i, tick)
            )
            published += deliver(controller, topic, i, message)
    return {m.chaser: m for t, m in published if t is topics.WRENCH}


def test_controller_commands_without_lost_odometry_or_sightings(
    controller: ControllerProcess, scenario: Scenario
) -> None:
    assert set(run_tick(controller, scenario, 1, {})) == {0, 1}
    without = run_tick(controller, scenario, 2, {topics.SIGHTING: {0, 1}})
    assert "none" not in {c.mode for c in without.values()}
    extrapolated = run_tick(controller, scenario, 3, {topics.ODOMETRY: {1}})
    assert {i: c.mode == "none" for i, c in extrapolated.items()} == {0: False, 1: False}


def test_extrapolated_odometry_is_no_measurement(scenario: Scenario) -> None:
    """In place of a lost odometry the controller takes its own prediction, and late odometry at its
    tick, whatever its time stamp is.

    What the chaser sees meanwhile is a measurement.
    """
    core, inputs, states = ControllerCore(scenario, lambda: 0.0), TickInputCollector(scenario), {}
    late = {4: 2, 5: 3}
    for tick in range(6):
        for i in (0, 1):
            if i == 0 or tick < 2:
                inputs.add_odometry(odometry(scenario, i, tick))
            else:
                inputs.add_lost(topics.ODOMETRY, i, tick)
            inputs.add_sighting(sighting(scenario, i, tick))
        if tick in late:
            behind = msgspec.structs.replace(odometry(scenario, 1, late[tick]), sim_time_ns=0)
            inputs.add_odometry(behind)
        taken = inputs.take(tick_of(scenario, tick, (0, 1)), ())
        assert [c.odometry is not None for c in taken.chasers[:2]] == [True, True]
        assert [(s.chaser, s.tick) for s in taken.sightings] == [(0, tick), (1, tick)]
        outdated = {c.chaser: c.outdated.tick for c in taken.chasers if c.outdated is not None}
        assert outdated == ({1: late.get(tick, 1)} if tick > 1 else {})
        core.step(taken)
        assert isinstance(core.estimator, JointEstimator)
        assert core.estimator.state is not None
        states[tick] = core.estimator.state.odometry_ns[1]
    assert states == {t: scenario.timing.tick_time_ns(late.get(t, min(t, 1))) for t in range(6)}


def test_sightings_are_taken_in_the_order_of_chasers(scenario: Scenario) -> None:
    """Two invalid sightings in a tick were reported in the order of their arrival, which differs
    from process to process.
    """
    inputs = TickInputCollector(scenario)
    for i, tick in ((1, 2), (0, 2), (1, 1), (0, 1)):
        inputs.add_sighting(sighting(scenario, i, tick))
    taken = inputs.take(tick_of(scenario, 2, (0, 1)), ())
    assert [(s.tick, s.chaser) for s in taken.sightings] == [(1, 0), (1, 1), (2, 0), (2, 1)]


def test_state_extrapolated_from_an_invalid_one_is_invalid(scenario: Scenario) -> None:
    core, now = ControllerCore(scenario, lambda: 0.0), odometry(scenario, 0, 1)
    invalid = msgspec.structs.replace(odometry(scenario, 0, 0), q_wxyz=(0.5, 0.0, 0.0, 0.0))
    taken = tick_inputs(1, now.sim_time_ns, {0: now}, (), outdated={0: invalid})
    seen = core.ingest.run(taken, core.output.sent).chasers[0]
    assert seen.invalid
    assert (seen.odometry, seen.outdated) == (None, None)


def test_chaser_without_recent_odometry_gets_no_command(
    controller: ControllerProcess, scenario: Scenario
) -> None:
    run_tick(controller, scenario, 1, {})
    modes = [
        run_tick(controller, scenario, k, {topics.ODOMETRY: {1}})[1].mode for k in range(2, 10)
    ]
    assert [mode == "none" for mode in modes] == [False] * 5 + [
        True
    ] * 3  # a command's lifetime is 0.5 s
    assert run_tick(controller, scenario, 10, {})[1].mode != "none"


def test_chaser_without_any_odometry_gets_no_command(
    controller: ControllerProcess, scenario: Scenario
) -> None:
    assert run_tick(controller, scenario, 1, {topics.ODOMETRY: {1}})[1].mode == "none"


def test_tick_waits_until_a_loss_is_known(
    controller: ControllerProcess, scenario: Scenario
) -> None:
    deliver(controller, topics.TICK, None, tick_of(scenario, 1, (0,)))
    deliver(controller, topics.ODOMETRY, 0, odometry(scenario, 0, 1))
    deliver(controller, topics.SIGHTING, 0, sighting(scenario, 0, 1))
    assert controller.done_tick == 0
    deliver(controller, topics.LEASE, 0, lost(scenario, 1))
    assert controller.done_tick == 1


def test_lease_that_contradicts_itself_counts_as_lost(
    controller: ControllerProcess, scenario: Scenario
) -> None:
    deliver(controller, topics.TICK, None, tick_of(scenario, 1, (0, 1)))
    damaged = msgspec.structs.replace(lease(scenario, 1, 1), holder="contRoller")
    deliver(controller, topics.LEASE, 1, damaged)
    assert controller.standby.leases.missing(tick_of(scenario, 1, (0, 1))) == [0]
    assert controller.node.counts.rejected["lease:contradictory"] == 1


def test_controller_without_a_majority_lets_the_others_wait(
    controller: ControllerProcess, scenario: Scenario
) -> None:
    commands = run_tick(controller, scenario, 1, {topics.LEASE: {0}})
    assert {i: c.mode for i, c in commands.items()} == {0: "wait", 1: "wait"}
    assert {c.mode for c in run_tick(controller, scenario, 2, {}).values()} != {"wait"}


class Clock:
    """Wall time, set by hand (s)."""

    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


def in_real_time(scenario: Scenario) -> tuple[ControllerProcess, Clock]:
    """Return a realtime controller that waits for the sightings of tick 1, and its clock."""
    clock = Clock()
    flight = ControllerCore(scenario, lambda: 0.0)
    made = ControllerProcess(ReplayNode("controller"), scenario, flight, realtime=True, now_s=clock)  # type: ignore[arg-type]
    made.heartbeat = SilentHeartbeat()  # type: ignore[assignment]
    made.standby.join("c")
    deliver(made, topics.TICK, None, tick_of(scenario, 1, (0, 1)))
    for i in (0, 1):
        deliver(made, topics.LEASE, i, lease(scenario, i, 1))
        deliver(made, topics.ODOMETRY, i, odometry(scenario, i, 1))
    return made, clock


def test_realtime_tick_waits_for_sightings_until_its_deadline(scenario: Scenario) -> None:
    controller, clock = in_real_time(scenario)
    published = deliver(controller, topics.SIGHTING, 0, sighting(scenario, 0, 1))
    assert not [m for t, m in published if t is topics.WRENCH]
    clock.now_s = 0.9 / scenario.time.rate_hz
    controller.listen()  # nothing arrives
    commands: list[Any] = [
        m for t, _, m in cast(ReplayNode, controller.node).take_published() if t is topics.WRENCH
    ]
    assert [(c.chaser, c.tick, c.mode != "none") for c in commands] == [(0, 1, True), (1, 1, True)]
    # A late sighting is used in the next tick and triggers no second command.
    published = deliver(controller, topics.SIGHTING, 1, sighting(scenario, 1, 1))
    assert not [m for t, m in published if t is topics.WRENCH]


def test_realtime_tick_is_completed_when_odometry_of_the_next_arrives(scenario: Scenario) -> None:
    controller, _ = in_real_time(scenario)
    published = deliver(controller, topics.ODOMETRY, 0, odometry(scenario, 0, 2))
    commands = [m for t, m in published if t is topics.WRENCH]
    assert [(c.chaser, c.tick, c.mode != "none") for c in commands] == [(0, 1, True), (1, 1, True)]
