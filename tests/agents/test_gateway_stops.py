# SPDX-License-Identifier: Apache-2.0
"""What must stop robots in flight stops all of them, in time and with a named reason."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pytest
import virtual_lab
from chaserdock_agents.gateway import process as gateway
from chaserdock_protocol import topics
from chaserdock_protocol.messages import ArmingCommand, ArmingReply, Kill, Presence
from chaserdock_protocol.process import ProcessOptions
from chaserdock_protocol.transport import Node
from virtual_lab import SCENARIO, SENT, Fault, arm_when_ready, fly, two_free_flyers

from chaserdock.analysis.summary import summarize
from chaserdock.simulation.mission import SimulatedFlight

TICK_S, STALE_S = 1 / 15, 0.5
"""Time of a tick, s, and age of odometry or of a command that is too old in ``SCENARIO``."""
ACT_S = 2.0
"""Time, s, from arming until something happens."""
ANSWER_NS = 500_000_000
"""Time, ns, that a second gateway waits for the answer of another."""


@dataclass
class Stops:
    """What robots have got: times, ns, at which each was stopped. ``acted_ns``: of the act."""

    at_ns: dict[int, list[int]] = field(default_factory=lambda: {0: [], 1: []})
    acted_ns: int = 0

    def delay_s(self, since_ns: int) -> float:
        """Return after which time all robots had zero. They get no command afterwards."""
        first = [min(t for t in times if t >= since_ns) for times in self.at_ns.values()]
        assert max(t for t, _ in SENT) <= max(first)
        return (max(first) - since_ns) / 1e9


@pytest.fixture
def stops(monkeypatch: pytest.MonkeyPatch) -> Stops:
    """The stops of the virtual robots."""
    noted, stop = Stops(), virtual_lab._Robot.stop

    def noting(robot: Any) -> None:
        noted.at_ns[robot.chaser].append(robot.host.now_ns())
        stop(robot)

    monkeypatch.setattr(virtual_lab._Robot, "stop", noting)
    return noted


def flown(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    lab: Any,
    text: str = SCENARIO,
    seconds: float = 5.0,
    **others: Any,
) -> tuple[SimulatedFlight, str]:
    """Fly; return the flight, and why the robots were disarmed or killed."""
    scenario = tmp_path / "lab.toml"
    scenario.write_text(text.replace("duration_s = 40.0", f"duration_s = {seconds}"))
    flight = fly(scenario, tmp_path / "run", lab, monkeypatch, **others)
    assert not flight.crashes
    said = [x for x in flight.output.splitlines() if "disarmed" in x or "kill accepted" in x]
    for actuators in lab.actuators.values():
        assert actuators.is_at_zero
    return flight, "\n".join(said)


def acting(stops: Stops, act: Callable[[Node], None], name: Any = "operator") -> Any:
    """Return an operator who arms, and does something ``ACT_S`` later."""

    def main(options: ProcessOptions) -> int:
        assert arm_when_ready(options) == 0
        node = Node(name, name, options.link)
        try:
            node.host.sleep(ACT_S)
            stops.acted_ns = round(node.host.now_s() * 1e9)
            act(node)
            node.host.sleep(0.5)
        finally:
            node.close()
        return 0

    return main


def ask(action: Any) -> Callable[[Node], None]:
    def act(node: Node) -> None:
        command = ArmingCommand(action=action, operator="Ada")
        reply = node.query(topics.ARMING_KEY, command, ArmingReply, 1.0)
        assert reply is not None
        assert reply.accepted

    return act


def press(node: Node) -> None:
    node.advertise(topics.KILL)
    node.publish(topics.KILL, Kill(by="a button"))


def join_unasked(node: Node) -> None:
    """Be a world that does not ask whether there is one."""
    node.advertise(topics.PRESENCE, "world")
    node.publish(topics.PRESENCE, Presence(process="world", instance="another", heard={}), "world")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("act", "name", "said"),
    [
        (press, "operator", "killed by a button"),
        (ask("kill"), "operator", "killed by Ada"),
        (ask("disarm"), "operator", ""),
        (join_unasked, "world", "another world or gateway runs in this namespace"),
    ],
    ids=["kill by topic", "kill by command", "disarm by command", "second world"],
)
def test_robots_are_at_zero_within_a_tick_of_the_act(
    act: Any, name: str, said: str, stops: Stops, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab = two_free_flyers(1)
    operator = acting(stops, act, name)
    _, reason = flown(tmp_path, monkeypatch, lab, operator=operator)
    assert said in reason
    assert stops.delay_s(stops.acted_ns) < TICK_S


@pytest.mark.slow
def test_a_second_gateway_that_gets_no_answer_is_named_by_the_first(
    stops: Stops, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Nobody answers its question whether there is a world, as in a divided network; both end."""
    asked_ns = 0

    def second(options: ProcessOptions) -> int:
        nonlocal asked_ns
        host = Node("viewer", "viewer", options.link).host
        host.sleep(3.0)
        asked_ns = round(host.now_s() * 1e9)
        return gateway.main(replace(options, patience_s=0.5))

    flight, reason = flown(tmp_path, monkeypatch, two_free_flyers(1), second=second)
    assert "another world or gateway runs in this namespace" in reason
    assert flight.statuses["second"] == 1
    assert stops.delay_s(asked_ns + ANSWER_NS) < TICK_S


