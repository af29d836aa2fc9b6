# SPDX-License-Identifier: Apache-2.0
"""The file by which a gateway takes a mission up again."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from chaserdock_agents.gateway.resume import (
    BegunMission,
    ResumeError,
    begun_mission,
    digest_of,
    forget_mission,
    note_mission,
)
from chaserdock_protocol import topics
from chaserdock_protocol.messages import JoinReply, JoinRequest
from chaserdock_protocol.mission.membership import Membership
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_protocol.scenario.simulation import SimulationSection
from chaserdock_protocol.transport import Link, Node
from chaserdock_protocol.transport.session import Heartbeat, watch_for_foreign_publishers
from harness import ROOT

from chaserdock.simulation.network import SimulatedNetwork
from chaserdock.simulation.scheduler import Scheduler


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario(ROOT / "scenarios" / "single.toml")


def test_what_was_noted_is_begun_until_it_is_forgotten(scenario: Scenario, tmp_path: Path) -> None:
    path = tmp_path / "begun.json"
    assert begun_mission(path, scenario, 10) is None
    begun = BegunMission(run_id="r1", start_ns=7, scenario=digest_of(scenario))
    note_mission(path, begun)
    assert begun_mission(path, scenario, 10) == begun
    assert list(tmp_path.iterdir()) == [path]
    forget_mission(path)
    forget_mission(path)
    assert begun_mission(path, scenario, 10) is None


def test_a_file_that_does_not_fit_is_named(scenario: Scenario, tmp_path: Path) -> None:
    path = tmp_path / "begun.json"
    note_mission(path, BegunMission(run_id="r1", start_ns=7, scenario=digest_of(scenario)))
    with pytest.raises(ResumeError, match=r"begun\.json: .* from before the last boot; remove it"):
        begun_mission(path, scenario, 6)
    other = load_scenario(ROOT / "scenarios" / "single.toml", ("duration_s=7.0",))
    with pytest.raises(ResumeError, match=r"a mission of another scenario; remove it to begin"):
        begun_mission(path, other, 10)
    path.write_text("{}")
    with pytest.raises(ResumeError, match=r"begun\.json: states no mission .*; remove it"):
        begun_mission(path, scenario, 10)
    with pytest.raises(ResumeError, match="cannot be read: Is a directory"):
        begun_mission(tmp_path, scenario, 10)


@pytest.mark.parametrize("resumed", [False, True])
def test_a_process_that_lives_joins_a_mission_only_if_that_goes_on(resumed: bool) -> None:
    membership = Membership(1, "r1", "realtime", "{}", resumed=resumed)
    membership.set_alive("chaser/0", True)
    reply = membership.admit(JoinRequest(process="chaser/0", instance="a"))
    assert reply is not None
    assert reply.accepted == resumed
    assert reply.reason == ("" if resumed else "chaser/0 is already running in this mission")


@pytest.mark.parametrize("run_id", ["r1", "another"])
def test_a_process_follows_only_a_world_that_takes_up_its_mission(run_id: str) -> None:
    followed: list[bool] = []

    def run(scheduler: Scheduler) -> None:
        section = SimulationSection.model_validate({"mode": "realtime"})
        link = Link(network=SimulatedNetwork(scheduler, section, 0, lockstep=False))
        first, chaser = Node("world", "world", link), Node("chaser/0", "chaser", link)
        chaser.blocking, chaser.run_id = False, "r1"
        watch_for_foreign_publishers(chaser, first.source)
        heartbeat = Heartbeat(chaser, "a", stall_s=8.0)
        first.close()
        second = Node("world", "world", link)
        membership = Membership(1, run_id, "realtime", "{}", source=second.source, resumed=True)

        def join(request: JoinRequest, reply: Callable[[JoinReply], None]) -> None:
            if (answer := membership.admit(request)) is not None:
                reply(answer)

        second.declare_queryable(topics.JOIN_KEY, JoinRequest, join)
        while not heartbeat.world_is_gone() and scheduler.now_s < 4.0:
            scheduler.pause(0.1)
        followed.append(chaser.world_source == second.source)
        chaser.close()
        second.close()

    scheduler = Scheduler(0)
    task = scheduler.spawn("run", lambda: run(scheduler))
    scheduler.run(20.0)
    assert not task.error
    assert followed == [run_id == "r1"]
