# SPDX-License-Identifier: Apache-2.0
"""The training task ``inspect``: what counts as seen, rewards, and the end of an episode."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.rigid_body import BodyState
from chaserdock_models.targets import Box
from chaserdock_protocol.errors import ScenarioError
from chaserdock_protocol.scenario import Scenario, load_scenario, parse_scenario
from chaserdock_protocol.scenario.learning import LearningInspection
from chaserdock_protocol.shipped_scenarios import shipped_scenario
from env_cases import ALONG_PORT, START, learning
from harness import ROOT

from chaserdock.envs.batch import BatchStep, DockingBatch
from chaserdock.envs.observation import goal_of, names_of, observation_of
from chaserdock.envs.surface import Coverage, surface_of
from chaserdock.envs.task import OUTCOMES
from chaserdock.toml_text import toml_value

SUN = (-1.0, 0.3, 0.2)


def inspecting(inspect: dict[str, Any] | None = None, **changes: Any) -> Scenario:
    """A chaser that looks at the servicer's -X face, which the sun lights, from 0.78 m."""
    keys = learning("inspect", inspect={"share": 1.0} | (inspect or {}), reward={"seen": 3.0})
    values = {"camera": {"sun_direction": list(SUN)}, "time": {"image_hz": 5}, "learning": keys}
    return parse_scenario(ALONG_PORT | {"docking": {}} | values | changes, "test")


def panels(**keys: Any) -> Scenario:
    """Two chasers around a satellite of twenty cuboids, whose panels hide and shade others."""
    table = learning("inspect", start=START, episode_s=40.0) | keys
    overrides = (f"learning={toml_value(table)}", "target.omega_rad_s=[0.1, 0.2, 0.1]")
    return load_scenario(shipped_scenario("markerless-inspection"), overrides)


def coverage_of(scenario: Scenario) -> Coverage:
    assert scenario.learning is not None
    boxes, sun = scenario.target_model().boxes, np.array(scenario.camera.sun_direction)
    return Coverage(boxes, scenario.camera_model(), scenario.learning.inspect, sun)


def flown(scenario: Scenario, ticks: int = 3) -> tuple[DockingBatch, BatchStep]:
    """Fly one environment without thrust."""
    batch = DockingBatch(scenario, 1)
    batch.start(0)
    done = batch.step(zeros := np.zeros((1, batch.chasers, batch.task.actuators)))
    for _ in range(ticks - 1):
        done = batch.step(zeros)
    return batch, done


# -- surface ---------------------------------------------------------------------------------------


def test_points_fill_the_faces_that_no_other_cuboid_covers() -> None:
    """A cube of 0.4 m with a smaller one on a face."""
    boxes = (Box((0.4, 0.4, 0.4)), Box((0.1, 0.2, 0.2), (0.25, 0.0, 0.0)))
    surface = surface_of(boxes, 0.1)
    assert len(surface.planes) == 11  # the small one's inner face is covered
    counts = np.bincount(surface.face)
    assert counts.tolist() == [16 - 4, 16, 16, 16, 16, 16, 4, 2, 2, 2, 2]
    for plane, box, k in zip(surface.planes, surface.box, range(11), strict=True):
        points = surface.points_m[surface.face == k]
        np.testing.assert_allclose(points @ plane[:3], plane[3], atol=1e-12)
        assert float((points - boxes[box].position_m)[0] @ plane[:3]) > 0.0  # outwards
    wide = surface_of((Box((0.25, 0.4, 0.4)),), 0.15)
    edges = np.unique(wide.points_m[wide.face == 2][:, 0].round(9))
    np.testing.assert_allclose(edges, [-0.0625, 0.0625])


# -- what is seen ----------------------------------------------------------------------------------


