# SPDX-License-Identifier: Apache-2.0
"""Hot standby: takes over from a killed, frozen or disconnected controller, in complete
missions.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chaserdock_protocol.leases import commander_of
from chaserdock_protocol.messages import ActuatorCommand, Event, Lease
from chaserdock_protocol.recording.log import LogError, read_log
from harness import DRILL, ByHand, run, sets, simulated_digest, summary, wait_for_log

from chaserdock.analysis.flight import RecordedFlight, load_flight
from chaserdock.replay.run import replay

WITH_STANDBY = (*DRILL[1:], "duration_s=4.0", "controller.standby=true")

pytestmark = pytest.mark.slow


KILLED = 'kind="kill", at_s=2.0, process="controller"'


def fly(out: Path, fault: str = "", *overrides: str) -> tuple[int, RecordedFlight, dict[str, Any]]:
    faults = [f"fault=[{{{fault}}}]"] if fault else []
    status, output = run(DRILL[0], out, *WITH_STANDBY, *faults, *overrides)
    assert (out / "summary.json").exists(), output
    return status, load_flight(out / "mission.mcap"), summary(out)


def truth_of(flight: RecordedFlight) -> dict[str, Any]:
    return {name: flight.motion[name].position_m for name in sorted(flight.motion)}


def check_leases(log: Path) -> None:
    """Assert that each chaser executed only commands of the controller that it stated to hold its
    lease.
    """
    holders: dict[tuple[int, int], set[str]] = {}
    executed: dict[tuple[int, int], set[str]] = {}
    for record in read_log(log):
        message = record.message
        if isinstance(message, Lease):
            holders.setdefault((message.tick, message.chaser), set()).add(message.holder)
        elif isinstance(message, ActuatorCommand) and message.source == "command":
            executed.setdefault((message.tick, message.chaser), set()).add(
                commander_of(message.term)
            )
    assert executed
    for at, commanders in executed.items():
        assert len(commanders) == 1, (at, commanders)
        assert commanders <= holders[at], (at, commanders, holders[at])


def commanders(log: Path) -> list[str]:
    """Return who commanded, in order of the ticks."""
    by_tick = sorted(
        (r.message.tick, r.message.commander) for r in read_log(log, ["controller/chaser/0/wrench"])
    )
    return [name for name, _ in groupby(name for _, name in by_tick)]


def test_takeover_from_killed_controller_leaves_trajectories_unchanged(
    drill_flight: Path, tmp_path: Path
) -> None:
    """The reference flight has no standby and flies on for longer."""
    status, killed, result = fly(tmp_path / "killed", KILLED)
    assert status == 0, result["failures"]
    events = [(e.what, e.detail) for e in killed.events]
    assert ("hand-over", "term 2: standby leads: controller lost") in events
    nominal = truth_of(load_flight(drill_flight / "mission.mcap"))
    for name, position_m in truth_of(killed).items():
        np.testing.assert_array_equal(position_m, nominal[name][: len(position_m)])
    ticks = [r.message for r in read_log(tmp_path / "killed" / "mission.mcap", ["world/tick"])]
    assert (list(ticks[0].controllers), list(ticks[-1].controllers)) == (
        ["controller", "standby"],
        ["standby"],
    )
    assert commanders(tmp_path / "killed" / "mission.mcap") == ["controller", "standby"]
    check_leases(tmp_path / "killed" / "mission.mcap")
    assert replay(tmp_path / "killed" / "mission.mcap", "controller").equal
    overrides = (*WITH_STANDBY, f"fault=[{{{KILLED}}}]")
    assert simulated_digest(DRILL[0], tmp_path / "simulated", *overrides) == result["digest"]
    assert not [
        e for e in killed.events if e.what.startswith(("fallback", "no command", "command refused"))
    ]


def test_standby_keeps_leadership_after_controller_reconnects(tmp_path: Path) -> None:
    status, cut, result = fly(
        tmp_path / "cut", 'kind="cut", at_s=1.5, duration_s=1.0, process="controller"'
    )
    assert status == 0, result["failures"]
    log = tmp_path / "cut" / "mission.mcap"
    takeovers = [e for e in cut.events if e.what == "hand-over"]
    assert [e.detail for e in takeovers] == [
        "term 2: standby leads: no command of controller executed for 0.20 s"
    ]
    assert takeovers[0].sim_time_ns / 1e9 == pytest.approx(1.6, abs=0.01)
    assert any(e.what == "fallback: plan" for e in cut.events)
    assert any(e.what == "fallback ends" for e in cut.events)
    ticks = [r.message for r in read_log(log, ["world/tick"])]
    assert list(ticks[-1].controllers) == ["controller", "standby"]
    assert commanders(log)[-1] == "standby"
    check_leases(log)


def test_resumed_controller_does_not_regain_leadership(tmp_path: Path) -> None:
    """Realtime mode; asserts only what does not depend on load."""
    out = tmp_path / "run"
    fault = 'fault=[{kind="freeze", at_s=2.0, duration_s=1.2, process="controller"}]'
    run(DRILL[0], out, *WITH_STANDBY, "duration_s=5.0", fault, arguments=["--mode", "realtime"])
    log = out / "mission.mcap"
    for i in range(4):
        terms = [
            r.message.term
            for r in read_log(log, [f"chaser/{i}/actuators"])
            if r.message.source == "command"
        ]
        assert terms == sorted(terms)
        assert terms[-1] >= 2
    assert summary(out)["collisions"] == 0


def test_restarted_controller_stands_by_and_takes_over_again(tmp_path: Path) -> None:
    """Kill the controller, restart it, then kill the standby."""
    by_hand = ByHand.at_free_port("standby")
    log = tmp_path / "mission.mcap"
    changes = (*WITH_STANDBY, "duration_s=30.0")
    try:
        by_hand.start("world", "world", DRILL[0], *sets(*changes))
        by_hand.start("recorder", "record", "--out", str(tmp_path))
        by_hand.start("controller", "controller")
        by_hand.start("standby", "controller", "--standby")
        for i in range(4):
            by_hand.start(f"chaser/{i}", "chaser", str(i))
        wait_for_log(log, 300_000)
        first = by_hand.processes.pop("controller")
        first.kill()
        first.wait()
        by_hand.start("controller", "controller")
        wait_for(
            log, lambda e: e.process == "controller" and e.what == "restored the leader's state"
        )
        by_hand.processes["standby"].kill()
        for name in ("world", "controller", "recorder", *(f"chaser/{i}" for i in range(4))):
            status, output = by_hand.output_of(name)
            assert status == 0, f"{name}: {output}"
    finally:
        by_hand.end()
    assert commanders(log) == ["controller", "standby", "controller"]
    assert max(r.message.term for r in read_log(log, ["chaser/0/actuators"])) == 3
    flight = load_flight(log)
    assert not [
        e for e in flight.events if e.what.startswith(("takes over without any state", "fallback"))
    ]
    phases = [e.what for e in flight.events if "from" in e.what]
    assert len(phases) == 4  # once per chaser: no controller restarted from the initial phase
    assert flight.world.contacts == 0
    check_leases(log)


def wait_for(log: Path, wanted: Callable[[Event], bool], timeout_s: float = 90.0) -> None:
    """Wait until a log that is being written contains a matching event."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        try:
            if any(wanted(r.message) for r in read_log(log, ["controller/event"])):
                return
        except LogError:
            pass  # no complete chunk has been written yet
        time.sleep(0.2)
    raise AssertionError(f"{log}: no such event after {timeout_s:.0f} s")
