# SPDX-License-Identifier: Apache-2.0
"""A chaser that looks at a target of unknown shape: what it waits for, and its pose by a map."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import msgspec
import numpy as np
import pytest
from chaser_cases import deliver, lost, odometry, tick_of
from chaserdock_agents.chaser.bodies_in_view import probe_discs
from chaserdock_agents.chaser.core import ChaserCore
from chaserdock_agents.chaser.feature_vision import FeatureVision, MappedPath
from chaserdock_agents.chaser.perception.features import (
    MapPoseTuning,
    NoMapPose,
    SeenLandmarks,
    pose_by_map,
)
from chaserdock_agents.chaser.perception.refine import PoseInCamera
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.camera import Camera
from chaserdock_models.targets import cuboid_corners
from chaserdock_protocol import topics
from chaserdock_protocol.messages import (
    FeatureTracks,
    Image,
    LandmarkMap,
    MappedMotion,
    SightedMap,
    Sighting,
    Tick,
)
from chaserdock_protocol.scenario import Scenario, flight_scenario, parse_scenario
from message_samples import PORT

LATENCY_TICKS = 60
CASE: dict[str, Any] = {
    "name": "unknown",
    "duration_s": 60.0,
    "time": {"rate_hz": 15, "image_hz": 5},
    "navigation": {"grade": "lab"},
    "perception": {"name": "features"},
    "target": {"model": "geo_servicer"},
    "camera": {"width_px": 160, "height_px": 120},
    "chasers": [{"position_m": [-1.9, 0.1, 0.2], "look_at": "target"}],
}
SCENARIO: Scenario = parse_scenario(CASE, "unknown")


def chaser() -> ChaserCore:
    return ChaserCore(flight_scenario(SCENARIO), 0)


def tick(number: int, mapper: str = "", since: int = 0) -> Tick:
    plain = tick_of(SCENARIO, number, (0,))
    known = {"mapper": since} if mapper else {}
    return msgspec.structs.replace(plain, mapper=mapper, since=known)


def image(number: int) -> Image:
    grey = np.random.default_rng(2).integers(0, 255, (120, 160), dtype=np.uint8)
    return Image(
        tick=number,
        sim_time_ns=SCENARIO.timing.tick_time_ns(number),
        chaser=0,
        width_px=160,
        height_px=120,
        encoding="mono8",
        data=grey.tobytes(),
    )


def map_of(number: int, next_tick: int, instance: str = "m") -> LandmarkMap:
    time_ns = SCENARIO.timing.tick_time_ns(number)
    return LandmarkMap(
        tick=number,
        sim_time_ns=time_ns,
        status="gathering",
        next_tick=next_tick,
        instance=instance,
    )


def seen(published: list[tuple[Any, Any]]) -> list[tuple[str, int]]:
    names = {Sighting: "sighting", FeatureTracks: "tracks"}
    return [(names[type(m)], m.tick) for _, m in published if type(m) in names]


def test_an_image_waits_for_the_state_at_its_exposure() -> None:
    core = chaser()
    deliver(core, topics.TICK, tick(0))
    assert seen(deliver(core, topics.IMAGE, image(0))) == []
    assert seen(deliver(core, topics.ODOMETRY, odometry(SCENARIO, 0, 0))) == [
        ("tracks", 0),
        ("sighting", 0),
    ]


def test_a_lost_image_or_state_holds_nobody_up() -> None:
    core = chaser()
    deliver(core, topics.TICK, tick(0))
    deliver(core, topics.ODOMETRY, odometry(SCENARIO, 0, 0))
    published = deliver(core, topics.IMAGE, lost(SCENARIO, 0))
    assert seen(published) == [("tracks", 0), ("sighting", 0)]
    assert {m.status for _, m in published} == {"bad_image"}
    deliver(core, topics.TICK, tick(3))
    deliver(core, topics.IMAGE, image(3))
    assert seen(deliver(core, topics.ODOMETRY, lost(SCENARIO, 3))) == [
        ("tracks", 3),
        ("sighting", 3),
    ]


def flown_to(core: ChaserCore, number: int, **known: Any) -> list[tuple[str, int]]:
    deliver(core, topics.TICK, tick(number, **known))
    deliver(core, topics.ODOMETRY, odometry(SCENARIO, 0, number))
    return seen(deliver(core, topics.IMAGE, image(number)))


def test_in_lock_step_an_image_waits_for_the_map_that_counts_by_then() -> None:
    core, both = chaser(), [("tracks", LATENCY_TICKS), ("sighting", LATENCY_TICKS)]
    assert len(flown_to(core, LATENCY_TICKS - 3, mapper="m")) == 2
    assert flown_to(core, LATENCY_TICKS, mapper="m") == []
    assert core.missing_keys() == ("mapper/map",)
    assert seen(deliver(core, topics.MAP, map_of(0, 15))) == both
    # The next one is due at 15 and counts 60 ticks later.
    assert len(flown_to(core, 72, mapper="m")) == 2
    assert flown_to(core, 75, mapper="m") == []
    assert len(seen(deliver(core, topics.MAP, map_of(15, 30)))) == 2


def test_no_image_waits_for_a_mapper_that_is_lost_or_new() -> None:
    core = chaser()
    assert flown_to(core, LATENCY_TICKS, mapper="m") == []
    revised = msgspec.structs.replace(tick(LATENCY_TICKS), revision=1)
    assert len(seen(deliver(core, topics.TICK, revised))) == 2
    assert len(flown_to(core, 63, mapper="n", since=30)) == 2
    assert flown_to(core, 90, mapper="n", since=30) == []
    # A map of the process before does not do.
    assert seen(deliver(core, topics.MAP, map_of(20, 500))) == []
    assert len(seen(deliver(core, topics.MAP, map_of(30, 45, "n")))) == 2


def test_in_real_time_an_image_waits_for_no_map() -> None:
    vision = FeatureVision(flight_scenario(SCENARIO), 0)
    vision.take(odometry(SCENARIO, 0, 90))
    assert vision.missing(image(90), tick(90, "m"), realtime=True) is None
    assert vision.missing(image(90), tick(90, "m"), realtime=False) is topics.MAP


def test_without_a_map_the_sighting_says_why() -> None:
    core = chaser()
    flown_to(core, 0, mapper="m")
    deliver(core, topics.MAP, msgspec.structs.replace(map_of(0, 300), status="does not turn"))
    deliver(core, topics.TICK, tick(LATENCY_TICKS, "m"))
    deliver(core, topics.ODOMETRY, odometry(SCENARIO, 0, LATENCY_TICKS))
    published = deliver(core, topics.IMAGE, image(LATENCY_TICKS))
    sighting = next(m for _, m in published if isinstance(m, Sighting))
    assert (sighting.status, sighting.solutions) == ("nothing", ())
    assert sighting.detail == "no map of the target: does not turn"


def test_a_sighting_says_whether_the_loop_has_closed_and_which_port_is_its_own() -> None:
    still = MappedMotion(
        position_m=(0.0, 0.0, 0.0), velocity_m_s=(0.0, 0.0, 0.0), q_wxyz=(1.0, 0.0, 0.0, 0.0),
        omega_rad_s=(0.0, 0.05, 0.0), covariance=(0.0,) * 144,
    )  # fmt: skip
    own = msgspec.structs.replace(PORT, chaser=0, number=3)
    core = chaser()
    flown_to(core, 0, mapper="m")
    mapped = msgspec.structs.replace(
        map_of(0, 300), status="mapped", motion=still, closed=True, ports=(own, PORT)
    )
    deliver(core, topics.MAP, mapped)
    maps = []
    for number in (LATENCY_TICKS - 3, LATENCY_TICKS):  # it counts in the second image
        deliver(core, topics.TICK, tick(number, "m"))
        deliver(core, topics.ODOMETRY, odometry(SCENARIO, 0, number))
        published = deliver(core, topics.IMAGE, image(number))
        maps += [m.map for _, m in published if isinstance(m, Sighting)]
    assert maps == [None, SightedMap(closed=True, port=own)]


# -- pose by a map ---------------------------------------------------------------------------------

CAMERA = Camera.from_hfov(960, 540, np.deg2rad(60.0))
TRUE = PoseInCamera(
    np.array([0.11, -0.07, 1.93]), rotations.to_matrix(rotations.exp([0.7, -0.4, 1.1]))
)
PREDICTION = np.diag([0.003**2] * 3 + [0.006**2] * 3)


def landmarks(noise_px: float, count: int = 160, seed: int = 3) -> SeenLandmarks:
    rng = np.random.default_rng(seed)
    places = rng.normal(0.0, 0.25, (count, 3))
    errors = rng.normal(0.0, 0.003, (count, 3))
    px = CAMERA.project_ideal(places @ TRUE.rotation.T + TRUE.position)
    px = px + rng.normal(0.0, noise_px, px.shape)
    spread = np.tile(np.eye(3) * 0.003**2, (count, 1, 1))
    return SeenLandmarks(px, np.zeros(count), places + errors, spread)


def off_by(step: list[float]) -> PoseInCamera:
    turn = rotations.to_matrix(rotations.exp(step[3:]))
    return PoseInCamera(TRUE.position + step[:3], TRUE.rotation @ turn)


def errors_of(pose: Any) -> Array:
    turn = rotations.from_matrix(TRUE.rotation.T @ rotations.to_matrix(pose.q_irf_trf_wxyz))
    return np.concatenate([pose.position_irf_m - TRUE.position, rotations.log(turn)])


def test_what_an_image_shows_corrects_an_uncertain_prediction() -> None:
    start = off_by([0.02, -0.015, 0.03, 0.012, -0.02, 0.015])
    uncertain = np.diag([0.03**2] * 3 + [0.02**2] * 3)
    pose = pose_by_map(CAMERA, landmarks(0.3), start, uncertain)
    error = errors_of(pose)
    assert np.linalg.norm(error[:3]) < 0.004
    assert np.linalg.norm(error[3:]) < np.deg2rad(0.4)
    assert 0.3 < pose.reprojection_rms_px < 3.0


def test_a_certain_prediction_counts_more_than_one_image_of_sliding_points() -> None:
    shown = landmarks(0.3)
    slid = replace(shown, px=shown.px + np.array([4.0, -3.0]))
    moved = pose_by_map(CAMERA, slid, TRUE, np.diag([0.05**2] * 3 + [0.03**2] * 3))
    kept = pose_by_map(CAMERA, slid, TRUE, np.diag([0.0005**2] * 3 + [0.0005**2] * 3))
    assert np.linalg.norm(errors_of(moved)[:3]) > 0.006
    assert np.linalg.norm(errors_of(kept)[:3]) < 0.001


def test_the_covariance_covers_the_errors() -> None:
    rng = np.random.default_rng(9)
    squared = []
    for k in range(40):
        step = rng.multivariate_normal(np.zeros(6), PREDICTION).tolist()
        pose = pose_by_map(CAMERA, landmarks(0.5, seed=k), off_by(step), PREDICTION)
        own = pose.covariance / MapPoseTuning().same_images
        error = errors_of(pose)
        squared.append(float(error @ np.linalg.solve(own, error)))
    # Conservative by the part that points of one image share, of which there is none here.
    assert 0.5 < np.mean(squared) < 7.5


def test_what_the_landmarks_do_not_confirm_is_no_pose() -> None:
    shown = landmarks(0.3)
    few = replace(
        shown,
        px=shown.px[:15],
        ages_s=shown.ages_s[:15],
        landmarks_m=shown.landmarks_m[:15],
        covariances_m2=shown.covariances_m2[:15],
    )
    with pytest.raises(NoMapPose, match="15 points of the map in view"):
        pose_by_map(CAMERA, few, TRUE, PREDICTION)
    wrong = replace(shown, landmarks_m=shown.landmarks_m[::-1].copy())
    with pytest.raises(NoMapPose, match="fit the map"):
        pose_by_map(CAMERA, wrong, TRUE, PREDICTION)
    with pytest.raises(NoMapPose, match="from the predicted attitude"):
        pose_by_map(CAMERA, shown, off_by([0.0, 0.0, 0.0, 0.08, -0.05, 0.06]), PREDICTION)
    with pytest.raises(NoMapPose, match="mm from the predicted position"):
        pose_by_map(CAMERA, shown, off_by([0.05, 0.04, -0.08, 0.0, 0.0, 0.0]), PREDICTION)


def test_a_mapped_path_is_that_of_constant_rates() -> None:
    q = rotations.exp([0.3, -0.2, 0.5])
    rng = np.random.default_rng(6)
    a = rng.normal(0.0, 1e-3, (12, 12))
    motion = MappedMotion(
        position_m=(0.1, 0.2, -0.3),
        velocity_m_s=(0.01, -0.02, 0.03),
        q_wxyz=tuple(q.tolist()),  # pyright: ignore[reportArgumentType]
        omega_rad_s=(0.03, 0.04, -0.02),
        covariance=tuple((a.T @ a).ravel().tolist()),
    )
    path = MappedPath(5.0, motion)
    at, turned = path.at([5.0, 8.0])
    assert np.allclose(at[1] - at[0], np.array(motion.velocity_m_s) * 3.0)
    assert np.allclose(turned[0], rotations.to_matrix(q))
    omega = rotations.log(rotations.from_matrix(turned[0].T @ turned[1])) / 3.0
    assert np.allclose(omega, motion.omega_rad_s)
    now, then = path.covariance_at(5.0), path.covariance_at(8.0)
    full = a.T @ a
    assert np.allclose(now[:3, :3], full[:3, :3])
    assert np.allclose(
        then[:3, :3],
        full[:3, :3] + 3.0 * (full[:3, 3:6] + full[3:6, :3]) + 9.0 * full[3:6, 3:6],
    )


def test_the_own_probe_is_left_out_of_the_points() -> None:
    wide = {"camera": {"width_px": 960, "height_px": 540}}
    scenario = flight_scenario(parse_scenario(CASE | wide, "unknown"))
    camera, (_, probe) = scenario.camera_model(), scenario.chaser.boxes()
    discs = np.array(probe_discs(camera, probe))
    corners = cuboid_corners(probe.size_m) + probe.position_m
    at = rotations.rotate_inverse(camera.q_crf_irf_wxyz, corners - np.array(camera.position_crf_m))
    for px in camera.project(at[at[:, 2] > 0.02]):
        assert (np.linalg.norm(discs[:, :2] - px, axis=1) < discs[:, 2]).any()
    assert (discs[:, 1] - discs[:, 2]).min() > camera.cy_px
