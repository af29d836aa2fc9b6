# SPDX-License-Identifier: Apache-2.0
"""The perception ``statistical`` measures as the default perception does on rendered images of the
same poses.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from chaserdock_agents.chaser.perception import PerceptionResult, make_perception
from chaserdock_agents.chaser.sighting import decode_image, look
from chaserdock_models import rotations
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_protocol.shipped_scenarios import find_scenario
from chaserdock_world.physics.simulation import BodyState
from chaserdock_world.rendering.cameras import Cameras, States
from chaserdock_world.rendering.pose_cameras import PoseCameras, make_cameras
from harness import ROOT

from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.summary import summary_of
from chaserdock.simulation.mission import simulate

POSES = 240
RANGE_M = (0.4, 1.5)


@dataclass
class Measured:
    """Of the images in which a perception measured a pose: errors, normalized squared errors,
    stated sigmas, markers.
    """

    seen: list[bool] = field(default_factory=list)
    position_m: list[float] = field(default_factory=list)
    angle_rad: list[float] = field(default_factory=list)
    nees: list[float] = field(default_factory=list)
    sigma_m: list[float] = field(default_factory=list)
    markers: list[int] = field(default_factory=list)


def scenario(*overrides: str) -> Scenario:
    exact = 'navigation.grade="exact"'
    return load_scenario(ROOT / "scenarios" / "fault-drill.toml", (exact, *overrides))


def drawn_states(rng: np.random.Generator) -> States:
    """A target at any attitude before the camera of chaser 0."""
    zero, distance_m = np.zeros(3), rng.uniform(*RANGE_M)
    aside = rng.normal(size=2) * 0.08 * distance_m
    target = BodyState(
        np.array([distance_m, *aside]), zero, rotations.exp(2.0 * rng.normal(size=3)), zero
    )
    return {
        "chaser/0": BodyState(zero, zero, rotations.exp(0.03 * rng.normal(size=3)), zero),
        "target": target,
    }


def add(measured: Measured, result: PerceptionResult, states: States, nominal: Scenario) -> None:
    measured.seen.append(bool(result.solutions))
    if not result.solutions:
        return
    own, target, found = states["chaser/0"], states["target"], result.solutions[0]
    eye, attitude = nominal.camera_model().irf_pose_in_world(own.position_m, own.q_wxyz)
    position = rotations.rotate_inverse(attitude, target.position_m - eye)
    q = rotations.multiply(rotations.conjugate(attitude), target.q_wxyz)
    turn = rotations.log(rotations.multiply(rotations.conjugate(found.q_irf_trf_wxyz), q))
    error = np.concatenate([position - found.position_irf_m, turn])
    measured.position_m.append(float(np.linalg.norm(error[:3])))
    measured.angle_rad.append(float(np.linalg.norm(turn)))
    measured.nees.append(float(error @ np.linalg.solve(found.covariance, error)))
    measured.sigma_m.append(float(np.sqrt(np.trace(found.covariance[:3, :3]))))
    measured.markers.append(len(result.marker_ids))


@pytest.fixture(scope="module")
def both() -> tuple[Measured, Measured]:
    """Measurements on images, and statistical ones."""
    rng, measured = np.random.default_rng(7), (Measured(), Measured())
    pictures, numbers = scenario(), scenario('perception.name="statistical"')
    cameras, perceptions = (
        (Cameras(pictures), PoseCameras(numbers)),
        tuple(map(make_perception, (pictures, numbers))),
    )
    for k in range(POSES):
        states = drawn_states(rng)
        for camera, perception, results in zip(cameras, perceptions, measured, strict=True):
            image = decode_image(camera.image(0, k, k, k, states))
            add(results, perception.estimate(image), states, pictures)
    return measured


@pytest.mark.slow
def test_statistical_perception_sees_the_target_where_images_show_it(
    both: tuple[Measured, Measured],
) -> None:
    images, statistical = both
    assert np.mean(np.array(images.seen) == statistical.seen) > 0.96
    assert np.mean(statistical.markers) == pytest.approx(np.mean(images.markers), rel=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("quantity", ["position_m", "angle_rad", "sigma_m"])
def test_its_errors_and_covariances_are_those_of_images(
    quantity: str, both: tuple[Measured, Measured]
) -> None:
    images, statistical = (np.median(getattr(m, quantity)) for m in both)
    assert statistical == pytest.approx(images, rel=0.35)


@pytest.mark.slow
def test_its_errors_follow_its_covariance(both: tuple[Measured, Measured]) -> None:
    assert np.mean(both[1].nees) == pytest.approx(6.0, abs=1.0)


@pytest.mark.slow(minutes=0.5)
@pytest.mark.parametrize("rate_hz", [5, 30])
@pytest.mark.parametrize(("name", "least"), [("docking-contact", 2.0), ("single-thrusters", 3.0)])
def test_the_filter_knows_how_large_its_errors_are(
    name: str, least: float, rate_hz: int, tmp_path: Path
) -> None:
    """The NEES of the relative pose is that of a consistent estimate, on both sides. The cameras
    are exact, as a flight draws their constant errors only once; the filter's floor, which covers
    what no covariance states, makes it too careful then, most where many markers are seen.
    """
    found = []
    for seed in range(4):
        overrides = (
            *(f"navigation.camera_{key}=0.0" for key in ("turn_deg", "shift_m", "focal_share")),
            f"time.rate_hz={rate_hz}",
            f"time.image_hz={rate_hz}",
            f"chaser.modulation.carrier_hz={rate_hz}",
            "duration_s=15.0",
            "settling_s=5.0",
            "timeline=[]",
            'perception.name="statistical"',
            f"seed={seed}",
        )
        simulate(find_scenario(name), tmp_path / f"{seed}", overrides)
        flight = load_flight(tmp_path / f"{seed}" / "mission.mcap")
        found.append(summary_of(flight)["chasers"]["0"]["relative_estimate"]["nees_mean"])
    assert least <= np.mean(found) <= 7.5


def test_measurements_depend_on_seed_chaser_and_number_only() -> None:
    states = drawn_states(np.random.default_rng(1))
    states["target"] = BodyState(
        np.array([0.7, 0.0, 0.0]), np.zeros(3), np.array([1.0, 0, 0, 0]), np.zeros(3)
    )
    states["chaser/1"] = states["chaser/0"]

    def position(chaser: int, number: int, seed: int) -> tuple[float, ...]:
        flown = scenario('perception.name="statistical"', f"seed={seed}")
        image = make_cameras(flown).image(chaser, number, 0, 0, states)
        return look(make_perception(flown), image, None).solutions[0].position_m

    assert position(0, 5, 1) == position(0, 5, 1)
    assert len({position(0, 5, 1), position(1, 5, 1), position(0, 6, 1), position(0, 5, 2)}) == 4


def test_a_picture_is_refused() -> None:
    image = Cameras(scenario()).image(0, 0, 0, 0, drawn_states(np.random.default_rng(1)))
    sighting = look(make_perception(scenario('perception.name="statistical"')), image, None)
    assert sighting.status == "bad_image"
    assert "is none of perception 'statistical'" in sighting.detail
