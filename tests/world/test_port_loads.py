# SPDX-License-Identifier: Apache-2.0
"""Loads at the ports of latched chasers, against the equations of motion of the chaser, and what a
stack conserves.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.port_load import CarriedBody, tumble_load
from chaserdock_models.rigid_body import BodyState
from chaserdock_world.physics.port_loads import PortLoadRecorder, port_attitude
from chaserdock_world.physics.simulation import TARGET, Physics
from docking_cases import (
    CHASER_INERTIA,
    CHASER_KG,
    REACH_M,
    TARGET_INERTIA,
    TARGET_KG,
    balance,
    latch,
    momenta,
    scenario,
)
from engine_cases import both

HZ = 960
FIRING = np.array([0.3, 0.5, -0.2, 0.05, 0.1, 0.02])
MISMATCH = {
    "truth": {"preset": "mismatch", "target": {"centre_of_mass_m": 0.05, "inertia_turn_deg": 20.0}}
}


@both
@pytest.mark.parametrize("changes", [{}, MISMATCH], ids=["nominal", "mismatch"])
@pytest.mark.parametrize("wrench", [np.zeros(6), FIRING], ids=["free", "firing"])
def test_port_load_is_what_the_chaser_lacks_to_move_as_it_does(
    worlds: Any, changes: dict[str, Any], wrench: Array
) -> None:
    physics = worlds(lateral_m=0.003, turn_rad=0.02, **changes)
    latch(physics)
    physics.advance(100, {"chaser/0": wrench})
    for _ in range(5):
        target = physics.state(TARGET)
        physics.port_loads["chaser/0"].take()
        force, torque = balance(physics, wrench)
        loads = physics.port_loads["chaser/0"].take()
        q_port = rotations.multiply(target.q_wxyz, port_attitude(np.array([1.0, 0.0, 0.0, 0.0])))
        assert np.linalg.norm(force) > 0.05
        assert np.linalg.norm(rotations.rotate(q_port, loads.force_N) - force) < 1e-6
        assert np.linalg.norm(rotations.rotate(q_port, loads.torque_N_m) - torque) < 1e-5


@both
def test_a_tumbling_chaser_pulls_outward(worlds: Any) -> None:
    """About an axis across the port's: centrifugal force m w^2 r along the port's outward axis, r
    to the common centre.
    """
    physics = worlds(omega_rad_s=(0.0, 0.0, 0.1))
    latch(physics)
    physics.advance(HZ, {})
    physics.port_loads["chaser/0"].take()
    physics.advance(20, {})
    loads = physics.port_loads["chaser/0"].take()
    centre_m = 17.8 * (0.2 + REACH_M) / (17.8 + 40.0)
    expected_N = 17.8 * 0.1**2 * (0.2 + REACH_M - centre_m)
    assert loads.force_N[0] == pytest.approx(expected_N, rel=0.02)
    assert loads.peak_axial_N == pytest.approx(expected_N, rel=0.02)


def test_tumble_load_of_the_scenario_checks_is_that_of_the_physics(worlds: Any) -> None:
    omega = (0.045, 0.135, 0.09)
    physics = worlds(gap_m=0.0002, omega_rad_s=omega)
    latch(physics)
    physics.advance(20, {})
    physics.port_loads["chaser/0"].take()
    physics.advance(1, {})
    loads = physics.port_loads["chaser/0"].take()
    target = CarriedBody(TARGET_KG, np.diag(TARGET_INERTIA), np.zeros(3))
    chaser = CarriedBody(CHASER_KG, np.diag(CHASER_INERTIA), np.array([-0.2 - REACH_M, 0.0, -0.05]))
    port = np.array([-0.2, 0.0, -0.05])
    force, torque = tumble_load(target, chaser, port, physics.state(TARGET).omega_rad_s)
    q_port = port_attitude(np.array([1.0, 0.0, 0.0, 0.0]))
    assert np.linalg.norm(force) > 0.1
    assert np.linalg.norm(torque) > 1e-3
    assert loads.force_N == pytest.approx(
        rotations.rotate_inverse(q_port, force), rel=0.02, abs=2e-3
    )
    assert loads.torque_N_m == pytest.approx(
        rotations.rotate_inverse(q_port, torque), rel=0.02, abs=5e-5
    )


def test_a_pull_shows_as_tension_in_the_port(worlds: Any) -> None:
    """Of a pull of 1 N backwards, the target's share of the mass reaches the port, outward."""
    physics = worlds(omega_rad_s=(0.0, 0.0, 0.0))
    latch(physics)
    physics.advance(100, {})
    physics.port_loads["chaser/0"].take()
    physics.advance(50, {"chaser/0": np.array([-1.0, 0.0, 0.0, 0.0, 0.0, 0.0])})
    loads = physics.port_loads["chaser/0"].take()
    assert loads.force_N[0] == pytest.approx(40.0 / 57.8, rel=0.02)


@both
def test_peaks_cover_steps_between_ticks(worlds: Any) -> None:
    physics = worlds(omega_rad_s=(0.0, 0.0, 0.0))
    latch(physics)
    physics.advance(100, {})
    physics.port_loads["chaser/0"].take()
    physics.advance(5, {"chaser/0": np.array([0.0, 2.0, 0.0, 0.0, 0.0, 0.0])})
    physics.advance(20, {})
    loads = physics.port_loads["chaser/0"].take()
    assert loads.peak_shear_N > 0.3
    assert loads.peak_bending_N_m > 0.05
    assert np.linalg.norm(loads.force_N) < 0.05
    assert loads.peak_axial_N < 0.1
    assert loads.peak_force_N == pytest.approx(loads.peak_shear_N, rel=0.01)
    empty = physics.port_loads["chaser/0"].take()
    assert empty.peak_force_N == 0.0


