# SPDX-License-Identifier: Apache-2.0
"""Bodies that are not rigid: panels, fuel and propellant on springs, on both engines."""

from __future__ import annotations

import json
import math
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.oscillators import MassDistribution, frequencies_hz, rigid_rest
from chaserdock_models.rigid_body import BodyState
from chaserdock_models.thruster_model import G0_M_S2
from chaserdock_protocol.messages import ActuatorCommand, ThrusterPulse
from chaserdock_protocol.scenario import ScenarioError, load_scenario
from chaserdock_protocol.shipped_scenarios import shipped_scenario
from chaserdock_world.actuators.ideal import fly_to
from chaserdock_world.actuators.thrusters import ThrusterActuators
from chaserdock_world.physics.oscillators import RESIDUAL_SHARE
from chaserdock_world.physics.simulation import TARGET, Physics
from chaserdock_world.plant import chaser_plant
from docking_cases import latch, momenta
from docking_cases import scenario as docking_scenario
from engine_cases import ENGINES, both
from thruster_cases import mission
from world_cases import HZ, STEP_S, scenario

BENCHMARKS = Path(__file__).parents[2] / "benchmarks"
NAME = "chaser/0"
PANEL = {"mass_share": 0.04, "position_m": [0.02, 0.3, 0.01], "frequency_hz": [3.0, 4.0, 0.4]}
FUEL = {"mass_share": 0.2, "position_m": [-0.05, 0.02, 0.03], "frequency_hz": 0.7}
PAIR = [PANEL, {**PANEL, "position_m": [0.02, -0.3, 0.01]}, FUEL]
ON_TARGET = {"body": "target", "mass_share": 0.1, "position_m": [0.1, 0.05, -0.1],
             "frequency_hz": 0.5}  # fmt: skip
WRENCH = np.array([0.5, 0.3, -0.4, 0.02, 0.03, -0.01])


def flexible(oscillators: list[dict[str, Any]], **changes: Any) -> dict[str, Any]:
    return {"truth": {"oscillator": oscillators}, **changes}


def all_momenta(physics: Physics) -> tuple[Array, Array]:
    """Momentum and angular momentum (3,) of all free bodies and what they carry, WRF's origin."""
    linear, angular = np.zeros(3), np.zeros(3)
    for name in physics.bodies:
        p, h = momenta(physics, name)
        linear, angular = linear + p, angular + h
        if name in physics.carried:
            m, x, v = physics.carried[name].momenta()
            linear = linear + m @ v
            angular = angular + (m[:, None] * np.cross(x, v)).sum(axis=0)
    return linear, angular


def energy(physics: Physics, held_hz: Array) -> float:
    """Kinetic energy of a chaser and what it carries, and the energy of the springs, J."""
    plant, s = physics.plants[NAME], physics.state(NAME)
    velocity = s.velocity_m_s + rotations.rotate(
        s.q_wxyz, np.cross(s.omega_rad_s, plant.centre_of_mass_m)
    )
    m, _, v = physics.carried[NAME].momenta()
    springs = m[:, None] * (2.0 * math.pi * held_hz * physics.deflections_m(NAME)) ** 2
    spin = s.omega_rad_s @ plant.inertia_kg_m2 @ s.omega_rad_s
    moving = plant.mass_kg * velocity @ velocity + m @ (v * v).sum(axis=1)
    return 0.5 * float(moving + spin + springs.sum())


def in_general_position(physics: Physics) -> None:
    """Place the chaser far from the target, with a rate about all axes, and set it swinging."""
    state = BodyState(
        np.array([3.0, -2.0, 1.0]),
        np.array([0.01, 0.02, -0.03]),
        rotations.exp([0.3, -0.5, 0.8]),
        np.array([0.05, -0.08, 0.06]),
    )
    physics.place(NAME, state)
    physics.advance(480, {NAME: WRENCH})


