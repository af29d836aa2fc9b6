# SPDX-License-Identifier: Apache-2.0
"""``[truth]``: true bodies, actuators and sensors that differ from the nominal values of the flight
software.
"""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.rigid_body import BodyState
from chaserdock_models.satellites import satellite
from chaserdock_protocol.messages import ActuatorCommand, ThrusterPulse
from chaserdock_protocol.scenario import ScenarioError
from chaserdock_world.actuators.ideal import IdealActuators
from chaserdock_world.actuators.thrusters import make_actuators
from chaserdock_world.physics.simulation import TARGET, Physics
from chaserdock_world.plant import chaser_plant, draw_moments, target_plant, true_mesh, true_target
from chaserdock_world.sensors.errors import OdometrySensor, camera_errors, true_camera
from chaserdock_world.sensors.publish import drawn_truth
from docking_cases import scenario as docking_scenario
from hypothesis import given, settings
from hypothesis import strategies as st
from thruster_cases import mission
from world_cases import HZ, STEP_S, scenario

few = settings(derandomize=True, deadline=None, max_examples=12)
many = settings(derandomize=True, deadline=None, max_examples=200)
offsets = st.tuples(*[st.floats(-0.03, 0.03, allow_subnormal=False)] * 3)
rates = st.tuples(*[st.floats(-0.5, 0.5, allow_subnormal=False)] * 3)
TENSOR = [[0.30, 0.02, -0.01], [0.02, 0.35, 0.015], [-0.01, 0.015, 0.40]]
AT = BodyState(
    np.array([1.0, -2.0, 3.0]),
    np.array([0.05, 0.02, -0.01]),
    rotations.exp([0.3, -0.2, 0.5]),
    np.zeros(3),
)


def with_values(**values: Any) -> Any:
    return scenario(truth={"values": [{"chaser": 0, **values}]})


def momenta(physics: Physics, name: str = "chaser/0") -> tuple[Array, Array, float]:
    """Return linear and angular momentum (WRF, about the centre of mass) and kinetic energy of a
    body.
    """
    s, plant = physics.state(name), physics.plants[name]
    velocity = s.velocity_m_s + rotations.rotate(
        s.q_wxyz, np.cross(s.omega_rad_s, plant.centre_of_mass_m)
    )
    spin = plant.inertia_kg_m2 @ s.omega_rad_s
    energy = 0.5 * plant.mass_kg * velocity @ velocity + 0.5 * s.omega_rad_s @ spin
    return plant.mass_kg * velocity, rotations.rotate(s.q_wxyz, spin), float(energy)


# -- mesh of the target ----------------------------------------------------------------------------


def mesh_errors(seed: int, **knowledge: float) -> tuple[float, Array]:
    """Return scale and rotation vectors (2, 3) of the true mesh, recovered from its vertices."""
    s = scenario(
        seed=seed,
        target={"model": "geo_servicer", "knowledge": knowledge},
        perception={"name": "model"},
    )
    mesh, nominal = true_mesh(s), satellite("geo_servicer")
    assert mesh is not None
    pairs = {
        p.name: (p.vertices_m, q.vertices_m) for p, q in zip(nominal.parts, mesh.parts, strict=True)
    }
    scale = float(np.linalg.norm(pairs["bus"][1]) / np.linalg.norm(pairs["bus"][0])) - 1.0
    turns = []
    for joint, at in nominal.joints.items():
        a, b = pairs[joint]
        u, _, v = np.linalg.svd((a - np.array(at)).T @ (b - np.array(mesh.joints[joint])))
        turns.append(rotations.log(rotations.from_matrix((u @ v).T)))
    return scale, np.array(turns)


def test_true_mesh_has_the_stated_errors() -> None:
    drawn = [mesh_errors(seed) for seed in range(60)]
    scales, turns = np.array([s for s, _ in drawn]), np.degrees(np.array([t for _, t in drawn]))
    assert 0.002 < scales.std() < 0.004
    assert abs(scales.mean()) < 0.0012
    assert 0.42 < turns.std() < 0.58
    assert mesh_errors(5)[0] == drawn[5][0]


def test_mesh_is_exact_without_errors() -> None:
    scale, turns = mesh_errors(1, panel_deg=0.0, scale_share=0.0)
    assert scale == 0.0
    assert np.abs(turns).max() < 1e-9


