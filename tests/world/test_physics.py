# SPDX-License-Identifier: Apache-2.0
"""The simulation against analytical physics and the controller model: motion, forces, contacts."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from chaserdock_controller.nmpc import NmpcParameters
from chaserdock_controller.nmpc.casadi_model import dynamics
from chaserdock_controller.parameters import nmpc_settings
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_world.physics.simulation import TARGET, BodyState, Physics, prescribed_state
from engine_cases import both
from world_cases import HZ, STEP_S, scenario

HALF = np.sqrt(0.5)


@pytest.fixture
def worlds(request: pytest.FixtureRequest) -> Iterator[Any]:
    opened: list[Physics] = []
    engine = getattr(request, "param", "pybullet")

    def make(**changes: Any) -> Physics:
        opened.append(Physics(scenario(world={"engine": engine}, **changes)))
        return opened[-1]

    yield make
    for physics in opened:
        physics.close()


NONE = {"min_distance_target_m": 0.0, "min_distance_chasers_m": 0.0}
"""Limits under which chasers may be where they touch."""


def state13(s: BodyState) -> Array:
    return np.concatenate([s.position_m, s.velocity_m_s, s.q_wxyz, s.omega_rad_s])


# -- free motion -----------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("inertia", "omega"),
    [
        ((0.1, 0.5, 0.55), (0.17, 0.18, -0.17)),  # a rod, tumbling
        ((0.3, 0.5, 0.7), (0.005, 0.3, 0.005)),  # about the unstable middle axis
        ((0.2, 0.35, 0.5), (-0.2, 0.1, 0.2)),
        ((0.1, 0.5, 0.55), (0.2, 0.3, 0.32)),  # 28 degrees a second
    ],
)
def test_torque_free_body_conserves_angular_momentum(
    worlds: Any, inertia: tuple[float, ...], omega: tuple[float, ...]
) -> None:
    """120 s at the default physics rate: within 1e-3, in size and direction; energy likewise."""
    target = {
        "motion": "torque_free",
        "mass_kg": 10.0,
        "inertia_kg_m2": inertia,
        "omega_rad_s": omega,
    }
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
        turned = max(
            turned, float(np.linalg.norm(physics.state(TARGET).omega_rad_s - np.array(omega)))
        )
    assert turned > 0.02  # the rate itself is far from constant: there was something to keep
    s = physics.state(TARGET)
    np.testing.assert_allclose(s.velocity_m_s, [0.015, 0.0075, 0.03], rtol=1e-12)
    np.testing.assert_allclose(s.position_m, 120.0 * np.array([0.015, 0.0075, 0.03]), rtol=1e-9)


@pytest.mark.parametrize("steps", [0, 1, 7, 8, 9, HZ, 12_345])
def test_prescribed_target_is_exact_at_every_step(worlds: Any, steps: int) -> None:
    q, v, omega = (
        np.array([HALF, 0.0, HALF, 0.0]),
        np.array([0.01, -0.02, 0.03]),
        np.array([0.1, -0.3, 0.2]),
    )
    target = {
        "position_m": [1.0, 2.0, 3.0],
        "q_wxyz": q.tolist(),
        "velocity_m_s": v.tolist(),
        "omega_rad_s": omega.tolist(),
    }
    physics = worlds(
        target=target, chasers=[{"position_m": [-20.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}]
    )
    physics.advance(steps, {})
    s, t = physics.state(TARGET), steps / HZ
    np.testing.assert_allclose(s.position_m, np.array([1.0, 2.0, 3.0]) + v * t, rtol=0, atol=1e-14)
    np.testing.assert_allclose(
        s.q_wxyz, rotations.multiply(q, rotations.exp(omega * t)), rtol=0, atol=1e-14
    )
    np.testing.assert_array_equal(s.velocity_m_s, v)
    np.testing.assert_array_equal(s.omega_rad_s, omega)
    np.testing.assert_array_equal(state13(prescribed_state(physics._scenario, t)), state13(s))


@both
def test_static_target_does_not_move(worlds: Any) -> None:
    physics = worlds(target={"motion": "static", "position_m": [0.5, 0.0, 0.0]})
    physics.advance(HZ, {})
    s = physics.state(TARGET)
    np.testing.assert_array_equal(state13(s), [0.5, 0, 0, 0, 0, 0, 1, 0, 0, 0, 0, 0, 0])


@both
def test_bodies_start_at_the_scenario_state(worlds: Any) -> None:
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
    physics = worlds(
        chasers=chasers, target={"position_m": [3.0, 2.0, 1.0], "q_wxyz": [0.0, 0.0, 0.0, 1.0]}
    )
    assert physics.bodies == ("target", "chaser/0", "chaser/1")
    s = physics.state("chaser/0")
    np.testing.assert_allclose(s.position_m, [4.0, 1.8, 1.0], rtol=0, atol=1e-12)
    np.testing.assert_allclose(s.velocity_m_s, [0.01, 0.02, -0.03], rtol=0, atol=1e-15)
    np.testing.assert_array_equal(s.omega_rad_s, np.zeros(3))
    assert rotations.angle_between(s.q_wxyz, physics._scenario.start_pose(0)[1]) < 1e-7


def test_bullets_steps_in_c_have_the_bits_of_those_in_python(worlds: Any) -> None:
    """A chaser that turns flies against another until they touch; a third is thrust alone. The
    target moves as prescribed.
    """
    chasers = [
        {
            "position_m": [-5.0, 0.0, 0.0],
            "q_wxyz": [1.0, 0.0, 0.0, 0.0],
            "start_velocity_m_s": [0.05, 0.01, 0.0],
        },
        {"position_m": [-4.5, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]},
        {"position_m": [5.0, 1.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]},
    ]
    wrench = np.array([0.1, -0.05, 0.02, 1e-3, 2e-3, -1e-3])
    moving = {
        "motion": "constant_rates",
        "velocity_m_s": [0.01, 0.0, 0.02],
        "omega_rad_s": [0.02, -0.1, 0.3],
    }
    flown: list[tuple[list[Any], list[set[tuple[str, str]]]]] = []
    for in_c in (True, False):
        physics = worlds(chasers=chasers, limits=NONE, target=moving)
        engine = physics._engine
        assert engine._stepper is not None, (
            "this build of PyBullet offers no plugin with its C interface"
        )
        if not in_c:
            engine._stepper = None
        touched = [physics.advance(HZ, {"chaser/0": wrench, "chaser/2": -wrench}) for _ in range(6)]
        flown.append(([engine.motion(body) for body in range(4)], touched))
    assert flown[0] == flown[1]
    assert any(flown[0][1])
    assert flown[0][0][0][0][2] > 0.11  # the target: 6 s at 0.02 m/s


# -- forces ----------------------------------------------------------------------------------------


@both
@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.0, 0.0, np.pi / 2), (0.4, -1.1, 2.0)])
def test_force_accelerates_along_body_axes(worlds: Any, axis: int, turn: tuple[float, ...]) -> None:
    q = rotations.exp(turn)
    physics = worlds(chasers=[{"position_m": [-5.0, 0.0, 0.0], "q_wxyz": q.tolist()}])
    wrench = np.zeros(6)
    wrench[axis] = 1.5
    physics.advance(2 * HZ, {"chaser/0": wrench})
    s = physics.state("chaser/0")
    a = 1.5 / 30.0 * rotations.to_matrix(q)[:, axis]
    np.testing.assert_allclose(s.velocity_m_s, a * 2.0, rtol=0, atol=1e-9)
    # The engines move with the velocity at the step's end: half a step ahead.
    np.testing.assert_allclose(
        s.position_m, [-5.0, 0.0, 0.0] + a * 2.0 * (1.0 + STEP_S / 2), rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(s.omega_rad_s, np.zeros(3), rtol=0, atol=1e-12)


@both
def test_force_rotates_with_the_body(worlds: Any) -> None:
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


@both
def test_wrench_does_not_persist(worlds: Any) -> None:
    physics = worlds()
    physics.advance(10, {"chaser/0": np.ones(6)})
    s = physics.state("chaser/0")
    physics.advance(10, {})
    np.testing.assert_allclose(
        physics.state("chaser/0").velocity_m_s, s.velocity_m_s, rtol=0, atol=1e-15
    )
    physics.advance(10, {"chaser/0": np.zeros(6)})
    np.testing.assert_allclose(
        physics.state("chaser/0").velocity_m_s, s.velocity_m_s, rtol=0, atol=1e-15
    )


@both
@pytest.mark.parametrize("split", [1, 7, 128])
def test_grouping_of_steps_does_not_change_the_result(worlds: Any, split: int) -> None:
    wrench = {"chaser/0": np.array([0.5, -0.2, 0.1, 0.01, -0.02, 0.005])}
    a, b = worlds(), worlds()
    a.advance(896, wrench)
    for _ in range(896 // split):
        b.advance(split, wrench)
    for name in a.bodies:
        np.testing.assert_array_equal(state13(a.state(name)), state13(b.state(name)))


# -- against the controller's model ----------------------------------------------------------------


@pytest.mark.parametrize(
    ("seed", "inertia"),
    [(0, (0.1, 0.5, 0.55)), (1, (0.6, 0.12, 0.6)), (2, (0.5, 0.9, 0.45)), (3, None)],
)
def test_controller_model_matches_the_simulation(
    worlds: Any, seed: int, inertia: tuple[float, float, float] | None
) -> None:
    """10 s of random inputs within the limits, inertias far from a sphere: 1 mm and 0.05 degrees
    (bar of the issue).
    """
    rng = np.random.default_rng(seed)
    body = {"mass_kg": 12.0, "inertia_kg_m2": inertia} if inertia else {}
    start = {"start_rotation_rad": [0.4, -0.7, 0.2], "start_velocity_m_s": [0.05, -0.02, 0.03]}
    chaser = {"position_m": [-5.0, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}
    physics = worlds(chaser=body, chasers=[chaser | start])
    b = physics._scenario.chaser
    model = dynamics(
        NmpcParameters(
            mass_kg=b.mass_kg,
            inertia_kg_m2=(
                (b.inertia[0], 0.0, 0.0),
                (0.0, b.inertia[1], 0.0),
                (0.0, 0.0, b.inertia[2]),
            ),
            force_max_N=b.force_max_N,
            torque_max_N_m=b.torque_max_N_m,
            **nmpc_settings(physics._scenario.controller, physics._scenario.limits),
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


# -- contacts --------------------------------------------------------------------------------------


@both
def test_contact_is_reported_when_bodies_touch_and_not_before(worlds: Any) -> None:
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


@both
@pytest.mark.parametrize("speed_m_s", [0.01, 0.1, 1.0])
@pytest.mark.parametrize("turn", [(0.0, 0.0, 0.0), (0.5, 0.0, 0.0), (0.6, 0.6, 0.2)])
def test_gentle_and_short_contacts_are_reported(
    worlds: Any, speed_m_s: float, turn: tuple[float, ...]
) -> None:
    start = {"start_velocity_m_s": [speed_m_s, 0.0, 0.0], "q_wxyz": rotations.exp(turn).tolist()}
    physics = worlds(
        chasers=[{"position_m": [-0.26, 0.01, 0.0]} | start],
        target={"motion": "static"},
        limits=NONE,
    )
    assert physics.contacts() == ()
    touched = physics.advance(int(0.12 / speed_m_s * HZ), {})
    assert touched == {("chaser/0", "target")}
    assert physics.state("chaser/0").velocity_m_s[0] < 0.5 * speed_m_s


@both
def test_contact_between_chasers_is_reported(worlds: Any) -> None:
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


@both
def test_moving_prescribed_target_contacts_a_chaser_in_its_way(worlds: Any) -> None:
    physics = worlds(
        target={"velocity_m_s": [-0.3, 0.0, 0.0], "omega_rad_s": [0.0, 0.0, 0.0]},
        chasers=[{"position_m": [-0.5, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]}],
    )
    assert ("chaser/0", "target") in physics.advance(2 * HZ, {})
    s = physics.state(TARGET)
    np.testing.assert_allclose(
        s.position_m, [-0.6, 0.0, 0.0], rtol=0, atol=1e-12
    )  # and is not stopped by it
