# SPDX-License-Identifier: Apache-2.0
"""Figures and criteria of the maps of an unknown target, and the frame in which it is judged."""

from __future__ import annotations

from typing import Any

import msgspec
import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import LandmarkMap, MappedMotion
from chaserdock_protocol.scenario import Scenario, load_scenario
from message_samples import BY_TYPE, PORT
from source_tree import ROOT

from chaserdock.analysis.mapping import (
    FittedFrame,
    mapping_criteria,
    mapping_of,
    mapping_text,
    ports_at,
)
from chaserdock.analysis.motion import Track

OMEGA = np.array([0.02, -0.05, 0.03])
TIMES = np.arange(0.0, 60.0, 0.5)


def scenario() -> Scenario:
    return load_scenario(ROOT / "scenarios/unknown-inspection.toml")


def turning() -> Track:
    """Return the motion of a target that turns and drifts, in general position."""
    q = rotations.multiply(rotations.exp([0.4, -0.7, 0.2]), rotations.exp(TIMES[:, None] * OMEGA))
    velocity = np.tile([0.01, -0.02, 0.005], (len(TIMES), 1))
    return Track(
        TIMES, TIMES[:, None] * velocity + [0.3, 0.1, -0.2], velocity, q,
        np.tile(OMEGA, (len(TIMES), 1)), np.zeros(len(TIMES)), np.zeros(len(TIMES)),
    )  # fmt: skip


def in_frame(true: Track, q: Array, origin: Array) -> Track:
    return FittedFrame(q, origin).frame_of(true)


def test_the_frame_of_a_map_is_found_in_the_flight() -> None:
    true, q, origin = turning(), rotations.exp([1.1, 0.6, -0.9]), np.array([0.05, -0.12, 0.2])
    estimate = in_frame(true, q, origin)
    fit = FittedFrame.of(estimate, true)
    assert rotations.angle_between(fit.q_wxyz, q) < 1e-9
    assert np.allclose(fit.origin_m, origin)
    again = fit.frame_of(true)
    assert np.allclose(again.position_m, estimate.position_m)
    assert np.allclose(rotations.angle_between(again.q_wxyz, estimate.q_wxyz), 0.0, atol=1e-7)


def test_rates_and_velocities_of_the_frame_are_derivatives_of_its_pose() -> None:
    frame = in_frame(turning(), rotations.exp([1.1, 0.6, -0.9]), np.array([0.05, -0.12, 0.2]))
    step_s = TIMES[1] - TIMES[0]
    moved = (frame.position_m[2:] - frame.position_m[:-2]) / (2.0 * step_s)
    assert np.abs(moved - frame.velocity_m_s[1:-1]).max() < 1e-4
    turned = rotations.multiply(rotations.conjugate(frame.q_wxyz[:-1]), frame.q_wxyz[1:])
    assert np.abs(rotations.log(turned) / step_s - frame.omega_rad_s[:-1]).max() < 1e-9


def message(time_s: float, **changes: Any) -> LandmarkMap:
    """Return a map whose axes differ from the target's, and whose rate is 1 % too large."""
    q_map, true = rotations.exp([1.1, 0.6, -0.9]), turning()
    row = int(np.argmin(np.abs(TIMES - time_s)))
    motion = BY_TYPE[LandmarkMap].motion  # pyright: ignore[reportAttributeAccessIssue]
    assert isinstance(motion, MappedMotion)
    q = rotations.multiply(true.q_wxyz[row], q_map)
    motion = msgspec.structs.replace(
        motion,
        q_wxyz=tuple(q.tolist()),
        omega_rad_s=tuple((1.01 * rotations.rotate_inverse(q_map, OMEGA)).tolist()),
    )
    plain = msgspec.structs.replace(
        BY_TYPE[LandmarkMap], motion=motion, sim_time_ns=round(time_s * 1e9)
    )
    found = msgspec.structs.replace(plain, **changes)
    assert isinstance(found, LandmarkMap)
    return found


NONE_YET = {"status": "does not turn", "motion": None, "landmarks_m": (), "moments_m2": ()}


def test_the_error_of_the_rate_does_not_depend_on_the_frame() -> None:
    maps = [message(2.0, **NONE_YET), message(7.0), message(31.0)]
    found = mapping_of(maps, turning())
    assert found is not None
    assert found["rate_error_share"] == pytest.approx(0.01)
    assert found["first_rate_error_share"] == pytest.approx(0.01)
    assert (found["first_map_s"], found["maps"], found["landmarks"]) == (7.0, 2, 2)
    assert "rate 1.00 % off" in mapping_text(found)
    unknown = mapping_of(maps, None)
    assert unknown is not None
    assert unknown["rate_error_share"] is None
    assert mapping_of([], turning()) is None


def test_the_first_map_whose_loop_has_closed_is_named() -> None:
    maps = [message(7.0, closed=False), message(31.0), message(37.0)]
    for chosen, at_s in ((maps, 31.0), (maps[:1], None)):
        found = mapping_of(chosen, turning())
        assert found is not None
        assert found["closed_s"] == at_s


def test_a_port_is_where_the_map_that_counts_says() -> None:
    moved = msgspec.structs.replace(PORT, position_m=(0.5, 0.25, -0.125))
    maps = [message(7.0, ports=()), message(13.0), message(19.0, ports=(moved,))]
    times = np.array([0.0, 16.9, 17.0, 22.9, 23.0, 40.0])
    at, axis = ports_at(maps, 4.0, PORT.chaser, times)
    before, first, last = np.zeros(3), np.array(PORT.position_m), np.array(moved.position_m)
    assert np.array_equal(at, [before, before, first, first, last, last])
    assert np.array_equal(axis[:3], [before, before, np.array(PORT.axis)])
    assert not ports_at(maps, 4.0, 0, times)[1].any()


@pytest.mark.parametrize(
    ("maps", "failures"),
    [
        ([message(7.0)], ["rate error of the last map: 1.00 %, at most 0.5 %"]),
        ([message(7.0, **NONE_YET)], ["first map at", "rate error of the last map"]),
        ([], ["first map at", "rate error of the last map"]),
        (
            [message(7.0), message(20.0, status="scale unknown")],
            ["first map at: 7.00 s", "rate error of the last map"],
        ),
        ([message(17.0)], ["first map at: 17.00 s, at most 15 s", "rate error"]),
    ],
)
def test_criteria_of_a_map(maps: list[LandmarkMap], failures: list[str]) -> None:
    result = {"mapping": mapping_of(maps, turning())}
    rows = [r.failure for r in mapping_criteria(result, scenario()) if r.outcome == "not met"]
    assert len(rows) == len(failures)
    for row, wanted in zip(rows, failures, strict=True):
        assert row.startswith(wanted)
