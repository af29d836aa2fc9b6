"""What chasers are told to do: moves, phases, prediction, and which commands a chaser refuses to fly."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import msgspec
import numpy as np
import pytest
from chaserdock_agents.chaser.pilot import brake, passed_on, refusal
from chaserdock_controller.flight import Flight, Inputs
from chaserdock_controller.guidance import Guidance
from chaserdock_controller.moves import Move, move_to, stay, stop
from chaserdock_controller.prediction import CommandHistory, integrate, predict_state
from chaserdock_protocol import rotations
from chaserdock_protocol.messages import Odometry, OperatorCommand, WrenchCommand
from chaserdock_protocol.rotations import Array
from chaserdock_protocol.scenario import Body, Scenario, parse_scenario
from hypothesis import example, given, settings
from hypothesis import strategies as st

quick = settings(derandomize=True, deadline=None, max_examples=60)
points = st.tuples(*[st.floats(-3.0, 3.0, allow_subnormal=False)] * 3)
HALF = math.sqrt(0.5)


def scenario(**changes: Any) -> Scenario:
    values: dict[str, Any] = {
        "name": "test",
        "duration_s": 100.0,
        "approach": {"dock_distance_m": 0.4, "max_speed_m_s": 0.03},
        "chasers": [
            {"position_m": [-1.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]},
            {"position_m": [0.0, -1.2, 0.0], "q_wxyz": [HALF, 0.0, 0.0, HALF]},
        ],
    }
    return parse_scenario(values | changes, "test")


def at(move: Move, t: float) -> tuple[Array, Array, Array]:
    p, v, a = move.at(np.array([t]))
    return p[0], v[0], a[0]


# -- moves ------------------------------------------------------------------------------------------------


@given(points, points, st.floats(0.0, 100.0), st.floats(0.01, 0.2))
@quick
def test_a_move_from_rest_goes_from_here_to_there_and_rests(
    start: Any, goal: Any, now: float, speed: float
) -> None:
    move = move_to(stay(start, 0.0), goal, now, speed)
    end = move.start_s + move.duration_s
    for t, place in ((now, start), (end, goal)):
        p, v, a = at(move, t)
        np.testing.assert_allclose(p, place, rtol=0, atol=1e-9)
        np.testing.assert_allclose(v, 0.0, rtol=0, atol=1e-9)
        np.testing.assert_allclose(a, 0.0, rtol=0, atol=1e-9)
    np.testing.assert_allclose(move.goal_m, goal, rtol=0, atol=1e-9)
    assert move.over_at(end)
    assert not move.over_at(end - 1e-3)
    # Before and after it stands still, where it was and where it went.
    np.testing.assert_allclose(at(move, now - 5.0)[0], start, rtol=0, atol=1e-9)
    np.testing.assert_allclose(at(move, end + 5.0)[0], goal, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(at(move, end + 5.0)[1:], np.zeros((2, 3)))
    times = np.linspace(now, end, 500)
    positions, velocities, _ = move.at(times)
    assert np.linalg.norm(velocities, axis=1).max() <= speed * 1.002
    # On the straight line between the two, and never back.
    way = np.subtract(goal, start)
    if np.linalg.norm(way) > 1e-3:
        along = (positions - start) @ way / (way @ way)
        np.testing.assert_allclose(positions, np.add(start, along[:, None] * way), rtol=0, atol=1e-8)
        assert np.all(np.diff(along) >= -1e-9)


def fastest(move: Move) -> float:
    times = np.linspace(move.start_s, move.start_s + move.duration_s, 3000)
    return float(np.linalg.norm(move.at(times)[1], axis=1).max())


@given(points, points, points, st.floats(0.0, 1.0), st.floats(0.01, 0.2), st.sampled_from([0.5, 1.0, 2.0]))
@example((-1, 0, 0), (0, 0, 0.5), (-0.4, 0, 0), 0.2, 0.06, 0.5)  # accelerating when a slower move begins
@example((0, 0, 0), (-0.6, 0, 0), (0, 0, 0), 0.21, 0.03, 1.0)  # back, at the moment of most acceleration
@quick
def test_a_move_out_of_a_move_is_smooth_and_no_faster_than_it_must_be(
    a: Any, b: Any, c: Any, share: float, speed: float, factor: float
) -> None:
    """Position, velocity and acceleration go on where they were; it ends at rest; the speed stays bounded."""
    first = move_to(stay(a, 0.0), b, 0.0, speed)
    now = share * first.duration_s
    second = move_to(first, c, now, speed * factor)
    for was, now_is in zip(at(first, now), at(second, now), strict=True):
        np.testing.assert_allclose(now_is, was, rtol=0, atol=1e-9)
    p, v, acceleration = at(second, now + second.duration_s)
    np.testing.assert_allclose(p, c, rtol=0, atol=1e-8)
    np.testing.assert_allclose(v, 0.0, rtol=0, atol=1e-8)
    np.testing.assert_allclose(acceleration, 0.0, rtol=0, atol=1e-8)
    stopping = fastest(stop(first, now))
    assert fastest(second) <= max(speed * factor, stopping) * 1.01
    assert stopping <= speed * 1.3
    assert second.duration_s <= 10.0 + 3.0 * 1.875 * math.dist(p, at(first, now)[0]) / (speed * factor)


@given(points, points, st.floats(0.0, 1.0))
@quick
def test_velocity_and_acceleration_are_the_positions_derivatives(a: Any, b: Any, share: float) -> None:
    move = move_to(stay(a, 0.0), b, 3.0, 0.1)
    t, h = 3.0 + move.duration_s * (0.01 + 0.98 * share), 1e-3 * move.duration_s
    (p0, v0, _), (_, v, acc), (p1, v1, _) = at(move, t - h), at(move, t), at(move, t + h)
    np.testing.assert_allclose((p1 - p0) / (2 * h), v, rtol=0, atol=1e-5)
    np.testing.assert_allclose((v1 - v0) / (2 * h), acc, rtol=0, atol=1e-5)


@given(points, points, st.floats(0.0, 1.2))
@quick
def test_stop_comes_to_rest_a_little_further_on(a: Any, b: Any, share: float) -> None:
    first = move_to(stay(a, 0.0), b, 0.0, 0.05)
    now = share * first.duration_s
    stopping = stop(first, now)
    for was, now_is in zip(at(first, now), at(stopping, now), strict=True):
        np.testing.assert_allclose(now_is, was, rtol=0, atol=1e-9)
    p, v, acceleration = at(stopping, now + stopping.duration_s)
    np.testing.assert_allclose(np.concatenate([v, acceleration]), 0.0, rtol=0, atol=1e-9)
    np.testing.assert_array_equal(p, stopping.goal_m)
    assert np.linalg.norm(p - at(first, now)[0]) <= 0.12
    assert stopping.duration_s <= 3.0


def test_moves_take_their_time() -> None:
    # The quintic's peak is 15/8 of its mean speed.
    assert move_to(stay([0, 0, 0], 0.0), [0.6, 0, 0], 0.0, 0.03).duration_s == pytest.approx(37.5)
    assert move_to(stay([0, 0, 0], 0.0), [1e-6, 0, 0], 0.0, 0.03).duration_s >= 1.0


@pytest.mark.parametrize("speed", [0.0, -1.0, math.nan])
def test_a_speed_must_be_positive(speed: float) -> None:
    with pytest.raises(ValueError, match="must be positive"):
        move_to(stay([0, 0, 0], 0.0), [1, 0, 0], 0.0, speed)


# -- guidance ---------------------------------------------------------------------------------------------


def operator(
    command: Any, chaser: int = 0, offset: tuple[float, float, float] | None = None
) -> OperatorCommand:
    return OperatorCommand(command=command, chaser=chaser, offset_m=offset)


def holding(**changes: Any) -> Guidance:
    guidance = Guidance(scenario(**changes))
    guidance.found(1.0)
    guidance.drain_events()
    return guidance


def reference(guidance: Guidance, i: int, t: float) -> Array:
    return at(guidance.chasers[i].move, t)[0]


def phases(guidance: Guidance) -> list[str]:
    return [c.phase for c in guidance.chasers]


def test_nothing_is_accepted_before_the_target_is_found() -> None:
    guidance = Guidance(scenario())
    assert phases(guidance) == ["acquire", "acquire"]
    for what in ("approach", "hold", "retreat", "abort"):
        answer = guidance.command(operator(what), 1.0)
        assert not answer.accepted
        assert "not been found" in answer.reason
    assert not guidance.command(operator("goto", 0, (2.0, 0.0, 0.0)), 1.0).accepted
    assert phases(guidance) == ["acquire", "acquire"]
    assert guidance.drain_events() == []
    guidance.found(2.0)
    assert phases(guidance) == ["hold", "hold"]
    assert guidance.drain_events() == [(0, "hold", "from acquire"), (1, "hold", "from acquire")]
    guidance.found(3.0)
    assert guidance.drain_events() == []
    assert guidance.chasers[0].since_s == 2.0


def test_who_holds_stays_at_its_nominal_offset() -> None:
    guidance = holding()
    for i, nominal in enumerate(([-1.0, 0.0, 0.0], [0.0, -1.2, 0.0])):
        np.testing.assert_array_equal(reference(guidance, i, 50.0), nominal)
        np.testing.assert_array_equal(at(guidance.chasers[i].move, 50.0)[1], np.zeros(3))


@pytest.mark.parametrize("chaser", [2, 200])
def test_commands_for_nobody_are_refused(chaser: int) -> None:
    answer = holding().command(operator("approach", chaser), 1.0)
    assert not answer.accepted
    assert answer.reason == f"there is no chaser {chaser}; this mission has 0 to 1"


def test_an_approach_goes_straight_in_to_the_docking_distance_and_docks() -> None:
    guidance = holding()
    answer = guidance.command(operator("approach", 1), 10.0)
    assert (answer.accepted, answer.reason) == (True, "phase approach")
    assert phases(guidance) == ["hold", "approach"]
    np.testing.assert_allclose(guidance.dock_offset(1), [0.0, -0.4, 0.0])
    end = 10.0 + guidance.chasers[1].move.duration_s
    assert end == pytest.approx(10.0 + 1.875 * 0.8 / 0.03)
    for t in np.linspace(10.0, end, 50):
        p = reference(guidance, 1, t)
        assert p[0] == p[2] == 0.0
        assert -1.2 - 1e-9 <= p[1] <= -0.4 + 1e-9
    # Under way good tracking is no docking.
    guidance.observe(1, end - 1.0, 0.0, 0.0)
    assert guidance.chasers[1].inside_since_s is None
    angle = math.radians(1.0)
    guidance.observe(1, end + 0.1, 0.009, angle * 0.99)
    guidance.observe(1, end + 4.0, 0.011, 0.0)  # outside: from the beginning again
    guidance.observe(1, end + 5.0, 0.009, 0.0)
    guidance.observe(1, end + 9.9, 0.009, angle * 0.99)
    assert phases(guidance)[1] == "approach"
    guidance.observe(1, end + 10.0, 0.009, 0.0)
    assert phases(guidance) == ["hold", "docked"]
    assert guidance.drain_events() == [(1, "approach", "from hold"), (1, "docked", "from approach")]
    # Docked is not for ever.
    guidance.observe(1, end + 11.0, 0.0, angle * 1.01)
    assert phases(guidance)[1] == "approach"
    guidance.observe(1, end + 12.0, 0.0, 0.0)
    guidance.observe(1, end + 17.0, 0.0, 0.0)
    assert phases(guidance)[1] == "docked"


def test_commands_are_idempotent() -> None:
    guidance = holding()
    assert guidance.command(operator("hold"), 5.0).reason == "already in phase hold"
    guidance.command(operator("approach"), 10.0)
    before = guidance.chasers[0]
    again = guidance.command(operator("approach"), 20.0)
    assert (again.accepted, again.reason) == (True, "already in phase approach")
    assert guidance.chasers[0] is before  # neither the move nor the clock begins anew
    end = 10.0 + before.move.duration_s
    guidance.observe(0, end, 0.0, 0.0)
    guidance.observe(0, end + 5.0, 0.0, 0.0)
    assert phases(guidance)[0] == "docked"
    docked = guidance.chasers[0]
    again = guidance.command(operator("approach"), end + 6.0)
    assert (again.accepted, again.reason) == (True, "already in phase docked")
    assert guidance.chasers[0] is docked
    for what in ("retreat", "abort"):
        guidance.command(operator(what), end + 7.0)
        under_way = guidance.chasers[0]
        assert guidance.command(operator(what), end + 8.0).accepted
        assert guidance.chasers[0] is under_way


@pytest.mark.parametrize(("what", "speed"), [("retreat", 0.03), ("abort", 0.06)])
def test_retreat_and_abort_go_back_to_the_nominal_offset_and_hold(what: str, speed: float) -> None:
    guidance = holding()
    guidance.command(operator("approach"), 10.0)
    half_way = reference(guidance, 0, 30.0)
    assert guidance.command(operator(what), 30.0).reason == f"phase {what}"
    move = guidance.chasers[0].move
    np.testing.assert_allclose(reference(guidance, 0, 30.0), half_way, rtol=0, atol=1e-12)
    np.testing.assert_allclose(move.goal_m, [-1.0, 0.0, 0.0], rtol=0, atol=1e-9)
    speeds = np.linalg.norm(move.at(np.linspace(30.0, 30.0 + move.duration_s, 200))[1], axis=1)
    assert speeds.max() <= speed * 1.01
    guidance.observe(0, 30.0 + move.duration_s - 0.1, 0.0, 0.0)
    assert phases(guidance)[0] == what
    guidance.observe(0, 30.0 + move.duration_s, 5.0, 3.0)  # the reference is there, wherever the chaser is
    assert phases(guidance)[0] == "hold"
    np.testing.assert_allclose(reference(guidance, 0, 1000.0), [-1.0, 0.0, 0.0], rtol=0, atol=1e-9)


def test_hold_stops_an_approach_where_it_is() -> None:
    guidance = holding()
    guidance.command(operator("approach"), 10.0)
    here, velocity, _ = at(guidance.chasers[0].move, 28.0)
    assert velocity[0] == pytest.approx(0.03, rel=0.05)
    guidance.command(operator("hold"), 28.0)
    move = guidance.chasers[0].move
    np.testing.assert_allclose(at(move, 28.0)[1], velocity, rtol=0, atol=1e-12)
    assert 0.0 < move.goal_m[0] - here[0] < 0.06
    # And the approach can be taken up again from there.
    assert guidance.command(operator("approach"), 60.0).accepted
    np.testing.assert_allclose(guidance.chasers[0].move.goal_m, [-0.4, 0.0, 0.0], rtol=0, atol=1e-9)


def test_goto_goes_where_it_may() -> None:
    guidance = holding()
    answer = guidance.command(operator("goto", 0, (0.0, 0.0, 1.5)), 10.0)
    assert (answer.accepted, answer.reason) == (True, "phase goto")
    first = guidance.chasers[0].move
    np.testing.assert_allclose(first.goal_m, [0.0, 0.0, 1.5], rtol=0, atol=1e-9)
    # Another goto changes the goal under way.
    assert guidance.command(operator("goto", 0, (0.0, 0.0, 2.0)), 20.0).accepted
    second = guidance.chasers[0].move
    np.testing.assert_allclose(second.goal_m, [0.0, 0.0, 2.0], rtol=0, atol=1e-9)
    np.testing.assert_allclose(at(second, 20.0)[1], at(first, 20.0)[1], rtol=0, atol=1e-12)
    guidance.observe(0, 20.0 + second.duration_s, 1.0, 1.0)
    assert phases(guidance)[0] == "hold"


@pytest.mark.parametrize(
    ("offset", "reason"),
    [
        (None, "goto needs an offset"),
        ((0.0, 0.0, 0.0), "0 m from the target; allowed are more than 0.35 m"),
        ((0.35, 0.0, 0.0), "0.35 m from the target"),
        ((0.0, 0.0, 25.01), "25 m from the target"),
        ((0.1, -1.2, 0.0), "0.1 m from where chaser 1 is to be"),
    ],
)
def test_goto_is_refused_with_the_reason(offset: Any, reason: str) -> None:
    guidance = holding()
    before = guidance.chasers[0]
    answer = guidance.command(operator("goto", 0, offset), 10.0)
    assert not answer.accepted
    assert reason in answer.reason
    assert guidance.chasers[0] is before
    assert guidance.drain_events() == []


def test_goto_keeps_away_from_where_others_are_going_not_where_they_were() -> None:
    guidance = holding()
    guidance.command(operator("goto", 1, (0.0, 2.0, 0.0)), 10.0)
    assert not guidance.command(operator("goto", 0, (0.0, 2.1, 0.0)), 11.0).accepted
    assert guidance.command(operator("goto", 0, (0.0, -1.2, 0.0)), 12.0).accepted
    assert guidance.command(operator("goto", 0, (0.0, -1.1, 0.0)), 13.0).accepted  # nor from itself


def test_an_approach_starts_on_its_line_only() -> None:
    guidance = holding()
    guidance.command(operator("goto", 0, (-1.0, 0.5, 0.0)), 10.0)
    end = 10.0 + guidance.chasers[0].move.duration_s
    guidance.observe(0, end, 0.0, 0.0)
    answer = guidance.command(operator("approach"), end)
    assert not answer.accepted
    assert answer.reason == "its reference is 0.50 m beside its approach line; retreat or goto first"
    assert phases(guidance)[0] == "hold"
    guidance.command(operator("retreat"), end)
    assert guidance.command(operator("approach"), end + guidance.chasers[0].move.duration_s).accepted


def test_an_approach_does_not_go_through_the_target() -> None:
    guidance = holding()
    guidance.command(operator("goto", 0, (1.0, 0.0, 0.0)), 10.0)
    end = 10.0 + guidance.chasers[0].move.duration_s
    assert not guidance.command(operator("approach"), end).accepted


def test_losing_the_target_stops_whoever_moves() -> None:
    guidance = holding()
    guidance.command(operator("approach", 0), 10.0)
    guidance.lost(30.0)
    assert phases(guidance) == ["hold", "hold"]
    assert np.linalg.norm(guidance.chasers[0].move.goal_m - reference(guidance, 0, 30.0)) < 0.06
    stopped = guidance.chasers[0]
    guidance.lost(31.0)
    assert guidance.chasers[0] is stopped


def test_timeline_commands_come_due_once_and_in_order() -> None:
    timeline = [
        {"at_s": 20.0, "command": "hold", "chasers": [1]},
        {"at_s": 5.0, "command": "goto", "chasers": [0], "offset_m": [0.0, 0.0, 2.0]},
        {"at_s": 5.0, "command": "approach", "chasers": [1, 0]},
    ]
    guidance = Guidance(scenario(timeline=timeline))
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
@quick
def test_whatever_is_asked_the_reference_is_smooth_and_slow(
    asked: list[tuple[tuple[Any, Any], float]],
) -> None:
    guidance, now = holding(), 1.0
    for (what, offset), wait_s in asked:
        before = at(guidance.chasers[0].move, now)
        answer = guidance.command(operator(what, 0, offset), now)
        after = at(guidance.chasers[0].move, now)
        np.testing.assert_allclose(after[0], before[0], rtol=0, atol=1e-8)
        np.testing.assert_allclose(after[1], before[1], rtol=0, atol=1e-8)
        assert answer.reason
        goal = guidance.chasers[0].move.goal_m
        assert 0.3 < np.linalg.norm(goal) < 10.0
        for t in np.linspace(now, now + wait_s, 5):
            assert np.linalg.norm(at(guidance.chasers[0].move, t)[1]) <= 0.06 * 1.3
            guidance.observe(0, float(t), 0.0, 0.0)
        now += wait_s
    assert guidance.chasers[1].phase == "hold"


# -- the controller without a target ----------------------------------------------------------------------


def odometry(chaser: int = 0, tick: int = 0, time_ns: int = 0, **changes: Any) -> Odometry:
    values: dict[str, Any] = {
        "position_m": (1.0, 2.0, 3.0),
        "velocity_m_s": (0.03, -0.06, 0.0),
        "q_wxyz": (0.5, 0.5, 0.5, 0.5),
        "omega_rad_s": (0.01, 0.0, -0.02),
    }
    return Odometry(tick=tick, sim_time_ns=time_ns, chaser=chaser, **(values | changes))


def test_without_a_target_everyone_brakes_and_every_tick_is_answered() -> None:
    timeline = [{"at_s": 0.0, "command": "approach", "chasers": [0]}]
    mission = scenario(timeline=timeline)
    flight = Flight(mission, lambda: 0.0)
    timing = mission.timing
    for tick in range(4):
        here = {i: odometry(i, tick, timing.tick_time_ns(tick)) for i in (0, 1)}
        out = flight.step(Inputs(tick, timing.tick_time_ns(tick), here, ()))
        assert out.target.status == "none"
        assert out.target.accepted == ()
        assert sorted(out.wrenches) == [0, 1]
        assert out.plans == {}
        for i, wrench in out.wrenches.items():
            assert wrench.mode == "brake"
            assert wrench.chaser == i
            assert wrench.effective_time_ns == timing.effective_ns(tick)
            assert wrench.expires_ns == wrench.sim_time_ns + 500_000_000
            speed = rotations.rotate(here[i].q_wxyz, wrench.force_N) @ np.array(here[i].velocity_m_s)
            assert speed < 0.0
        assert out.solver is not None
        assert out.solver.chasers == ()
        told = [(r.accepted, r.reason) for r in out.replies]
        assert told == ([(False, "the target has not been found yet")] if tick == 0 else [])
    assert flight.step(Inputs(4, timing.tick_time_ns(4), {1: odometry(1, 4)}, ())).wrenches.keys() == {1}


# -- prediction -------------------------------------------------------------------------------------------

LONG = Body(mass_kg=12.0, inertia_kg_m2=(0.1, 0.5, 0.55))


def fine(x: Array, u: Array, body: Body, duration_s: float, steps: int = 4000) -> Array:
    """The rigid body's equations by RK4 in small steps, written with vectors and nothing of the module's."""
    moments, h = np.array(body.inertia), duration_s / steps

    def slope(s: Array) -> Array:
        q, w = s[6:10], s[10:13]
        return np.concatenate(
            [
                s[3:6],
                rotations.to_matrix(q / np.linalg.norm(q)) @ u[:3] / body.mass_kg,
                0.5 * rotations.multiply(q, np.array([0.0, *w])),
                (u[3:] - np.cross(w, moments * w)) / moments,
            ]
        )

    for _ in range(steps):
        k1 = slope(x)
        k2 = slope(x + h / 2 * k1)
        k3 = slope(x + h / 2 * k2)
        k4 = slope(x + h * k3)
        x = x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    x[6:10] /= np.linalg.norm(x[6:10])
    return x


def start(seed: int) -> Array:
    rng = np.random.default_rng(seed)
    x = rng.normal(size=13)
    x[6:10] = rotations.normalize(x[6:10])
    return x


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("duration_s", [1 / 30, 0.5])
def test_integrate_agrees_with_fine_steps(seed: int, duration_s: float) -> None:
    x = start(seed)
    u = np.random.default_rng(seed + 100).uniform(-1, 1, 6) * [2, 2, 2, 0.05, 0.05, 0.05]
    result = integrate(x, u, LONG, duration_s)
    np.testing.assert_allclose(result, fine(x, u, LONG, duration_s, 500), rtol=0, atol=1e-7)
    assert abs(np.linalg.norm(result[6:10]) - 1.0) < 1e-15


def test_integrate_leaves_its_argument_alone_and_nothing_happens_in_no_time() -> None:
    x = start(1)
    before = x.copy()
    np.testing.assert_allclose(integrate(x, np.ones(6), LONG, 0.0), x, rtol=0, atol=1e-15)
    integrate(x, np.ones(6), LONG, 1.0)
    np.testing.assert_array_equal(x, before)


def wrench(value: float) -> Array:
    return np.full(6, value)


def test_history_gives_what_acts_between_two_times() -> None:
    history = CommandHistory()
    history.add(0, 100, wrench(1.0))
    history.add(0, 200, wrench(2.0))
    history.add(1, 150, wrench(9.0))

    def told(begin: int, end: int) -> list[tuple[int, int, float]]:
        return [(a, b, float(w[0])) for a, b, w in history.segments(0, begin, end)]

    assert told(0, 50) == [(0, 50, 0.0)]
    assert told(0, 300) == [(0, 100, 0.0), (100, 200, 1.0), (200, 300, 2.0)]
    assert told(100, 200) == [(100, 200, 1.0)]
    assert told(150, 250) == [(150, 200, 1.0), (200, 250, 2.0)]
    assert told(200, 250) == [(200, 250, 2.0)]
    assert told(500, 501) == [(500, 501, 2.0)]
    assert [float(w[0]) for _, _, w in history.segments(7, 0, 10)] == [0.0]


def test_of_two_commands_for_one_time_the_last_counts() -> None:
    history = CommandHistory()
    history.add(0, 100, wrench(1.0))
    history.add(0, 100, wrench(2.0))
    assert [(a, b, float(w[0])) for a, b, w in history.segments(0, 50, 150)] == [
        (50, 100, 0.0),
        (100, 150, 2.0),
    ]


def test_history_keeps_its_own_copy() -> None:
    history, u = CommandHistory(), wrench(1.0)
    history.add(0, 0, u)
    u[:] = 5.0
    np.testing.assert_array_equal(history.segments(0, 0, 1)[0][2], wrench(1.0))


@given(
    st.lists(st.integers(0, 1000), max_size=8).map(sorted),
    st.integers(0, 1000),
    st.integers(0, 500),
    st.integers(1, 500),
)
@quick
def test_forgetting_the_past_changes_nothing_from_then_on(
    times: list[int], now: int, later: int, span: int
) -> None:
    whole, short = CommandHistory(), CommandHistory()
    for k, t in enumerate(times):
        whole.add(0, t, wrench(float(k + 1)))
        short.add(0, t, wrench(float(k + 1)))
    short.forget_before(now)

    def told(history: CommandHistory) -> list[tuple[int, int, float]]:
        begin = now + later
        return [(a, b, float(w[0])) for a, b, w in history.segments(0, begin, begin + span)]

    assert told(short) == told(whole)
    kept = [float(w[0]) for _, _, w in short.segments(0, 0, 2000)]
    assert len(kept) <= 2 + sum(t > now for t in times)


def test_prediction_flies_the_commands_that_are_under_way() -> None:
    """Two commands take effect between odometry and prediction, as with a latency of more than a tick."""
    o = odometry(time_ns=1_000_000_000)
    history = CommandHistory()
    early = np.array([1.0, -0.5, 0.2, 0.01, -0.02, 0.005])
    late = np.array([-1.0, 2.0, 0.0, -0.05, 0.03, 0.01])
    history.add(0, 990_000_000, early)
    history.add(0, 1_040_000_000, late)
    history.add(0, 1_200_000_000, wrench(1.0))  # after the time asked for
    predicted = predict_state(o, history, 1_100_000_000, LONG)
    x = np.array([*o.position_m, *o.velocity_m_s, *o.q_wxyz, *o.omega_rad_s])
    x = fine(fine(x, early, LONG, 0.04, 200), late, LONG, 0.06, 200)
    np.testing.assert_allclose(predicted, x, rtol=0, atol=1e-9)


def test_without_commands_a_chaser_coasts() -> None:
    o = odometry(time_ns=5, omega_rad_s=(0.0, 0.0, 0.1))
    x = predict_state(o, CommandHistory(), 5 + 2_000_000_000, Body())
    np.testing.assert_allclose(x[:3], [1.06, 1.88, 3.0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(x[6:10], rotations.integrate(o.q_wxyz, [0, 0, 0.1], 2.0), rtol=0, atol=1e-9)


# -- the pilot --------------------------------------------------------------------------------------------

BODY = Body()
COMMAND = WrenchCommand(
    tick=5,
    sim_time_ns=300_000_000,
    chaser=1,
    effective_time_ns=333_000_000,
    expires_ns=800_000_000,
    mode="nmpc",
    force_N=(2.0, -2.0, 0.5),
    torque_N_m=(0.05, 0.0, -0.05),
)


def why_not(last_tick: int = 4, now_ns: int = 300_000_000, **changes: Any) -> str | None:
    return refusal(msgspec.structs.replace(COMMAND, **changes), 1, BODY, last_tick, now_ns)


def test_a_good_command_is_flown_as_it_is() -> None:
    assert why_not() is None
    assert why_not(now_ns=799_999_999) is None
    assert why_not(last_tick=-1) is None
    assert why_not(force_N=(2.0 * 1.009, 0.0, 0.0)) is None  # rounding at the limit
    flown = passed_on(COMMAND)
    assert flown.source == "command"
    for field in ("tick", "sim_time_ns", "chaser", "effective_time_ns", "force_N", "torque_N_m"):
        assert getattr(flown, field) == getattr(COMMAND, field)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"chaser": 0}, "it is for chaser 0"),
        ({"last_tick": 5}, "one for tick 5 was flown already"),
        ({"last_tick": 9}, "it answers tick 5, and one for tick 9"),
        ({"now_ns": 800_000_000}, "it expired at 0.800 s, and it is 0.800 s"),
        ({"now_ns": 900_000_000}, "it expired at 0.800 s, and it is 0.900 s"),
        ({"force_N": (0.0, -2.03, 0.0)}, "its force of 2.03 N exceeds the body's 2 N"),
        ({"force_N": (0.0, 0.0, 1e9)}, "its force of 1e+09 N exceeds"),
        ({"torque_N_m": (0.0, 0.0, -0.0506)}, "its torque of 0.0506 N m exceeds the body's 0.05 N m"),
    ],
)
def test_a_command_that_must_not_be_flown_is_refused_with_the_reason(
    changes: dict[str, Any], reason: str
) -> None:
    refused = why_not(**changes)
    assert refused is not None
    assert reason in refused


@pytest.mark.parametrize("seed", range(4))
def test_braking_brings_a_chaser_to_rest_within_its_limits(seed: int) -> None:
    rng = np.random.default_rng(seed)
    x = start(seed)
    x[3:6] = rng.uniform(-0.3, 0.3, 3)
    x[10:13] = rng.uniform(-0.2, 0.2, 3)
    speeds = []
    for k in range(600):
        o = Odometry(
            tick=k,
            sim_time_ns=k,
            chaser=3,
            position_m=tuple(x[:3].tolist()),
            velocity_m_s=tuple(x[3:6].tolist()),
            q_wxyz=tuple(x[6:10].tolist()),
            omega_rad_s=tuple(x[10:13].tolist()),
        )
        command = brake(o, BODY, 77)
        assert (command.chaser, command.tick, command.effective_time_ns, command.source) == (
            3,
            k,
            77,
            "brake",
        )
        assert max(map(abs, command.force_N)) <= BODY.force_max_N
        assert max(map(abs, command.torque_N_m)) <= BODY.torque_max_N_m
        x = integrate(x, np.array([*command.force_N, *command.torque_N_m]), BODY, 1 / 15)
        speeds.append((np.linalg.norm(x[3:6]), np.linalg.norm(x[10:13])))
    assert speeds[-1][0] < 1e-3
    assert speeds[-1][1] < 1e-4
    assert all(b[0] <= a[0] + 1e-12 for a, b in pairwise(speeds))


def test_braking_in_body_axes_pushes_against_the_motion_in_the_world() -> None:
    quarter = rotations.exp([0.0, 0.0, math.pi / 2])
    o = odometry(velocity_m_s=(0.0, 0.03, 0.0), q_wxyz=tuple(quarter.tolist()), omega_rad_s=(0.0, 0.0, 0.0))
    force = brake(o, BODY, 0).force_N
    assert force[0] == pytest.approx(-0.3)  # world y is the body's x; 30 kg and three seconds
    np.testing.assert_allclose(force[1:], 0.0, atol=1e-12)
