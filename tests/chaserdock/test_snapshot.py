# SPDX-License-Identifier: Apache-2.0
"""Snapshots: what the line over a camera image states."""

from __future__ import annotations

import numpy as np
import pytest
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import PoseSolution, Sighting

from chaserdock.analysis.snapshot import seen_text

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
        ((), (POSE,), "seen by its shape"),
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
