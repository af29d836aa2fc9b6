# SPDX-License-Identifier: Apache-2.0
"""Fallback of a chaser without commands: modes, wrenches, and transitions in the chaser process."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from chaser_cases import deliver, step
from chaserdock_agents.chaser.core import ChaserCore
from chaserdock_agents.chaser.fallback import (
    BRAKE_LIMIT_S,
    CLEARANCE_MARGIN_M,
    FallbackState,
    LastCommand,
    clearance_m,
    extrapolate_target,
    fallback_limits,
    fallback_wrench,
    interpolate_plan,
    is_at_rest,
    next_state,
)
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol import topics
from chaserdock_protocol.codec import vector
from chaserdock_protocol.leases import longest_lease_ticks
from chaserdock_protocol.messages import Odometry, Plan, TargetEstimate, Tick, WrenchCommand
from chaserdock_protocol.scenario import Scenario, load_scenario

ROOT = Path(__file__).resolve().parents[2]
STEP_S, DT_S, STAGES = 0.1, 0.1, 30
Q = (1.0, 0.0, 0.0, 0.0)
ZERO = (0.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return load_scenario(ROOT / "scenarios" / "fault-drill.toml")


def moving(x: Array, time_s: float) -> Odometry:
    return Odometry(
        tick=round(time_s / STEP_S),
        sim_time_ns=round(time_s * 1e9),
        chaser=0,
        position_m=vector(x[:3]),
        velocity_m_s=vector(x[3:6]),
        q_wxyz=vector(rotations.normalize(x[6:10])),
        omega_rad_s=vector(x[10:]),
    )


def straight(speed_m_s: float) -> Plan:
    """Return a plan of three seconds along +X from (-1, 0, 0)."""
    along = np.arange(STAGES + 1) * DT_S * speed_m_s
    places = np.stack([along - 1.0, 0 * along, 0 * along], axis=1)
    return Plan(
        tick=0,
        sim_time_ns=0,
        chaser=0,
        step_s=DT_S,
        positions_m=vector(places),
        quaternions_wxyz=Q * (STAGES + 1),
        inputs=(0.0,) * (6 * STAGES),
    )


def target(
    x_m: float = 0.0, velocity_m_s: tuple[float, float, float] = ZERO, status: Any = "tracking"
) -> TargetEstimate:
    return TargetEstimate(
        status=status,
        position_m=(x_m, 0.0, 0.0),
        velocity_m_s=velocity_m_s,
        q_wxyz=Q,
        omega_rad_s=ZERO,
        covariance=(0.0,) * 144,
        accepted=(),
        rejected=(),
    )


def fly_fallback(
    scenario: Scenario, last: LastCommand, x: Array, seconds: float, disturbance: Any = (0.0,) * 6
) -> tuple[list[FallbackState], Array]:
    """Simulate a rigid body in fallback; return its fallback state of each step and its states (K,
    13).

    ``disturbance``: constant force and torque (6,), body axes, that the chaser does not know.
    """
    body, limits = scenario.chaser, fallback_limits(scenario, 0)
    history: list[FallbackState] = []
    states, state = [x], None
    for k in range(round(seconds / STEP_S)):
        odometry = moving(x, k * STEP_S)
        effective_ns = odometry.sim_time_ns
        state = next_state(state, odometry, effective_ns, last, limits)
        u = fallback_wrench(state, odometry, effective_ns, last, body)
        assert np.all(np.abs(u[:3]) <= body.force_max_N * (1 + 1e-9))
        assert np.all(np.abs(u[3:]) <= body.torque_max_N_m * (1 + 1e-9))
        u = u + np.asarray(disturbance)
        v = x[3:6] + rotations.rotate(x[6:10], u[:3]) / body.mass_kg * STEP_S
        omega = x[10:] + u[3:] / np.asarray(body.inertia) * STEP_S
        x = np.concatenate(
            [x[:3] + v * STEP_S, v, rotations.integrate(x[6:10], omega, STEP_S), omega]
        )
        history.append(state)
        states.append(x)
    return history, np.array(states)


def start(
    position_m: Any = (-1.0, 0.0, 0.0), velocity_m_s: Any = ZERO, omega_rad_s: Any = ZERO
) -> Array:
    return np.array([*position_m, *velocity_m_s, *Q, *omega_rad_s], dtype=float)


def modes_of(history: list[FallbackState]) -> list[str]:
    """Return the sequence of modes without repetitions."""
    return [a.mode for k, a in enumerate(history) if k == 0 or history[k - 1].mode != a.mode]


def test_fallback_flies_the_plan_then_brakes_then_holds(scenario: Scenario) -> None:
    speed = 0.03
    last = LastCommand(straight(speed), target())
    history, x = fly_fallback(scenario, last, start(velocity_m_s=(speed, 0.0, 0.0)), 60.0)
    assert modes_of(history) == ["plan", "brake", "hold"]
    assert [a.mode for a in history].count("plan") == STAGES
    np.testing.assert_allclose(x[STAGES, :3], [-1.0 + 3.0 * speed, 0.0, 0.0], atol=1e-3)
    at_rest = next(k for k, a in enumerate(history) if a.mode == "hold")
    assert np.linalg.norm(x[at_rest, 3:6]) < 0.005
    assert (
        np.linalg.norm(x[-1, :3] - x[at_rest, :3]) < 0.01
    )  # outside the clearance: it holds this position


def test_fallback_returns_to_its_plan(scenario: Scenario) -> None:
    x = start((-1.0, 0.02, 0.0), (0.0, 0.0, 0.0))
    history, states = fly_fallback(scenario, LastCommand(straight(0.0), target()), x, 2.9)
    assert modes_of(history) == ["plan"]
    assert abs(states[-1, 1]) < 0.016


def test_fallback_leaves_the_corridor_and_moves_with_the_target(scenario: Scenario) -> None:
    drift = (0.0, 0.01, 0.0)
    last = LastCommand(None, target(0.0, drift))
    history, x = fly_fallback(scenario, last, start((-0.45, 0.0, 0.0), (0.02, 0.0, 0.0)), 90.0)
    assert modes_of(history) == ["brake", "hold"]
    relative = x[:, :3] - np.outer(np.arange(len(x)) * STEP_S, drift)
    assert history[-1].distance_m == pytest.approx(clearance_m(scenario, 0))
    assert np.linalg.norm(relative[-1]) == pytest.approx(clearance_m(scenario, 0), abs=0.01)
    assert np.linalg.norm(relative, axis=1).min() > 0.35
    np.testing.assert_allclose(x[-1, 3:6], drift, atol=1e-3)


def test_fallback_brakes_relative_to_a_drifting_target(scenario: Scenario) -> None:
    """A target that drifts towards the chaser comes no nearer while the chaser brakes."""
    drift = (-0.034, 0.0, 0.0)
    last = LastCommand(None, target(0.0, drift))
    history, x = fly_fallback(scenario, last, start((-0.6, 0.0, 0.0), (-0.01, 0.0, 0.0)), 30.0)
    assert modes_of(history) == ["brake", "hold"]
    distance_m = np.linalg.norm(x[:, :3] - np.outer(np.arange(len(x)) * STEP_S, drift), axis=1)
    brake = [a.mode for a in history].count("brake")
    assert distance_m[: brake + 1].min() > 0.5
    np.testing.assert_allclose(x[-1, 3:6], drift, atol=4e-3)


def test_fallback_comes_to_rest_from_any_rotation(scenario: Scenario) -> None:
    history, x = fly_fallback(
        scenario,
        LastCommand(),
        start(velocity_m_s=(0.05, -0.02, 0.01), omega_rad_s=(0.05, 0.02, -0.1)),
        60.0,
    )
    assert modes_of(history) == ["brake", "hold"]
    assert history[-1].distance_m is None
    assert "the target is unknown" in history[-1].text()
    assert is_at_rest(moving(x[-1], 60.0), np.zeros(3), fallback_limits(scenario, 0))


def test_braking_ends_where_a_disturbance_keeps_the_chaser_from_rest(scenario: Scenario) -> None:
    """Seed 3065 of `fault-drill`: under 0.5 mN m chasers kept rotating at 0.5 deg/s, and braked for
    ever.
    """
    near, torque = (
        start((-0.45, 0.0, 0.0), omega_rad_s=(0.0, 0.05, 0.0)),
        (0.0, 0.0, 0.0, 0.0, 0.0005, 0.0),
    )
    history, x = fly_fallback(scenario, LastCommand(None, target()), near, 60.0, torque)
    assert modes_of(history) == ["brake", "hold"]
    assert [a.mode for a in history].count("brake") == BRAKE_LIMIT_S / STEP_S
    assert np.linalg.norm(x[-1, :3]) == pytest.approx(clearance_m(scenario, 0), abs=0.01)


def test_chaser_with_thrusters_is_at_rest_within_its_shortest_pulses() -> None:
    """Seed 285 of `docking-contact`: pulses keep the rate between 0.3 and 1.1 deg/s, and it braked
    for ever, within the keep-out.
    """
    limits = fallback_limits(load_scenario(ROOT / "scenarios" / "docking-contact.toml"), 0)
    assert limits.rest_m_s == pytest.approx(0.004)
    assert np.degrees(limits.rest_rad_s) == pytest.approx(1.5, abs=0.01)
    slow = start(velocity_m_s=(0.002, 0.0, 0.0), omega_rad_s=(0.0, 0.019, 0.0))
    assert (
        next_state(FallbackState("brake"), moving(slow, 0.0), 0, LastCommand(), limits).mode
        == "hold"
    )


def test_fallback_modes_do_not_return(scenario: Scenario) -> None:
    fast = moving(start(velocity_m_s=(0.1, 0.0, 0.0)), 0.0)
    for before in (FallbackState("brake"), FallbackState("hold", np.zeros(3))):
        again = next_state(
            before, fast, 0, LastCommand(straight(0.1), target()), fallback_limits(scenario, 0)
        )
        assert again.mode == before.mode


def test_plan_is_interpolated_and_ends_after_its_last_node() -> None:
    plan = straight(0.1)
    goal = interpolate_plan(plan, 250_000_000)
    assert goal is not None
    np.testing.assert_allclose(goal.position_m, [-0.975, 0.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(goal.velocity_m_s, [0.1, 0.0, 0.0], atol=1e-12)
    assert interpolate_plan(plan, 3_000_000_000) is None
    assert interpolate_plan(None, 0) is None
    early = interpolate_plan(msgspec.structs.replace(plan, sim_time_ns=1_000_000_000), 0)
    assert early is not None
    np.testing.assert_allclose(early.position_m, [-1.0, 0.0, 0.0])


def test_each_step_of_a_plan_has_its_own_input() -> None:
    inputs = np.arange(6.0 * STAGES)
    plan = msgspec.structs.replace(straight(0.1), inputs=vector(inputs))
    for k in (0, 2, STAGES - 1):
        goal = interpolate_plan(plan, round((k + 0.5) * DT_S * 1e9))
        assert goal is not None
        np.testing.assert_array_equal(goal.wrench, inputs[6 * k : 6 * k + 6])


@pytest.mark.parametrize("status", ["none", "lost"])
def test_unknown_target_has_no_position(status: str) -> None:
    assert extrapolate_target(target(status=status), 10**9) is None
    place = extrapolate_target(target(1.0, (0.0, 0.0, 0.5)), 2 * 10**9)
    assert place is not None
    np.testing.assert_allclose(place, [1.0, 0.0, 1.0])


def test_clearance_is_outside_of_keep_out_sphere_and_corridor() -> None:
    for name in ("fault-drill", "docking-contact"):
        scenario = load_scenario(ROOT / "scenarios" / f"{name}.toml")
        assert (
            clearance_m(scenario, 0) >= scenario.limits.min_distance_target_m + CLEARANCE_MARGIN_M
        )
    docking = load_scenario(ROOT / "scenarios" / "docking-contact.toml")
    port = docking.docking.port_of(0)
    assert port is not None
    entry = np.asarray(port.position_m) + np.asarray(port.axis) * (0.35 + docking.docking.entry_m)
    assert clearance_m(docking, 0) > np.linalg.norm(entry)


# -- the chaser's core -----------------------------------------------------------------------------


def tick_of(scenario: Scenario, tick: int, *controllers: str, revision: int = 0) -> Tick:
    return Tick(
        tick=tick,
        revision=revision,
        sim_time_ns=scenario.timing.tick_time_ns(tick),
        images=False,
        chasers=(0,),
        controllers={name: name[:1] for name in controllers},
    )


def command(scenario: Scenario, tick: int, commander: str, term: int) -> WrenchCommand:
    now_ns = scenario.timing.tick_time_ns(tick)
    return WrenchCommand(
        tick=tick,
        sim_time_ns=now_ns,
        chaser=0,
        effective_time_ns=scenario.timing.effective_ns(tick),
        expires_ns=now_ns + 500_000_000,
        mode="nmpc",
        force_N=(0.01, 0.0, 0.0),
        torque_N_m=ZERO,
        term=term,
        commander=commander,
        instance=commander[:1],
    )


@pytest.fixture
def chaser(scenario: Scenario) -> ChaserCore:
    return ChaserCore(scenario, 0)


def at(scenario: Scenario, tick: int) -> Odometry:
    return msgspec.structs.replace(
        moving(start(), 0.0), tick=tick, sim_time_ns=scenario.timing.tick_time_ns(tick)
    )


def sources(published: list[tuple[Any, Any]]) -> list[tuple[str, int]]:
    return [(m.source, m.term) for t, m in published if t is topics.ACTUATORS]


def test_lost_controller_reports_each_fallback_mode_once(
    chaser: ChaserCore, scenario: Scenario
) -> None:
    plan = msgspec.structs.replace(straight(0.0), sim_time_ns=scenario.timing.effective_ns(0))
    deliver(chaser, topics.TICK, tick_of(scenario, 0, "controller"))
    deliver(chaser, topics.ODOMETRY, at(scenario, 0))
    deliver(chaser, topics.PLAN, plan)
    assert sources(deliver(chaser, topics.WRENCH, command(scenario, 0, "controller", 1))) == [
        ("command", 1)
    ]
    published = []
    for tick in range(1, 40):
        published += deliver(chaser, topics.TICK, tick_of(scenario, tick))
        published += deliver(chaser, topics.ODOMETRY, at(scenario, tick))
    events = [m.what for t, m in published if t is topics.EVENT]
    assert events == ["fallback: plan", "fallback: hold"]  # at rest when the plan ends: no braking
    assert [s for s, _ in sources(published)].count("plan") == STAGES - 1
    deliver(chaser, topics.TICK, tick_of(scenario, 40, "standby"))
    deliver(chaser, topics.ODOMETRY, at(scenario, 40))
    published = deliver(chaser, topics.WRENCH, command(scenario, 40, "standby", 2))
    assert sources(published) == [("command", 2)]
    assert "fallback ends" in [m.what for t, m in published if t is topics.EVENT]


@pytest.mark.parametrize("topic", [topics.PLAN, topics.TARGET])
def test_fallback_does_not_depend_on_order_of_arrival(
    scenario: Scenario, topic: topics.Topic
) -> None:
    x = start()
    x[:3] = (
        0.3,
        0.0,
        0.0,
    )  # inside the hold position, so that the wrench depends on the target's place
    odometry = {
        k: msgspec.structs.replace(at(scenario, k), position_m=vector(x[:3])) for k in range(3)
    }

    def replies(order: tuple[str, ...]) -> list[Any]:
        made = ChaserCore(scenario, 0)
        published = []
        for tick in (0, 1):
            deliver(made, topics.TICK, tick_of(scenario, tick, "controller"))
            deliver(made, topics.ODOMETRY, odometry[tick])
            stamp = {"tick": tick, "sim_time_ns": odometry[tick].sim_time_ns}
            messages = {
                "plan": (topics.PLAN, msgspec.structs.replace(straight(0.1), **stamp)),
                "target": (topics.TARGET, msgspec.structs.replace(target(0.1 * tick), **stamp)),
                "wrench": (topics.WRENCH, command(scenario, tick, "controller", 1)),
            }
            if topic is topics.TARGET:
                del messages["plan"]  # without a plan the wrench follows the target
            for name in order:
                if name in messages:
                    deliver(made, *messages[name])
        deliver(made, topics.TICK, tick_of(scenario, 2))
        published += deliver(made, topics.ODOMETRY, odometry[2])
        return [m for t, m in published if t is topics.ACTUATORS]

    expected = replies(("plan", "target", "wrench"))
    assert [m.source for m in expected] == ["plan" if topic is topics.PLAN else "hold"]
    assert replies(("wrench", "target", "plan")) == expected


def test_plan_without_its_command_is_not_executed(chaser: ChaserCore, scenario: Scenario) -> None:
    deliver(chaser, topics.TICK, tick_of(scenario, 0, "controller"))
    deliver(chaser, topics.ODOMETRY, at(scenario, 0))
    deliver(chaser, topics.PLAN, straight(0.0))
    published = deliver(chaser, topics.TICK, tick_of(scenario, 0, revision=1))
    assert [s for s, _ in sources(published)] == ["hold"]


def test_stale_terms_are_rejected_counted_and_reported_once(
    chaser: ChaserCore, scenario: Scenario
) -> None:
    for tick in (1, 2):
        deliver(chaser, topics.TICK, tick_of(scenario, tick, "standby"))
        deliver(chaser, topics.ODOMETRY, at(scenario, tick))
        outputs = step(chaser, topics.WRENCH, command(scenario, tick, "controller", 1))
        assert [t for t, _, _ in outputs.messages] == ([topics.EVENT] if tick == 1 else [])
        assert outputs.rejected == "wrench:stale term"
    published = deliver(chaser, topics.WRENCH, command(scenario, 2, "standby", 2))
    assert sources(published) == [("command", 2)]
    ended = [m for t, m in published if t is topics.EVENT and m.what == "commands accepted again"]
    assert [(m.level, m.detail) for m in ended] == [("info", "2 refused")]
    deliver(chaser, topics.TICK, tick_of(scenario, 3, "standby"))
    deliver(chaser, topics.ODOMETRY, at(scenario, 3))
    published = deliver(chaser, topics.WRENCH, command(scenario, 3, "standby", 2))
    assert not [m for t, m in published if t is topics.EVENT]


@pytest.mark.parametrize("mode", ["nmpc", "none", "yield"])
def test_command_far_ahead_of_the_newest_tick_is_refused(
    chaser: ChaserCore, scenario: Scenario, mode: Any
) -> None:
    def deliver_tick(tick: int) -> list[tuple[Any, Any]]:
        deliver(chaser, topics.TICK, tick_of(scenario, tick, "controller"))
        return deliver(chaser, topics.ODOMETRY, at(scenario, tick))

    deliver_tick(3)
    until_tick, latest = (
        chaser.gate.leases.until_tick,
        3 + longest_lease_ticks(scenario.time.rate_hz),
    )
    far = msgspec.structs.replace(command(scenario, latest + 1, "controller", 1), mode=mode)
    outputs = step(chaser, topics.WRENCH, far)
    published: list[Any] = [(t, m) for t, _, m in outputs.messages]
    assert sources(published) == [("hold", 0)]  # the reply that the world waits for
    events = [(m.what, m.tick) for t, m in published if t is topics.EVENT]
    assert events == [("command refused", 3), ("no command", 3), ("fallback: hold", 3)]
    assert chaser.gate.leases.until_tick == until_tick
    assert outputs.rejected == "wrench:early tick"
    deliver_tick(4)
    assert sources(deliver(chaser, topics.WRENCH, command(scenario, 4, "controller", 1))) == [
        ("command", 1)
    ]
    assert sources(deliver(chaser, topics.WRENCH, command(scenario, latest, "controller", 1))) == [
        ("command", 1)
    ]


def test_new_leader_within_a_tick_does_not_repeat_a_command(
    chaser: ChaserCore, scenario: Scenario
) -> None:
    deliver(chaser, topics.TICK, tick_of(scenario, 3, "controller", "standby"))
    deliver(chaser, topics.ODOMETRY, at(scenario, 3))
    assert sources(deliver(chaser, topics.WRENCH, command(scenario, 3, "controller", 1))) == [
        ("command", 1)
    ]
    deliver(chaser, topics.TICK, tick_of(scenario, 3, "standby", revision=1))
    assert deliver(chaser, topics.WRENCH, command(scenario, 3, "standby", 2)) == []
    deliver(chaser, topics.TICK, tick_of(scenario, 4, "standby"))
    deliver(chaser, topics.ODOMETRY, at(scenario, 4))
    # Once the tick names the new term, commands of the previous leader are rejected.
    assert sources(deliver(chaser, topics.WRENCH, command(scenario, 4, "controller", 1))) == []
    assert sources(deliver(chaser, topics.WRENCH, command(scenario, 4, "standby", 2))) == [
        ("command", 2)
    ]
