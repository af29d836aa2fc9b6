# SPDX-License-Identifier: Apache-2.0
"""Scheduler and network of the simulation: order, determinism, and what conditions do to
messages.
"""

from __future__ import annotations

import itertools
import queue
from collections.abc import Callable
from typing import Any

import pytest
from chaserdock_protocol import topics
from chaserdock_protocol.messages import RecorderAck, Tick
from chaserdock_protocol.scenario.simulation import SimulationSection
from chaserdock_protocol.transport import Link, Node
from message_samples import BY_TYPE

from chaserdock.simulation import scheduler as scheduler_module
from chaserdock.simulation.network import LEASE_S, SimulatedNetwork, matches
from chaserdock.simulation.scheduler import Killed, Scheduler, VirtualQueue


def flown(*works: Callable[[Scheduler], Any], seed: int = 0, limit_s: float = 100.0) -> Scheduler:
    """Runs tasks to their end."""
    scheduler = Scheduler(seed)
    tasks = [scheduler.spawn(str(k), lambda w=work: w(scheduler)) for k, work in enumerate(works)]
    scheduler.run(limit_s)
    scheduler.end()
    for task in tasks:
        assert not task.error, task.error
    return scheduler


def test_virtual_time_passes_only_while_all_wait() -> None:
    seen: list[tuple[str, float]] = []

    def sleeper(name: str, *durations_s: float) -> Callable[[Scheduler], None]:
        def work(scheduler: Scheduler) -> None:
            for duration_s in durations_s:
                scheduler.pause(duration_s)
                seen.append((name, scheduler.now_s))

        return work

    assert flown(sleeper("a", 1.0, 3.0), sleeper("b", 2.5)).now_s == 4.0
    assert seen == [("a", 1.0), ("b", 2.5), ("a", 4.0)]


def test_queue_wakes_its_reader_and_times_out() -> None:
    got: list[tuple[float, Any]] = []

    def reader(scheduler: Scheduler) -> None:
        items = VirtualQueue(scheduler, lambda: None)
        scheduler.call_at(2.0, items.put, args=("late", 4))
        with pytest.raises(queue.Empty):
            items.get(0.5)
        got.append((scheduler.now_s, None))
        got.append((scheduler.now_s, items.get(5.0)))
        got.append((scheduler.now_s, items.empty()))

    assert flown(reader).now_s == 2.0
    assert got == [(0.5, None), (0.5, "late"), (2.0, True)]


def test_equal_seeds_repeat_the_interleaving_and_others_differ() -> None:
    def order(seed: int) -> list[int]:
        seen: list[int] = []
        flown(*(lambda s, k=k: (s.pause(1.0), seen.append(k)) for k in range(8)), seed=seed)
        return seen

    assert order(1) == order(1)
    assert len({tuple(order(seed)) for seed in range(10)}) > 5


def test_killed_and_failing_tasks_end_without_the_others() -> None:
    def fail() -> None:
        raise ValueError("broken")

    def killed() -> None:
        raise Killed

    scheduler = Scheduler(0)
    failing, dying = scheduler.spawn("failing", fail), scheduler.spawn("dying", killed)
    healthy = scheduler.spawn("healthy", lambda: scheduler.pause(1.0) or 7)
    assert scheduler.run(10.0)
    assert "ValueError: broken" in failing.error
    assert dying.killed
    assert not dying.error
    assert healthy.result == 7


def test_a_run_that_never_ends_is_stopped() -> None:
    scheduler = Scheduler(0)

    def forever() -> None:
        while True:
            scheduler.pause(1.0)

    task = scheduler.spawn("forever", forever)
    assert not scheduler.run(10.0)
    scheduler.end()
    assert task.done
    assert not task.error