def test_a_face_before_the_camera_is_seen_point_by_point() -> None:
    scenario = inspecting()
    batch, done = flown(scenario)
    surface = surface_of(scenario.target_model().boxes, 0.1)
    facing = surface.planes[surface.face, 0] < -0.9
    assert 0 < facing.sum() < len(facing)
    np.testing.assert_array_equal(batch.seen[0], facing)
    assert done.rewards[0, 0] == pytest.approx(3.0 * facing.mean())
    assert batch.step(np.zeros((1, 1, 6))).rewards[0, 0] == 0.0  # once only


def test_nothing_is_seen_between_two_images() -> None:
    scenario = inspecting()
    assert scenario.timing.ticks_per_image == 3
    assert not flown(scenario, 2)[0].seen.any()
    assert flown(scenario, 3)[0].seen.any()


@pytest.mark.parametrize(
    ("inspect", "sun", "some"),
    [
        ({}, SUN, True),
        ({}, (1.0, 0.3, 0.2), False),
        ({"sunlit": False}, (1.0, 0.3, 0.2), True),
        ({"range_m": 0.5}, SUN, False),
        ({"range_m": 0.9}, SUN, True),
        ({"incidence_deg": 1.5, "spacing_m": 0.4}, SUN, False),
        ({"incidence_deg": 3.0, "spacing_m": 0.4}, SUN, True),
    ],
)
def test_light_range_and_incidence(
    inspect: dict[str, Any], sun: tuple[float, float, float], some: bool
) -> None:
    """With one point on the face, 2.5 cm below the camera, 0.7 m away: 2 degrees."""
    scenario = inspecting(inspect, camera={"sun_direction": list(sun)})
    assert bool(flown(scenario)[0].seen.any()) == some


def test_a_camera_that_looks_aside_sees_nothing() -> None:
    chasers = [ALONG_PORT["chasers"][0] | {"start_rotation_rad": [0.0, 0.0, 1.2]}]
    assert not flown(inspecting(chasers=chasers))[0].seen.any()


@pytest.mark.parametrize("sunlit", [True, False])
def test_the_kernel_sees_what_flight_code_computes(sunlit: bool) -> None:
    """Seen points, observation and reward of two chasers, whose lines of sight cuboids cross."""
    scenario = panels(reward={"seen": 7.0}, inspect={"sunlit": sunlit, "incidence_deg": 80.0})
    batch, coverage = DockingBatch(scenario, 2), coverage_of(scenario)
    batch.start(1)
    for tick in range(1, 150):
        done = batch.step(np.zeros((2, 2, batch.task.actuators)))
        states, target = [batch.state(1, i) for i in range(2)], batch.state(1, None)
        gained = [0.0, 0.0]
        if tick % scenario.timing.ticks_per_image == 0:
            gained = [7.0 * len(coverage.look(s, target)) / len(coverage.seen) for s in states]
        np.testing.assert_array_equal(batch.seen[1], coverage.seen)
        np.testing.assert_allclose(done.rewards[1], gained, atol=1e-12)
        for i, own in enumerate(states):
            other = [states[1 - i].position_m]
            added = coverage.elements(own, target)
            expected = observation_of(goal_of(scenario, i, "inspect"), own, target, other, added)
            np.testing.assert_allclose(done.observations[1, i], expected, atol=1e-6)
    assert batch.task.width == len(names_of(2, "inspect"))
    hidden = sum(coverage._hidden(p, np.array([1.4, 0.3, 0.2])) for p in range(100))
    assert hidden > 10
    assert 0.2 < coverage.seen.mean() < 0.95


def test_a_cuboid_before_a_face_hides_it_and_shades_it() -> None:
    boxes = (Box((0.2, 0.2, 0.2)), Box((0.01, 0.5, 0.5), (0.5, 0.0, 0.0)))
    scenario = inspecting()
    settings = LearningInspection()

    def seen(eye: Array, sun: Array) -> set[float]:
        """Places along x of the seen points of the cube's face."""
        coverage = Coverage(boxes, scenario.camera_model(), settings, sun)
        back = BodyState(eye, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), np.zeros(3))
        still = BodyState(np.zeros(3), np.zeros(3), rotations.IDENTITY, np.zeros(3))
        found = coverage.look(back, still)
        return set(coverage.surface.points_m[found, 0].round(6).tolist())

    near, far = np.array([0.4, 0.0, 0.0]), np.array([1.0, 0.0, 0.0])
    side = np.array([0.4, 0.0, 1.0])
    assert 0.1 in seen(near, side)
    assert 0.1 not in seen(far, side)
    assert 0.1 not in seen(near, np.array([1.0, 0.0, 0.1]))


