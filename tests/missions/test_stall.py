# SPDX-License-Identifier: Apache-2.0
"""No endless waits: a lost message, a process that hangs, a world that dies, and messages of a
foreign publisher.
"""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh
from chaserdock_protocol import codec, topics
from chaserdock_protocol.messages import JoinRequest, MissionEnd, Tick, encoding_of
from chaserdock_protocol.mission.membership import Membership
from chaserdock_protocol.recording.log import read_log
from chaserdock_protocol.scenario import load_scenario
from chaserdock_protocol.transport import Link, Node
from chaserdock_protocol.transport.bounded_queue import BoundedQueue
from chaserdock_protocol.transport.zenoh_network import zenoh_config
from chaserdock_world.process import World
from harness import ROOT, SHORT, ByHand, sets

from chaserdock.launch.json_events import EventNotice, JsonLine
from chaserdock.launch.launcher import Fleet, never, open_hub, watch
from chaserdock.launch.progress import ProgressReporter, Show
from chaserdock.launch.status import observe
from chaserdock.simulation.mission import SimulatedFlight, simulate
from chaserdock.simulation.network import SimulatedHost

DRILL = (
    "duration_s=3.0",
    "timeline=[]",
    "success.docked=[]",
    "settling_s=1.0",
    "perception.name='statistical'",
    "camera.width_px=480",
    "camera.height_px=270",
)


open_tick = World._open_tick


def simulated(folder: Path, *overrides: str) -> SimulatedFlight:
    flight = simulate(ROOT / "scenarios" / "fault-drill.toml", folder, (*DRILL, *overrides))
    assert flight.crashes == {}
    return flight


def end_of(folder: Path) -> MissionEnd:
    return next(r.message for r in read_log(folder / "mission.mcap", [topics.END.key_of()]))


def test_process_that_hangs_ends_the_mission_with_its_name(tmp_path: Path) -> None:
    flight = simulated(
        tmp_path, "fault=[{kind='freeze',at_s=2.0,duration_s=900.0,process='chaser/1'}]"
    )
    end = end_of(tmp_path)
    assert not end.complete
    assert end.reason.startswith("stalled: no progress for 60 s in tick 20: ")
    assert "in tick 20: chaser/1 owes chaser/1/" in end.reason
    assert "(hangs or is cut off: silent for 6" in end.reason
    assert flight.statuses["world"] == 1
    assert flight.stalled == ("chaser/1",)


