# SPDX-License-Identifier: Apache-2.0
"""Phases, operator commands, and behaviour without a target."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, get_args

import numpy as np
import pytest
from chaserdock_controller.core import ControllerCore
from chaserdock_controller.guidance.fleet import ChaserFleet
from chaserdock_controller.guidance.phases import (
    TRANSITIONS,
    Phase,
    Trigger,
    next_phase,
    permitted_commands,
)
from chaserdock_controller.guidance.stage import GuidanceStage
from chaserdock_controller.guidance.thruster_commands import THRUSTER_COMMANDS
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import OperatorCommand, OperatorCommandName, PhaseName
from chaserdock_protocol.scenario import Scenario
from docking_cases import scenario as capture_scenario
from flight_cases import (
    at,
    drain,
    fleet_of,
    known,
    odometry,
    order,
    points,
    quick,
    scenario,
    step,
    tick_inputs,
)
from hypothesis import example, given
from hypothesis import strategies as st


def operator(
    command: Any, chaser: int = 0, offset: tuple[float, float, float] | None = None
) -> OperatorCommand:
    return OperatorCommand(command=command, chaser=chaser, offset_m=offset)


def holding(**changes: Any) -> ChaserFleet:
    guidance = fleet_of(scenario(**changes), acquired_s=1.0)
    return guidance


def acquire(guidance: ChaserFleet, now_s: float) -> None:
    guidance.follow_target(now_s, [known(now_s)] * 2, seen=True, settled=False)


def reference(guidance: ChaserFleet, i: int, t: float) -> Array:
    return at(guidance.chasers[i].state.move, t)[0]


def phases(guidance: ChaserFleet) -> list[str]:
    return [c.phase for c in guidance.chasers]


def test_nothing_is_accepted_before_the_target_is_found() -> None:
    guidance = fleet_of(scenario())
    assert phases(guidance) == ["acquire", "acquire"]
    for what in ("approach", "hold", "retreat", "abort"):
        answer = order(guidance, operator(what), 1.0)
        assert not answer.accepted
        assert "not been found" in answer.reason
    assert not order(guidance, operator("goto", 0, (2.0, 0.0, 0.0)), 1.0).accepted
    assert phases(guidance) == ["acquire", "acquire"]
    assert drain(guidance) == []
    acquire(guidance, 2.0)
    assert phases(guidance) == ["hold", "hold"]
    assert drain(guidance) == [(0, "hold", "from acquire"), (1, "hold", "from acquire")]
    acquire(guidance, 3.0)
    assert drain(guidance) == []
    assert guidance.chasers[0].state.since_s == 2.0


def test_holding_chaser_stays_at_its_nominal_offset() -> None:
    guidance = holding()
    for i, nominal in enumerate(([-1.0, 0.0, 0.0], [0.0, -1.2, 0.0])):
        np.testing.assert_array_equal(reference(guidance, i, 50.0), nominal)
        np.testing.assert_array_equal(at(guidance.chasers[i].state.move, 50.0)[1], np.zeros(3))


@pytest.mark.parametrize("chaser", [2, 200])
def test_commands_for_unknown_chasers_are_refused(chaser: int) -> None:
    answer = order(holding(), operator("approach", chaser), 1.0)
    assert not answer.accepted
    assert answer.reason == f"there is no chaser {chaser}; this mission has 0 to 1"


def test_an_approach_goes_straight_in_to_the_docking_distance_and_docks() -> None:
    guidance = holding()
    answer = order(guidance, operator("approach", 1), 10.0)
    assert (answer.accepted, answer.reason) == (True, "phase approach")
    assert phases(guidance) == ["hold", "approach"]
    np.testing.assert_allclose(guidance.chasers[1].line.docked_m, [0.0, -0.4, 0.0])
    end = 10.0 + guidance.chasers[1].state.move.duration_s
    assert end == pytest.approx(10.0 + 1.875 * 0.8 / 0.03)
    for t in np.linspace(10.0, end, 50):
        p = reference(guidance, 1, t)
        assert p[0] == p[2] == 0.0
        assert -1.2 - 1e-9 <= p[1] <= -0.4 + 1e-9
    # Under way good tracking is no docking.
    step(guidance.chasers[1], end - 1.0, 0.0, 0.0)
    assert guidance.chasers[1].state.inside_since_s is None
    angle = math.radians(1.0)
    step(guidance.chasers[1], end + 0.1, 0.009, angle * 0.99)
    step(guidance.chasers[1], end + 4.0, 0.011, 0.0)  # outside: from the beginning again
    step(guidance.chasers[1], end + 5.0, 0.009, 0.0)
    step(guidance.chasers[1], end + 9.9, 0.009, angle * 0.99)
    assert phases(guidance)[1] == "approach"
    step(guidance.chasers[1], end + 10.0, 0.009, 0.0)
    assert phases(guidance) == ["hold", "docked"]
    assert drain(guidance) == [(1, "approach", "from hold"), (1, "docked", "from approach")]
    # Docked is not for ever.
    step(guidance.chasers[1], end + 11.0, 0.0, angle * 1.01)
    assert phases(guidance)[1] == "approach"
    step(guidance.chasers[1], end + 12.0, 0.0, 0.0)
    step(guidance.chasers[1], end + 17.0, 0.0, 0.0)
    assert phases(guidance)[1] == "docked"


def test_commands_are_idempotent() -> None:
    guidance = holding()
    assert order(guidance, operator("hold"), 5.0).reason == "already in phase hold"
    order(guidance, operator("approach"), 10.0)
    before = guidance.chasers[0].state
    again = order(guidance, operator("approach"), 20.0)
    assert (again.accepted, again.reason) == (True, "already in phase approach")
    assert guidance.chasers[0].state is before  # neither the move nor the clock restarts
    end = 10.0 + before.move.duration_s
    step(guidance.chasers[0], end, 0.0, 0.0)
    step(guidance.chasers[0], end + 5.0, 0.0, 0.0)
    assert phases(guidance)[0] == "docked"
    docked = guidance.chasers[0].state
    again = order(guidance, operator("approach"), end + 6.0)
    assert (again.accepted, again.reason) == (True, "already in phase docked")
    assert guidance.chasers[0].state is docked
    for what in ("retreat", "abort"):
        order(guidance, operator(what), end + 7.0)
        under_way = guidance.chasers[0].state
        assert order(guidance, operator(what), end + 8.0).accepted
        assert guidance.chasers[0].state is under_way


@pytest.mark.parametrize(("what", "speed"), [("retreat", 0.03), ("abort", 0.06)])
def test_retreat_and_abort_go_back_to_the_nominal_offset_and_hold(what: str, speed: float) -> None:
    guidance = holding()
    order(guidance, operator("approach"), 10.0)
    half_way = reference(guidance, 0, 30.0)
    assert order(guidance, operator(what), 30.0).reason == f"phase {what}"
    move = guidance.chasers[0].state.move
    np.testing.assert_allclose(reference(guidance, 0, 30.0), half_way, rtol=0, atol=1e-12)
    np.testing.assert_allclose(move.goal_m, [-1.0, 0.0, 0.0], rtol=0, atol=1e-9)
    speeds = np.linalg.norm(move.at(np.linspace(30.0, 30.0 + move.duration_s, 200))[1], axis=1)
    assert speeds.max() <= speed * 1.01
    step(guidance.chasers[0], 30.0 + move.duration_s - 0.1, 0.0, 0.0)
    assert phases(guidance)[0] == what
    step(
        guidance.chasers[0], 30.0 + move.duration_s, 5.0, 3.0
    )  # the reference is there, wherever the chaser is
    assert phases(guidance)[0] == "hold"
    np.testing.assert_allclose(reference(guidance, 0, 1000.0), [-1.0, 0.0, 0.0], rtol=0, atol=1e-9)


def test_hold_stops_an_approach_where_it_is() -> None:
    guidance = holding()
    order(guidance, operator("approach"), 10.0)
    here, velocity, _ = at(guidance.chasers[0].state.move, 28.0)
    assert velocity[0] == pytest.approx(0.03, rel=0.05)
    order(guidance, operator("hold"), 28.0)
    move = guidance.chasers[0].state.move
    np.testing.assert_allclose(at(move, 28.0)[1], velocity, rtol=0, atol=1e-12)
    assert 0.0 < move.goal_m[0] - here[0] < 0.06
    # And the approach can be taken up again from there.
    assert order(guidance, operator("approach"), 60.0).accepted
    np.testing.assert_allclose(
        guidance.chasers[0].state.move.goal_m, [-0.4, 0.0, 0.0], rtol=0, atol=1e-9
    )


def test_goto_goes_where_it_may() -> None:
    guidance = holding()
    answer = order(guidance, operator("goto", 0, (0.0, 0.0, 1.5)), 10.0)
    assert (answer.accepted, answer.reason) == (True, "phase goto")
    first = guidance.chasers[0].state.move
    np.testing.assert_allclose(first.goal_m, [0.0, 0.0, 1.5], rtol=0, atol=1e-9)
    # Another goto changes the goal under way.
    assert order(guidance, operator("goto", 0, (0.0, 0.0, 2.0)), 20.0).accepted
    second = guidance.chasers[0].state.move
    np.testing.assert_allclose(second.goal_m, [0.0, 0.0, 2.0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(at(second, 20.0)[1], at(first, 20.0)[1], rtol=0, atol=1e-12)
    step(guidance.chasers[0], 20.0 + second.duration_s, 1.0, 1.0)
    assert phases(guidance)[0] == "hold"


@pytest.mark.parametrize(
    ("offset", "reason"),
    [
        (None, "goto needs an offset"),
        ((0.0, 0.0, 0.0), "0 m from the target; allowed are more than 0.35 m"),
        ((0.35, 0.0, 0.0), "0.35 m from the target"),
        ((0.0, 0.0, 25.01), "25 m from the target"),
        ((0.1, -1.2, 0.0), "0.1 m from the goal of chaser 1"),
    ],
)
def test_goto_is_refused_with_the_reason(offset: Any, reason: str) -> None:
    guidance = holding()
    before = guidance.chasers[0].state
    answer = order(guidance, operator("goto", 0, offset), 10.0)
    assert not answer.accepted
    assert reason in answer.reason
    assert guidance.chasers[0].state is before
    assert drain(guidance) == []


def test_goto_keeps_away_from_where_others_are_going_not_where_they_were() -> None:
    guidance = holding()
    order(guidance, operator("goto", 1, (0.0, 2.0, 0.0)), 10.0)
    assert not order(guidance, operator("goto", 0, (0.0, 2.1, 0.0)), 11.0).accepted
    assert order(guidance, operator("goto", 0, (0.0, -1.2, 0.0)), 12.0).accepted
    assert order(guidance, operator("goto", 0, (0.0, -1.1, 0.0)), 13.0).accepted  # nor from itself


def test_an_approach_starts_on_its_line_only() -> None:
    guidance = holding()
    order(guidance, operator("goto", 0, (-1.0, 0.5, 0.0)), 10.0)
    end = 10.0 + guidance.chasers[0].state.move.duration_s
    step(guidance.chasers[0], end, 0.0, 0.0)
    answer = order(guidance, operator("approach"), end)
    assert not answer.accepted
    assert (
        answer.reason == "the reference is 0.50 m beside the approach line; retreat or goto first"
    )
    assert phases(guidance)[0] == "hold"
    order(guidance, operator("retreat"), end)
    assert order(
        guidance, operator("approach"), end + guidance.chasers[0].state.move.duration_s
    ).accepted


def test_an_approach_does_not_go_through_the_target() -> None:
    guidance = holding()
    order(guidance, operator("goto", 0, (1.0, 0.0, 0.0)), 10.0)
    end = 10.0 + guidance.chasers[0].state.move.duration_s
    assert not order(guidance, operator("approach"), end).accepted


def lose(guidance: ChaserFleet, now_s: float) -> None:
    for chaser in guidance.chasers:
        chaser.lose_target(now_s)


def test_losing_the_target_stops_moving_chasers() -> None:
    guidance = holding()
    order(guidance, operator("approach", 0), 10.0)
    lose(guidance, 30.0)
    assert phases(guidance) == ["hold", "hold"]
    assert (
        np.linalg.norm(guidance.chasers[0].state.move.goal_m - reference(guidance, 0, 30.0)) < 0.06
    )
    stopped = guidance.chasers[0].state
    lose(guidance, 31.0)
    assert guidance.chasers[0].state is stopped


def test_timeline_commands_come_due_once_and_in_order() -> None:
    timeline = [
        {"at_s": 20.0, "command": "hold", "chasers": [1]},
        {"at_s": 5.0, "command": "goto", "chasers": [0], "offset_m": [0.0, 0.0, 2.0]},
        {"at_s": 5.0, "command": "approach", "chasers": [1, 0]},
    ]
    guidance = fleet_of(scenario(timeline=timeline))
    assert guidance.due_commands(4.99) == []
    assert guidance.due_commands(5.0 - 1e-10) == [
        operator("goto", 0, (0.0, 0.0, 2.0)),
        operator("approach", 1),
        operator("approach", 0),
    ]
    assert guidance.due_commands(10.0) == []
    assert guidance.due_commands(1e9) == [operator("hold", 1)]
    assert guidance.due_commands(2e9) == []


COMMANDS = st.one_of(
    st.tuples(st.sampled_from(["approach", "hold", "retreat", "abort"]), st.just(None)),
    st.tuples(st.just("goto"), points),
)


@given(st.lists(st.tuples(COMMANDS, st.floats(0.1, 40.0)), max_size=8))
@example(
    asked=[(("approach", None), 28.0), (("goto", (1.0, 0.0, 0.0)), 10.0), (("hold", None), 1.0)]
)
@quick
def test_reference_is_smooth_and_slow_for_any_commands(
    asked: list[tuple[tuple[Any, Any], float]],
) -> None:
    guidance, now = holding(), 1.0
    for (what, offset), wait_s in asked:
        before = at(guidance.chasers[0].state.move, now)
        answer = order(guidance, operator(what, 0, offset), now)
        after = at(guidance.chasers[0].state.move, now)
        np.testing.assert_allclose(after[0], before[0], rtol=0, atol=1e-8)
        np.testing.assert_allclose(after[1], before[1], rtol=0, atol=1e-8)
        assert answer.reason
        goal_m = guidance.chasers[0].state.move.goal_m
        # A hold may end on a way that leads through the target: the plan keeps the distance, not
        # the reference.
        nearest_m = 0.0 if guidance.chasers[0].phase == "hold" else 0.3
        assert nearest_m <= np.linalg.norm(goal_m) < 10.0
        for t in np.linspace(now, now + wait_s, 5):
            assert np.linalg.norm(at(guidance.chasers[0].state.move, t)[1]) <= 0.06 * 1.3
            step(guidance.chasers[0], float(t), 0.0, 0.0)
        now += wait_s
    assert guidance.chasers[1].phase == "hold"


# -- the controller without a target ---------------------------------------------------------------


def test_without_a_target_everyone_brakes_and_every_tick_is_answered() -> None:
    timeline = [{"at_s": 0.0, "command": "approach", "chasers": [0]}]
    mission = scenario(timeline=timeline)
    flight = ControllerCore(mission, lambda: 0.0)
    timing = mission.timing
    for tick in range(4):
        here = {i: odometry(i, tick, timing.tick_time_ns(tick)) for i in (0, 1)}
        out = flight.step(tick_inputs(tick, timing.tick_time_ns(tick), here, ()))
        assert out.target.status == "none"
        assert out.target.accepted == ()
        assert sorted(out.wrenches) == [0, 1]
        assert out.plans == {}
        for i, wrench in out.wrenches.items():
            assert wrench.mode == "brake"
            assert wrench.chaser == i
            assert wrench.effective_time_ns == timing.effective_ns(tick)
            assert wrench.expires_ns == wrench.sim_time_ns + 500_000_000
            speed = rotations.rotate(here[i].q_wxyz, wrench.force_N) @ np.array(
                here[i].velocity_m_s
            )
            assert speed < 0.0
        assert out.solver is not None
        assert out.solver.chasers == ()
        events = [(r.accepted, r.reason) for r in out.replies]
        assert events == ([(False, "the target has not been found yet")] if tick == 0 else [])
    assert flight.step(
        tick_inputs(4, timing.tick_time_ns(4), {1: odometry(1, 4)}, ())
    ).wrenches.keys() == {1}


# -- when nobody sees the target -------------------------------------------------------------------


def blind_phases(seen: Callable[[float], bool], command: str = "") -> list[tuple[float, str, str]]:
    """Phases of chaser 0, commanded to approach at 0 s, with their reasons; ``command`` at 10 s."""
    guidance, out = fleet_of(scenario()), []
    for k in range(300):
        now_s = 0.1 * k
        guidance.follow_target(now_s, [known(now_s)] * 2, seen(now_s), settled=False)
        if k == 1:
            assert order(guidance, operator("approach"), now_s).accepted
        if k == 100 and command:
            order(guidance, operator(command), now_s)
        out += [(round(now_s, 1), what, why) for i, what, why in drain(guidance) if i == 0]
    return out


def test_approach_holds_while_the_target_is_out_of_sight_and_continues() -> None:
    events = blind_phases(lambda s: not 5.0 < s < 15.0)
    assert [(what, why.partition(": ")[2]) for _, what, why in events] == [
        ("hold", ""),
        ("approach", ""),
        ("hold", "no chaser has seen the target for 3 s"),
        ("approach", "its sightings can be used again"),
    ]
    assert events[2][0] == pytest.approx(8.0, abs=0.11)
    assert events[3][0] == pytest.approx(15.0, abs=0.11)


def test_a_moment_without_sight_changes_nothing() -> None:
    assert [what for _, what, _ in blind_phases(lambda s: not 5.0 < s < 7.9)] == [
        "hold",
        "approach",
    ]


def test_approach_holds_while_the_odometry_is_doubtful_and_continues() -> None:
    guidance, events = fleet_of(scenario()), []
    for k in range(100):
        ticks = [known(0.1 * k, doubtful=20 <= k < 40), known(0.1 * k)]
        guidance.follow_target(0.1 * k, ticks, seen=True, settled=False)
        if k == 1:
            for i in (0, 1):
                assert order(guidance, operator("approach", i), 0.1).accepted
        events += [(k, *change) for change in drain(guidance)]
    reason = "its sightings have contradicted its odometry since that was received"
    assert [(k, i, what, why.partition(": ")[2]) for k, i, what, why in events if k >= 20] == [
        (20, 0, "hold", reason),
        (40, 0, "approach", "its sightings can be used again"),
    ]


def test_commanded_chaser_does_not_resume_its_approach() -> None:
    assert [what for _, what, _ in blind_phases(lambda s: not 5.0 < s < 15.0, "hold")] == [
        "hold",
        "approach",
        "hold",
    ]


@pytest.mark.parametrize(
    ("phase", "by_capture", "target"),
    [
        (Phase.APPROACH, False, Phase.HOLD),
        (Phase.APPROACH, True, Phase.RETREAT),
        (Phase.ALIGN, True, Phase.RETREAT),
        (Phase.FINAL, True, Phase.RETREAT),
        (Phase.CONTACT, True, None),
        (Phase.LATCHED, True, None),
        (Phase.DOCKED, False, None),
        (Phase.RETREAT, True, None),
        (Phase.GOTO, False, None),
    ],
)
def test_loss_of_sight_interrupts_approaches_only(
    phase: Phase, by_capture: bool, target: Phase | None
) -> None:
    assert next_phase(phase, Trigger.SIGHT_LOST, by_capture) is target


# -- the transition table --------------------------------------------------------------------------


def test_every_transition_is_unique() -> None:
    keys = [
        (source, t.trigger, kind)
        for t in TRANSITIONS
        for source in t.sources
        for kind in ((False, True) if t.by_capture is None else (t.by_capture,))
    ]
    assert len(keys) == len(set(keys))


@pytest.mark.parametrize("mission", [scenario(), capture_scenario()])
def test_every_phase_and_command_belongs_to_one_activity(mission: Scenario) -> None:
    """Of those that a kind of docking leads to; isolating and restoring thrusters change no
    phase.
    """
    stage = GuidanceStage(mission)
    kinds = (None, stage.chasers[0].by_capture)
    activities = [a for a in stage.activities if a.by_capture in kinds]
    phases = [phase for a in activities for phase in a.phases]
    commands = [command for a in activities for command in a.commands]
    assert {t.target for t in TRANSITIONS if t.by_capture in kinds} | {Phase.ACQUIRE} <= set(phases)
    assert len(phases) == len(set(phases))
    assert sorted((*commands, *THRUSTER_COMMANDS)) == sorted(get_args(OperatorCommandName))


def test_every_phase_can_be_entered_and_left() -> None:
    first = {Phase.ACQUIRE, Phase.SURVEY}
    assert {t.target for t in TRANSITIONS} == set(Phase) - first
    assert {source for t in TRANSITIONS for source in t.sources} == set(Phase)


def test_abort_and_retreat_are_permitted_in_every_phase_with_a_known_target() -> None:
    for by_capture in (False, True):
        for phase in {
            s for t in TRANSITIONS if t.by_capture in (None, by_capture) for s in t.sources
        }:
            permitted = permitted_commands(phase, by_capture)
            expected = (
                set()
                if phase in (Phase.ACQUIRE, Phase.SEARCHING, Phase.SURVEY)
                else {"abort", "retreat"} - {phase}
            )
            assert expected <= set(permitted)


def test_phases_are_those_of_the_reference_message() -> None:
    assert tuple(Phase) == get_args(PhaseName)
