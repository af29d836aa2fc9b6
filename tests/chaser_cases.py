# SPDX-License-Identifier: Apache-2.0
"""Messages of a tick, and a chaser's core that takes them."""

from __future__ import annotations

from typing import Any

from chaserdock_agents.chaser.core import ChaserCore
from chaserdock_agents.chaser.outbox import ChaserOutputs
from chaserdock_protocol.fault_injection import LostMessage
from chaserdock_protocol.messages import DockingStatus, Odometry, Tick, WrenchCommand
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.topics import Topic
from chaserdock_protocol.transport import ReceivedMessage

ZERO = (0.0, 0.0, 0.0)


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


def lost(scenario: Scenario, tick: int) -> LostMessage:
    return LostMessage(tick, scenario.timing.tick_time_ns(tick))


def docking(scenario: Scenario, tick: int, latched: bool = False) -> DockingStatus:
    now_ns = scenario.timing.tick_time_ns(tick)
    return DockingStatus(
        tick=tick, sim_time_ns=now_ns, chaser=0, contact=latched, armed=latched, latched=latched
    )


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


def step(chaser: ChaserCore, topic: Topic, message: Any) -> ChaserOutputs:
    """Hand a chaser one message; return what follows."""
    place = str(chaser.number) if "{" in topic.key else None
    return chaser.step(ReceivedMessage(topic, place, message, 0))


def deliver(chaser: ChaserCore, topic: Topic, message: Any) -> list[tuple[Topic, Any]]:
    """Hand a chaser one message; return what it publishes, by topic."""
    return [(t, m) for t, _, m in step(chaser, topic, message).messages]