def test_true_mesh_is_integrated_about_its_principal_axes() -> None:
    s = scenario(
        target={"model": "geo_servicer", "motion": "torque_free", "mass_kg": 9.0},
        perception={"name": "model"},
    )
    np.testing.assert_allclose(target_plant(s).inertia_kg_m2, s.target.inertia_tensor, atol=1e-12)
    assert np.abs(s.target.inertia_tensor - np.diag(s.target.moments)).max() > 1e-4


# -- bodies ----------------------------------------------------------------------------------------


def test_without_truth_plants_are_the_nominal_bodies() -> None:
    s = docking_scenario()
    for plant, body in ((chaser_plant(s, 0), s.chaser), (target_plant(s), s.target)):
        assert plant.frame is None
        assert plant.mass_kg == body.mass_kg
        assert plant.moments_kg_m2 == body.inertia_kg_m2
        assert not plant.disturbance.any()


@many
@given(
    st.tuples(*[st.floats(0.01, 10.0)] * 3).map(lambda m: (m[1] + m[2], m[0] + m[2], m[0] + m[1])),
    st.floats(0.0, 0.3),
    st.integers(0, 10_000),
)
def test_drawn_moments_are_those_of_a_rigid_body(nominal: Any, share: float, seed: int) -> None:
    a, b, c = draw_moments(nominal, share, np.random.default_rng(seed))
    assert min(a, b, c) > 0.0
    assert 2.0 * max(a, b, c) <= (a + b + c) * (1.0 + 1e-12)


def test_a_thin_rod_still_gets_moments_of_a_rigid_body() -> None:
    a, b, c = draw_moments((1e-9, 1.0, 1.0), 0.3, np.random.default_rng(1))
    assert abs(b - c) <= a


def test_drawn_mass_has_the_stated_sigma_and_limit() -> None:
    masses = [
        chaser_plant(scenario(seed=seed, truth={"chaser": {"mass_share": 0.1}}), 0).mass_kg / 30.0
        - 1.0
        for seed in range(400)
    ]
    assert np.std(masses) == pytest.approx(0.1, rel=0.12)
    assert np.max(np.abs(masses)) <= 0.3 + 1e-12


def test_chasers_and_target_are_drawn_apart() -> None:
    s = docking_scenario(chasers=2, truth={"preset": "mismatch", "target": {"mass_share": 0.1}})
    a, b, t = chaser_plant(s, 0), chaser_plant(s, 1), target_plant(s)
    assert len({a.mass_kg / 17.8, b.mass_kg / 17.8, t.mass_kg / 40.0}) == 3
    assert chaser_plant(s, 1).mass_kg == b.mass_kg
    assert t.disturbance.tolist() == [0.0] * 6


def test_explicit_values_replace_drawn_ones() -> None:
    s = with_values(
        mass_kg=12.0,
        inertia_kg_m2=TENSOR,
        centre_of_mass_m=[0.01, 0.0, -0.02],
        force_N=[0.0, 0.1, 0.0],
    )
    plant = chaser_plant(s, 0)
    assert plant.mass_kg == 12.0
    np.testing.assert_allclose(plant.inertia_kg_m2, TENSOR, atol=1e-12)
    assert plant.centre_of_mass_m.tolist() == [0.01, 0.0, -0.02]
    assert plant.disturbance.tolist() == [0.0, 0.1, 0.0, 0.0, 0.0, 0.0]
    assert chaser_plant(scenario(), 0).mass_kg == 30.0


# -- motion ----------------------------------------------------------------------------------------


@few
@given(offsets, rates)
def test_free_motion_conserves_momentum_and_energy(offset: Any, omega: Any) -> None:
    physics = Physics(with_values(inertia_kg_m2=TENSOR, centre_of_mass_m=offset))
    physics.place("chaser/0", BodyState(AT.position_m, AT.velocity_m_s, AT.q_wxyz, np.array(omega)))
    linear, angular, energy = momenta(physics)
    physics.advance(2 * HZ, {})
    later = momenta(physics)
    physics.close()
    np.testing.assert_allclose(later[0], linear, atol=1e-6)
    np.testing.assert_allclose(later[1], angular, atol=1e-5)
    assert later[2] == pytest.approx(energy, rel=1e-5, abs=1e-9)


