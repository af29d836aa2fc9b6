# SPDX-License-Identifier: Apache-2.0
"""Operator commands through the whole controller: impossible ones are rejected with a reason,
repeated ones change nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import pytest
from chaserdock_protocol.messages import OperatorCommand
from docking_cases import scenario
from flights.measured_poses import measurement_model

from chaserdock.experiments.in_process import InProcessMission

V = (0.0, 2.0, 0.0)


@pytest.fixture
def flight() -> Iterator[InProcessMission]:
    """A chaser with thrusters that holds before its port, two seconds into the mission."""
    s = scenario(chaser={"body": "tetra12", "actuation": "thrusters", "torque_max_N_m": 0.15})
    out = InProcessMission(s, measurement_model(s, 1, 0.002, math.radians(0.1)))
    while out.time_s < 2.0:
        out.step()
    yield out
    out.close()


def ask(flight: InProcessMission, *wishes: dict[str, Any]) -> list[tuple[bool, str]]:
    """The answers to what operators ask for in one tick."""
    nobody: dict[str, Any] = {"chaser": 0}
    commands = [OperatorCommand(**(nobody | w)) for w in wishes]
    outputs = flight.step(tuple(commands)).outputs
    assert outputs is not None
    replies = outputs.replies
    assert [(r.command, r.chaser, r.operator) for r in replies] == [
        (c.command, c.chaser, c.operator) for c in commands
    ]
    assert all(r.tick == flight.tick - 1 for r in replies)
    return [(r.accepted, r.reason) for r in replies]


@pytest.mark.parametrize(
    ("wish", "reason"),
    [
        ({"command": "approach", "chaser": 7}, "there is no chaser 7; this mission has 0 to 0"),
        (
            {"command": "isolate", "chaser": 7, "thruster": 0},
            "there is no chaser 7; this mission has 0 to 0",
        ),
        ({"command": "isolate", "thruster": 12}, "isolate needs a thruster; this body has 0 to 11"),
        (
            {"command": "approach", "expires_ns": 10**9},
            "stale: the command expired at 1.00 s, now is 2.00 s",
        ),
        (
            {"command": "isolate", "thruster": 1, "expires_ns": 10**9},
            "stale: the command expired at 1.00 s",
        ),
        ({"command": "goto"}, "goto needs an offset"),
        ({"command": "goto", "offset_m": (0.1, 0.0, 0.0)}, "the offset is 0.1 m from the target"),
    ],
)
def test_impossible_values_are_refused(
    flight: InProcessMission, wish: dict[str, Any], reason: str
) -> None:
    ((accepted, why),) = ask(flight, wish)
    assert not accepted
    assert why.startswith(reason)
    assert flight.phase(0) == "hold"
    outputs = flight.step().outputs
    assert outputs is not None
    assert outputs.wrenches[0].isolated == ()


def test_twice_is_once(flight: InProcessMission) -> None:
    for what in ({"command": "approach"}, {"command": "isolate", "thruster": 3}):
        assert ask(flight, what)[0][0]
        since = flight.controller.guidance.chasers[0].state.since_s
        (again,) = ask(flight, what)
        assert again[0]
        assert "already" in again[1]
        assert flight.controller.guidance.chasers[0].state.since_s == since


def test_in_a_wrong_phase(flight: InProcessMission) -> None:
    ask(flight, {"command": "approach"})
    while flight.phase(0) != "approach":
        flight.step()
    assert ask(flight, {"command": "goto", "offset_m": V}) == [
        (False, "in phase approach permitted: abort, hold, retreat")
    ]
    assert flight.phase(0) == "approach"


@pytest.mark.parametrize(
    ("first", "second"),
    [
        ({"command": "approach"}, {"command": "retreat"}),
        ({"command": "goto", "offset_m": V}, {"command": "goto", "offset_m": (0.0, -2.0, 0.0)}),
        ({"command": "isolate", "thruster": 3}, {"command": "restore", "thruster": 3}),
    ],
)
def test_of_two_operators_at_once_the_first_counts(
    flight: InProcessMission, first: dict[str, Any], second: dict[str, Any]
) -> None:
    answers = ask(flight, {**first, "operator": "ann"}, {**second, "operator": "bob"})
    assert answers[0][0]
    assert answers[1] == (False, f"{first['command']} by ann came first in this tick")


def test_but_an_abort_always_does(flight: InProcessMission) -> None:
    answers = ask(
        flight, {"command": "approach", "operator": "ann"}, {"command": "abort", "operator": "bob"}
    )
    assert [accepted for accepted, _ in answers] == [True, True]
    assert flight.phase(0) == "abort"