@both
@pytest.mark.parametrize("physics_hz", [960, 3840])
def test_closing_impulse_does_not_depend_on_the_step(worlds: Any, physics_hz: int) -> None:
    """It stops the closing speed against the reduced mass; the peaks are without it."""
    physics = worlds(omega_rad_s=(0.0, 0.0, 0.0), time={"physics_hz": physics_hz})
    latch(physics)
    physics.advance(10, {})
    (touch,) = physics.latches["chaser/0"].touches
    loads = physics.port_loads["chaser/0"].take()
    reduced_kg = 17.8 * 40.0 / 57.8
    assert loads.closing_impulse_N_s == pytest.approx(reduced_kg * touch.closing_m_s, rel=0.1)
    assert loads.peak_force_N < 1.0


def test_loads_need_a_latch(worlds: Any) -> None:
    physics = worlds()
    physics.advance(HZ // 2, {})
    assert physics.port_loads["chaser/0"].take().peak_force_N == 0.0
    without = Physics(scenario(docking={"kind": "held"}))
    try:
        assert without.port_loads == {}
    finally:
        without.close()


def test_recorder_takes_axes_at_each_step() -> None:
    """Torque in the chaser's axes, force in world axes, each turned by the attitudes of its own
    step.
    """
    q_off = np.array([1.0, 0.0, 0.0, 0.0])
    recorder = PortLoadRecorder(port_attitude(q_off), 1.0 / HZ)
    level, quarter_about_z = (1.0, 0.0, 0.0, 0.0), (0.5**0.5, 0.0, 0.0, 0.5**0.5)
    recorder.add((1.0, 0.0, 0.0, 0.0, 0.0, 0.0), level, level, False)
    recorder.add((0.0, 3.0, 4.0, 2.0, 0.0, 0.0), quarter_about_z, level, False)
    loads = recorder.take()
    assert loads.force_N == pytest.approx([-3.0, 0.0, 4.0])
    assert loads.torque_N_m == pytest.approx([0.0, 2.0, 0.0])
    assert (loads.peak_axial_N, loads.peak_shear_N, loads.peak_force_N) == pytest.approx(
        (3.0, 4.0, 5.0)
    )
    assert (loads.peak_torque_N_m, loads.peak_bending_N_m) == pytest.approx((2.0, 2.0))


def test_two_latches_close_in_one_step() -> None:
    still = {"omega_rad_s": [0.0, 0.0, 0.0], "velocity_m_s": [0.0, 0.0, 0.0]}
    physics = Physics(scenario(chasers=2, target=still))
    try:
        for i, side in enumerate((-1.0, 1.0)):
            q = np.array([1.0, 0.0, 0.0, 0.0]) if i == 0 else np.array([0.0, 0.0, 0.0, 1.0])
            place = np.array([side * (0.2 + REACH_M + 0.001), 0.0, -0.05])
            physics.place(
                f"chaser/{i}", BodyState(place, np.array([-side * 0.01, 0.0, 0.0]), q, np.zeros(3))
            )
            physics.command_latch(i, "arm", 0)
        physics.advance(HZ // 2, {})
        assert [x.latched for x in physics.latches.values()] == [True, True]
        first, second = (x.touches[0].sim_time_ns for x in physics.latches.values())
        assert first == second
        loads = [x.take() for x in physics.port_loads.values()]
        assert all(x.closing_impulse_N_s > 0.1 for x in loads)
        assert all(x.peak_force_N < 1.0 for x in loads)
    finally:
        physics.close()


def momentum_drifts(worlds: Any, seconds: int) -> list[float]:
    """Return the changes of linear and angular momentum of a free tumbling stack, as shares, after
    ``seconds``.
    """
    physics = worlds(omega_rad_s=(0.045, 0.135, 0.09), lateral_m=0.003, turn_rad=0.02, **MISMATCH)
    latch(physics)
    physics.advance(10, {})
    names = (TARGET, "chaser/0")

    def total() -> tuple[Array, Array]:
        parts = [momenta(physics, name) for name in names]
        return parts[0][0] + parts[1][0], parts[0][1] + parts[1][1]

    disturbance = {"chaser/0": -physics.plants["chaser/0"].disturbance}
    before = total()
    physics.advance(seconds * HZ, disturbance)
    return [
        float(np.linalg.norm(b - a) / np.linalg.norm(a))
        for a, b in zip(before, total(), strict=True)
    ]


@both
def test_a_tumbling_stack_conserves_momentum(worlds: Any) -> None:
    """To a tenth of what 300 s are allowed, in a tenth of the time."""
    assert max(momentum_drifts(worlds, 30)) <= 1e-4


@both
@pytest.mark.slow
def test_a_tumbling_stack_conserves_momentum_for_long(worlds: Any) -> None:
    """To a third of what 300 s are allowed, in a third of the time."""
    assert max(momentum_drifts(worlds, 100)) <= 1e-3 / 3.0