@few
@given(offsets, rates)
def test_a_placed_body_is_where_it_was_placed(offset: Any, omega: Any) -> None:
    physics = Physics(with_values(inertia_kg_m2=TENSOR, centre_of_mass_m=offset))
    physics.place("chaser/0", BodyState(AT.position_m, AT.velocity_m_s, AT.q_wxyz, np.array(omega)))
    s = physics.state("chaser/0")
    physics.close()
    np.testing.assert_allclose(s.position_m, AT.position_m, atol=1e-12)
    np.testing.assert_allclose(s.velocity_m_s, AT.velocity_m_s, atol=1e-12)
    np.testing.assert_allclose(s.omega_rad_s, omega, atol=1e-12)
    assert rotations.angle_between(s.q_wxyz, AT.q_wxyz) < 1e-7


def test_the_origin_circles_the_centre_of_mass() -> None:
    """A body that spins about its centre of mass: the origin, 2 cm beside it, moves on a circle."""
    physics = Physics(with_values(centre_of_mass_m=[0.02, 0.0, 0.0]))
    upright = np.array([1.0, 0.0, 0.0, 0.0])
    at, moving, spin = (
        np.array([9.0, 0.0, 0.0]),
        np.array([0.0, -0.01, 0.0]),
        np.array([0.0, 0.0, 0.5]),
    )
    physics.place("chaser/0", BodyState(at, moving, upright, spin))
    physics.advance(HZ, {})
    s = physics.state("chaser/0")
    physics.close()
    centre = np.array([9.02, 0.0, 0.0])
    expected = centre - 0.02 * np.array([np.cos(0.5), np.sin(0.5), 0.0])
    np.testing.assert_allclose(s.position_m, expected, atol=1e-6)


def test_a_force_beside_the_centre_of_mass_turns_the_body_as_calculated() -> None:
    offset, force = np.array([0.0, 0.01, -0.02]), np.array([2.0, -1.0, 0.5])
    physics = Physics(
        with_values(mass_kg=20.0, inertia_kg_m2=TENSOR, centre_of_mass_m=offset.tolist())
    )
    physics.place("chaser/0", BodyState(AT.position_m, np.zeros(3), AT.q_wxyz, np.zeros(3)))
    steps = 24
    physics.advance(steps, {"chaser/0": np.array([*force, 0.0, 0.0, 0.0])})
    s = physics.state("chaser/0")
    physics.close()
    time_s = steps * STEP_S
    alpha = np.linalg.solve(np.array(TENSOR), np.cross(-offset, force))
    np.testing.assert_allclose(s.omega_rad_s, alpha * time_s, rtol=1e-3, atol=1e-7)
    acceleration = force / 20.0 + np.cross(alpha, -offset)  # of the origin
    np.testing.assert_allclose(
        s.velocity_m_s, rotations.rotate(AT.q_wxyz, acceleration) * time_s, rtol=2e-3, atol=1e-6
    )


def test_constant_disturbance_acts_without_commands() -> None:
    physics = Physics(with_values(force_N=[0.0, 0.3, 0.0], torque_N_m=[0.01, 0.0, 0.0]))
    before = physics.state("chaser/0")
    physics.advance(HZ // 4, {})
    s, plant = physics.state("chaser/0"), physics.plants["chaser/0"]
    physics.close()
    np.testing.assert_allclose(
        s.omega_rad_s, [0.25 * 0.01 / plant.moments_kg_m2[0], 0.0, 0.0], atol=1e-6
    )
    gained = rotations.rotate_inverse(before.q_wxyz, s.velocity_m_s - before.velocity_m_s)
    np.testing.assert_allclose(gained, [0.0, 0.25 * 0.3 / 30.0, 0.0], atol=1e-4)


def test_disturbance_noise_changes_at_ticks_and_does_not_depend_on_the_slices() -> None:
    s = scenario(truth={"chaser": {"force_noise_N": 0.1, "disturbance_time_s": 1.0}})
    ends = []
    for slices in ((64, 64, 64), (32, 32, 64, 16, 48)):
        physics = Physics(s)
        assert physics.next_change(0) == 64
        for steps in slices:
            physics.advance(steps, {})
        ends.append(physics.state("chaser/0").velocity_m_s)
        physics.close()
    np.testing.assert_array_equal(*ends)
    assert np.linalg.norm(ends[0]) > 1e-5


def test_the_surface_stays_where_it_is_with_another_centre_of_mass() -> None:
    """Two chasers that overlap by half a millimetre touch; half a millimetre apart they do not."""
    places = [{"position_m": [x, 0.0, 0.0], "q_wxyz": [1.0, 0.0, 0.0, 0.0]} for x in (-5.0, -3.0)]
    s = scenario(
        chasers=places,
        truth={
            "values": [
                {"chaser": 0, "centre_of_mass_m": [0.02, 0.01, 0.0], "inertia_kg_m2": TENSOR}
            ]
        },
    )
    for gap_m, touch in ((-0.0005, True), (0.0005, False)):
        physics = Physics(s)
        for k, x in enumerate((20.0, 20.25 + gap_m)):
            state = BodyState(
                np.array([x, 0.0, 0.0]), np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3)
            )
            physics.place(f"chaser/{k}", state)
        assert (("chaser/0", "chaser/1") in physics.advance(2, {})) == touch
        physics.close()


