# SPDX-License-Identifier: Apache-2.0
"""Lost messages: chaser and controller complete the tick without them."""

from __future__ import annotations

from pathlib import Path
from typing import Any, cast

import msgspec
import pytest
from chaserdock_agents.chaser.process import ChaserProcess
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.estimation.joint import JointEstimator
from chaserdock_controller.ingest.tick_inputs import TickInputCollector
from chaserdock_controller.interfaces import TickInputs
from chaserdock_controller.process import ControllerProcess
from chaserdock_protocol import topics
from chaserdock_protocol.fault_injection import LostMessage
from chaserdock_protocol.messages import (
    DockingStatus,
    Image,
    Lease,
    Message,
    Odometry,
    Plan,
    Sighting,
    TargetEstimate,
    ThrusterReport,
    Tick,
    WrenchCommand,
)
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
        controllers={"controller": "c"},
    )


def deliver(process: Any, topic: Topic, place: int | None, message: Any) -> list[tuple[Topic, Any]]:
    """Hand a process one message; return what it publishes."""
    process.node.put(ReceivedMessage(topic, None if place is None else str(place), message, 0))
    process.listen()
    return [(t, m) for t, _, m in process.node.take_published()]


def lost(scenario: Scenario, tick: int) -> LostMessage:
    return LostMessage(tick, scenario.timing.tick_time_ns(tick))


# -- chaser ----------------------------------------------------------------------------------------


@pytest.fixture
def chaser(scenario: Scenario) -> ChaserProcess:
    made = ChaserProcess(ReplayNode("chaser/0"), scenario, 0)  # type: ignore[arg-type]
    made.heartbeat = SilentHeartbeat()  # type: ignore[assignment]
    return made


def wrench(scenario: Scenario, tick: int, **values: Any) -> WrenchCommand:
    now_ns = scenario.timing.tick_time_ns(tick)
    given = {
        "commander": "controller",
        "instance": "c",
        "term": 1,
        "mode": "nmpc",
        "force_N": (0.1, 0.0, 0.0),
        "torque_N_m": ZERO,
    } | values
    return WrenchCommand(
        tick=tick,
        sim_time_ns=now_ns,
        chaser=0,
        effective_time_ns=scenario.timing.effective_ns(tick),
        expires_ns=now_ns + 500_000_000,
        **given,
    )


def actuated(published: list[tuple[Topic, Any]]) -> list[tuple[int, str]]:
    return [(m.tick, m.source) for t, m in published if t is topics.ACTUATORS]


@pytest.mark.parametrize(
    ("how", "order"),
    [
        # A controller commands a tick after the chaser has stated its lease, and so has received
        # the tick.
        *(
            (how, order)
            for how in ("lost", "none", "expired")
            for order in ((0, 1, 2), (0, 2, 1), (1, 0, 2))
        ),
        *(("lost", order) for order in ((1, 2, 0), (2, 0, 1), (2, 1, 0))),
    ],
)
def test_chaser_without_command_actuates_once_per_tick(
    chaser: ChaserProcess, scenario: Scenario, order: tuple[int, ...], how: str
) -> None:
    """Tick, odometry and the lost command arrive in any order."""
    commands = {
        "lost": lost(scenario, 1),
        "none": wrench(scenario, 1, mode="none"),
        "expired": msgspec.structs.replace(wrench(scenario, 1), expires_ns=0),
    }
    arrivals = [
        (topics.TICK, None, tick_of(scenario, 1, (0,))),
        (topics.ODOMETRY, 0, odometry(scenario, 0, 1)),
        (topics.WRENCH, 0, commands[how]),
    ]
    published = [s for k in order for s in deliver(chaser, *arrivals[k])]
    assert [tick for tick, source in actuated(published)] == [1]
    assert [source for tick, source in actuated(published)] != ["command"]
    assert any(t is topics.EVENT for t, _ in published)


