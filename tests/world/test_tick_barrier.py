# SPDX-License-Identifier: Apache-2.0
"""The lock-step barrier after all processes were lost and have returned."""

from __future__ import annotations

from typing import Any
from unittest.mock import Mock

from chaserdock_protocol import topics
from chaserdock_protocol.messages import Tick
from chaserdock_protocol.scenario import load_scenario
from chaserdock_world.lockstep.tick_barrier import _MOST_REPEATS, TickBarrier
from harness import ROOT

TIMING = load_scenario(ROOT / "scenarios" / "fault-drill.toml").timing


class Network:
    """A node that receives nothing; waiting takes its time. ``ticks``: those published."""

    def __init__(self) -> None:
        self.time_s, self.ticks = 0.0, list[Tick]()
        self.host = Mock(now_s=lambda: self.time_s)

    def receive(self, timeout_s: float) -> None:
        self.time_s += timeout_s

    def publish(self, topic: topics.Topic, message: Any, place: Any = None) -> None:
        if topic is topics.TICK:
            self.ticks.append(message)


def test_first_tick_after_a_return_is_repeated_until_it_is_answered() -> None:
    """The chasers state their leases again, which the network may have lost. Later ticks are not repeated."""
    network, connected = Network(), set[str]()
    membership: Any = Mock(realtime=False, connected=lambda heard: connected, take_departed=list)
    membership.progress = dict
    arguments: list[Any] = [network, membership, Mock(), TIMING, {"chaser/0": Mock()}, lambda: 0, Mock()]
    barrier = TickBarrier(*arguments, recorder_expected=False)
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