# -- reward and end --------------------------------------------------------------------------------


def test_an_episode_ends_when_the_share_is_seen_and_the_next_begins_with_nothing() -> None:
    scenario = inspecting({"share": 0.1})
    batch, done = flown(scenario)
    assert OUTCOMES[done.outcomes[0, 0]] == "inspected"
    assert (done.terminated[0, 0], done.truncated[0, 0]) == (True, False)
    assert done.observations[0, 0, 22] >= 0.1
    again = batch.step(np.zeros((1, 1, 6)))
    assert again.outcomes[0, 0] == 0
    assert again.observations[0, 0, 22] == 0.0
    assert not batch.seen.any()
    all_faces, _ = flown(inspecting({"share": 1.0}), 40)
    assert all_faces.seen.any()
    assert not all_faces._arrays["outcome"].any()


def test_a_surface_that_is_all_seen_leaves_zeros() -> None:
    scenario = inspecting({"share": 1.0})
    batch = DockingBatch(scenario, 1)
    batch.start(0)
    batch._arrays["unseen"][:] = 0.0
    done = batch.step(np.zeros((1, 1, 6)))
    assert OUTCOMES[done.outcomes[0, 0]] == "inspected"
    assert done.observations[0, 0, 16:22].tolist() == [0.0] * 6
    assert done.observations[0, 0, 22] == 1.0


def test_statistical_observations_turn_the_sun_with_the_target() -> None:
    """The estimated target is turned; what is fixed in WRF turns against it."""
    keys = learning("inspect", observation="statistical")
    camera = {"width_px": 960, "height_px": 540, "sun_direction": list(SUN)}
    scenario = inspecting(learning=keys, camera=camera)
    batch = DockingBatch(scenario, 1)
    batch.start(0)
    batch._arrays["errors"][3:6, 0] = [0.0, 0.0, 0.1]
    seen = batch.step(np.zeros((1, 1, 6))).observations[0, 0].astype(float)
    turned = rotations.exp(batch._arrays["errors"][3:6, 0])
    sun = np.array(SUN) / np.linalg.norm(SUN)
    np.testing.assert_allclose(seen[23:26], rotations.rotate_inverse(turned, sun), atol=1e-6)


# -- scenarios -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("inspect", "text"),
    [
        ({"share": 0.0}, "learning.inspect.share"),
        ({"incidence_deg": 91.0}, "learning.inspect.incidence_deg"),
        ({"spacing_m": 0.0}, "learning.inspect.spacing_m"),
        ({"spacing_m": 0.005}, "learning.inspect.spacing_m: 0.005 m gives 28672 points on the"),
    ],
)
def test_an_invalid_table_is_one_line(inspect: dict[str, Any], text: str) -> None:
    with pytest.raises(ScenarioError, match=text) as raised:
        DockingBatch(inspecting(inspect), 1)
    assert len(str(raised.value).splitlines()) == 1


def test_eclipses_are_not_simulated() -> None:
    camera = {"eclipses": [{"from_s": 1.0, "to_s": 2.0}]}
    with pytest.raises(ScenarioError, match=r"do not simulate camera\.eclipses"):
        DockingBatch(inspecting(camera=camera), 1)


@pytest.mark.slow
def test_the_law_of_the_example_inspects() -> None:
    folder = ROOT / "examples" / "learning"
    done = subprocess.run(
        [sys.executable, str(folder / "inspecting.py"), "40"],
        capture_output=True,
        text=True,
        check=True,
    )
    share = float(done.stdout.split("success ")[1].split("%")[0])
    assert share >= 80.0, done.stdout
