"""The world: PyBullet against physics and against the controller's model, actuators, and who takes part."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from chaserdock_controller.nmpc import NmpcParameters
from chaserdock_controller.nmpc.problem import dynamics
from chaserdock_protocol import rotations
from chaserdock_protocol.messages import ActuatorCommand, JoinRequest, Presence
from chaserdock_protocol.rotations import Array
from chaserdock_protocol.scenario import Body, Scenario, parse_scenario
from chaserdock_world.actuators import IdealActuators, fly_to
from chaserdock_world.membership import Membership
from chaserdock_world.physics import TARGET, BodyState, Physics, prescribed_state
from hypothesis import given, settings
from hypothesis import strategies as st

HZ = 960
STEP_S = 1.0 / HZ
HALF = np.sqrt(0.5)


def scenario(**changes: Any) -> Scenario:
    """One chaser five metres from the target, unless said otherwise."""
    values: dict[str, Any] = {
        "name": "test",
        "duration_s": 10.0,
        "chasers": [{"position_m": [-5.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}],
    }
    return parse_scenario(values | changes, "test")


@pytest.fixture
def worlds() -> Iterator[Any]:
    opened: list[Physics] = []

    def make(**changes: Any) -> Physics:
        opened.append(Physics(scenario(**changes)))
        return opened[-1]

    yield make
    for physics in opened:
        physics.close()


def state13(s: BodyState) -> Array:
    return np.concatenate([s.position_m, s.velocity_m_s, s.q_wxyz, s.omega_rad_s])


# -- free motion ------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("inertia", "omega"),
    [
        ((0.1, 0.5, 0.55), (0.17, 0.18, -0.17)),  # a rod, tumbling
        ((0.3, 0.5, 0.7), (0.005, 0.3, 0.005)),  # about the unstable middle axis
        ((0.2, 0.35, 0.5), (-0.2, 0.1, 0.2)),
        ((0.1, 0.5, 0.55), (0.2, 0.3, 0.32)),  # 28 degrees a second
    ],
)
def test_torque_free_body_keeps_its_angular_momentum(
    worlds: Any, inertia: tuple[float, ...], omega: tuple[float, ...]
) -> None:
    """120 s at the default physics rate: within 1e-3, in size and direction; energy likewise."""
    target = {"motion": "torque_free", "mass_kg": 10.0, "inertia_kg_m2": inertia, "omega_rad_s": omega}
    physics = worlds(target=target)
    moments = np.array(inertia)

    def momentum_and_energy() -> tuple[Array, float]:
        s = physics.state(TARGET)
        return rotations.rotate(s.q_wxyz, moments * s.omega_rad_s), float(
            s.omega_rad_s @ (moments * s.omega_rad_s)
        )

    momentum, energy = momentum_and_energy()
    turned = 0.0
    for _ in range(6):
        physics.advance(20 * HZ, {})
        now, energy_now = momentum_and_energy()
        assert np.linalg.norm(now - momentum) <= 1e-3 * np.linalg.norm(momentum)
        assert abs(energy_now - energy) <= 2e-3 * energy
        turned = max(turned, float(np.linalg.norm(physics.state(TARGET).omega_rad_s - np.array(omega))))
    assert turned > 0.02  # the rate itself is far from constant: there was something to keep
    s = physics.state(TARGET)
    np.testing.assert_allclose(s.velocity_m_s, [0.015, 0.0075, 0.03], rtol=1e-12)
    np.testing.assert_allclose(s.position_m, 120.0 * np.array([0.015, 0.0075, 0.03]), rtol=1e-9)


@pytest.mark.parametrize("steps", [0, 1, 7, 8, 9, HZ, 12_345])
def test_prescribed_target_is_exact_at_any_step(worlds: Any, steps: int) -> None:
    q, v, omega = np.array([HALF, 0.0, HALF, 0.0]), np.array([0.01, -0.02, 0.03]), np.array([0.1, -0.3, 0.2])
    target = {
        "position_m": [1.0, 2.0, 3.0],
        "q_wxyz": q.tolist(),
        "velocity_m_s": v.tolist(),
        "omega_rad_s": omega.tolist(),
    }
    physics = worlds(
        target=target, chasers=[{"position_m": [-50.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}]
    )
    physics.advance(steps, {})
    s, t = physics.state(TARGET), steps / HZ
    np.testing.assert_allclose(s.position_m, np.array([1.0, 2.0, 3.0]) + v * t, rtol=0, atol=1e-14)
    np.testing.assert_allclose(s.q_wxyz, rotations.multiply(q, rotations.exp(omega * t)), rtol=0, atol=1e-14)
    np.testing.assert_array_equal(s.velocity_m_s, v)
    np.testing.assert_array_equal(s.omega_rad_s, omega)
    np.testing.assert_array_equal(state13(prescribed_state(physics._scenario, t)), state13(s))


def test_static_target_stays(worlds: Any) -> None:
    physics = worlds(target={"motion": "static", "position_m": [0.5, 0.0, 0.0]})
    physics.advance(HZ, {})
    s = physics.state(TARGET)
    np.testing.assert_array_equal(state13(s), [0.5, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0])


def test_bodies_start_where_the_scenario_says(worlds: Any) -> None:
    chasers = [
        {
            "position_m": [-1.0, 0.0, 0.0],
            "q_wxyz": [HALF, 0.0, 0.0, HALF],
            "start_offset_m": [0.0, 0.2, 0.0],
            "start_rotation_rad": [0.1, -0.2, 0.3],
            "start_velocity_m_s": [0.01, 0.02, -0.03],
        },
        {"position_m": [1.0, 0.0, 0.0], "q_wxyz": [0.0, 0.0, 0.0, 1.0]},
    ]
    physics = worlds(chasers=chasers, target={"position_m": [3.0, 2.0, 1.0], "q_wxyz": [0.0, 0.0, 0.0, 1.0]})
    assert physics.bodies == ("target", "chaser/0", "chaser/1")
    s = physics.state("chaser/0")
    np.testing.assert_allclose(s.position_m, [4.0, 1.8, 1.0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(s.velocity_m_s, [0.01, 0.02, -0.03], rtol=0, atol=1e-15)
    np.testing.assert_array_equal(s.omega_rad_s, np.zeros(3))
    assert rotations.angle_between(s.q_wxyz, physics._scenario.start_pose(0)[1]) < 1e-7


# -- forces -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.0, 0.0, np.pi / 2), (0.4, -1.1, 2.0)])
def test_a_force_in_body_axes_accelerates_along_them(worlds: Any, axis: int, turn: tuple[float, ...]) -> None:
    q = rotations.exp(turn)
    physics = worlds(chasers=[{"position_m": [-5.0, 0.0, 0.0], "q_wxyz": q.tolist()}])
    wrench = np.zeros(6)
    wrench[axis] = 1.5
    physics.advance(2 * HZ, {"chaser/0": wrench})
    s = physics.state("chaser/0")
    a = 1.5 / 30.0 * rotations.to_matrix(q)[:, axis]
    np.testing.assert_allclose(s.velocity_m_s, a * 2.0, rtol=0, atol=1e-9)
    # Bullet moves with the velocity at the step's end: half a step ahead.
    np.testing.assert_allclose(
        s.position_m, [-5.0, 0.0, 0.0] + a * 2.0 * (1.0 + STEP_S / 2), rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(s.omega_rad_s, np.zeros(3), rtol=0, atol=1e-12)


def test_a_force_turns_with_the_body(worlds: Any) -> None:
    """A quarter turn later a push along body x is one along world y."""
    physics = worlds()
    inertia_z = physics._scenario.chaser.inertia[2]
    spin = np.array([0.0, 0.0, 0.0, 0.0, 0.0, inertia_z * np.pi / 4])
    physics.advance(HZ, {"chaser/0": spin})  # pi/4 a second, having turned by pi/8
    physics.advance(HZ + HZ // 2, {})  # and on to a quarter
    before = physics.state("chaser/0")
    np.testing.assert_allclose(before.omega_rad_s, [0.0, 0.0, np.pi / 4], rtol=0, atol=1e-9)
    assert rotations.angle_between(before.q_wxyz, rotations.exp([0.0, 0.0, np.pi / 2])) < 1e-3
    physics.advance(1, {"chaser/0": np.array([2.0, 0, 0, 0, 0, 0])})
    gained = physics.state("chaser/0").velocity_m_s - before.velocity_m_s
    np.testing.assert_allclose(gained / np.linalg.norm(gained), [0.0, 1.0, 0.0], rtol=0, atol=1e-3)


def test_no_wrench_is_left_over(worlds: Any) -> None:
    physics = worlds()
    physics.advance(10, {"chaser/0": np.ones(6)})
    s = physics.state("chaser/0")
    physics.advance(10, {})
    np.testing.assert_allclose(physics.state("chaser/0").velocity_m_s, s.velocity_m_s, rtol=0, atol=1e-15)
    physics.advance(10, {"chaser/0": np.zeros(6)})
    np.testing.assert_allclose(physics.state("chaser/0").velocity_m_s, s.velocity_m_s, rtol=0, atol=1e-15)


@pytest.mark.parametrize("split", [1, 7, 128])
def test_how_the_steps_are_grouped_changes_nothing(worlds: Any, split: int) -> None:
    wrench = {"chaser/0": np.array([0.5, -0.2, 0.1, 0.01, -0.02, 0.005])}
    a, b = worlds(), worlds()
    a.advance(896, wrench)
    for _ in range(896 // split):
        b.advance(split, wrench)
    for name in a.bodies:
        np.testing.assert_array_equal(state13(a.state(name)), state13(b.state(name)))


# -- against the controller's model -----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("seed", "inertia"),
    [(0, (0.1, 0.5, 0.55)), (1, (0.6, 0.12, 0.6)), (2, (0.5, 0.9, 0.45)), (3, None)],
)
def test_the_controllers_model_is_the_worlds(
    worlds: Any, seed: int, inertia: tuple[float, float, float] | None
) -> None:
    """10 s of random inputs within the limits, inertias far from a sphere: 1 mm and 0.05 degrees (bar of the issue)."""
    rng = np.random.default_rng(seed)
    body = {"mass_kg": 12.0, "inertia_kg_m2": inertia} if inertia else {}
    start = {"start_rotation_rad": [0.4, -0.7, 0.2], "start_velocity_m_s": [0.05, -0.02, 0.03]}
    chaser = {"position_m": [-5.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}
    physics = worlds(chaser=body, chasers=[chaser | start])
    b = physics._scenario.chaser
    model = dynamics(
        NmpcParameters(
            mass_kg=b.mass_kg,
            inertia_kg_m2=((b.inertia[0], 0.0, 0.0), (0.0, b.inertia[1], 0.0), (0.0, 0.0, b.inertia[2])),
            force_max_N=b.force_max_N,
            torque_max_N_m=b.torque_max_N_m,
            dt_s=0.1,
        )
    )
    x = state13(physics.state("chaser/0"))
    distance, angle, rate = 0.0, 0.0, 0.0
    limit = np.repeat([b.force_max_N, b.torque_max_N_m], 3)
    for u in np.repeat(rng.uniform(-limit, limit, (20, 6)), 5, axis=0):
        x = np.array(model(x, u)).ravel()
        physics.advance(HZ // 10, {"chaser/0": u})
        s = physics.state("chaser/0")
        distance = max(distance, float(np.linalg.norm(s.position_m - x[:3])))
        angle = max(angle, float(rotations.angle_between(s.q_wxyz, x[6:10])))
        rate = max(rate, float(np.linalg.norm(s.omega_rad_s)))
    assert distance < 1e-3
    assert np.degrees(angle) < 0.05
    assert rate > 0.1
    assert np.linalg.norm(x[:3] - [-5.0, 0.0, 0.0]) > 0.1


# -- contacts ---------------------------------------------------------------------------------------------


def test_contact_is_reported_when_bodies_meet_and_not_before(worlds: Any) -> None:
    start = {"start_velocity_m_s": [0.5, 0.0, 0.0]}
    chaser = {"position_m": [-0.6, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}
    physics = worlds(chasers=[chaser | start], target={"motion": "static"})
    assert physics.contacts() == ()
    half_target = 0.05  # the paper's target is 0.1 m wide, its longest side along z
    gap_m = 0.6 - 0.125 - half_target
    before = int((gap_m - 0.01) / 0.5 * HZ)
    assert physics.advance(before, {}) == set()
    assert physics.advance(HZ // 20, {}) == {("chaser/0", "target")}
    assert (
        physics.state("chaser/0").velocity_m_s[0] < 0.0
    )  # stopped; how hard it bounces is a matter of the step
    physics.advance(HZ, {"chaser/0": np.array([-2.0, 0.0, 0.0, 0.0, 0.0, 0.0])})
    assert physics.contacts() == ()
    assert physics.advance(HZ, {}) == set()


@pytest.mark.parametrize("speed_m_s", [0.01, 0.1, 1.0])
@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.6, 0.6, 0.2)])
def test_no_touch_is_too_gentle_or_too_short(worlds: Any, speed_m_s: float, turn: tuple[float, ...]) -> None:
    start = {"start_velocity_m_s": [speed_m_s, 0.0, 0.0], "q_wxyz": rotations.exp(turn).tolist()}
    physics = worlds(chasers=[{"position_m": [-0.26, 0.01, 0.0]} | start], target={"motion": "static"})
    assert physics.contacts() == ()
    touched = physics.advance(int(0.12 / speed_m_s * HZ), {})
    assert touched == {("chaser/0", "target")}
    assert physics.state("chaser/0").velocity_m_s[0] < 0.5 * speed_m_s


def test_contact_between_chasers(worlds: Any) -> None:
    chasers = [
        {
            "position_m": [-1.0, 0.3, 0.0],
            "q_wxyz": [1.0, 0.0, 0.0, 0.0],
            "start_velocity_m_s": [0.0, -0.5, 0.0],
        },
        {
            "position_m": [-1.0, -0.3, 0.0],
            "q_wxyz": [1.0, 0.0, 0.0, 0.0],
            "start_velocity_m_s": [0.0, 0.5, 0.0],
        },
    ]
    physics = worlds(chasers=chasers, target={"motion": "static"})
    touched = physics.advance(2 * HZ, {})
    assert touched == {("chaser/0", "chaser/1")}


def test_a_moving_prescribed_target_hits_who_stands_in_its_way(worlds: Any) -> None:
    physics = worlds(
        target={"velocity_m_s": [-0.3, 0.0, 0.0], "omega_rad_s": [0.0, 0.0, 0.0]},
        chasers=[{"position_m": [-0.5, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}],
    )
    assert ("chaser/0", "target") in physics.advance(2 * HZ, {})
    s = physics.state(TARGET)
    np.testing.assert_allclose(s.position_m, [-0.6, 0.0, 0.0], rtol=0, atol=1e-12)  # and is not stopped by it


# -- actuators --------------------------------------------------------------------------------------------

BODY = Body()


def command(seq: int, fx_N: float, torque_N_m: float = 0.0) -> ActuatorCommand:
    return ActuatorCommand(
        seq=seq,
        tick=seq,
        chaser=0,
        effective_time_ns=0,
        source="command",
        force_N=(fx_N, 0.0, 0.0),
        torque_N_m=(torque_N_m, 0.0, 0.0),
    )


def test_commands_wait_until_they_take_effect_and_then_hold() -> None:
    a = IdealActuators(BODY)
    a.command(command(0, 1.0), 10, 0)
    a.command(command(1, 2.0), 20, 0)
    assert a.next_change(0) == 10
    np.testing.assert_array_equal(a.act(0, 10, STEP_S), np.zeros(6))
    assert a.next_change(10) == 20
    assert a.act(10, 10, STEP_S)[0] == 1.0
    assert a.next_change(20) is None
    assert a.act(20, 5, STEP_S)[0] == 2.0
    assert a.act(25, 100, STEP_S)[0] == 2.0  # the last one holds
    assert a.late == 0


def test_commands_act_in_the_order_of_their_effect_not_of_their_arrival() -> None:
    a = IdealActuators(BODY)
    for seq, effective in ((2, 30), (0, 10), (1, 20)):
        a.command(command(seq, float(seq) / 2), effective, 0)
    assert [a.act(step, 10, STEP_S)[0] for step in (0, 10, 20, 30)] == [0.0, 0.0, 0.5, 1.0]


def test_of_two_with_the_same_effect_the_later_number_acts() -> None:
    for order in ((0, 1), (1, 0)):
        a = IdealActuators(BODY)
        for seq in order:
            a.command(command(seq, 1.0 + seq / 2), 10, 0)
        assert a.act(10, 1, STEP_S)[0] == 1.5


def test_a_number_used_twice_is_no_trouble() -> None:
    """A chaser that was started anew counts from zero again."""
    a = IdealActuators(BODY)
    a.command(command(3, 1.0), 10, 0)
    a.command(command(3, 0.5), 10, 0)
    assert a.act(10, 1, STEP_S)[0] in (0.5, 1.0)


def test_a_late_command_acts_at_once_and_is_counted() -> None:
    a = IdealActuators(BODY)
    a.act(0, 50, STEP_S)
    a.command(command(0, 1.0), 49, 50)
    a.command(command(1, 1.25), 50, 50)  # just in time
    assert a.next_change(50) is None
    assert a.act(50, 1, STEP_S)[0] == 1.25
    assert a.take()[3] == 1
    assert a.take()[3] == 0


def test_commands_are_cut_off_at_the_bodys_limits_and_that_is_told() -> None:
    a = IdealActuators(BODY)
    a.command(command(0, BODY.force_max_N, -BODY.torque_max_N_m), 0, 0)
    a.act(0, 1, STEP_S)
    assert a.take()[2] is False
    a.command(command(1, -5.0, 1.0), 1, 0)
    np.testing.assert_array_equal(a.act(1, 1, STEP_S), [-2.0, 0.0, 0.0, 0.05, 0.0, 0.0])
    assert a.take()[2] is True
    assert a.take()[2] is False


def test_impulse_is_accounted_for() -> None:
    a = IdealActuators(BODY)
    both = ActuatorCommand(
        chaser=0,
        effective_time_ns=0,
        source="command",
        force_N=(1.0, -2.0, 0.5),
        torque_N_m=(0.01, 0.0, -0.02),
    )
    a.command(both, HZ, 0)
    a.act(0, HZ, STEP_S)
    a.act(HZ, HZ // 2, STEP_S)
    impulse, absolute, _, _ = a.take()
    np.testing.assert_allclose(impulse, [0.5, -1.0, 0.25, 0.005, 0.0, -0.01], rtol=1e-12)
    assert absolute == pytest.approx(3.5 / 2)
    assert a.take()[1] == 0.0


def test_stop_ends_everything() -> None:
    a = IdealActuators(BODY)
    a.command(command(0, 1.0), 0, 0)
    a.command(command(1, 2.0), 20, 0)
    a.act(0, 10, STEP_S)
    a.stop()
    assert a.next_change(10) is None
    np.testing.assert_array_equal(a.act(20, 10, STEP_S), np.zeros(6))


@given(
    st.lists(st.tuples(st.integers(0, 60), st.integers(-2, 2)), max_size=6),
    st.lists(st.integers(1, 59), max_size=3, unique=True),
)
@settings(derandomize=True, deadline=None, max_examples=60)
def test_what_the_body_gets_is_what_was_commanded(commands: list[tuple[int, int]], stops: list[int]) -> None:
    """``fly_to`` splits the flight at every change: the momentum gained is the commands' integral."""
    physics = Physics(scenario())
    a = IdealActuators(BODY)
    for seq, (step, force) in enumerate(commands):
        a.command(command(seq, float(force)), step, 0)
    for end in (*sorted(stops), 60):
        fly_to(end, physics, {"chaser/0": a}, STEP_S)
        assert physics.step_count == end
    expected, force = 0.0, 0.0
    for step in range(60):
        for seq in [s for s, (effective, _) in enumerate(commands) if effective == step]:
            force = float(commands[seq][1])
        expected += force * STEP_S
    impulse, absolute, saturated, _ = a.take()
    velocity = physics.state("chaser/0").velocity_m_s
    physics.close()
    assert impulse[0] == pytest.approx(expected, abs=1e-12)
    assert absolute >= abs(expected) - 1e-12
    assert not saturated
    np.testing.assert_allclose(velocity, [expected / BODY.mass_kg, 0.0, 0.0], rtol=0, atol=1e-12)


