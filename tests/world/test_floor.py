# SPDX-License-Identifier: Apache-2.0
"""Bodies on a floor move by Newton's and Euler's laws in the plane, and stay in it, whatever
pushes, hits or holds them.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any, cast

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.physics.engine import BodyMotion
from chaserdock_world.physics.floor import Floor, on_floor
from chaserdock_world.physics.simulation import TARGET, Physics
from chaserdock_world.plant import Plant, chaser_plant, target_plant
from engine_cases import both
from general_position import matrix
from planar_cases import HEIGHT_M, UP_TRF, scenario

HZ = 960
Worlds = Callable[[], tuple[Scenario, Physics]]


@pytest.fixture
def worlds(request: pytest.FixtureRequest) -> Iterator[Worlds]:
    """Open worlds on the floor, of the engine that ``engine_cases.both`` names."""
    opened: list[Physics] = []

    def make() -> tuple[Scenario, Physics]:
        s = scenario(request.param)
        opened.append(Physics(s))
        return s, opened[-1]

    yield make
    for physics in opened:
        physics.close()


def plants(s: Scenario) -> dict[str, Plant]:
    """Bodies as drawn, without a floor."""
    return {TARGET: target_plant(s), "chaser/0": chaser_plant(s, 0), "chaser/1": chaser_plant(s, 1)}


def planar_motion(state: BodyState, plant: Plant, up: Array) -> tuple[Array, float, Array, float]:
    """Return centre of mass and its velocity (2,), WRF, rate about the vertical, and moment of
    inertia about the vertical through the centre of mass.
    """
    turn = rotations.to_matrix(state.q_wxyz)
    arm, rate = turn @ plant.centre_of_mass_m, turn @ state.omega_rad_s
    velocity = state.velocity_m_s + np.cross(rate, arm)
    moment = float(up @ plant.inertia_kg_m2 @ up)
    return (state.position_m + arm)[:2], float(rate[2]), velocity[:2], moment


def up_of(name: str) -> Array:
    return UP_TRF if name == TARGET else np.array([0.0, 0.0, 1.0])


def momentum(s: Scenario, physics: Physics) -> Array:
    """Return momentum along x and y, and angular momentum about WRF's z (3,), of all bodies."""
    total = np.zeros(3)
    for name, plant in plants(s).items():
        place, rate, velocity, moment = planar_motion(physics.state(name), plant, up_of(name))
        total[:2] += plant.mass_kg * velocity
        total[2] += moment * rate
        total[2] += plant.mass_kg * (place[0] * velocity[1] - place[1] * velocity[0])
    return total


def off_floor(physics: Physics, first: dict[str, BodyState]) -> float:
    """Return the largest motion out of the plane of all bodies: m, rad, m/s or rad/s."""
    worst = 0.0
    for name in physics.bodies:
        state, up = physics.state(name), up_of(name)
        off = [
            state.position_m[2] - first[name].position_m[2],
            *(rotations.rotate(state.q_wxyz, up) - [0.0, 0.0, 1.0]),
            state.velocity_m_s[2],
            *np.cross(up, state.omega_rad_s),
        ]
        worst = max(worst, float(np.abs(off).max()))
    return worst


class StillEngine:
    """Stand-in for an engine: bodies move as stated, until they are placed."""

    def __init__(self, motions: list[BodyMotion]) -> None:
        self.motions, self.placed = motions, dict[int, BodyState]()

    def motion(self, body: int) -> BodyMotion:
        return self.motions[body]

    def place(self, body: int, state: BodyState) -> None:
        self.placed[body] = state