@pytest.mark.parametrize(
    ("ahead_s", "source"), [(0.3, "command"), (-0.3, "command"), (36.0, "hold")]
)
def test_wrong_clock_of_a_controller_delays_no_command(
    chaser: ChaserProcess, scenario: Scenario, ahead_s: float, source: str
) -> None:
    """Commands act at the time of their tick; the thrusters of a chaser that took 36 s for it did
    not open until then.
    """
    sent = wrench(scenario, 1)
    ahead_ns = round(ahead_s * 1e9)
    stamps = ("sim_time_ns", "effective_time_ns", "expires_ns")
    sent = msgspec.structs.replace(
        sent, **{name: getattr(sent, name) + ahead_ns for name in stamps}
    )
    published = deliver(chaser, topics.TICK, None, tick_of(scenario, 1, (0,)))
    published += deliver(chaser, topics.ODOMETRY, 0, odometry(scenario, 0, 1))
    published += deliver(chaser, topics.WRENCH, 0, sent)
    effective_ns = scenario.timing.effective_ns(1)
    found = [(m.source, m.effective_time_ns) for t, m in published if t is topics.ACTUATORS]
    assert found == [(source, effective_ns)]


def test_older_tick_changes_no_lease(chaser: ChaserProcess, scenario: Scenario) -> None:
    deliver(chaser, topics.TICK, None, tick_of(scenario, 9, (0,)))
    repeated = msgspec.structs.replace(tick_of(scenario, 9, (0,)), revision=1)
    assert [
        m.revision for t, m in deliver(chaser, topics.TICK, None, repeated) if t is topics.LEASE
    ] == [1]
    others = {"controllers": {"standby": "s"}}
    for older in (tick_of(scenario, 8, (0,)), tick_of(scenario, 9, (0,))):
        assert deliver(chaser, topics.TICK, None, msgspec.structs.replace(older, **others)) == []
    assert (chaser.tick, chaser.leases.holder) == (repeated, "controller")


def test_lost_image_gives_empty_sighting(chaser: ChaserProcess, scenario: Scenario) -> None:
    ((topic, sighting),) = deliver(chaser, topics.IMAGE, 0, lost(scenario, 4))
    assert topic is topics.SIGHTING
    assert (sighting.tick, sighting.status, sighting.solutions) == (4, "bad_image", ())


def test_duplicate_image_is_ignored(chaser: ChaserProcess, scenario: Scenario) -> None:
    image = Image(tick=3, chaser=0, width_px=8, height_px=8, encoding="mono8", data=bytes(64))
    first = [m for t, m in deliver(chaser, topics.IMAGE, 0, image) if t is topics.SIGHTING]
    assert len(first) == 1
    assert deliver(chaser, topics.IMAGE, 0, image) == []
    assert chaser.node.counts.stale == 1


def test_lost_odometry_is_extrapolated_and_braking_ends(
    chaser: ChaserProcess, scenario: Scenario
) -> None:
    moving = msgspec.structs.replace(odometry(scenario, 0, 0), velocity_m_s=(0.5, 0.0, 0.0))
    deliver(chaser, topics.ODOMETRY, 0, moving)
    forces = {}
    for tick in range(1, 9):
        deliver(chaser, topics.TICK, None, tick_of(scenario, tick, (0,)))
        published = deliver(chaser, topics.ODOMETRY, 0, lost(scenario, tick))
        published += deliver(chaser, topics.WRENCH, 0, lost(scenario, tick))
        (command,) = [m for t, m in published if t is topics.ACTUATORS]
        forces[tick] = command.force_N
        assert chaser.odometry is not None
        assert chaser.odometry.tick == tick
    extrapolated = chaser.odometry
    assert extrapolated is not None
    assert abs(extrapolated.position_m[0] - moving.position_m[0] - 0.5 * 0.8) < 1e-9
    assert any(forces[3])
    assert not any(forces[8])  # 0.8 s without odometry: no force


def test_older_odometry_does_not_replace_newer(chaser: ChaserProcess, scenario: Scenario) -> None:
    for tick in (2, 1):
        deliver(chaser, topics.ODOMETRY, 0, odometry(scenario, 0, tick))
    assert chaser.odometry is not None
    assert chaser.odometry.tick == 2


def target_estimate(scenario: Scenario, tick: int) -> TargetEstimate:
    return TargetEstimate(
        tick=tick,
        sim_time_ns=scenario.timing.tick_time_ns(tick),
        status="tracking",
        position_m=ZERO,
        velocity_m_s=ZERO,
        q_wxyz=(1.0, 0.0, 0.0, 0.0),
        omega_rad_s=ZERO,
        covariance=(0.0,) * 144,
        accepted=(),
        rejected=(),
    )