def test_a_latched_pair_keeps_its_relative_pose() -> None:
    values = [
        {"chaser": 0, "centre_of_mass_m": [0.01, -0.02, 0.01], "inertia_kg_m2": TENSOR},
        {"target": True, "centre_of_mass_m": [-0.02, 0.01, 0.0]},
    ]
    physics = Physics(docking_scenario(truth={"values": values}))
    target = physics.state(TARGET)
    at = target.position_m + rotations.rotate(target.q_wxyz, [-0.56, 0.0, -0.05])
    omega = target.omega_rad_s
    velocity = target.velocity_m_s + rotations.rotate(
        target.q_wxyz, np.cross(omega, [-0.56, 0.0, -0.05])
    )
    physics.place("chaser/0", BodyState(at, velocity, target.q_wxyz, omega))
    physics.close_latch(0)
    physics.advance(2 * HZ, {"chaser/0": np.array([0.0, 0.02, 0.0, 0.0, 0.0, 0.0])})
    a, b = physics.state(TARGET), physics.state("chaser/0")
    physics.close()
    relative = rotations.rotate_inverse(a.q_wxyz, b.position_m - a.position_m)
    np.testing.assert_allclose(relative, [-0.56, 0.0, -0.05], atol=1e-3)
    assert rotations.angle_between(a.q_wxyz, b.q_wxyz) < np.radians(0.2)


# -- actuators -------------------------------------------------------------------------------------


def wrench_of(actuators: IdealActuators, force: Any, step: int = 10) -> Array:
    command = ActuatorCommand(
        tick=0,
        sim_time_ns=0,
        chaser=0,
        effective_time_ns=0,
        source="command",
        force_N=force,
        torque_N_m=(0.0, 0.0, 0.0),
    )
    actuators.command(command, step, 0)
    return actuators.act(step, 1, STEP_S)


def test_ideal_actuators_give_the_command_with_their_errors() -> None:
    s = with_values(thrust_share=[0.1, -0.1, 0.0, 0.0, 0.0, 0.0])
    actuators = make_actuators(s, 0)
    assert isinstance(actuators, IdealActuators)
    np.testing.assert_allclose(
        wrench_of(actuators, (1.0, 1.0, 1.0))[:3], [1.1, 0.9, 1.0], rtol=1e-12
    )
    np.testing.assert_allclose(
        actuators.take_output(11).impulse[:3], np.array([1.1, 0.9, 1.0]) * STEP_S
    )


def test_thrust_turn_keeps_the_force_and_changes_its_direction() -> None:
    angles = []
    for seed in range(100):
        actuators = make_actuators(
            scenario(seed=seed, truth={"chaser": {"thrust_turn_deg": 1.0}}), 0
        )
        assert isinstance(actuators, IdealActuators)
        force = wrench_of(actuators, (0.0, 0.0, 1.0))[:3]
        assert np.linalg.norm(force) == pytest.approx(1.0)
        angles.append(np.degrees(force[:2]))
    assert np.std(angles) == pytest.approx(1.0, rel=0.2)


def test_delay_moves_the_effect_of_a_command() -> None:
    actuators = make_actuators(scenario(truth={"chaser": {"delay_s": 0.05}}), 0)
    assert isinstance(actuators, IdealActuators)
    assert not wrench_of(actuators, (1.0, 0.0, 0.0), 10).any()
    assert actuators.next_change(10) == 10 + 48
    assert actuators.act(58, 1, STEP_S)[0] == 1.0


