# SPDX-License-Identifier: Apache-2.0
"""Thruster faults by operator command: applied between ticks, refused with a reason, recorded as
events.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from chaserdock_protocol.messages import CommandReply, Event, ThrusterFaultCommand, ThrusterReport
from chaserdock_protocol.recording.log import read_log
from chaserdock_world.actuators.operator_faults import ThrusterFaultHandler
from chaserdock_world.actuators.thrusters import ThrusterActuators, make_actuators
from harness import SHORT, ByHand, finished, sets, wait_for_log
from thruster_cases import mission

ALLOWED: dict[str, Any] = {"chaser": {"thruster_faults_by_command": True}}


def submit(handler: ThrusterFaultHandler, tick: int, timing: Any, **changes: Any) -> CommandReply:
    """The reply to one changes, decided at ``tick``."""
    replies: list[CommandReply] = []
    values: dict[str, Any] = {"chaser": 0, "thruster": 2, "kind": "stuck_on", "operator": "me"}
    handler.submit(ThrusterFaultCommand(**(values | changes)), replies.append)
    assert replies == []  # not before the tick
    events = handler.apply_pending(tick, timing)
    assert [what for what, _ in events] == [
        "thruster fault by command" if replies[0].accepted else "thruster fault refused"
    ]
    assert "by me" in events[0][1]
    assert replies[0].reason in events[0][1]
    return replies[0]


def test_thruster_fails_from_the_tick_on_until_repaired() -> None:
    s = mission(**ALLOWED)
    thrusters = make_actuators(s, 0)
    assert isinstance(thrusters, ThrusterActuators)
    handler, per_tick = ThrusterFaultHandler(s, {"chaser/0": thrusters}), s.timing.steps_per_tick
    given = []
    kinds = {2: "stuck_on", 3: "stuck_on", 5: "healthy"}
    for tick in range(8):
        if tick in kinds:
            reply = submit(handler, tick, s.timing, kind=kinds[tick])
            assert reply.accepted
            assert ("already" in reply.reason) is (tick == 3)
            assert reply.tick == tick
        step, end = s.timing.step_of_tick(tick), s.timing.step_of_tick(tick + 1)
        while step < end:
            until = min(thrusters.next_change(step) or end, end)
            thrusters.act(step, until - step, 1.0 / s.timing.physics_hz)
            step = until
        given.append(thrusters.take_output(end).thruster_impulse_N_s[2])
    full = 1.5 * per_tick / s.timing.physics_hz
    assert given[:2] == [0.0, 0.0]
    assert given[2] == pytest.approx(full - 1.5 * 0.001)  # less the rise
    assert given[3:5] == pytest.approx([full] * 2)
    assert given[5:] == pytest.approx([0.0] * 3, abs=1.5 * 0.002)


@pytest.mark.parametrize(
    ("scenario", "changes", "reason"),
    [
        ({}, {}, "chaser.thruster_faults_by_command = true"),
        (ALLOWED, {"chaser": 1}, "there is no chaser 1; this mission has 0 to 0"),
        (ALLOWED, {"thruster": 12}, "there is no thruster 12; the body has 0 to 11"),
        (ALLOWED, {"kind": "weak"}, "factor is required for weak"),
        (ALLOWED, {"factor": 0.5}, "factor is required for weak"),
        (ALLOWED, {"kind": "weak", "factor": 1.5}, "factor must be from 0 to 1, not 1.5"),
        (
            {"chaser": {"actuation": "ideal", "thruster_faults_by_command": True}},
            {},
            "have no thrusters",
        ),
    ],
)
def test_invalid_fault_command_is_refused_without_effect(
    scenario: dict[str, Any], changes: dict[str, Any], reason: str
) -> None:
    s = mission(**scenario)
    thrusters = make_actuators(s, 0)
    reply = submit(ThrusterFaultHandler(s, {"chaser/0": thrusters}), 0, s.timing, **changes)
    assert not reply.accepted
    assert reason in reply.reason
    assert thrusters.next_change(0) is None or not thrusters.act(0, 1, 0.001).any()


@pytest.mark.parametrize("factor", [0.0, 1.0])
def test_the_ends_of_the_range_of_a_factor_are_valid(factor: float) -> None:
    s = mission(**ALLOWED)
    handler = ThrusterFaultHandler(s, {"chaser/0": make_actuators(s, 0)})
    assert submit(handler, 0, s.timing, kind="weak", factor=factor).accepted


@pytest.mark.slow
def test_chaser_detects_a_commanded_thruster_fault_in_a_mission(tmp_path: Path) -> None:
    by_hand, log = ByHand.at_free_port("thrusterfault"), tmp_path / "mission.mcap"
    reach = ("--namespace", by_hand.namespace, "--connect", by_hand.endpoint)
    flown = (
        *SHORT,
        "thruster_failure=[]",
        "duration_s=25.0",
        "chaser.thruster_faults_by_command=true",
    )
    try:
        by_hand.start("world", "world", "thruster-failure", *sets(*flown))
        by_hand.start("recorder", "record", "--out", str(tmp_path))
        by_hand.start("controller", "controller")
        by_hand.start("chaser/0", "chaser", "0")
        wait_for_log(log, 200_000)
        status, said = finished(
            *("command", "thruster-fault", "0", "--thruster", "5", "--fault", "stuck_on"),
            *("--operator", "test", *reach),
        )
        assert (status, "accepted" in said) == (0, True), said
        status, said = finished(
            *("command", "thruster-fault", "0", "--thruster", "44", "--fault", "stuck_on"), *reach
        )
        assert (status, "there is no thruster 44" in said) == (1, True), said
        for name in by_hand.processes:
            status, said = by_hand.output_of(name)
            assert status == 0, f"{name}: {said}"
    finally:
        by_hand.end()
    events, reports = [], []
    for record in read_log(log):
        match record.message:
            case Event(process="world") as m:
                events.append(m)
            case ThrusterReport() as m:
                reports.append(m)
    done, refused = [e for e in events if e.what.startswith("thruster fault")]
    assert "chaser 0 thruster 5 stuck_on, by test" in done.detail
    assert refused.what == "thruster fault refused"
    shut = next(r for r in reports if r.isolated)
    assert shut.isolated == (5,)
    assert 0 < shut.sim_time_ns - done.sim_time_ns < 500_000_000