# -- membership -------------------------------------------------------------------------------------------


def membership(chasers: int = 2, mode: str = "lockstep") -> Membership:
    return Membership(chasers=chasers, run_id="run-1", mode=mode, scenario_json='{"a": 1}')


def joined(members: Membership, *names: str) -> Membership:
    for name in names:
        assert members.admit(JoinRequest(process=name, instance=f"{name}-1")).accepted
        members.alive_changed(name, True)
    return members


def tell(members: Membership, name: str, *heard: str, instance: str | None = None) -> bool:
    return members.presence_told(Presence(process=name, instance=instance or f"{name}-1", heard=heard))


@pytest.mark.parametrize("mode", ["lockstep", "realtime"])
def test_who_may_join_is_told_the_mission(mode: str) -> None:
    for name in ("chaser/0", "chaser/1", "controller", "recorder"):
        reply = membership(mode=mode).admit(JoinRequest(process=name, instance="i"))
        assert (reply.accepted, reply.reason) == (True, "")
        assert (reply.run_id, reply.mode, reply.scenario_json) == ("run-1", mode, '{"a": 1}')


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("chaser/2", "there is no chaser/2 in this mission; its chasers are 0 to 1"),
        ("chaser/99999999999999999999", "there is no chaser/99999999999999999999"),
        ("chaser/01", "'chaser/01' is no process of a mission"),
        ("chaser/-1", "is no process of a mission"),
        ("chaser", "is no process of a mission"),
        ("target", "'target' is no process of a mission"),
        ("", "'' is no process of a mission"),
        ("hacker", "is no process of a mission"),
        ("world", "this mission has its world already"),
    ],
)
def test_who_may_not_join_is_told_why(name: str, reason: str) -> None:
    members = membership()
    reply = members.admit(JoinRequest(process=name, instance="i"))
    assert not reply.accepted
    assert reason in reply.reason
    assert reply.scenario_json == ""
    assert not tell(members, name, instance="i")