def plan(scenario: Scenario, tick: int) -> Plan:
    now_ns = scenario.timing.tick_time_ns(tick)
    empty: Any = {"positions_m": (), "quaternions_wxyz": (), "inputs": ()}
    return Plan(tick=tick, sim_time_ns=now_ns, chaser=0, step_s=0.1, **empty)


def test_older_plan_and_target_do_not_replace_newer(
    chaser: ChaserProcess, scenario: Scenario
) -> None:
    """The command that they came with is flown with them, and the fallback goes on from there."""
    deliver(chaser, topics.TICK, None, tick_of(scenario, 2, (0,)))
    deliver(chaser, topics.ODOMETRY, 0, odometry(scenario, 0, 2))
    for tick in (2, 1):
        deliver(chaser, topics.PLAN, 0, plan(scenario, tick))
        deliver(chaser, topics.TARGET, None, target_estimate(scenario, tick))
    deliver(chaser, topics.WRENCH, 0, wrench(scenario, 2))
    assert chaser._last.plan is not None
    assert chaser._last.target is not None
    assert (chaser._last.plan.tick, chaser._last.target.tick) == (2, 2)
    assert chaser.node.counts.stale == 2


# -- docking sensors and thrusters -----------------------------------------------------------------


@pytest.fixture(scope="module")
def capture() -> Scenario:
    return load_scenario(ROOT / "scenarios" / "docking-contact.toml")


def docking(scenario: Scenario, tick: int, latched: bool = False) -> DockingStatus:
    now_ns = scenario.timing.tick_time_ns(tick)
    return DockingStatus(
        tick=tick, sim_time_ns=now_ns, chaser=0, contact=latched, armed=latched, latched=latched
    )


def at_port(capture: Scenario) -> ChaserProcess:
    made = ChaserProcess(ReplayNode("chaser/0"), capture, 0)  # type: ignore[arg-type]
    made.heartbeat = SilentHeartbeat()  # type: ignore[assignment]
    return made


def test_older_docking_status_does_not_replace_newer(capture: Scenario) -> None:
    """The report of the tick needs the status of that tick."""
    chaser = at_port(capture)
    deliver(chaser, topics.TICK, None, tick_of(capture, 2, (0,)))
    for tick, latched in ((2, True), (1, False)):
        deliver(chaser, topics.DOCKING, 0, docking(capture, tick, latched))
    published = deliver(chaser, topics.ODOMETRY, 0, odometry(capture, 0, 2))
    assert [m.tick for t, m in published if t is topics.THRUSTERS] == [2]
    assert chaser.docking is not None
    assert chaser.docking.latched
    assert chaser.node.counts.stale == 1


def test_late_docking_status_replaces_an_assumed_one(capture: Scenario) -> None:
    """In lock-step a late status arrives after the loss of newer ones."""
    chaser = at_port(capture)
    deliver(chaser, topics.DOCKING, 0, docking(capture, 1))
    deliver(chaser, topics.DOCKING, 0, lost(capture, 3))
    deliver(chaser, topics.DOCKING, 0, docking(capture, 2, latched=True))
    assert chaser.docking == msgspec.structs.replace(
        docking(capture, 3, latched=True), contact=False
    )


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
    assert taken.docking[0].latched
    assert taken.thrusters[0].tick == 2


# -- controller ------------------------------------------------------------------------------------


@pytest.fixture
def controller(scenario: Scenario) -> ControllerProcess:
    made = ControllerProcess(
        ReplayNode("controller"), scenario, ControllerCore(scenario, lambda: 0.0)
    )  # type: ignore[arg-type]
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
        assert set(taken.odometry) == {0, 1}
        assert [(s.chaser, s.tick) for s in taken.sightings] == [(0, tick), (1, tick)]
        assert {i: o.tick for i, o in taken.outdated.items()} == (
            {1: late.get(tick, 1)} if tick > 1 else {}
        )
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
    taken = TickInputs(1, now.sim_time_ns, {0: now}, (), outdated={0: invalid})
    observation = core.ingest.run(taken, core.output.history)
    assert (observation.odometry, observation.outdated, set(observation.invalid)) == ({}, {}, {0})


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