@pytest.mark.parametrize(("offset_s", "acts_at"), [(0.05, 10), (-0.05, 58 + 10 - 10)])
def test_a_clock_that_is_ahead_does_not_act_before_the_command_arrives(
    offset_s: float, acts_at: int
) -> None:
    actuators = make_actuators(with_values(clock_offset_s=offset_s), 0)
    command = ActuatorCommand(
        tick=0, sim_time_ns=0, chaser=0, effective_time_ns=0, source="command",
        force_N=(1.0, 0.0, 0.0),
        torque_N_m=(0.0, 0.0, 0.0),
    )  # fmt: skip
    actuators.command(command, 10, 10)
    assert not actuators.act(acts_at - 1, 1, STEP_S).any()
    assert actuators.act(acts_at, 1, STEP_S)[0] == 1.0


def test_jitter_keeps_the_order_of_commands() -> None:
    actuators = make_actuators(
        scenario(truth={"chaser": {"delay_s": 0.02, "delay_jitter_s": 0.02}}), 0
    )
    assert isinstance(actuators, IdealActuators)
    steps = []
    for k in range(60):
        command = ActuatorCommand(
            seq=k, tick=k, sim_time_ns=0, chaser=0, effective_time_ns=0, source="command",
            force_N=(0.01 * k, 0.0, 0.0), torque_N_m=(0.0, 0.0, 0.0),
        )  # fmt: skip
        actuators.command(command, 10 * k, 0)
        steps.append(actuators._last_step)
    assert steps == sorted(steps)
    assert len({b - a for a, b in itertools.pairwise(steps)}) > 3
    assert actuators.act(10_000, 1, STEP_S)[0] == pytest.approx(0.59)


def impulse_of(s: Any, width_ns: int = 50_000_000) -> Array:
    actuators = make_actuators(s, 0)
    pulse = ThrusterPulse(thruster=0, open_ns=100_000_000, close_ns=100_000_000 + width_ns)
    command = ActuatorCommand(
        tick=0, sim_time_ns=0, chaser=0, effective_time_ns=0, source="command",
        force_N=(0.0, 0.0, 0.0),
        torque_N_m=(0.0, 0.0, 0.0), pulses=(pulse,),
    )  # fmt: skip
    actuators.command(command, 0, 0)
    step = 0
    while step < HZ // 2:
        actuators.act(step, 1, STEP_S)
        step += 1
    return actuators.take_output(step).impulse


def test_thrusters_have_their_own_thrust_and_direction() -> None:
    n = len(mission().chaser.thrusters)
    stated = impulse_of(mission())
    stronger = impulse_of(
        mission(truth={"values": [{"chaser": 0, "thrust_share": [0.1] + [0.0] * (n - 1)}]})
    )
    np.testing.assert_allclose(stronger, 1.1 * stated, rtol=1e-9, atol=1e-12)
    turned = impulse_of(mission(truth={"chaser": {"thrust_turn_deg": 2.0}}))[:3]
    assert np.linalg.norm(turned) == pytest.approx(np.linalg.norm(stated[:3]), rel=1e-9)
    assert np.linalg.norm(turned - stated[:3]) > 1e-3 * np.linalg.norm(stated[:3])


@pytest.mark.slow
def test_pulses_scatter_in_width_but_not_below_the_minimum() -> None:
    nominal = np.linalg.norm(impulse_of(mission())[:3])
    widths = [
        np.linalg.norm(
            impulse_of(mission(seed=k, truth={"chaser": {"pulse_scatter_share": 0.1}}))[:3]
        )
        / nominal
        for k in range(100)
    ]
    assert np.std(widths) == pytest.approx(0.1, rel=0.25)
    shortest = np.linalg.norm(impulse_of(mission(), 10_000_000)[:3])
    scattered = [
        np.linalg.norm(
            impulse_of(mission(seed=k, truth={"chaser": {"pulse_scatter_share": 0.1}}), 10_000_000)[
                :3
            ]
        )
        for k in range(20)
    ]
    assert min(scattered) == pytest.approx(shortest)


# -- sensors and target ----------------------------------------------------------------------------