def test_nobody_joins_twice_at_a_time_and_anybody_comes_back() -> None:
    members = joined(membership(), "chaser/0")
    twin = JoinRequest(process="chaser/0", instance="another")
    assert members.admit(twin).reason == "chaser/0 is already running in this mission"
    assert members.admit(JoinRequest(process="chaser/0", instance="chaser/0-1")).accepted  # asked again
    members.alive_changed("chaser/0", False)
    assert members.who_left() == ["chaser/0"]
    assert members.who_left() == []
    assert members.admit(twin).accepted
    assert not tell(members, "chaser/0", "world")  # the old one has nothing to say any more
    assert tell(members, "chaser/0", "world", instance="another")


def test_leaving_without_having_come_is_nothing() -> None:
    members = membership()
    members.alive_changed("chaser/0", False)
    assert members.who_left() == []
    assert members.alive() == set()


def test_linked_are_those_who_have_heard_each_other_both_ways() -> None:
    members = joined(membership(1), "chaser/0", "controller")
    assert members.linked(frozenset()) == set()
    everyone = frozenset({"chaser/0", "controller"})
    tell(members, "chaser/0", "world", "controller")
    tell(members, "controller", "world", "chaser/0")
    assert members.linked(everyone) == {"chaser/0", "controller"}
    assert members.linked(frozenset({"controller"})) == {"controller"}  # the world has not heard the chaser
    tell(members, "controller", "world")  # not any more
    assert members.linked(everyone) == set()
    tell(members, "controller", "chaser/0")  # has not heard the world
    assert members.linked(everyone) == {"chaser/0"}


def test_chasers_need_not_hear_each_other_and_the_recorder_must_hear_all() -> None:
    members = joined(membership(2), "chaser/0", "chaser/1", "controller", "recorder")
    tell(members, "chaser/0", "world", "controller")
    tell(members, "chaser/1", "world", "controller")
    tell(members, "controller", "world", "chaser/0", "chaser/1")
    tell(members, "recorder", "world", "chaser/0", "controller")
    everyone = frozenset({"chaser/0", "chaser/1", "controller", "recorder"})
    assert members.linked(everyone) == {"chaser/0", "chaser/1", "controller"}


def test_who_is_gone_links_nobody_up_and_is_linked_no_more() -> None:
    members = joined(membership(1), "chaser/0", "controller")
    tell(members, "chaser/0", "world", "controller")
    tell(members, "controller", "world", "chaser/0")
    everyone = frozenset({"chaser/0", "controller"})
    members.alive_changed("controller", False)
    assert members.linked(everyone) == {"chaser/0"}
    assert members.alive() == {"chaser/0"}
    members.alive_changed("controller", True)
    assert members.linked(everyone) == {"chaser/0"}  # back, and not heard anew