YAW, LEAN = rotations.exp((0.0, 0.0, 0.9)), rotations.exp((0.0, -3e-8, 0.0))
LEVEL: dict[str, Any] = {
    "position": (1.2, -0.7, 0.31),
    "q_wxyz": YAW,
    "velocity": (0.04, -0.03, 0.0),
    "omega": (0.0, 0.0, 0.07),
}
"""A motion in the plane of a floor, axes of an engine."""
OFF: dict[str, dict[str, Any]] = {
    "higher": {"position": (1.2, -0.7, 0.31 + 3e-8)},
    "leans forward": {"q_wxyz": rotations.multiply(YAW, LEAN)},
    "leans aside": {"q_wxyz": rotations.multiply(YAW, rotations.exp((3e-8, 0.0, 0.0)))},
    "sinks": {"velocity": (0.04, -0.03, -3e-8)},
    "rolls": {"omega": (3e-8, 0.0, 0.07)},
    "pitches": {"omega": (0.0, -3e-8, 0.07)},
    "everything": {
        "position": (1.2, -0.7, 0.28),
        "q_wxyz": rotations.multiply(rotations.exp((0.2, -0.3, 0.0)), YAW),
        "velocity": (0.04, -0.03, 0.05),
        "omega": (-0.2, 0.1, 0.07),
    },
}


@pytest.mark.parametrize("name", OFF)
def test_the_floor_puts_a_body_back_into_the_plane_and_keeps_its_motion_there(name: str) -> None:
    engine = StillEngine([cast(BodyMotion, tuple(LEVEL.values()))] * 3)
    floor = Floor(cast(Any, engine), [0, 2])
    floor.hold()
    assert not engine.placed

    engine.motions = [cast(BodyMotion, tuple((LEVEL | OFF[name]).values()))] * 3
    floor.hold()
    assert sorted(engine.placed) == [0, 2]
    state = engine.placed[2]
    assert state.position_m == pytest.approx(LEVEL["position"], abs=0.0)
    assert state.velocity_m_s == pytest.approx(LEVEL["velocity"], abs=0.0)
    assert matrix(state.q_wxyz) == pytest.approx(matrix(YAW), abs=1e-10)
    assert matrix(state.q_wxyz) @ state.omega_rad_s == pytest.approx(LEVEL["omega"], abs=1e-10)


def test_the_floor_carries_the_vertical_force_and_the_horizontal_torques() -> None:
    loads = np.arange(1.0, 13.0).reshape(2, 6)
    Floor(cast(Any, StillEngine([])), []).carry(loads)
    assert loads.tolist() == [[1.0, 2.0, 0.0, 0.0, 0.0, 6.0], [7.0, 8.0, 0.0, 0.0, 0.0, 12.0]]


def test_on_a_floor_bodies_turn_about_the_vertical_alone() -> None:
    """Their third principal axis is the vertical through the centre of mass, with their moment
    about it; about the others 1 N m tilts them by less than 1e-11 rad in a step of 1 ms.
    """
    s = scenario()
    free = plants(s)
    for name, plant in on_floor(s, free).items():
        up, inertia = up_of(name), free[name].inertia_kg_m2
        assert plant.frame is not None
        assert matrix(plant.frame.q_wxyz) @ [0.0, 0.0, 1.0] == pytest.approx(up, abs=1e-12)
        assert plant.frame.offset_m == pytest.approx(free[name].centre_of_mass_m)
        assert plant.moments_kg_m2[2] == pytest.approx(float(up @ inertia @ up))
        assert 0.5 * 1e-3**2 / min(plant.moments_kg_m2[:2]) < 1e-11
        assert plant.mass_kg == free[name].mass_kg