def test_unknown_camera_errors_add_to_the_known_ones() -> None:
    known = {"grade": "exact", "camera_turn_deg": 0.3}
    a = camera_errors(scenario(navigation=known), 0)
    b = camera_errors(scenario(navigation=known, truth={"camera": {"turn_deg": 0.4}}), 0)
    only = camera_errors(scenario(truth={"camera": {"turn_deg": 0.4}}), 0)
    np.testing.assert_allclose(b.turn_rad, a.turn_rad + only.turn_rad)
    assert only.turn_rad.any()
    s = scenario()
    assert true_camera(s, 0) == s.camera_model()


def test_noise_factor_changes_the_noise_but_not_the_stated_covariance() -> None:
    figures = {"grade": "exact", "position_noise_m": 0.001}
    honest = OdometrySensor(scenario(navigation=figures))
    louder = OdometrySensor(scenario(navigation=figures, truth={"sensors": {"noise_factor": 3.0}}))
    errors = [s.measure(0, 5, AT).position_m - AT.position_m for s in (honest, louder)]
    np.testing.assert_allclose(errors[1], 3.0 * errors[0], rtol=1e-9)
    assert louder.covariances == honest.covariances


def test_markers_move_in_their_planes() -> None:
    s = scenario(truth={"target": {"marker_m": 0.001}})
    moved = true_target(s)
    for stated, true in zip(s.target_model().markers, moved.markers, strict=True):
        shift = np.subtract(true.position_trf_m, stated.position_trf_m)
        assert abs(shift @ stated.normal_trf()) < 1e-12
        assert 0.0 < np.linalg.norm(shift) < 0.0043
    assert true_target(scenario()) == scenario().target_model()


def test_drawn_truth_states_what_the_world_simulates() -> None:
    s = docking_scenario(chasers=2, truth={"preset": "mismatch"}, navigation={"grade": "orbit"})
    message, physics = drawn_truth(s, OdometrySensor(s)), Physics(s)
    assert [b.body for b in message.bodies] == list(physics.bodies)
    for body in message.bodies:
        plant = physics.plants[body.body]
        assert body.mass_kg == plant.mass_kg
        np.testing.assert_array_equal(np.reshape(body.inertia_kg_m2, (3, 3)), plant.inertia_kg_m2)
        assert body.centre_of_mass_m == tuple(plant.centre_of_mass_m.tolist())
    chaser = message.bodies[1]
    np.testing.assert_array_equal(chaser.camera_turn_rad, camera_errors(s, 0).turn_rad)
    measured = OdometrySensor(s).biases(0)[2]
    np.testing.assert_array_equal(chaser.gyro_bias_rad_s, measured)
    physics.close()


# -- errors of a scenario --------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("truth", "line"),
    [
        (
            {"preset": "mismatched"},
            "truth.preset: must be one of nominal, mismatch (got 'mismatched'); did you mean",
        ),
        (
            {"chaser": {"mass_share": 0.5}},
            "truth.chaser.mass_share: must be a number from 0 to 0.3 (got 0.5)",
        ),
        (
            {"target": {"mass_share": 0.1}},
            'truth.target.mass_share: needs target.motion = "torque_free"',
        ),
        (
            {"values": [{"chaser": 1, "mass_kg": 1.0}]},
            "truth.values.0.chaser: there is no chaser 1",
        ),
        ({"values": [{"mass_kg": 1.0}]}, "truth.values.0: give either chaser = N or target = true"),
        ({"values": [{"chaser": 0}, {"chaser": 0}]}, "truth.values.1: chaser 0 has values already"),
        (
            {"values": [{"chaser": 0, "inertia_kg_m2": [1.0, 1.0, 3.0, 0.0, 0.0, 0.0]}]},
            "no body has this inertia",
        ),
        (
            {"values": [{"chaser": 0, "thrust_share": [0.1]}]},
            "truth.values.0.thrust_share: must have 6 numbers (got 1)",
        ),
        (
            {"values": [{"chaser": 0, "inertia_kg_m2": [[1, 0, 0], [1, 1, 0], [0, 0, 1]]}]},
            "must be symmetric",
        ),
    ],
)
def test_impossible_truth_is_one_line(truth: dict[str, Any], line: str) -> None:
    with pytest.raises(ScenarioError) as error:
        scenario(truth=truth)
    assert line in str(error.value)
    assert "\n" not in str(error.value)