def test_a_task_that_never_waits_for_a_later_time_is_stopped(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(scheduler_module, "MOST_EVENTS", 1000)
    scheduler = Scheduler(0)

    def forever() -> None:
        while True:
            scheduler.pause(0.0)

    scheduler.spawn("forever", forever)
    assert not scheduler.run(10.0)
    assert scheduler.now_s == 0.0
    scheduler.end()


def test_ticks_at_one_virtual_time_go_on(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without latency and jitter all ticks of a flight in lock-step have the same virtual time."""
    monkeypatch.setattr(scheduler_module, "MOST_EVENTS", 100)
    ended_s: list[float] = []

    def ticks(scheduler: Scheduler) -> None:
        network = SimulatedNetwork(scheduler, SimulationSection(), 0, True)
        world = Node("world", "world", Link(network=network))
        for _ in range(50):
            for _ in range(10):
                scheduler.pause(0.0)
            world.publish(topics.TICK, Tick(tick=0, sim_time_ns=0, images=False, chasers=()))
        ended_s.append(scheduler.now_s)

    flown(ticks)
    assert ended_s == [0.0]


@pytest.mark.parametrize("timeout_s", [1e-300, 1e-17, 1.7e-15])
def test_a_wait_below_the_resolution_of_virtual_time_passes(timeout_s: float) -> None:
    """The clock of a process may be finer than virtual time: with an offset of -30 s at 17.8 s it
    is.
    """

    def work(scheduler: Scheduler) -> None:
        scheduler.pause(17.8)
        begin_s = scheduler.now_s
        scheduler.pause(timeout_s)
        assert begin_s < scheduler.now_s < begin_s + 1e-14

    flown(work)


@pytest.mark.parametrize(
    ("expression", "key", "found"),
    [
        ("**", "world/tick", True),
        ("live/**", "live/chaser/0", True),
        ("world/chaser/*/image", "world/chaser/12/image", True),
        ("world/chaser/*/image", "world/chaser/1/2/image", False),
        ("**/presence", "chaser/0/presence", True),
        ("**/presence", "presence", True),
        ("world/tick", "world/ticks", False),
    ],
)
def test_key_expressions_match_as_in_zenoh(expression: str, key: str, found: bool) -> None:
    assert matches(expression, key) is found


# -- conditions ------------------------------------------------------------------------------------


TICK: Any = BY_TYPE[Tick]
HARSH: dict[str, Any] = {"loss": 0.1, "duplicate": 0.1, "reorder": 0.1, "jitter_s": 0.01}


def ack(tick: int) -> RecorderAck:
    return RecorderAck(tick=tick)


def arrivals(
    number: int = 200, mode: str = "realtime", seed: int = 1, **conditions: Any
) -> list[tuple[int, float]]:
    """Number and virtual time of the acknowledgements that the world receives of one every 10
    ms.
    """
    got: list[tuple[int, float]] = []

    def run(scheduler: Scheduler) -> None:
        section = SimulationSection.model_validate({"mode": mode, **conditions})
        network = SimulatedNetwork(scheduler, section, seed, mode == "lockstep")
        link = Link(network=network)
        world, recorder = Node("world", "world", link), Node("recorder", "recorder", link)
        world.blocking = recorder.blocking = mode == "lockstep"
        world.subscribe(topics.ACK)
        scheduler.pause(1.0)
        world.publish(topics.TICK, TICK)  # mission time begins
        for k in range(number):
            scheduler.call_at(
                scheduler.now_s + 0.01 * k, lambda k=k: recorder.publish(topics.ACK, ack(k))
            )
        begin_s = scheduler.now_s
        while (received := world.receive(5.0)) is not None:
            got.append((received.message.tick, scheduler.now_s - begin_s))

    flown(run)
    return got


def test_messages_of_a_link_stay_in_order_under_jitter() -> None:
    got = arrivals(latency_s=0.005, jitter_s=0.02)
    assert [tick for tick, _ in got] == list(range(200))
    delays = [at_s - 0.01 * tick for tick, at_s in got]
    assert min(delays) >= 0.005
    assert max(delays) > 0.04


def test_loss_duplication_and_overtaking_happen_at_their_shares() -> None:
    assert 120 < len(arrivals(loss=0.25)) < 180
    assert 230 < len(arrivals(duplicate=0.25)) < 270
    ticks = [tick for tick, _ in arrivals(reorder=0.25, latency_s=0.01)]
    assert sorted(ticks) == list(range(200))
    assert 15 < sum(a > b for a, b in itertools.pairwise(ticks)) < 85


def test_nothing_is_lost_or_reordered_in_lockstep() -> None:
    cut = {"at_s": 0.5, "duration_s": 1.0, "processes": ["world"]}
    got = arrivals(
        mode="lockstep", loss=0.5, duplicate=0.5, reorder=0.5, latency_s=0.01, partition=[cut]
    )
    assert [tick for tick, _ in got] == list(range(200))
    assert got[60][1] == pytest.approx(1.5, abs=0.02)


def test_partition_drops_what_may_be_lost() -> None:
    got = arrivals(partition=[{"at_s": 0.5, "duration_s": 1.0, "processes": ["world"]}])
    assert {tick for tick, _ in got}.isdisjoint(range(51, 150))
    assert len(got) == pytest.approx(100, abs=1)


def test_a_slow_reader_takes_its_time() -> None:
    slow = {"at_s": 0.0, "duration_s": 60.0, "process": "world", "each_s": 0.05}
    got = arrivals(number=50, slow=[slow])
    assert [tick for tick, _ in got] == list(range(50))
    assert got[-1][1] == pytest.approx(2.5, abs=0.1)


def test_equal_seeds_repeat_all_arrivals() -> None:
    assert arrivals(seed=3, **HARSH) == arrivals(seed=3, **HARSH)
    assert arrivals(seed=3, **HARSH) != arrivals(seed=4, **HARSH)


def test_a_partition_beyond_the_lease_ends_liveliness_and_its_end_restores_it() -> None:
    changes: list[tuple[float, str, bool]] = []

    def run(scheduler: Scheduler) -> None:
        cut = {"at_s": 1.0, "duration_s": 3.0, "processes": ["chaser/0"]}
        section = SimulationSection.model_validate({"mode": "realtime", "partition": [cut]})
        network = SimulatedNetwork(scheduler, section, 0, lockstep=False)
        world = Node("world", "world", Link(network=network))
        chaser = Node("chaser/0", "chaser", Link(network=network))
        world.watch_liveliness(lambda name, alive: changes.append((scheduler.now_s, name, alive)))
        chaser.declare_liveliness()
        scheduler.pause(1.0)
        world.publish(topics.TICK, TICK)
        scheduler.pause(10.0)
        chaser.close()
        scheduler.pause(1.0)

    flown(run)
    assert [(name, alive) for _, name, alive in changes] == [
        ("chaser/0", alive) for alive in (True, False) * 2
    ]
    assert changes[1][0] == pytest.approx(1.0 + 1.0 + LEASE_S)
    assert changes[2][0] == pytest.approx(1.0 + 4.0, abs=0.01)


def test_a_world_that_is_started_again_learns_who_lives_and_is_another_session() -> None:
    changes: list[tuple[str, bool]] = []
    sources: list[str] = []

    def run(scheduler: Scheduler) -> None:
        section = SimulationSection.model_validate({"mode": "realtime"})
        network = SimulatedNetwork(scheduler, section, 0, lockstep=False)
        chaser = Node("chaser/0", "chaser", Link(network=network))
        chaser.declare_liveliness()
        for _ in range(2):
            world = Node("world", "world", Link(network=network))
            sources.append(world.source)
            world.watch_liveliness(lambda name, alive: changes.append((name, alive)))
            scheduler.pause(1.0)
            world.close()
        chaser.close()

    flown(run)
    assert changes == [("chaser/0", True)] * 2
    assert len(set(sources)) == 2


def test_clocks_of_processes_differ_by_offset_and_drift() -> None:
    def run(scheduler: Scheduler) -> None:
        section = SimulationSection.model_validate(
            {"clock": [{"process": "world", "offset_s": 5.0, "drift": 0.02}]}
        )
        host = Node(
            "world", "world", Link(network=SimulatedNetwork(scheduler, section, 0, True))
        ).host
        begin_s = host.now_s()
        assert begin_s == 5.0
        host.sleep(1.02)
        assert host.now_s() == pytest.approx(6.02)
        assert scheduler.now_s == pytest.approx(1.0)

    flown(run)
