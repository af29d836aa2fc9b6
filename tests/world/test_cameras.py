# SPDX-License-Identifier: Apache-2.0
"""Cameras of a scenario: every effect, and the distribution of drawn errors."""

from pathlib import Path

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_protocol.scenario import load_scenario
from chaserdock_protocol.scenario.errors import ScenarioError
from chaserdock_world.physics.simulation import TARGET, BodyState, Physics, prescribed_state
from chaserdock_world.rendering.cameras import Cameras
from chaserdock_world.sensors.errors import OdometrySensor, true_camera

SINGLE = Path(__file__).resolve().parents[2] / "scenarios" / "single.toml"
BARE = (
    "navigation.grade='exact'",
    "target.model='servicer'",
    "camera.width_px=640",
    "camera.height_px=480",
    "camera.effects={point_spread_px=0.0, read_noise=0.0, shot_noise=0.0, jpeg_quality=0}",
)


def scenario_with(*changes):
    return load_scenario(SINGLE, (*BARE, *changes))


def states_of(scenario, target_omega=(0.0, 0.0, 0.0)):
    target = prescribed_state(scenario, 0.0)
    states = {
        TARGET: BodyState(target.position_m, np.zeros(3), target.q_wxyz, np.array(target_omega))
    }
    c = scenario.chasers[0]
    states["chaser/0"] = BodyState(
        np.array(c.position_m), np.zeros(3), np.array(c.q_wxyz), np.zeros(3)
    )
    return states


def taken(*changes, omega=(0.0, 0.0, 0.0), time_ns=0):
    scenario = scenario_with(*changes)
    return Cameras(scenario).render(0, 0, time_ns, states_of(scenario, omega)).astype(float)


@pytest.mark.slow
def test_concurrent_rendering_equals_sequential_rendering():
    scenario = load_scenario(SINGLE.with_name("four-chaser-docking.toml"))
    physics, cameras = Physics(scenario), Cameras(scenario)
    states = {name: physics.state(name) for name in physics.bodies}
    for chasers in ((0, 1, 2, 3), (1, 2, 3), (2,), ()):
        one_by_one = [cameras.image(i, 7, 7, 70_000_000, states) for i in chasers]
        assert cameras.images(chasers, 7, 7, 70_000_000, states) == one_by_one


@pytest.mark.slow
def test_motion_blur_is_the_mean_over_the_exposure():
    omega, exposure_s = (0.0, 0.0, 0.4), 0.1
    scenario = scenario_with()
    cameras, at_rest = Cameras(scenario), states_of(scenario)
    images = []
    for share in np.linspace(-0.5, 0.5, 21):
        turned = dict(at_rest)
        target = turned[TARGET]
        q = rotations.integrate(target.q_wxyz, np.array(omega), share * exposure_s)
        turned[TARGET] = BodyState(target.position_m, np.zeros(3), q, np.zeros(3))
        images.append(cameras.render(0, 0, 0, turned).astype(float))
    blurred = taken(f"camera.effects.exposure_s={exposure_s}", omega=omega)
    mean = np.mean(images, axis=0)
    assert np.abs(blurred - mean).mean() < 0.2 * np.abs(blurred - images[10]).mean()
    # Nothing moves: nothing is blurred, however long the exposure.
    assert np.array_equal(taken(f"camera.effects.exposure_s={exposure_s}"), images[10])


def test_glare_falls_with_squared_angle_and_vanishes_in_eclipse_and_occultation():
    sun, glare = "camera.sun_direction=[1.0, 0.3, 0.2]", "camera.effects.glare=500.0"
    far = "target.position_m=[0.0, 30.0, 0.0]"
    plain, lit = taken(sun, far), taken(sun, far, glare)
    camera = scenario_with().camera_model()
    to_sun = np.array([-0.3, -0.2, 1.0]) / np.linalg.norm([0.3, 0.2, 1.0])
    u, v = np.rint(camera.project(to_sun)).astype(int)
    assert lit[v, u] == 255
    for column in (60, 320, 480):
        ray = np.array(
            [(column - camera.cx_px) / camera.fx_px, (150 - camera.cy_px) / camera.fy_px, 1.0]
        )
        angle_deg = np.degrees(np.arccos(ray @ to_sun / np.linalg.norm(ray)))
        stray = 500.0 / angle_deg**2
        assert abs((lit - plain)[150, column] - min(stray, 255)) <= 1.0 + 0.05 * stray
    eclipse = "camera.eclipses=[{from_s=1.0, to_s=2.0}]"
    assert taken(sun, far, glare, eclipse, time_ns=1_500_000_000)[v, u] < 200
    assert np.array_equal(taken(sun, far, glare, eclipse, time_ns=2_000_000_000), lit)
    behind = "camera.sun_direction=[1.0, 0.0, 0.0]"  # the target stands before it
    assert np.array_equal(taken(behind, glare), taken(behind))


def test_lamp_lights_the_target_in_eclipse():
    eclipse = "camera.eclipses=[{from_s=0.0, to_s=2.0}]"
    day, dark, lamp = taken(), taken(eclipse), taken(eclipse, "camera.lamp=60.0")
    face = day > 60  # white paint
    assert np.percentile(dark[face], 99) < 8  # but for a star
    # White paint (0.95) on the face, 0.6 to 1 m away, seen nearly straight.
    assert 40 < np.median(lamp[face]) < 60 / 0.6**2


