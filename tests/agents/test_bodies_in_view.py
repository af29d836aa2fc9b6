# SPDX-License-Identifier: Apache-2.0
"""Other chasers in the images of a chaser that maps a target: where they are, and left out."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from chaser_cases import deliver, odometry, tick_of, wrench
from chaserdock_agents.chaser.bodies_in_view import chaser_discs
from chaserdock_agents.chaser.core import ChaserCore
from chaserdock_agents.chaser.feature_vision import FeatureVision
from chaserdock_agents.chaser.perception.features import FeatureTracker
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol import topics
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import Image, RelativeEstimate, TargetEstimate
from chaserdock_protocol.scenario import flight_scenario, parse_scenario
from message_samples import EYE6, EYE12
from unknown_cases import UNKNOWN

PARSED = parse_scenario(UNKNOWN, "unknown")
SCENARIO = flight_scenario(PARSED)
CAMERA, BOXES = SCENARIO.camera_model(), SCENARIO.chaser.boxes()


def estimate_of(poses: dict[int, tuple[Array, Array]], tick: int = 0) -> TargetEstimate:
    zero = (0.0, 0.0, 0.0)
    return TargetEstimate(
        tick=tick,
        sim_time_ns=SCENARIO.timing.tick_time_ns(tick),
        status="tracking",
        position_m=zero,
        velocity_m_s=zero,
        q_wxyz=(1.0, 0.0, 0.0, 0.0),
        omega_rad_s=zero,
        covariance=EYE12,
        accepted=(),
        rejected=(),
        relative=tuple(
            RelativeEstimate(
                chaser=i,
                position_m=vector(at),
                q_wxyz=vector(q),
                covariance=EYE6,
                force_N=zero,
                torque_N_m=zero,
            )
            for i, (at, q) in poses.items()
        ),
    )


def two(seed: int) -> dict[int, tuple[Array, Array]]:
    """Return poses of chasers in a target's frame, 1 in the view of 0, in general position."""
    rng = np.random.default_rng(seed)
    q = rotations.exp(rng.normal(size=3))
    place = rng.uniform(-2.0, 2.0, 3)
    before = np.array([rng.uniform(0.9, 2.0), rng.uniform(-0.3, 0.3), rng.uniform(-0.15, 0.15)])
    other = place + rotations.rotate(q, before)
    return {0: (place, q), 1: (other, rotations.exp(rng.normal(size=3)))}


def on_boxes(rng: np.random.Generator) -> Array:
    """Return points (n, 3) on and in a chaser's cuboids, CRF."""
    return np.concatenate(
        [
            np.array(b.position_m)
            + rotations.rotate(b.q_wxyz, rng.uniform(-0.5, 0.5, (200, 3)).round(1) * b.size_m)
            for b in BOXES
        ]
    )


@pytest.mark.parametrize("seed", range(6))
def test_discs_cover_another_chaser_and_little_else(seed: int) -> None:
    poses = two(seed)
    discs = np.array(chaser_discs(CAMERA, BOXES, 0, estimate_of(poses)))
    lens, q_camera = CAMERA.irf_pose_in_world(*poses[0])
    world = poses[1][0] + rotations.rotate(poses[1][1], on_boxes(np.random.default_rng(seed)))
    px = CAMERA.project(rotations.rotate_inverse(q_camera, world - lens))
    off = np.linalg.norm(px[:, None] - discs[:, :2], axis=2)
    assert (off < discs[:, 2] - 10.0).any(axis=1).all()  # with the margin
    around = np.linspace(0.0, 2.0 * np.pi, 8, endpoint=False)
    way = np.column_stack([np.cos(around), np.sin(around)])
    rim = discs[:, None, :2] + discs[:, None, 2:] * way
    outside = np.linalg.norm(rim.reshape(-1, 1, 2) - px, axis=2).min(axis=1)
    assert outside.max() < 60.0


def test_without_the_own_pose_or_another_chaser_there_are_no_discs() -> None:
    poses = two(3)
    assert chaser_discs(CAMERA, BOXES, 0, estimate_of({1: poses[1]})) == ()
    assert chaser_discs(CAMERA, BOXES, 0, estimate_of({0: poses[0]})) == ()
    behind = {0: poses[0], 1: (2.0 * poses[0][0] - poses[1][0], poses[1][1])}
    assert chaser_discs(CAMERA, BOXES, 0, estimate_of(behind)) == ()


def image(tick: int) -> Image:
    grey = np.random.default_rng(2).integers(0, 255, (540, 960), dtype=np.uint8)
    return Image(
        tick=tick,
        sim_time_ns=SCENARIO.timing.tick_time_ns(tick),
        chaser=0,
        width_px=960,
        height_px=540,
        encoding="mono8",
        data=grey.tobytes(),
    )


def test_points_on_another_chaser_are_left_out_while_its_pose_is_known(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    excluded: list[int] = []
    track = FeatureTracker.track

    def tracked(self: FeatureTracker, *args: Any) -> Any:
        excluded.append(len(args[5]))
        return track(self, *args)

    monkeypatch.setattr(FeatureTracker, "track", tracked)
    vision = FeatureVision(SCENARIO, 0)
    for tick in (0, 3, 6, 21):
        if tick == 3:
            vision.take(estimate_of(two(1), tick=1))
        vision.take(odometry(PARSED, 0, tick))
        assert vision.look(image(tick)) is not None
    probe, known, still_known, old = excluded
    assert known == still_known > probe + 10
    assert old == probe


def test_a_chaser_learns_where_others_are_by_the_estimate_of_its_last_command() -> None:
    core = ChaserCore(SCENARIO, 0)
    taken: list[int] = []
    take = core.vision.take

    def record(message: Any) -> None:
        if isinstance(message, TargetEstimate):
            taken.append(message.tick)
        take(message)

    core.vision.take = record
    for tick in (0, 1, 2):
        now = msgspec.structs.replace(tick_of(PARSED, tick, (0,)), images=False)
        deliver(core, topics.TICK, now)
        deliver(core, topics.ODOMETRY, odometry(PARSED, 0, tick))
        # In which order both arrive makes no difference.
        later = [
            (topics.TARGET, estimate_of(two(1), tick)),
            (topics.WRENCH, wrench(PARSED, tick)),
        ]
        for topic, message in later[:: 1 if tick % 2 else -1]:
            deliver(core, topic, message)
    assert taken == [0, 1]
