# SPDX-License-Identifier: Apache-2.0
"""A standby takes over: killed, frozen, cut off, in whole missions over real processes."""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chaserdock_protocol.messages import ActuatorCommand, Event, Tick
from chaserdock_protocol.recording.log import LogError, read_log
from harness import ByHand, run, sets, summary, wait_for_log

from chaserdock.analysis.flight import RecordedFlight, load_flight
from chaserdock.replay.run import replay

DRILL = "fault-drill"
SHORT = ("duration_s=4.0", "timeline=[]", "success.docked=[]", "settling_s=1.0", "controller.standby=true")

pytestmark = pytest.mark.slow


def flown(out: Path, fault: str = "", *overrides: str) -> tuple[int, RecordedFlight, dict[str, Any]]:
    faults = [f"fault=[{{{fault}}}]"] if fault else []
    status, said = run(DRILL, out, *SHORT, *faults, *overrides)
    assert (out / "summary.json").exists(), said
    return status, load_flight(out / "mission.mcap"), summary(out)


def truth_of(flight: RecordedFlight) -> dict[str, Any]:
    return {name: flight.truth[name].position_m for name in sorted(flight.truth)}


def check_fencing(log: Path) -> None:
    """No chaser has flown a command of a term that was over for its tick, and none of two terms in a tick."""
    newest: dict[int, int] = {}
    flown_terms: dict[tuple[int, int], set[int]] = {}
    for record in read_log(log):
        message = record.message
        if isinstance(message, Tick):
            newest[message.tick] = max(message.term, newest.get(message.tick, 0))
        elif isinstance(message, ActuatorCommand) and message.source == "command":
            flown_terms.setdefault((message.tick, message.chaser), set()).add(message.term)
    assert flown_terms
    for (tick, chaser), terms in flown_terms.items():
        assert len(terms) == 1, (tick, chaser, terms)
        assert terms == {newest[tick]} or terms == {newest[tick] - 1}, (tick, chaser, terms)


def test_killed_in_lockstep_the_flight_goes_on_as_if_nothing_had_been(tmp_path: Path) -> None:
    status, plain, _ = flown(tmp_path / "plain")
    assert status == 0
    status, killed, told = flown(tmp_path / "killed", 'kind="kill", at_s=2.0, process="controller"')
    assert status == 0, told["failures"]
    what = [(e.what, e.detail) for e in killed.events]
    assert ("hand-over", "term 2: standby leads: controller lost") in what
    before, after = truth_of(plain), truth_of(killed)
    for name in before:
        np.testing.assert_array_equal(before[name], after[name])
    ticks = [r.message for r in read_log(tmp_path / "killed" / "mission.mcap", ["world/tick"])]
    assert (ticks[0].term, ticks[0].commander, list(ticks[0].standing_by)) == (1, "controller", ["standby"])
    assert (ticks[-1].term, ticks[-1].commander, ticks[-1].standing_by) == (2, "standby", {})
    check_fencing(tmp_path / "killed" / "mission.mcap")
    assert replay(tmp_path / "killed" / "mission.mcap", "controller").equal
    assert not [e for e in killed.events if e.what.startswith(("fallback", "no command", "command refused"))]


def test_cut_off_in_lockstep_the_standby_commands_and_keeps_the_command(tmp_path: Path) -> None:
    status, cut, told = flown(tmp_path / "cut", 'kind="cut", at_s=1.5, duration_s=1.0, process="controller"')
    assert status == 0, told["failures"]
    log = tmp_path / "cut" / "mission.mcap"
    handed = [e for e in cut.events if e.what == "hand-over"]
    assert [e.detail for e in handed] == [
        "term 2: standby leads: no command of controller executed for 0.20 s"
    ]
    assert handed[0].sim_time_ns / 1e9 == pytest.approx(1.6, abs=0.01)
    assert any(e.what == "fallback: plan" for e in cut.events)
    assert any(e.what == "fallback ends" for e in cut.events)
    ticks = [r.message for r in read_log(log, ["world/tick"])]
    assert (ticks[-1].term, ticks[-1].commander, list(ticks[-1].standing_by)) == (
        2,
        "standby",
        ["controller"],
    )
    check_fencing(log)


def test_a_frozen_commander_that_thaws_commands_nobody(tmp_path: Path) -> None:
    """In real time; only what does not depend on the machine's load is asked."""
    out = tmp_path / "run"
    fault = 'fault=[{kind="freeze", at_s=3.0, duration_s=1.2, process="controller"}]'
    run(DRILL, out, *SHORT, "duration_s=8.0", fault, arguments=["--mode", "realtime"])
    log = out / "mission.mcap"
    ticks = [r.message for r in read_log(log, ["world/tick"])]
    assert ticks[-1].term >= 2
    for i in range(4):
        terms = [
            r.message.term for r in read_log(log, [f"chaser/{i}/actuators"]) if r.message.source == "command"
        ]
        assert terms == sorted(terms)
        assert terms[-1] >= 2
    assert summary(out)["collisions"] == 0


def test_who_was_lost_and_comes_back_stands_by_and_can_take_over_again(tmp_path: Path) -> None:
    """Controller killed, started again, then the standby killed: in lock-step, over separate processes."""
    hand = ByHand.at_free_port("hand-over")
    log = tmp_path / "mission.mcap"
    changes = (*SHORT, "duration_s=40.0")
    try:
        hand.start("world", "world", DRILL, *sets(*changes))
        hand.start("recorder", "record", "--out", str(tmp_path))
        hand.start("controller", "controller")
        hand.start("standby", "controller", "--standby")
        for i in range(4):
            hand.start(f"chaser/{i}", "chaser", str(i))
        wait_for_log(log, 300_000)
        first = hand.processes.pop("controller")
        first.kill()
        first.wait()
        hand.start("controller", "controller")
        wait_for(log, lambda e: e.process == "controller" and e.what == "restored the leader's state")
        hand.processes["standby"].kill()
        for name in ("world", "controller", "recorder", *(f"chaser/{i}" for i in range(4))):
            status, said = hand.said(name)
            assert status == 0, f"{name}: {said}"
    finally:
        hand.end()
    ticks = [r.message for r in read_log(log, ["world/tick"])]
    assert [k for k, _ in groupby(t.commander for t in ticks)] == ["controller", "standby", "controller"]
    assert ticks[-1].term == 3
    flight = load_flight(log)
    assert not [e for e in flight.events if e.what.startswith(("takes over without any state", "fallback"))]
    phases = [e.what for e in flight.events if "from" in e.what]
    assert len(phases) == 4  # each once: nobody began as at the start
    assert flight.world.contacts == 0
    check_fencing(log)


def wait_for(log: Path, wanted: Callable[[Event], bool], timeout_s: float = 90.0) -> None:
    """Waits until an event stands in a log that is being written."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        try:
            if any(wanted(r.message) for r in read_log(log, ["controller/event"])):
                return
        except LogError:
            pass  # not a whole chunk of it is there yet
        time.sleep(0.2)
    raise AssertionError(f"{log}: it has not come")
