# SPDX-License-Identifier: Apache-2.0
"""The world in an orbit: motion in the Hill frame, rotation, drag, light and Earth."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.orbit import state_of
from chaserdock_models.relative_motion import propagate_relative
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.orbit import TargetOrbit, to_sun
from chaserdock_world.physics.simulation import Physics
from chaserdock_world.rendering.cameras import Cameras
from world_cases import HZ, scenario

ORBIT = {"altitude_m": 4e5}
POSITION, VELOCITY = [100.0, -20.0, 5.0], [0.01, -0.22, 0.02]


def in_orbit(orbit: dict[str, Any] = ORBIT, **changes: Any) -> Scenario:
    chaser = {
        "position_m": POSITION,
        "q_wxyz": [1.0, 0.0, 0.0, 0.0],
        "start_velocity_m_s": VELOCITY,
    }
    still = {"velocity_m_s": [0.0, 0.0, 0.0]}
    values: dict[str, Any] = {
        "orbit": orbit,
        "target": {"motion": "torque_free", "omega_rad_s": [0.02, 0.01, -0.03], **still},
        "limits": {"max_reference_distance_m": 200.0},
        "chasers": [chaser],
    }
    return scenario(**(values | changes))


@pytest.mark.parametrize("orbit", [ORBIT, {"semi_major_axis_m": 7.5e6, "eccentricity": 0.05}])
def test_free_chaser_follows_the_relative_motion_of_two_orbits(orbit: dict[str, Any]) -> None:
    case = in_orbit(orbit)
    assert case.orbit is not None
    physics = Physics(case)
    for _ in range(10):
        physics.advance(HZ, {})
    state = physics.state("chaser/0")
    position, velocity = propagate_relative(state_of(case.orbit.elements), POSITION, VELOCITY, 10.0)
    # Bullet's positions use the velocity at the end of each step: half a step's change of velocity,
    # 2 micrometres.
    assert state.position_m == pytest.approx(position, abs=4e-6)
    assert state.velocity_m_s == pytest.approx(velocity, abs=1e-8)
    target = physics.state("target")
    assert target.position_m == pytest.approx(np.zeros(3), abs=1e-12)


def test_centre_of_mass_off_the_origin_follows_the_relative_motion() -> None:
    """Gravity acts at the centre of mass: a body whose centre is off CRF's origin does not turn by
    the tidal force.
    """
    values = [{"chaser": 0, "centre_of_mass_m": [0.1, 0.0, 0.0]}]
    case = in_orbit(truth={"values": values})
    assert case.orbit is not None
    physics = Physics(case)
    for _ in range(5):
        physics.advance(HZ, {})
    state, centre = physics.state("chaser/0"), np.array([0.1, 0.0, 0.0])
    start = np.array(POSITION) + centre
    position, _ = propagate_relative(state_of(case.orbit.elements), start, VELOCITY, 5.0)
    assert state.position_m + centre == pytest.approx(position, abs=1e-5)


def test_rotation_against_space_is_free() -> None:
    """A body with equal moments keeps its rate against space, while its rate in the turning WRF
    changes.
    """
    target = {
        "motion": "torque_free",
        "velocity_m_s": [0.0, 0.0, 0.0],
        "omega_rad_s": [0.2, 0.1, -0.3],
    }
    case = in_orbit(target={**target, "inertia_kg_m2": [1.0, 1.0, 1.0]})
    assert case.orbit is not None
    physics, orbit = Physics(case), TargetOrbit(case.orbit)
    for _ in range(10):
        physics.advance(HZ, {})
    axes = [rotations.from_matrix(orbit.frame_at(t).axes) for t in (0.0, 10.0)]
    rate = np.add(case.target.omega_rad_s, orbit.frame_at(0.0).rate_rad_s)
    in_space = rotations.multiply(rotations.conjugate(axes[0]), rotations.exp(10.0 * rate))
    expected = rotations.multiply(axes[1], in_space)
    off = rotations.log(
        rotations.multiply(rotations.conjugate(expected), physics.state("target").q_wxyz)
    )
    assert np.linalg.norm(off) < 2e-5  # without the torque of the turning frame: 0.02


def test_differential_drag_pulls_the_lighter_body_back() -> None:
    drag = {"target_ballistic_coefficient_kg_m2": 200.0, "chaser_ballistic_coefficient_kg_m2": 50.0}
    case = in_orbit({"altitude_m": 2.5e5, **drag})
    assert case.orbit is not None
    orbit = TargetOrbit(case.orbit)
    acceleration = orbit.differential_drag(0.0)
    assert acceleration[1] < -1e-6
    moved = []
    for section in ({"altitude_m": 2.5e5, **drag}, {"altitude_m": 2.5e5}):
        physics = Physics(in_orbit(section))
        for _ in range(5):
            physics.advance(HZ, {})
        moved.append(physics.state("chaser/0").velocity_m_s)
    # Across the motion only the Coriolis acceleration acts on what drag changed.
    assert moved[0] - moved[1] == pytest.approx(
        5.0 * acceleration, abs=0.15 * 5.0 * abs(acceleration[1])
    )


def test_motion_does_not_depend_on_how_steps_are_grouped() -> None:
    ends = []
    for parts in ([64] * 5, [1, 63, 100, 28, 128]):
        physics = Physics(in_orbit())
        for steps in parts:
            physics.advance(steps, {})
        ends.append(physics.state("chaser/0"))
    assert (ends[0].position_m == ends[1].position_m).all()
    assert (ends[0].omega_rad_s == ends[1].omega_rad_s).all()


def test_sun_sets_and_rises_once_per_orbit() -> None:
    case = in_orbit()
    assert case.orbit is not None
    orbit, cameras = TargetOrbit(case.orbit), Cameras(case)
    times = np.arange(0.0, case.orbit.elements.period_s, 30.0).tolist()
    shares = [orbit.sunlit_share(t) for t in times]
    dark = sum(s == 0.0 for s in shares) / len(shares)
    assert 0.3 < dark < 0.42  # low orbit near the ecliptic: 36 of 92 minutes
    day, night = times[int(np.argmax(shares))], times[int(np.argmin(shares))]
    assert cameras.light_at(day).sun == pytest.approx(0.65)
    assert cameras.light_at(night).sun == 0.0
    assert cameras.light_at(night).ambient < 0.1 * cameras.light_at(day).ambient
    # At local noon the sun is above the target, on the side away from the Earth.
    noon = max(times, key=lambda t: float(orbit.to_sun(t)[0]))
    assert orbit.to_sun(noon)[0] > 0.8
    assert orbit.sunlit_share(noon) == 1.0
    assert to_sun(case) == tuple(orbit.to_sun(0.0))


def test_earth_fills_the_image_towards_the_nadir_only() -> None:
    def brightness(q_wxyz: list[float]) -> float:
        case = in_orbit(
            {"altitude_m": 4e5, "true_anomaly_deg": 0.0},
            chasers=[{"position_m": [0.0, 20.0, 0.0], "q_wxyz": q_wxyz}],
        )
        physics = Physics(case)
        states = {name: physics.state(name) for name in physics.bodies}
        return float(Cameras(case).render(0, 0, 0, states).mean())

    up, down = [1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]  # the camera looks along +X of CRF
    assert brightness(down) > 4.0 * brightness(up)
