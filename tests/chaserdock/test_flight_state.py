# SPDX-License-Identifier: Apache-2.0
"""Progress and notices of a running mission, and how they are shown."""

from __future__ import annotations

import io
import json
import math
from typing import Any

import msgspec
import pytest
from chaserdock_protocol import messages as m
from chaserdock_protocol.scenario import load_scenario
from chaserdock_protocol.shipped_scenarios import SHIPPED
from rich.console import Console

from chaserdock.launch import progress
from chaserdock.launch.flight_state import FlightState
from chaserdock.launch.json_events import CommandNotice, EventNotice, JsonLine, Progress, Start
from chaserdock.launch.mission_address import MissionAddress
from chaserdock.launch.progress import ProgressReporter, Show, headline, text_of

SCENARIO = load_scenario(SHIPPED[0] / "two-chaser-tracking.toml")
AT_REST: dict[str, Any] = {"velocity_m_s": (0.0, 0.0, 0.0), "omega_rad_s": (0.0, 0.0, 0.0)}


def tick(number: int) -> m.Tick:
    return m.Tick(
        tick=number,
        sim_time_ns=number * 100_000_000,
        images=True,
        chasers=(0, 1),
        controllers={"controller": "c"},
    )


def odometry(chaser: int, number: int, x_m: float) -> m.Odometry:
    return m.Odometry(
        chaser=chaser,
        tick=number,
        position_m=(x_m, 0.0, 0.0),
        q_wxyz=(1.0, 0.0, 0.0, 0.0),
        **AT_REST,
    )


def reference(chaser: int, number: int) -> m.Reference:
    half = math.sqrt(0.5)
    return m.Reference(
        chaser=chaser,
        tick=number,
        phase="hold",
        phase_time_s=1.5,
        position_m=(0.0, 0.0, 0.0),
        q_wxyz=(half, 0.0, 0.0, half),
        offset_m=(-0.6, 0.0, 0.8),
        min_distance_target_m=0.35,
    )


def flying_state() -> FlightState:
    """Ten simulated seconds in twenty, then five in five: ``now`` is 25 s after the first tick."""
    state = FlightState(SCENARIO)
    for k in range(101):
        state.update(tick(k), 0.2 * k)
    for k in range(101, 151):
        state.update(tick(k), 20.0 + 0.1 * (k - 100))
    return state


def test_speed_since_start_and_over_last_seconds() -> None:
    state = flying_state()
    progress_now = state.progress(25.0)
    assert (progress_now.tick, progress_now.sim_time_s) == (150, 15.0)
    assert progress_now.speed == pytest.approx(15.0 / 25.0)
    assert progress_now.speed_now == pytest.approx(1.0, abs=0.05)
    remaining_s = state.remaining_s(progress_now)
    assert remaining_s == pytest.approx((SCENARIO.duration_s - 15.0) / progress_now.speed_now)
    assert "15.0 of 120 s" in headline(state, progress_now)


def test_progress_is_complete_at_the_end_of_the_mission() -> None:
    state = flying_state()
    end_ns = round(SCENARIO.duration_s * 1e9)
    state.update(
        m.MissionEnd(tick=1200, sim_time_ns=end_ns, reason="completed", complete=True), 25.0
    )
    assert state.progress(25.0).sim_time_s == SCENARIO.duration_s


def test_first_refresh_shows_what_a_mission_waits_for(capsys: pytest.CaptureFixture[str]) -> None:
    reporter = ProgressReporter(SCENARIO, Show.text)
    reporter.refresh()
    assert "starting, waiting for world, controller" in capsys.readouterr().err


def test_stalled_mission_has_no_remaining_time() -> None:
    state = flying_state()
    progress_now = state.progress(1e6)
    assert progress_now.speed_now == pytest.approx(0.0, abs=1e-4)
    assert "left" not in headline(state, progress_now)
    assert FlightState(SCENARIO).remaining_s(FlightState(SCENARIO).progress(3.0)) is None


def test_errors_use_reference_and_odometry_of_the_same_tick() -> None:
    state = flying_state()
    state.update(odometry(0, 149, 0.5), 25.0)
    state.update(reference(0, 150), 25.0)
    assert state.progress(25.0).chasers == ()  # its odometry is of another tick
    state.update(odometry(0, 150, 0.25), 25.0)
    (chaser,) = state.progress(25.0).chasers
    assert chaser.position_error_m == pytest.approx(0.25)
    assert chaser.orientation_error_rad == pytest.approx(math.pi / 2)
    assert chaser.reference_distance_m == pytest.approx(1.0)
    assert (chaser.phase, chaser.phase_time_s) == ("hold", 1.5)


def test_old_odometry_is_dropped() -> None:
    state = FlightState(SCENARIO)
    for k in range(10_000):
        state.update(odometry(0, k, 0.0), 0.0)
        state.update(tick(k), 0.01 * k)
    assert len(state._odometry) <= 50
    assert len(state._tick_times) <= 501 + 1


