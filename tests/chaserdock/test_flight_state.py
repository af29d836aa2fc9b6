"""What an operator hears of a mission, and how it is told."""

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
from chaserdock.launch.json_events import Commanded, Line, Progress, Start, Told
from chaserdock.launch.progress import ProgressReporter, Show, head_of, words_of

SCENARIO = load_scenario(SHIPPED[0] / "two-chaser-tracking.toml")
NOWHERE: dict[str, Any] = {"velocity_m_s": (0.0, 0.0, 0.0), "omega_rad_s": (0.0, 0.0, 0.0)}


def tick(number: int) -> m.Tick:
    return m.Tick(tick=number, sim_time_ns=number * 100_000_000, images=True, chasers=(0, 1), controller=True)


def placed(chaser: int, number: int, x_m: float) -> m.Odometry:
    return m.Odometry(
        chaser=chaser, tick=number, position_m=(x_m, 0.0, 0.0), q_wxyz=(1.0, 0.0, 0.0, 0.0), **NOWHERE
    )


def wanted(chaser: int, number: int) -> m.Reference:
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


def flown() -> FlightState:
    """Ten simulated seconds in twenty, then five in five: ``now`` is 25 s after the first tick."""
    state = FlightState(SCENARIO)
    for k in range(101):
        state.take(tick(k), 0.2 * k)
    for k in range(101, 151):
        state.take(tick(k), 20.0 + 0.1 * (k - 100))
    return state


def test_speed_is_that_of_the_whole_flight_and_that_of_the_last_seconds() -> None:
    state = flown()
    stood = state.progress(25.0)
    assert (stood.tick, stood.sim_time_s) == (150, 15.0)
    assert stood.speed == pytest.approx(15.0 / 25.0)
    assert stood.speed_now == pytest.approx(1.0, abs=0.05)
    left_s = state.left_s(stood)
    assert left_s == pytest.approx((SCENARIO.duration_s - 15.0) / stood.speed_now)
    assert "15.0 of 120 s" in head_of(state, stood)


def test_a_mission_that_stands_still_has_no_end() -> None:
    state = flown()
    stood = state.progress(1e6)
    assert stood.speed_now == pytest.approx(0.0, abs=1e-4)
    assert "left" not in head_of(state, stood)
    assert FlightState(SCENARIO).left_s(FlightState(SCENARIO).progress(3.0)) is None


def test_errors_are_of_the_reference_and_the_odometry_of_one_tick() -> None:
    state = flown()
    state.take(placed(0, 149, 0.5), 25.0)
    state.take(wanted(0, 150), 25.0)
    assert state.progress(25.0).chasers == ()  # its odometry is of another tick
    state.take(placed(0, 150, 0.25), 25.0)
    (chaser,) = state.progress(25.0).chasers
    assert chaser.position_error_m == pytest.approx(0.25)
    assert chaser.orientation_error_rad == pytest.approx(math.pi / 2)
    assert chaser.reference_distance_m == pytest.approx(1.0)
    assert (chaser.phase, chaser.phase_time_s) == ("hold", 1.5)


def test_old_odometry_is_forgotten() -> None:
    state = FlightState(SCENARIO)
    for k in range(10_000):
        state.take(placed(0, k, 0.0), 0.0)
        state.take(tick(k), 0.01 * k)
    assert len(state._odometry) <= 50
    assert len(state._heard) <= 501 + 1


def test_whoever_is_missing_is_named() -> None:
    state = FlightState(SCENARIO)
    for name in ("world", "recorder", "chaser/1"):
        state.take(m.Presence(process=name, instance="a", heard={}), 0.0)
    assert state.waiting_for() == ["controller", "chaser/0"]


def health(refused: int, lost: int) -> m.Health:
    return m.Health(process="chaser/0", rejected={"range": refused} if refused else {}, lost=lost, stale=0)


