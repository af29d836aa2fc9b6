# SPDX-License-Identifier: Apache-2.0
"""The emulated laboratory of the examples: its pictures, probes and thrusters."""

from __future__ import annotations

import math
from importlib import import_module
from typing import Any

import numpy as np
import pytest
from chaserdock_protocol.scenario import load_scenario
from chaserdock_protocol.scenario.flight import flight_scenario
from scipy.spatial.transform import Rotation
from virtual_lab import FOLDER, emulated

import chaserdock as cd

bodies = import_module("lab_bodies")
pictures = import_module("lab_pictures")


@pytest.mark.parametrize(
    ("name", "target", "distance_m", "largest_m", "largest_rad"),
    [
        ("tracking", "paper", 0.6, 1e-3, 5e-3),
        ("planar-docking", "servicer", 1.0, 3e-4, 5e-4),
        ("free-flyer-docking", "servicer", 0.35, 3e-4, 5e-4),
    ],
)
def test_perception_measures_what_the_laboratory_draws(
    name: str, target: str, distance_m: float, largest_m: float, largest_rad: float
) -> None:
    setup = emulated.read_setup(FOLDER / name / "lab.toml", 1)
    drawn = pictures.Camera(setup)
    camera = flight_scenario(load_scenario(FOLDER / name / "scenario.toml")).camera_model()
    np.testing.assert_allclose(drawn.matrix, camera.matrix(), atol=1e-9)
    rng = np.random.default_rng(3)
    for number in range(3):
        place = np.array([*rng.uniform(-0.05, 0.05, 2), distance_m])
        turn = emulated.CAMERA_AXES.inv() * Rotation.from_rotvec(rng.normal(0.0, 0.15, 3))
        exposure = emulated.Exposure(0, place, emulated.wxyz(turn), 1000 + number)
        pose = cd.Tracker(camera, target).track(drawn.picture(exposure), 0).pose
        assert pose is not None
        assert np.linalg.norm(pose.position_m - place) < largest_m
        w, x, y, z = pose.q_wxyz
        assert (turn.inv() * Rotation.from_quat([x, y, z, w])).magnitude() < largest_rad


def approaching(speed_m_s: float, aside_m: float, armed: bool = True) -> tuple[Any, Any, Any]:
    """Return probe, robot and target after the robot has met its port and pulled for 2 s."""
    setup = emulated.read_setup(FOLDER / "free-flyer-docking" / "lab.toml", 1)
    robot, target, probe = setup.chasers[0], setup.target, setup.probes[0]
    target.omega = np.zeros(3)
    robot.position, robot.rotation = np.array([-0.56, aside_m, -0.05]), Rotation.identity()
    robot.velocity = np.array([speed_m_s, 0.0, 0.0])
    if armed:
        probe.command("arm")
    for step in range(2000):
        force, torque = probe.load(robot, target)
        pull = np.array([-0.5, 0.0, 0.0]) if step > 1000 else np.zeros(3)
        tip, _ = robot.at(probe.tip)
        robot.move(force + pull, torque + np.cross(tip - robot.position, force))
        target.move(-force, -np.cross(tip - target.position, force) - torque)
    return probe, robot, target


def test_a_probe_that_meets_its_port_slowly_latches_and_holds() -> None:
    probe, robot, target = approaching(0.01, 0.002)
    assert probe.is_latched
    assert probe.misses == probe.refusals == []
    tip, tip_speed = robot.at(probe.tip)
    place = target.position + target.rotation.apply(probe.port.position)
    assert np.linalg.norm(tip - place) < 0.005
    _, speed = target.at(probe.port.position)
    assert np.linalg.norm(tip_speed - speed) < 0.002
    total = robot.mass_kg * robot.velocity + target.mass_kg * target.velocity
    pulled = robot.mass_kg * 0.01 - 0.5 * 999 * bodies.STEP_S
    np.testing.assert_allclose(total, [pulled, 0.0, 0.0], atol=1e-6)
    probe.command("release")
    assert not probe.is_latched


@pytest.mark.parametrize(
    ("speed_m_s", "aside_m", "armed", "said"),
    [
        (0.01, 0.002, False, "not armed"),
        (0.03, 0.002, True, "30.0 mm/s closing"),
        (0.01, 0.015, True, "15.0 mm off"),
        (0.01, 0.04, True, "40.0 mm off"),
    ],
)
def test_a_touch_beyond_the_limits_bounces(
    speed_m_s: float, aside_m: float, armed: bool, said: str
) -> None:
    probe, robot, _ = approaching(speed_m_s, aside_m, armed)
    assert not probe.is_latched
    assert probe.refusals[0] == said
    assert bool(probe.misses) == (aside_m > bodies.PORT_RADIUS_M)
    assert robot.velocity[0] < 0.0


def test_thrusters_give_the_impulse_of_their_duty_with_a_lag() -> None:
    thruster = np.array([[0.0, 0.1, 0.0, 1.0, 0.0, 0.0, 2.0]])
    actuators = bodies.Actuators(thruster)
    actuators.command_duty(np.array([0.3]), 0)
    outputs = np.array([actuators.step(k * 2_000_000) for k in range(200)])
    assert outputs[:, 0].sum() * bodies.STEP_S == pytest.approx(0.06, rel=1e-3)
    assert outputs[:, 5].sum() * bodies.STEP_S == pytest.approx(-0.006, rel=1e-3)
    assert outputs[4, 0] == pytest.approx(2.0 * (1.0 - 0.9**5))


def test_bodies_touch_where_their_cuboids_meet() -> None:
    a = bodies.Body(np.zeros(3), Rotation.identity(), size_m=np.array([0.2, 0.2, 0.2]))
    b = bodies.Body(np.array([0.3, 0.0, 0.0]), Rotation.identity(), size_m=a.size_m)
    assert bodies.apart_m(a, b) == pytest.approx(0.1)
    b.rotation = Rotation.from_rotvec([0.0, 0.0, math.pi / 4])
    assert bodies.apart_m(a, b) == pytest.approx(0.2 - 0.1 * math.sqrt(2.0))
    b.position = np.array([0.2, 0.0, 0.0])
    assert bodies.apart_m(a, b) == 0.0
