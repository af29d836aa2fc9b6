# SPDX-License-Identifier: Apache-2.0
"""A chaser handles lost, late and repeated messages, and replies to every tick once."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import pytest
from chaser_cases import ZERO, deliver, docking, lost, odometry, step, tick_of, wrench
from chaserdock_agents.chaser.core import ChaserCore
from chaserdock_agents.chaser.outbox import ChaserOutputs
from chaserdock_protocol import topics
from chaserdock_protocol.messages import Event, Image, Plan, TargetEstimate
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_protocol.topics import Topic
from chaserdock_protocol.transport import ReceivedMessage

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario(ROOT / "scenarios" / "fault-drill.toml")


@pytest.fixture(scope="module")
def capture() -> Scenario:
    return load_scenario(ROOT / "scenarios" / "docking-contact.toml")


@pytest.fixture
def chaser(scenario: Scenario) -> ChaserCore:
    return ChaserCore(scenario, 0)


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
    chaser: ChaserCore, scenario: Scenario, order: tuple[int, ...], how: str
) -> None:
    """Tick, odometry and the lost command arrive in any order."""
    commands = {
        "lost": lost(scenario, 1),
        "none": wrench(scenario, 1, mode="none"),
        "expired": msgspec.structs.replace(wrench(scenario, 1), expires_ns=0),
    }
    arrivals = [
        (topics.TICK, tick_of(scenario, 1, (0,))),
        (topics.ODOMETRY, odometry(scenario, 0, 1)),
        (topics.WRENCH, commands[how]),
    ]
    published = [s for k in order for s in deliver(chaser, *arrivals[k])]
    assert [tick for tick, source in actuated(published)] == [1]
    assert [source for tick, source in actuated(published)] != ["command"]
    assert any(t is topics.EVENT for t, _ in published)


@pytest.mark.parametrize(
    ("ahead_s", "source"), [(0.3, "command"), (-0.3, "command"), (36.0, "hold")]
)
def test_wrong_clock_of_a_controller_delays_no_command(
    chaser: ChaserCore, scenario: Scenario, ahead_s: float, source: str
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
    published = deliver(chaser, topics.TICK, tick_of(scenario, 1, (0,)))
    published += deliver(chaser, topics.ODOMETRY, odometry(scenario, 0, 1))
    published += deliver(chaser, topics.WRENCH, sent)
    effective_ns = scenario.timing.effective_ns(1)
    found = [(m.source, m.effective_time_ns) for t, m in published if t is topics.ACTUATORS]
    assert found == [(source, effective_ns)]


def test_older_tick_changes_no_lease(chaser: ChaserCore, scenario: Scenario) -> None:
    deliver(chaser, topics.TICK, tick_of(scenario, 9, (0,)))
    repeated = msgspec.structs.replace(tick_of(scenario, 9, (0,)), revision=1)
    assert [m.revision for t, m in deliver(chaser, topics.TICK, repeated) if t is topics.LEASE] == [
        1
    ]
    others = {"controllers": {"standby": "s"}}
    for older in (tick_of(scenario, 8, (0,)), tick_of(scenario, 9, (0,))):
        assert deliver(chaser, topics.TICK, msgspec.structs.replace(older, **others)) == []
    assert (chaser.inbox.tick, chaser.gate.leases.holder) == (repeated, "controller")


def test_lost_image_gives_empty_sighting(chaser: ChaserCore, scenario: Scenario) -> None:
    ((topic, sighting),) = deliver(chaser, topics.IMAGE, lost(scenario, 4))
    assert topic is topics.SIGHTING
    assert (sighting.tick, sighting.status, sighting.solutions) == (4, "bad_image", ())


def test_duplicate_image_is_ignored(chaser: ChaserCore, scenario: Scenario) -> None:
    image = Image(tick=3, chaser=0, width_px=8, height_px=8, encoding="mono8", data=bytes(64))
    first = [m for t, m in deliver(chaser, topics.IMAGE, image) if t is topics.SIGHTING]
    assert len(first) == 1
    assert step(chaser, topics.IMAGE, image) == ChaserOutputs(stale=True)


def test_lost_odometry_is_extrapolated_and_braking_ends(
    chaser: ChaserCore, scenario: Scenario
) -> None:
    moving = msgspec.structs.replace(odometry(scenario, 0, 0), velocity_m_s=(0.5, 0.0, 0.0))
    deliver(chaser, topics.ODOMETRY, moving)
    forces = {}
    for tick in range(1, 9):
        deliver(chaser, topics.TICK, tick_of(scenario, tick, (0,)))
        published = deliver(chaser, topics.ODOMETRY, lost(scenario, tick))
        published += deliver(chaser, topics.WRENCH, lost(scenario, tick))
        (command,) = [m for t, m in published if t is topics.ACTUATORS]
        forces[tick] = command.force_N
        assert chaser.inbox.odometry is not None
        assert chaser.inbox.odometry.tick == tick
    extrapolated = chaser.inbox.odometry
    assert extrapolated is not None
    assert abs(extrapolated.position_m[0] - moving.position_m[0] - 0.5 * 0.8) < 1e-9
    assert any(forces[3])
    assert not any(forces[8])  # 0.8 s without odometry: no force


def test_older_odometry_does_not_replace_newer(chaser: ChaserCore, scenario: Scenario) -> None:
    for tick in (2, 1):
        deliver(chaser, topics.ODOMETRY, odometry(scenario, 0, tick))
    assert chaser.inbox.odometry is not None
    assert chaser.inbox.odometry.tick == 2


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


def test_older_plan_and_target_do_not_replace_newer(chaser: ChaserCore, scenario: Scenario) -> None:
    """The command that they came with is flown with them, and the fallback goes on from there."""
    deliver(chaser, topics.TICK, tick_of(scenario, 2, (0,)))
    deliver(chaser, topics.ODOMETRY, odometry(scenario, 0, 2))
    for tick in (2, 1):
        taken = step(chaser, topics.PLAN, plan(scenario, tick))
        estimated = step(chaser, topics.TARGET, target_estimate(scenario, tick))
        assert taken.stale == estimated.stale == (tick == 1)
    deliver(chaser, topics.WRENCH, wrench(scenario, 2))
    last = chaser.fallback.last
    assert last.plan is not None
    assert last.target is not None
    assert (last.plan.tick, last.target.tick) == (2, 2)


# -- docking sensors and thrusters -----------------------------------------------------------------


def test_older_docking_status_does_not_replace_newer(capture: Scenario) -> None:
    """The report of the tick needs the status of that tick."""
    chaser = ChaserCore(capture, 0)
    deliver(chaser, topics.TICK, tick_of(capture, 2, (0,)))
    for tick, latched in ((2, True), (1, False)):
        taken = step(chaser, topics.DOCKING, docking(capture, tick, latched))
        assert taken.stale == (tick == 1)
    published = deliver(chaser, topics.ODOMETRY, odometry(capture, 0, 2))
    assert [m.tick for t, m in published if t is topics.THRUSTERS] == [2]
    assert chaser.inbox.latched


def test_late_docking_status_replaces_an_assumed_one(capture: Scenario) -> None:
    """In lock-step a late status arrives after the loss of newer ones."""
    chaser = ChaserCore(capture, 0)
    deliver(chaser, topics.DOCKING, docking(capture, 1))
    deliver(chaser, topics.DOCKING, lost(capture, 3))
    deliver(chaser, topics.DOCKING, docking(capture, 2, latched=True))
    assert chaser.inbox.docking == msgspec.structs.replace(
        docking(capture, 3, latched=True), contact=False
    )


# -- real time -------------------------------------------------------------------------------------


def test_fallback_begins_after_a_commands_lifetime_in_real_time(scenario: Scenario) -> None:
    """The lease is stated again at once, and a command that arrives later takes precedence."""
    chaser, lifetime_s = ChaserCore(scenario, 0, realtime=True), 0.5
    deliver(chaser, topics.TICK, tick_of(scenario, 1, (0,)))
    deliver(chaser, topics.ODOMETRY, odometry(scenario, 0, 1))
    published = deliver(chaser, topics.WRENCH, wrench(scenario, 1))
    assert [t for t, _ in published] == [topics.LEASE, topics.ACTUATORS]
    acted = {}
    for tick in range(2, 9):
        deliver(chaser, topics.TICK, tick_of(scenario, tick, (0,)))
        acted[tick] = actuated(deliver(chaser, topics.ODOMETRY, odometry(scenario, 0, tick)))
    silent_s = {tick: (tick - 1) / scenario.time.rate_hz for tick in acted}
    assert [bool(own) for own in acted.values()] == [s > lifetime_s for s in silent_s.values()]
    assert any(acted.values())
    assert chaser.gate.executed_tick == 1
    assert actuated(deliver(chaser, topics.WRENCH, wrench(scenario, 8))) == [(8, "command")]


def test_command_that_waited_beyond_its_lifetime_is_refused_in_real_time(
    scenario: Scenario,
) -> None:
    """Simulated time goes on by the host's clock while the process does not read its messages."""
    chaser = ChaserCore(scenario, 0, realtime=True)
    deliver(chaser, topics.TICK, tick_of(scenario, 1, (0,)))
    deliver(chaser, topics.ODOMETRY, odometry(scenario, 0, 1))
    received = ReceivedMessage(topics.WRENCH, "0", wrench(scenario, 1), 0)
    outputs = chaser.step(received, now_s=0.6)
    events = [m.what for _, _, m in outputs.messages if isinstance(m, Event)]
    assert events == ["command refused", "no command", "fallback: hold"]
    assert outputs.stale