def test_missing_processes_are_named() -> None:
    state = FlightState(SCENARIO)
    for name in ("world", "recorder", "chaser/1"):
        state.update(m.Presence(process=name, instance="a", heard={}), 0.0)
    assert state.waiting_for() == ["controller", "chaser/0"]


def health(rejected: int, lost: int) -> m.Health:
    return m.Health(
        process="chaser/0", rejected={"range": rejected} if rejected else {}, lost=lost, stale=0
    )


def test_rejected_and_lost_messages_are_reported_when_they_grow() -> None:
    state = flying_state()
    assert state.update(health(0, 0), 0.0) == []
    (notice,) = state.update(health(3, 0), 0.0)
    assert isinstance(notice, EventNotice)
    assert (notice.process, notice.level, notice.what, notice.detail) == (
        "chaser/0",
        "warning",
        "3 messages rejected",
        "range: 3",
    )
    assert state.update(health(3, 0), 0.0) == []
    assert [t.what for t in state.update(health(3, 2), 0.0) if isinstance(t, EventNotice)] == [
        "2 messages missing"
    ]
    assert state.update(health(0, 0), 0.0) == []  # restarted
    assert len(state.update(health(1, 0), 0.0)) == 1


def solver_status(*status: str) -> m.SolverStatus:
    n = len(status)
    return m.SolverStatus(
        solver="rti",
        chasers=tuple(range(n)),
        status=status,
        iterations=(0,) * n,
        cost=(0.0,) * n,
        max_violation_m=(0.0,) * n,
    )


def test_failed_plan_is_reported_once_per_streak() -> None:
    state = flying_state()
    assert state.update(solver_status("solved", "iteration_limit"), 0.0) == []
    (notice,) = state.update(solver_status("solved", "infeasible_relaxed"), 0.0)
    assert isinstance(notice, EventNotice)
    assert notice.what == "chaser 1: plan infeasible_relaxed"
    assert state.update(solver_status("solved", "infeasible_relaxed"), 0.0) == []
    assert state.update(solver_status("solved", "solved"), 0.0) == []
    assert len(state.update(solver_status("failed", "failed"), 0.0)) == 2


def test_notices_as_text() -> None:
    event = EventNotice(
        sim_time_s=3.0, process="world", level="warning", what="lost", detail="chaser/1"
    )
    assert text_of(event) == "   3.00 s  WARNING: world: lost chaser/1"
    answer = CommandNotice(
        sim_time_s=60.0, command="approach", chaser=3, accepted=False, reason="no estimate"
    )
    assert text_of(answer) == "  60.00 s  approach chaser 3: refused (no estimate)"


def test_json_shows_one_object_per_line(capsys: pytest.CaptureFixture[str]) -> None:
    reporter = ProgressReporter(SCENARIO, Show.json)
    address = MissionAddress(namespace="n", endpoint="tcp/127.0.0.1:1")
    reporter.report(
        Start(
            scenario="a",
            seed=0,
            mode="lockstep",
            duration_s=1.0,
            chasers=2,
            folder="b",
            address=address,
        )
    )
    reporter.update(tick(0))
    reporter.update(m.Event(process="world", level="error", what="gone", sim_time_ns=5_000_000_000))
    reporter.update(m.CommandReply(command="hold", chaser=0, accepted=True, reason="phase hold"))
    reporter.report_lost("chaser/1", "killed")
    reporter.report_lost("chaser/1", "killed")
    reporter.print_text("text only")
    reporter.close()
    out = capsys.readouterr()
    lines = [msgspec.json.decode(line, type=JsonLine) for line in out.out.splitlines()]
    assert [type(line) for line in lines] == [
        Start,
        EventNotice,
        CommandNotice,
        EventNotice,
        Progress,
    ]
    assert json.loads(out.out.splitlines()[1])["type"] == "event"
    assert out.err == ""


@pytest.mark.parametrize("show", [Show.text, Show.none])
def test_text_goes_to_standard_error_or_nowhere(
    show: Show, capsys: pytest.CaptureFixture[str]
) -> None:
    reporter = ProgressReporter(SCENARIO, show)
    reporter.update(
        m.Event(process="world", level="warning", what="gone", sim_time_ns=5_000_000_000)
    )
    reporter.close()
    printed = capsys.readouterr()
    assert printed.out == ""
    assert printed.err == ("   5.00 s  WARNING: world: gone\n" if show is Show.text else "")


def test_terminal_shows_live_table(monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()
    monkeypatch.setattr(
        progress, "Console", lambda stderr: Console(file=out, force_terminal=True, width=100)
    )
    reporter = ProgressReporter(SCENARIO, Show.text)
    reporter.state = flying_state()
    reporter.update(odometry(1, 150, 0.02))
    reporter.update(reference(1, 150))
    reporter.update(m.Event(process="world", level="warning", what="gone"))
    reporter.close()
    printed = out.getvalue()
    assert "WARNING: world: gone" in printed
    for part in ("two-chaser-tracking", "of 120 s", "hold", "20.00 mm", "90.000 deg"):
        assert part in printed
    assert printed.endswith("\x1b[?25h")  # the cursor is back
