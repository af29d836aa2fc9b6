# SPDX-License-Identifier: Apache-2.0
"""The lock-step barrier after processes were lost and have returned."""

from __future__ import annotations

from typing import Any
from unittest.mock import Mock

from chaserdock_protocol import topics
from chaserdock_protocol.messages import ActuatorCommand, Tick
from chaserdock_protocol.mission.command_intake import CommandIntake
from chaserdock_protocol.mission.tick_barrier import _MOST_REPEATS, TickBarrier
from chaserdock_protocol.scenario import load_scenario
from chaserdock_protocol.transport import ReceivedMessage
from chaserdock_protocol.transport.node import TrafficCounters
from harness import ROOT

TIMING = load_scenario(ROOT / "scenarios" / "fault-drill.toml").timing


class Network:
    """A node that receives ``received``; waiting takes its time. ``ticks``: those published."""

    def __init__(self) -> None:
        self.time_s, self.ticks = 0.0, list[Tick]()
        self.host = Mock(now_s=lambda: self.time_s)
        self.counts, self.received = TrafficCounters(), list[Any]()

    def receive(self, timeout_s: float) -> Any:
        self.time_s += timeout_s
        return self.received.pop(0) if self.received else None

    def publish(self, topic: topics.Topic, message: Any, place: Any = None) -> None:
        if topic is topics.TICK:
            self.ticks.append(message)


def barrier_of(network: Network, membership: Any, actuators: Any) -> TickBarrier:
    """Return the barrier of a mission with one chaser."""
    commands = CommandIntake(TIMING, {"chaser/0": actuators}, lambda: 0, Mock())
    node: Any = network
    return TickBarrier(node, membership, Mock(), TIMING, commands, recorder_expected=False)


def test_first_tick_after_a_return_is_repeated_until_it_is_answered() -> None:
    """The chasers state their leases again, which the network may have lost. Later ticks are not
    repeated.
    """
    network, connected = Network(), set[str]()
    membership: Any = Mock(realtime=False, connected=lambda heard: connected, take_departed=list)
    membership.progress = dict
    barrier = barrier_of(network, membership, Mock())
    barrier.open_tick(0, images=False)
    assert barrier.chasers == ()

    def returns() -> bool:
        connected.update({"chaser/0", "controller"} if network.time_s > 1.0 else ())
        return False

    assert not barrier.lost_all_chasers(30.0, returns)
    assert 1.0 < network.time_s < 2.0
    for tick, repeats in ((1, _MOST_REPEATS), (2, 0)):
        network.ticks.clear()
        barrier.open_tick(tick, images=False)
        begin_s = network.time_s
        assert "stalled" in barrier.await_replies(lambda: False, stall_s=10.0)
        assert [t.revision for t in network.ticks] == list(range(repeats + 1))
        assert network.time_s - begin_s < 20.0


def test_commands_of_a_replaced_chaser_are_rejected() -> None:
    """A chaser that was frozen and replaced may send a command before it reads that another one
    flies in its place.
    """
    network, chaser = Network(), Mock()
    membership: Any = Mock(realtime=True, connected=lambda heard: {"chaser/0"}, take_departed=list)
    membership.instance_of = lambda name: "second"
    barrier = barrier_of(network, membership, chaser)
    barrier.open_tick(0, images=False)
    assert network.ticks[-1].chaser_instances == {"chaser/0": "second"}
    for instance in ("first", "second"):
        command = ActuatorCommand(
            tick=0,
            sim_time_ns=0,
            chaser=0,
            effective_time_ns=TIMING.effective_ns(0),
            source="brake",
            force_N=(0.0, 0.0, 0.0),
            torque_N_m=(0.0, 0.0, 0.0),
            instance=instance,
        )
        network.received.append(ReceivedMessage(topics.ACTUATORS, "0", command, 0))
        barrier.process_message(0.1)
    assert [c.args[0].instance for c in chaser.command.call_args_list] == ["second"]
    assert network.counts.rejected == {"actuators:replaced": 1}
