# SPDX-License-Identifier: Apache-2.0
"""Odometry that cannot be believed, and sightings that go on disagreeing."""

from __future__ import annotations

import math
from pathlib import Path

import msgspec
import numpy as np
import pytest
from chaserdock_controller.ingest.odometry_validation import OdometryValidation
from chaserdock_controller.ingest.sensor_consistency import AGREES_S, DISAGREES_S, SensorConsistency
from chaserdock_models import rotations
from chaserdock_protocol.codec import vector
from chaserdock_protocol.messages import Odometry
from chaserdock_protocol.scenario import load_scenario
from hypothesis import given, settings
from hypothesis import strategies as st

SCENARIO = load_scenario(Path(__file__).resolve().parents[2] / "scenarios" / "fault-drill.toml")
TIMING = SCENARIO.timing


def flown(tick: int, noise: float = 0.0, seed: int = 0) -> Odometry:
    """A chaser on a curve under 0.01 m/s2, turning at 0.05 rad/s."""
    t = TIMING.tick_time_ns(tick) / 1e9
    off = np.random.default_rng(seed + tick).normal(0.0, 1.0, 3) * noise
    return Odometry(
        tick=tick,
        sim_time_ns=TIMING.tick_time_ns(tick),
        chaser=1,
        position_m=vector(np.array([0.03 * t, 0.005 * t * t, -0.5]) + off),
        velocity_m_s=(0.03, 0.01 * t, 0.0),
        q_wxyz=vector(rotations.exp(np.array([0.0, 0.0, 0.05 * t]))),
        omega_rad_s=(0.0, 0.0, 0.05),
    )


def lying(odometry: Odometry, off_m: tuple[float, float, float], turn_rad: float) -> Odometry:
    return msgspec.structs.replace(
        odometry,
        position_m=vector(np.add(odometry.position_m, off_m)),
        q_wxyz=vector(
            rotations.multiply(odometry.q_wxyz, rotations.exp(np.array([turn_rad, 0.0, 0.0])))
        ),
    )


def test_honest_odometry_is_handed_on_as_it_is() -> None:
    watch = OdometryValidation(SCENARIO)
    for tick in [*range(50), *range(53, 60), 90]:  # some are missing
        assert watch.update(flown(tick)) == (flown(tick), [])


def test_noise_that_the_scenario_admits_is_no_jump() -> None:
    noisy = SCENARIO.model_copy(
        update={"navigation": SCENARIO.navigation.model_copy(update={"position_noise_m": 0.02})}
    )
    watch = OdometryValidation(noisy)
    assert [watch.update(flown(tick, 0.02))[1] for tick in range(200)] == [[]] * 200


@given(
    off=st.tuples(*[st.floats(-0.5, 0.5)] * 3).filter(lambda v: math.hypot(*v) > 0.06),
    turn=st.floats(-0.4, 0.4),
)
@settings(derandomize=True, deadline=None, max_examples=50)
def test_jump_is_excluded_and_its_begin_and_end_are_reported_once(
    off: tuple[float, float, float], turn: float
) -> None:
    watch, events_at = OdometryValidation(SCENARIO), []
    for tick in range(60):
        lie = 20 <= tick < 40
        given_, events = watch.update(lying(flown(tick), off, turn) if lie else flown(tick))
        events_at += [(tick, level) for level, _ in events]
        assert math.dist(given_.position_m, flown(tick).position_m) < 0.005
        assert float(rotations.angle_between(given_.q_wxyz, flown(tick).q_wxyz)) < math.radians(0.5)
        if not lie:
            assert given_ == flown(tick)
    assert events_at == [(20, "warning"), (40, "info")]


def test_after_long_silence_anything_is_believed() -> None:
    watch = OdometryValidation(SCENARIO)
    watch.update(flown(0))
    far = lying(flown(30), (3.0, 0.0, 0.0), 0.0)
    assert watch.update(far) == (far, [])


def test_agreement() -> None:
    watches, events_at = [SensorConsistency(i) for i in range(3)], []
    for tick in range(100):
        now_s = tick / 16  # exact
        rejected = {2} if 30 <= tick < 60 or tick in (10, 12, 80) else set()
        seen = {0, 1, 2} if tick % 3 else {0, 2}
        found = [watches[i].update(now_s, True) for i in sorted(seen - rejected)]
        found += [watches[i].update(now_s, False) for i in sorted(rejected)]
        events_at += [(tick, *event) for event in found if event is not None]
    # A single chaser, or one that alone sees the target, has no others to disagree with.
    assert events_at == [
        (
            40,
            "warning",
            "chaser 2: sightings disagree with the estimate: camera or odometry fault",
        ),
        (70, "info", "chaser 2: sightings agree with the estimate again"),
    ]


def test_odometry_is_doubtful_until_sightings_agree_since_it_was_interrupted() -> None:
    """Sightings of chaser 1 disagree from 2 to 3 s and from 5 to 6 s; its odometry is interrupted
    until 1 s, and from 4 to 5 s.
    """
    watch, doubtful_at = SensorConsistency(1), []
    for tick in range(160):
        now_s = tick / 16  # exact
        rejected = 2.0 <= now_s < 3.0 or 5.0 <= now_s < 6.0
        if now_s < 1.0 or 4.0 <= now_s < 5.0:
            watch.interrupt(now_s)
        else:
            watch.update(now_s, not rejected)
        doubtful_at += [now_s] if watch.doubtful else []
    # From 2 to 3 s, after a second of agreement, a camera fault is likelier: a jump of the odometry
    # would have been noticed.
    assert doubtful_at[0] == pytest.approx(5.0 + DISAGREES_S, abs=1 / 16)
    assert doubtful_at[-1] == pytest.approx(6.0 + AGREES_S, abs=1 / 16)
    assert len(doubtful_at) == (doubtful_at[-1] - doubtful_at[0]) * 16 + 1


def test_jump_of_doubtful_odometry_is_accepted() -> None:
    watch = OdometryValidation(SCENARIO)
    for tick in range(20):
        assert watch.update(lying(flown(tick), (0.2, 0.0, 0.0), 0.1), doubtful=tick > 10)[1] == []
    odometry, events = watch.update(flown(20), doubtful=True)
    assert odometry == flown(20)
    assert [level for level, _ in events] == ["warning"]
    assert watch.update(flown(21)) == (flown(21), [])


@pytest.mark.parametrize("gap", [1, 2, 5])
def test_the_limit_grows_with_the_time_between(gap: int) -> None:
    """A displacement that full thrust can cause in the time is no jump."""
    body = SCENARIO.chaser
    dt = gap / SCENARIO.time.rate_hz
    watch = OdometryValidation(SCENARIO)
    first = flown(0)
    watch.update(first)
    moved = 0.5 * body.force_max_N / body.mass_kg * dt**2
    later = msgspec.structs.replace(
        flown(gap), position_m=vector(np.add(first.position_m, [0.03 * dt + moved, moved, moved]))
    )
    assert watch.update(later)[1] == []