def test_earth_is_drawn_at_its_direction():
    image = taken(
        "target.position_m=[0.0, 30.0, 0.0]",
        "camera.earth={direction=[0.0, 0.0, -1.0], radius_deg=84.0}",
    )
    camera = scenario_with().camera_model()
    # Its limb is 6 degrees below the horizon, level in the image.
    limb = camera.cy_px + camera.fy_px * np.tan(np.radians(6.0))
    assert np.median(image[: int(limb) - 6]) < 10
    assert np.median(image[int(limb) + 6 : int(limb) + 30, :200]) > 15


def test_calibration_errors_have_the_stated_sigma_per_chaser_and_seed():
    error = (
        "navigation={grade='exact', camera_focal_share=0.001, camera_centre_px=0.5, "
        "camera_turn_deg=0.3, camera_shift_m=0.002}"
    )
    drawn = []
    for seed in range(80):
        scenario = scenario_with(error, f"seed={seed}")
        calibrated, true = scenario.camera_model(), true_camera(scenario, 0)
        assert true == true_camera(scenario, 0)
        turn = rotations.log(
            rotations.multiply(true.q_crf_irf_wxyz, rotations.conjugate(calibrated.q_crf_irf_wxyz))
        )
        drawn.append(
            [
                true.fx_px / calibrated.fx_px - 1.0,
                true.cx_px - calibrated.cx_px,
                true.cy_px - calibrated.cy_px,
                *np.degrees(turn),
                *np.subtract(true.position_crf_m, calibrated.position_crf_m),
            ]
        )
        assert true.fx_px / true.fy_px == pytest.approx(calibrated.fx_px / calibrated.fy_px)
    sigma = np.std(drawn, axis=0) / ([0.001, 0.5, 0.5] + [0.3] * 3 + [0.002] * 3)
    assert np.all((sigma > 0.7) & (sigma < 1.3))
    assert true_camera(scenario_with(error), 0) != true_camera(scenario_with(error), 1)
    assert true_camera(scenario_with(), 0) == scenario_with().camera_model()


def test_odometry_has_the_stated_noise_and_bias():
    scenario = scenario_with(
        "navigation={grade='exact', position_noise_m=0.002, attitude_noise_deg=0.1, "
        "attitude_roll_noise_deg=0.1, "
        "position_bias_m=0.01}"
    )
    state = states_of(scenario)["chaser/0"]
    navigation = OdometrySensor(scenario)
    known = [navigation.measure(0, tick, state) for tick in range(300)]
    again = OdometrySensor(scenario).measure(0, 7, state)
    assert np.array_equal(again.position_m, known[7].position_m)
    off = np.array([k.position_m - state.position_m for k in known])
    assert np.abs(off.std(axis=0) / 0.002 - 1.0).max() < 0.2
    assert np.linalg.norm(off.mean(axis=0)) > 0.002
    turns = [
        rotations.log(rotations.multiply(rotations.conjugate(state.q_wxyz), k.q_wxyz))
        for k in known
    ]
    assert np.abs(np.degrees(np.std(turns, axis=0)) / 0.1 - 1.0).max() < 0.2
    assert np.array_equal(known[0].velocity_m_s, state.velocity_m_s)
    assert OdometrySensor(scenario_with()).measure(0, 3, state) is state


def test_camera_mounted_to_the_left_sees_the_target_on_the_right():
    image, turned = taken(), taken("camera.mounting_rotation_deg=[0.0, 0.0, 5.0]")

    def column(pixels):
        return np.average(np.arange(640), weights=np.where(pixels > 60, 1.0, 0.0)[:350].sum(axis=0))

    shift = scenario_with().camera_model().fx_px * np.tan(np.radians(5.0))
    assert column(turned) - column(image) == pytest.approx(shift, rel=0.1)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("camera.renderer=pybullet", "camera.renderer: .* remove the key"),
        ("camera.calibration=none.yaml", "no such calibration file"),
        ("camera.calibration=pyproject.toml", "calibration file"),
        ("camera.eclipses=[{from_s=3.0, to_s=2.0}]", "to_s"),
        ("camera.sun_direction=[0.0, 0.0, 0.0]", "sun_direction"),
        ("camera.effects.exposure_s=-1.0", "exposure_s"),
        ("camera.earth={direction=[0.0, 0.0, 0.0]}", "direction"),
        ("target.model=nowhere.toml", r"nowhere\.toml"),
        (
            "camera.intrinsics={width_px=640,height_px=480,fx_px=1,fy_px=1,cx_px=1,cy_px=1,"
            "distortion=[1.0]}",
            "distortion",
        ),
    ],
)
def test_invalid_camera_is_refused(change, message):
    with pytest.raises(ScenarioError, match=message):
        scenario_with(change)


def test_non_invertible_lens_is_refused():
    lens = (
        "{width_px=640,height_px=480,fx_px=400.0,fy_px=400.0,cx_px=320.0,cy_px=240.0,"
        "distortion=[-0.9,0.0,0.0,0.0]}"
    )
    with pytest.raises(ScenarioError, match="distortion"):
        Cameras(scenario_with(f"camera.intrinsics={lens}"))