def test_refused_and_lost_messages_are_told_when_they_grow() -> None:
    state = flown()
    assert state.take(health(0, 0), 0.0) == []
    (told,) = state.take(health(3, 0), 0.0)
    assert isinstance(told, Told)
    assert (told.process, told.level, told.what, told.detail) == (
        "chaser/0",
        "warning",
        "3 messages refused",
        "range: 3",
    )
    assert state.take(health(3, 0), 0.0) == []
    assert [t.what for t in state.take(health(3, 2), 0.0) if isinstance(t, Told)] == ["2 messages missing"]
    assert state.take(health(0, 0), 0.0) == []  # it was started again
    assert len(state.take(health(1, 0), 0.0)) == 1


def solved(*status: str) -> m.SolverStatus:
    n = len(status)
    return m.SolverStatus(
        solver="rti",
        chasers=tuple(range(n)),
        status=status,
        iterations=(0,) * n,
        cost=(0.0,) * n,
        max_violation_m=(0.0,) * n,
    )


def test_a_plan_that_fails_is_told_once_a_streak() -> None:
    state = flown()
    assert state.take(solved("solved", "iteration_limit"), 0.0) == []
    (told,) = state.take(solved("solved", "infeasible_relaxed"), 0.0)
    assert isinstance(told, Told)
    assert told.what == "chaser 1: plan infeasible_relaxed"
    assert state.take(solved("solved", "infeasible_relaxed"), 0.0) == []
    assert state.take(solved("solved", "solved"), 0.0) == []
    assert len(state.take(solved("failed", "failed"), 0.0)) == 2


def test_words() -> None:
    event = Told(sim_time_s=3.0, process="world", level="warning", what="lost", detail="chaser/1")
    assert words_of(event) == "   3.00 s  WARNING: world: lost chaser/1"
    answer = Commanded(sim_time_s=60.0, command="approach", chaser=3, accepted=False, reason="no estimate")
    assert words_of(answer) == "  60.00 s  approach chaser 3: refused (no estimate)"


def test_scripts_get_one_object_a_line(capsys: pytest.CaptureFixture[str]) -> None:
    out = io.StringIO()
    heartbeat = ProgressReporter(SCENARIO, Show.scripts, out)
    heartbeat.tell(Start(scenario="a", seed=0, mode="lockstep", duration_s=1.0, chasers=2, folder="b"))
    heartbeat.take(tick(0))
    heartbeat.take(m.Event(process="world", level="error", what="gone", sim_time_ns=5_000_000_000))
    heartbeat.take(m.CommandReply(command="hold", chaser=0, accepted=True, reason="phase hold"))
    heartbeat.warn("chaser/1", "killed")
    heartbeat.warn("chaser/1", "killed")
    heartbeat.say("only for people")
    heartbeat.close()
    lines = [msgspec.json.decode(line, type=Line) for line in out.getvalue().splitlines()]
    assert [type(line) for line in lines] == [Start, Told, Commanded, Told, Progress]
    assert json.loads(out.getvalue().splitlines()[1])["type"] == "event"
    assert capsys.readouterr() == ("", "")


@pytest.mark.parametrize("show", [Show.people, Show.nobody])
def test_people_are_told_on_standard_error_or_not_at_all(
    show: Show, capsys: pytest.CaptureFixture[str]
) -> None:
    heartbeat = ProgressReporter(SCENARIO, show)
    heartbeat.take(m.Event(process="world", level="warning", what="gone", sim_time_ns=5_000_000_000))
    heartbeat.close()
    said = capsys.readouterr()
    assert said.out == ""
    assert said.err == ("   5.00 s  WARNING: world: gone\n" if show is Show.people else "")


def test_a_terminal_gets_a_live_table(monkeypatch: pytest.MonkeyPatch) -> None:
    out = io.StringIO()
    monkeypatch.setattr(progress, "Console", lambda stderr: Console(file=out, force_terminal=True, width=100))
    heartbeat = ProgressReporter(SCENARIO, Show.people)
    heartbeat.state = flown()
    heartbeat.take(placed(1, 150, 0.02))
    heartbeat.take(wanted(1, 150))
    heartbeat.take(m.Event(process="world", level="warning", what="gone"))
    heartbeat.close()
    said = out.getvalue()
    assert "WARNING: world: gone" in said
    for part in ("two-chaser-tracking", "of 120 s", "hold", "20.00 mm", "90.000 deg"):
        assert part in said
    assert said.endswith("\x1b[?25h")  # the cursor is back