@both
def test_momentum_is_conserved_and_energy_does_not_grow_without_damping(worlds: Any) -> None:
    undamped = [{**o, "damping_share": 0.0} for o in PAIR]
    physics = worlds(**flexible(undamped))
    in_general_position(physics)
    held = np.array([[3.0, 4.0, 0.4]] * 2 + [[0.7] * 3])
    linear, angular = all_momenta(physics)
    size, energies = float(np.linalg.norm(angular)), [energy(physics, held)]
    for _ in range(20):
        physics.advance(HZ // 4, {})
        energies.append(energy(physics, held))
    after_linear, after_angular = all_momenta(physics)
    assert np.abs(physics.deflections_m(NAME)).max() > 1e-3
    np.testing.assert_allclose(after_linear, linear, atol=1e-13)
    np.testing.assert_allclose(after_angular, angular, atol=1e-6 * size)
    # Velocities are those of half a step before the positions, so the sum swings by 1e-3.
    assert np.ptp(energies) < 4e-3 * energies[0]
    assert np.mean(energies[-8:]) < np.mean(energies[:8]) * 1.001


@both
def test_damping_takes_energy(worlds: Any) -> None:
    physics = worlds(**flexible([{**o, "damping_share": 0.1} for o in PAIR]))
    in_general_position(physics)
    before = np.abs(physics.deflections_m(NAME)).max()
    linear, _ = all_momenta(physics)
    physics.advance(6 * HZ, {})
    assert np.abs(physics.deflections_m(NAME)).max() < 0.5 * before
    np.testing.assert_allclose(all_momenta(physics)[0], linear, atol=1e-13)


@both
def test_chaser_latched_to_a_target_conserves_the_momentum_of_all(worlds: Any) -> None:
    physics = worlds(**flexible([*PAIR, ON_TARGET]))
    linear, angular = all_momenta(physics)
    size = float(np.linalg.norm(angular))
    latch(physics)
    physics.advance(HZ, {})
    assert physics.latches[NAME].latched
    for name in (NAME, TARGET):
        assert np.abs(physics.deflections_m(name)).max() > 1e-5
    after_linear, after_angular = all_momenta(physics)
    np.testing.assert_allclose(after_linear, linear, atol=1e-10)
    np.testing.assert_allclose(after_angular, angular, atol=1e-4 * size)


@pytest.mark.parametrize("engine", ENGINES)
def test_motion_agrees_with_basilisk(engine: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Reference: ``python benchmarks/physics.py --only flexible --basilisk PYTHON --write``."""
    monkeypatch.setattr(sys, "path", [str(BENCHMARKS), *sys.path])
    from parts import flexible as comparison

    rows = json.loads(comparison.REFERENCE.read_text())["panels_and_slosh"][:2]
    assert [row["at_s"] for row in rows] == [1, 2]
    physics = Physics(comparison.scenario_of("panels_and_slosh", engine))
    shares = comparison.apart(comparison.fly(physics, [1, 2]), rows)
    physics.close()
    assert max(shares) < 1e-4


def test_rigid_rest_and_masses_make_up_the_whole_body() -> None:
    whole = MassDistribution(17.0, np.array([0.01, -0.02, 0.03]), np.diag([0.4, 0.5, 0.6]))
    whole.inertia_kg_m2[0, 1] = whole.inertia_kg_m2[1, 0] = 0.03
    masses, places = np.array([0.5, 2.0]), np.array([[0.1, 0.4, -0.2], [-0.1, 0.05, 0.1]])
    rest = rigid_rest(whole, masses, places)
    points = np.vstack([rest.centre_m, places])
    kg = np.array([rest.mass_kg, *masses])
    assert kg.sum() == pytest.approx(17.0)
    centre = kg @ points / kg.sum()
    np.testing.assert_allclose(centre, whole.centre_m, atol=1e-15)
    arms = points - centre
    inertia = rest.inertia_kg_m2 + sum(
        m * (r @ r * np.eye(3) - np.outer(r, r)) for m, r in zip(kg, arms, strict=True)
    )
    np.testing.assert_allclose(inertia, whole.inertia_kg_m2, atol=1e-14)


def test_a_free_body_oscillates_faster_than_a_held_one() -> None:
    rest = MassDistribution(8.0, np.array([0.1, -0.2, 0.3]), np.diag([0.5, 0.6, 0.7]))
    held = np.array([[0.5, 0.6, 0.7]])
    at_centre = frequencies_hz(rest, np.array([2.0]), np.array([rest.centre_m]), held)
    np.testing.assert_allclose(at_centre, held[0] * math.sqrt(1.0 + 2.0 / 8.0))
    # An arm along Y: motion along X and Z turns the body, motion along Y does not.
    place = np.array([rest.centre_m + np.array([0.0, 0.4, 0.0])])
    arm2 = 2.0 * 0.4**2
    factors = np.sqrt(1.25 + np.array([arm2 / 0.7, 0.0, arm2 / 0.5]))
    found = frequencies_hz(rest, np.array([2.0]), place, held)
    np.testing.assert_allclose(found, np.sort(held[0] * factors))


@pytest.mark.parametrize("engine", ENGINES)
def test_masses_follow_the_orbit_with_their_body(engine: str) -> None:
    rigid, soft = (
        Physics(
            docking_scenario(
                world={"engine": engine},
                orbit={"altitude_m": 4e5},
                target={"velocity_m_s": [0.0, 0.0, 0.0]},
                **flexible(carried),
            )
        )
        for carried in ([], [FUEL])
    )
    state = BodyState(np.array([0.0, 60.0, 80.0]), np.zeros(3), rotations.exp([0.3, 0.1, 0.4]),
                      np.zeros(3))  # fmt: skip
    for physics in (rigid, soft):
        physics.place(NAME, state)
        physics.advance(4 * HZ, {})
    moved = rigid.state(NAME).position_m - state.position_m
    assert np.linalg.norm(moved) > 1e-4
    np.testing.assert_allclose(
        soft.state(NAME).position_m, rigid.state(NAME).position_m, atol=0.01 * np.abs(moved).max()
    )
    assert np.abs(soft.deflections_m(NAME)).max() < 1e-6
    rigid.close()
    soft.close()


# -- propellant ------------------------------------------------------------------------------------


TANK = {"mass_share": 0.3, "position_m": [0.02, 0.0, -0.01], "frequency_hz": 8.0,
        "damping_share": 0.1, "propellant": True}  # fmt: skip


def test_mass_falls_by_what_the_thrusters_consume() -> None:
    s = mission(truth={"oscillator": [TANK, FUEL]})
    physics, thrusters = Physics(s), ThrusterActuators(s.chaser, s.timing, ())
    tank, fuel = physics.carried[NAME].masses_kg.tolist()
    pulses = tuple(ThrusterPulse(thruster=j, open_ns=0, close_ns=80_000_000) for j in (0, 5, 7))
    thrusters.command(
        ActuatorCommand(tick=0, sim_time_ns=0, chaser=0, effective_time_ns=0, source="command",
                        force_N=(0.0, 0.0, 0.0), torque_N_m=(0.0, 0.0, 0.0), pulses=pulses),
        0, 0,
    )  # fmt: skip
    fly_to(120, physics, {NAME: thrusters}, STEP_S)
    consumed_kg = thrusters.take_output(120).propellant_kg
    left = physics.carried[NAME].masses_kg.tolist()
    physics.close()
    assert consumed_kg > 3e-4
    assert tank - left[0] == pytest.approx(consumed_kg, rel=1e-6)
    assert left[1] == fuel


@pytest.mark.parametrize("engine", ENGINES)
def test_speed_is_that_of_the_rocket_equation(engine: str) -> None:
    s = mission(truth={"oscillator": [TANK]}, world={"engine": engine})
    physics = Physics(s)
    far_away = replace(physics.state(NAME), position_m=np.array([-30.0, 2.0, 1.0]))
    physics.place(NAME, far_away)
    exhaust_m_s, thrust_N, steps = 70.0 * G0_M_S2, 200.0, HZ
    thrusts = np.array([thrust_N] + [0.0] * (len(s.chaser.thrusters) - 1))
    whole = chaser_plant(s, 0).mass_kg
    for _ in range(steps):
        physics.burn(NAME, thrusts, STEP_S)
        physics.advance(1, {NAME: np.array([thrust_N, 0.0, 0.0, 0.0, 0.0, 0.0])})
    left = physics.plants[NAME].mass_kg + float(physics.carried[NAME].masses_kg.sum())
    assert whole - left == pytest.approx(thrust_N / exhaust_m_s)
    linear, _ = all_momenta(physics)
    speed = float(np.linalg.norm(linear)) / left
    assert speed == pytest.approx(exhaust_m_s * math.log(whole / left), rel=2e-3)
    physics.burn(NAME, 1e6 * thrusts, 1.0)
    left = float(physics.carried[NAME].masses_kg.sum())
    physics.close()
    assert left == pytest.approx(RESIDUAL_SHARE * TANK["mass_share"] * whole)


# -- invalid input ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("oscillator", "changes", "message"),
    [
        ({"mass_share": 0.45, "position_m": [0.0, 0.8, 0.0]}, {}, "choose a smaller mass_share"),
        ({"frequency_hz": 40.0, "mass_share": 0.02}, {}, "time.physics_hz = 960 resolves 32 Hz"),
        ({"frequency_hz": [1.0, 2.0]}, {}, "truth.oscillator.0.frequency_hz"),
        ({"frequency_hz": 0.0}, {}, "truth.oscillator.0.frequency_hz"),
        ({"propellant": True}, {}, r"truth.oscillator.0.propellant: only a chaser's thrusters"),
        ({"body": "target"}, {}, 'truth.oscillator.0.body: needs target.motion = "torque_free"'),
    ],
)
def test_an_oscillator_that_no_body_can_carry_is_refused(
    oscillator: dict[str, Any], changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(ScenarioError, match=message):
        scenario(**flexible([{**FUEL, **oscillator}], **changes))


def test_bodies_on_a_floor_are_rigid() -> None:
    with pytest.raises(ScenarioError, match=r"truth.oscillator: bodies on a floor are rigid"):
        load_scenario(
            shipped_scenario("planar-docking"),
            ("truth.oscillator=[{mass_share=0.1, position_m=[0.0,0.0,0.0], frequency_hz=1.0}]",),
        )


def test_shares_that_leave_no_body_are_refused() -> None:
    with pytest.raises(ScenarioError, match="mass_share adds up to 1, which must be less than 1"):
        scenario(**flexible([{**FUEL, "mass_share": 0.5}] * 2))


def test_a_drawn_body_that_cannot_carry_them_is_refused() -> None:
    thin = {"chaser": 0, "inertia_kg_m2": [0.1, 0.1, 0.1, 0.0, 0.0, 0.0]}
    s = docking_scenario(truth={"oscillator": PAIR, "values": [thin]})
    with pytest.raises(ScenarioError, match=r"truth.oscillator: chaser/0 as drawn: no body has"):
        Physics(s)
