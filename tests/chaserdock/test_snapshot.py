# SPDX-License-Identifier: Apache-2.0
"""Snapshots: what the line over a camera image states, and images without a picture."""

from __future__ import annotations

import numpy as np
import pytest
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import Image, PoseSolution, Sighting
from chaserdock_protocol.pose_image import NAME, WIDTH_PX, encode_pose
from chaserdock_protocol.scenario import load_scenario
from harness import ROOT

from chaserdock.analysis.snapshot import annotated_image, seen_text

POSE = PoseSolution(
    position_m=(0.0, 0.0, 1.0),
    q_wxyz=(1.0, 0.0, 0.0, 0.0),
    covariance=vector(np.eye(6)),
    reprojection_rms_px=0.1,
)


@pytest.mark.parametrize(
    ("markers", "solutions", "text"),
    [
        ((), (), "not seen"),
        ((4,), (POSE,), "1 marker"),
        ((4, 5), (), "2 markers"),
        ((), (POSE,), "seen without markers"),
    ],
)
def test_text_states_by_what_the_target_was_found(
    markers: tuple[int, ...], solutions: tuple[PoseSolution, ...], text: str
) -> None:
    sighting = Sighting(
        tick=0,
        sim_time_ns=0,
        chaser=0,
        status="seen" if solutions else "nothing",
        solutions=solutions,
        marker_ids=markers,
        corners_px=(),
        rejected_ids=(),
    )
    assert seen_text(sighting) == text
    assert seen_text(None) == "not seen"


def test_an_image_that_holds_a_pose_is_dark_with_its_axes() -> None:
    """Stretched to the size of a picture its bytes would be stripes."""
    scenario = load_scenario(ROOT / "scenarios" / "single.toml", (f'perception.name="{NAME}"',))
    data = encode_pose(np.array([0.0, 0.0, 1.0]), np.array([1.0, 0.0, 0.0, 0.0]), (1, 2))
    image = Image(
        tick=0,
        sim_time_ns=0,
        chaser=0,
        width_px=WIDTH_PX,
        height_px=1,
        encoding="mono8",
        data=data,
    )
    sighting = Sighting(
        tick=0,
        sim_time_ns=0,
        chaser=0,
        status="seen",
        solutions=(POSE,),
        marker_ids=(0,),
        corners_px=(0.0,) * 8,
        rejected_ids=(),
    )
    camera = scenario.camera_model()
    shown = annotated_image(scenario, image, sighting, camera.width_px)
    assert shown.shape == (camera.height_px, camera.width_px, 3)
    assert np.median(shown) < 60
    away = np.argwhere(shown[40:].max(axis=2) > 120) - [
        camera.height_px / 2 - 40,
        camera.width_px / 2,
    ]
    assert 0 < len(away) < 0.01 * shown[40:, :, 0].size
    assert np.abs(away).max() < 0.2 * camera.width_px