@pytest.mark.slow
def test_lost_odometry_stops_all_robots_within_a_tick_of_its_limit(
    stops: Stops, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lab = two_free_flyers(1, (Fault("motion capture frozen", ACT_S, chaser=1),))
    _, reason = flown(tmp_path, monkeypatch, lab)
    assert "chaser 1: odometry lost" in reason
    assert lab.begun_ns is not None
    lost_ns = lab.begun_ns + round(ACT_S * 1e9)
    assert STALE_S - 0.02 < stops.delay_s(lost_ns) < STALE_S + TICK_S


@pytest.mark.slow
def test_a_stale_command_stops_all_robots_within_a_tick_of_its_limit(
    stops: Stops, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The process of a chaser hangs: nothing commands its robot."""
    text = SCENARIO.replace(
        "[camera]",
        "fault = [{kind = 'freeze', at_s = 3.0, duration_s = 2.0, process = 'chaser/1'}]\n[camera]",
        1,
    )
    _, reason = flown(tmp_path, monkeypatch, two_free_flyers(1), text)
    assert "chaser 1: command stale" in reason
    newest_ns = max(t for t, chaser in SENT if chaser == 1)
    assert STALE_S - TICK_S < stops.delay_s(newest_ns) < STALE_S + TICK_S


@pytest.mark.slow
def test_a_robot_that_leaves_the_volume_stops_all_within_a_tick(
    stops: Stops, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Chaser 1 follows the turning target along x."""
    limit_m = 0.1
    text = SCENARIO.replace("upper_m = [2.0, 2.0, 2.0]", f"upper_m = [{limit_m}, 2.0, 2.0]")
    lab = two_free_flyers(1)
    _, reason = flown(tmp_path, monkeypatch, lab, text, seconds=12.0)
    assert "chaser 1: left the volume" in reason
    states = [(t, s["chaser/1"][0][0]) for t, s in lab.history]
    inside_ns = max(t for t, x in states if x <= limit_m and t < max(stops.at_ns[1]))
    crossed = next(t for t, x in states if x > limit_m)
    assert stops.delay_s(inside_ns) < (crossed - inside_ns) / 1e9 + TICK_S


@pytest.mark.slow
def test_a_reference_that_jumps_is_named_and_stops_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The target is measured by the reference alone."""
    lab = two_free_flyers(1, (Fault("motion capture jumps", ACT_S, ACT_S + 1.0, chaser=-1),))
    flight, reason = flown(tmp_path, monkeypatch, lab)
    assert reason == ""
    assert "reference jumped: target by 0.54 m" in flight.output
    (said,) = (x for x in summarize(flight.folder)["not_judged"] if "jumped" in x)
    assert "target by 0.54 m, 0 deg" in said
    assert "left out until" in said