def test_message_lost_in_lockstep_ends_the_mission_with_who_owes_what(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lost_tick = 15
    key = topics.SIGHTING.key_of(2)

    def is_lost(item: Any) -> bool:
        if not isinstance(item, tuple) or item[2].key != key:
            return False
        sighting: Any = codec.decode(topics.SIGHTING.kind, item[2].payload)
        return sighting.tick == lost_tick

    new_queue = SimulatedHost.new_queue

    def overflowing_queue(self: SimulatedHost) -> BoundedQueue[Any]:
        made = new_queue(self)
        if self.name == "controller":
            put = made.put
            monkeypatch.setattr(
                made, "put", lambda item, size: not is_lost(item) and put(item, size)
            )
        return made

    monkeypatch.setattr(SimulatedHost, "new_queue", overflowing_queue)
    flight = simulated(tmp_path)
    reason = end_of(tmp_path).reason
    assert f"in tick {lost_tick}: " in reason
    assert f"controller owes controller/chaser/2/wrench (waits for {key})" in reason
    assert f"chaser/2 owes {key} (waits for controller/chaser/2/wrench)" in reason
    assert flight.statuses["world"] == 1
    assert flight.stalled == ()


def test_processes_notice_that_the_world_has_died_and_the_log_is_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def die(self: World, tick: int) -> None:
        if tick == 20:
            self._node.host.kill()
        open_tick(self, tick)

    monkeypatch.setattr(World, "_open_tick", die)
    flight = simulated(tmp_path)
    assert flight.stalled == ()
    assert flight.statuses.pop("world") is None
    assert set(flight.statuses.values()) == {1}
    assert "chaser/0: the world is gone: no presence of it for 60 s" in flight.output
    ticks = [r.message.tick for r in read_log(tmp_path / "mission.mcap", [topics.TICK.key_of()])]
    assert ticks[-1] == 19


def test_processes_notice_that_the_world_hangs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def hang(self: World, tick: int) -> None:
        if tick == 20:
            self._node.host.sleep(900.0)

    monkeypatch.setattr(
        World, "_open_tick", lambda self, tick: (hang(self, tick), open_tick(self, tick))
    )
    flight = simulated(tmp_path, "duration_s=20.0")
    assert flight.stalled == ("world",)
    assert set(flight.statuses.values()) == {1}


@contextmanager
def world_and_intruder(endpoint: str) -> Iterator[tuple[Node, Node]]:
    """Open a node that replies as the world does, and another one that may publish on the world's
    keys.
    """
    world, intruder = (Node("world", "world", Link("forged", (endpoint,))) for _ in range(2))
    try:
        mission = Membership(1, "forged", "lockstep", "{}", source=world.source)
        world.declare_queryable(
            topics.JOIN_KEY, JoinRequest, lambda request, reply: reply(mission.admit(request))
        )
        world.declare_liveliness()
        yield world, intruder
    finally:
        world.close()
        intruder.close()


def until(
    condition: Callable[[], Any], act: Callable[[], None] = lambda: None, timeout_s: float = 120.0
) -> None:
    """Wait until a condition holds, and call ``act`` ten times a second meanwhile."""
    deadline = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline
        act()
        time.sleep(0.1)


FORGED = MissionEnd(reason="forged end", complete=False)


def test_run_ignores_a_forged_end_and_names_its_publisher() -> None:
    hub, endpoint = open_hub("forged", 600_000)
    lines: list[JsonLine] = []
    reporter = ProgressReporter(
        load_scenario(ROOT / "scenarios" / "single.toml"), Show.json, lines.append
    )
    with world_and_intruder(endpoint) as (world, intruder), ThreadPoolExecutor(1) as thread:
        try:
            failure = thread.submit(watch, Fleet(), hub, reporter, never, 60.0)
            until(lambda: failure.done() or lines, lambda: intruder.publish(topics.END, FORGED))
            assert not failure.done()
            end = MissionEnd(reason="duration flown", complete=True)
            until(failure.done, lambda: world.publish(topics.END, end))
            assert failure.result() is None
        finally:
            world.publish(topics.END, MissionEnd(reason="the test ends", complete=True))
    hub.close()
    notices = [(line.what, line.detail) for line in lines if isinstance(line, EventNotice)]
    text = (
        f"session {intruder.source} publishes on world/end, which is the world's (session "
        f"{world.source}); ignored"
    )
    assert notices == [("foreign publisher", text)]


def test_status_ignores_a_forged_end(capsys: pytest.CaptureFixture[str]) -> None:
    hub, endpoint = open_hub("forged", 600_000)
    with world_and_intruder(endpoint) as (_, intruder), ThreadPoolExecutor(1) as thread:
        seen = thread.submit(observe, Link("forged", (endpoint,)), 3.0)
        until(seen.done, lambda: intruder.publish(topics.END, FORGED))
    hub.close()
    assert seen.result().alive == {"world"}
    assert seen.result().ended is None
    assert (
        f"status: foreign publisher: session {intruder.source} publishes on world/end"
        in capsys.readouterr().err
    )


def test_ring_buffer_gives_no_messages_of_foreign_publishers() -> None:
    hub, endpoint = open_hub("forged", 600_000)
    looker, foreign = Node("viewer", "viewer", Link("forged", (endpoint,))), []
    with world_and_intruder(endpoint) as (world, intruder):
        looker.expect_world(world.source, lambda key, source, _: foreign.append((key, source)))
        take, ticks = looker.subscribe_newest(topics.TICK, 4), list[int]()

        def publish() -> None:
            intruder.publish(topics.TICK, Tick(tick=5000, images=False, chasers=()))
            world.publish(topics.TICK, Tick(tick=1, images=False, chasers=()))
            ticks.extend(received.message.tick for received in take())

        until(lambda: foreign and ticks, publish)
    looker.close()
    hub.close()
    assert set(ticks) == {1}
    assert foreign == [("world/tick", intruder.source)]


@pytest.mark.slow
def test_foreign_messages_are_ignored_and_their_publisher_is_named(tmp_path: Path) -> None:
    by_hand = ByHand.at_free_port("foreign")
    try:
        changes = (*SHORT, "duration_s=60.0", "perception.name='statistical'")
        world = by_hand.start("world", "world", "two-chaser-tracking", *sets(*changes))
        by_hand.start("recorder", "record", "--by-run", "--out", str(tmp_path))
        by_hand.start("judge", "judge", str(tmp_path), "--live", "--timeout", "120")
        by_hand.start("controller", "controller")
        until(lambda: list(tmp_path.glob("*/mission.mcap")))
        (log,) = tmp_path.glob("*/mission.mcap")
        link = Link(by_hand.namespace, (by_hand.endpoint,))
        with zenoh.open(zenoh_config(link)) as session:
            intruder, number = str(session.zid()), itertools.count(5000)

            def forge() -> None:
                tick = Tick(
                    tick=next(number),
                    sim_time_ns=10**12,
                    images=True,
                    chasers=(0, 1),
                    controllers={"controller": "c"},
                )
                session.put(topics.TICK.key_of(), codec.encode(tick), encoding=encoding_of(Tick))
                if log.stat().st_size > 100_000:  # the mission flies
                    end = codec.encode(FORGED)
                    session.put(topics.END.key_of(), end, encoding=encoding_of(MissionEnd))

            # Before the mission begins and until it is over: a busy machine may know the intruder
            # late.
            forge()
            for i in range(2):
                by_hand.start(f"chaser/{i}", "chaser", str(i))
            until(lambda: world.poll() is not None, forge, 300.0)
        for name in ("world", "controller", "recorder", "chaser/0", "chaser/1", "judge"):
            status, output = by_hand.output_of(name)
            assert status == 0, f"{name}: {output}"
            if name != "world":
                own = (
                    "operator: foreign publisher "
                    if name == "judge"
                    else f"{name}: foreign publisher: "
                )
                # It is named once, by the key that was read first.
                assert f"{own}session {intruder} publishes on world/" in output
    finally:
        by_hand.end()
    records = list(read_log(log))
    assert max(r.message.tick for r in records) < 5000
    warnings = [r.message for r in records if getattr(r.message, "what", "") == "foreign publisher"]
    assert {w.process for w in warnings} == {"controller", "recorder", "chaser/0", "chaser/1"}