@both
def test_a_body_is_moved_by_the_forces_in_the_plane_and_the_torque_about_the_vertical(
    worlds: Worlds,
) -> None:
    s, physics = worlds()
    physics.advance(HZ // 3, {"chaser/0": np.array([0.2, -0.1, 0.0, 0.0, 0.0, 0.02])})
    first = {name: physics.state(name) for name in physics.bodies}
    wrench = np.array([0.07, -0.11, 0.4, 0.06, -0.05, 0.004])
    physics.advance(1, {"chaser/0": wrench})
    before, plant = first["chaser/0"], plants(s)["chaser/0"]
    _, rate, velocity, moment = planar_motion(before, plant, up_of("chaser/0"))
    after = physics.state("chaser/0")
    _, new_rate, new_velocity, _ = planar_motion(after, plant, up_of("chaser/0"))

    given = wrench + plant.disturbance
    force = rotations.rotate(before.q_wxyz, given[:3])[:2]
    torque = given[5] - np.cross(plant.centre_of_mass_m, given[:3])[2]
    assert (new_velocity - velocity) * HZ == pytest.approx(force / plant.mass_kg, rel=1e-3)
    assert (new_rate - rate) * HZ == pytest.approx(torque / moment, rel=1e-3)
    assert abs(rate) > 0.01
    assert off_floor(physics, first) < 1e-9


@both
def test_the_target_drifts_and_turns_about_the_vertical_at_its_rates(worlds: Worlds) -> None:
    s, physics = worlds()
    first = physics.state(TARGET)
    _, rate, velocity, _ = planar_motion(first, plants(s)[TARGET], UP_TRF)
    physics.advance(2 * HZ, {})
    now = physics.state(TARGET)
    turned = rotations.multiply(rotations.exp((0.0, 0.0, 2.0 * rate)), first.q_wxyz)
    assert rotations.angle_between(now.q_wxyz, turned) < 1e-6
    arm, arm_now = (rotations.rotate(x.q_wxyz, plants(s)[TARGET].centre_of_mass_m)[:2]
                    for x in (first, now))  # fmt: skip
    gone = now.position_m[:2] + arm_now - first.position_m[:2] - arm
    assert gone == pytest.approx(2.0 * velocity, abs=1e-7)


@both
@pytest.mark.slow
def test_a_collision_stays_in_the_plane_and_keeps_momentum(worlds: Worlds) -> None:
    s, physics = worlds()
    target = physics.state(TARGET).position_m
    for i, aside in enumerate((0.1, -0.05)):
        state = physics.state(f"chaser/{i}")
        way = (target - state.position_m)[:2]
        ahead = np.array([*way, 0.0]) / math.hypot(*way)
        speed = 0.4 * ahead + aside * np.cross([0.0, 0.0, 1.0], ahead)
        physics.place(
            f"chaser/{i}", BodyState(state.position_m, speed, state.q_wxyz, state.omega_rad_s)
        )
    first = {name: physics.state(name) for name in physics.bodies}
    before, worst = momentum(s, physics), 0.0
    pushed = {name: -plants(s)[name].disturbance for name in ("chaser/0", "chaser/1")}
    for _ in range(20):
        physics.advance(HZ // 10, pushed)
        worst = max(worst, off_floor(physics, first))
    assert worst < 1e-6
    assert momentum(s, physics) == pytest.approx(before, abs=2e-3 * np.abs(before).max())
    assert np.linalg.norm(physics.state(TARGET).velocity_m_s - first[TARGET].velocity_m_s) > 0.05


@both
@pytest.mark.slow
def test_a_latched_stack_stays_in_the_plane_and_keeps_momentum(worlds: Worlds) -> None:
    s, physics = worlds()
    target = physics.state(TARGET)
    reach_m = s.chaser.probe_reach_m
    for i, port in enumerate(s.docking.ports):
        place = np.array(port.position_m) + reach_m * np.array(port.axis)
        at = target.position_m + rotations.rotate(target.q_wxyz, place)
        q = rotations.multiply(target.q_wxyz, s.chasers[i].q_wxyz)
        still = np.zeros(3)
        physics.place(f"chaser/{i}", BodyState(at, still, q, still))
        physics.close_latch(i)
    first = {name: physics.state(name) for name in physics.bodies}
    assert first["chaser/1"].position_m[2] - target.position_m[2] == pytest.approx(HEIGHT_M)
    before, worst = momentum(s, physics), 0.0
    pushed = {name: -plants(s)[name].disturbance for name in ("chaser/0", "chaser/1")}
    for _ in range(10):
        physics.advance(HZ // 10, pushed)
        worst = max(worst, off_floor(physics, first))
    assert worst < 1e-6
    assert momentum(s, physics) == pytest.approx(before, abs=1e-3 * np.abs(before).max())
    rates = [rotations.rotate(physics.state(n).q_wxyz, physics.state(n).omega_rad_s)[2]
             for n in physics.bodies]  # fmt: skip
    assert rates == pytest.approx([rates[0]] * 3, abs=1e-5)
    assert abs(rates[0]) > 0.005
