# SPDX-License-Identifier: Apache-2.0
"""The simulation twin of a flight has its start and its commands."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_protocol.messages import BodyTruth
from chaserdock_protocol.recording.log import read_log
from harness import ROOT
from motion_cases import without_truth

from chaserdock.launch.twin import TwinError, twin_of

GOLDEN = ROOT / "tests" / "golden" / "two-chasers.mcap"


def first_truth() -> dict[str, BodyTruth]:
    found: dict[str, BodyTruth] = {}
    for record in read_log(GOLDEN):
        if isinstance(record.message, BodyTruth):
            found.setdefault(record.message.body, record.message)
    return found


def test_bodies_start_where_they_were() -> None:
    twin, truth = twin_of(GOLDEN), first_truth()
    target = truth["target"]
    np.testing.assert_allclose(twin.target.position_m, target.position_m, atol=1e-9)
    np.testing.assert_allclose(twin.target.velocity_m_s, target.velocity_m_s, atol=1e-9)
    np.testing.assert_allclose(twin.target.omega_rad_s, target.omega_rad_s, atol=1e-9)
    q_target = np.array(twin.target.q_wxyz)
    for i, own in enumerate(twin.chasers):
        true = truth[f"chaser/{i}"]
        place = np.array(own.position_m) + own.start_offset_m
        at = np.array(twin.target.position_m) + rotations.rotate(q_target, place)
        np.testing.assert_allclose(at, true.position_m, atol=1e-9)
        q = rotations.multiply(
            q_target, rotations.multiply(own.q_wxyz, rotations.exp(own.start_rotation_rad))
        )
        turn = rotations.log(rotations.multiply(rotations.conjugate(true.q_wxyz), q))
        assert np.linalg.norm(turn) < 1e-9


def test_its_timeline_is_that_of_the_flight() -> None:
    twin = twin_of(GOLDEN)
    assert [(e.command, e.chasers) for e in twin.timeline] == [("approach", (0,))]
    assert twin.timeline[0].at_s == pytest.approx(0.6)
    assert (twin.name, twin.lab) == ("two-chaser-tracking-twin", None)


def test_a_flight_of_unknown_motion_has_no_twin(tmp_path: Path) -> None:
    log = without_truth(GOLDEN, tmp_path / "log.mcap")
    with pytest.raises(TwinError, match=r"no reference of target, chaser/0, chaser/1"):
        twin_of(log)
