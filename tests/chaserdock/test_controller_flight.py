# SPDX-License-Identifier: Apache-2.0
"""The controller by itself: the offline loop, the perfect estimator, and the least possible
transient.
"""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pytest
from chaserdock_models import rotations
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_world.physics.simulation import prescribed_state
from harness import SHORT
from hypothesis import given, settings
from hypothesis import strategies as st

from chaserdock.experiments.controller_flight import fly_alone, fly_on_images
from chaserdock.experiments.flight_record import record_flight
from chaserdock.experiments.least_transient import gauss_times, least_square_integral
from chaserdock.experiments.perfect_knowledge import PerfectEstimator
from chaserdock.experiments.plan import Alone

SCENARIOS = Path(__file__).resolve().parents[2] / "scenarios"
LEVEL = np.array([1.0, 0.0, 0.0, 0.0])


def scenario(name: str, *overrides: str) -> Scenario:
    return load_scenario(SCENARIOS / f"{name}.toml", overrides)


# -- the floor -------------------------------------------------------------------------------------


def box_least_squares(matrix: np.ndarray, target: np.ndarray, bound: float) -> float:
    """min |matrix u + target|^2 with |u| <= bound by an active set on the normal equations: no
    ipopt, no CasADi.
    """
    n = matrix.shape[1]
    u, fixed = np.zeros(n), np.zeros(n, dtype=bool)
    for _ in range(50 * n):
        free = ~fixed
        step = np.zeros(n)
        rest = target + matrix @ u
        if free.any():
            step[free] = -np.linalg.lstsq(matrix[:, free], rest, rcond=None)[0]
        with np.errstate(divide="ignore", invalid="ignore"):
            room = np.where(np.abs(step) > 1e-15, (np.sign(step) * bound - u) / step, np.inf)
        length = min(1.0, float(room.min()))
        u = u + length * step
        if length < 1.0:
            hit = int(np.argmin(room))
            u[hit], fixed[hit] = math.copysign(bound, u[hit]), True
            continue
        slope = 2 * matrix.T @ (matrix @ u + target)
        inward = np.where(fixed, slope * np.sign(u), -np.inf)  # > 0: leaving the bound is cheaper
        if inward.max() <= 1e-9:
            return float(np.sum((matrix @ u + target) ** 2))
        fixed[int(np.argmax(inward))] = False
    raise AssertionError("the independent solution did not settle")


def condensed(
    error_m: float, speed_m_s: float, steps: int, h: float
) -> tuple[np.ndarray, np.ndarray]:
    """Weighted errors at the Gauss points of a double integrator on one axis: matrix @
    accelerations + target.
    """
    rows, target = [], []
    for k in range(steps):
        for at, weight in (
            (0.5 - math.sqrt(0.15), 5 / 18),
            (0.5, 8 / 18),
            (0.5 + math.sqrt(0.15), 5 / 18),
        ):
            t = (k + at) * h
            row = np.zeros(steps)
            for j in range(k):
                row[j] = h * (t - (j + 0.5) * h)
            row[k] = (at * h) ** 2 / 2
            rows.append(row * math.sqrt(weight * h))
            target.append((error_m + speed_m_s * t) * math.sqrt(weight * h))
    return np.array(rows), np.array(target)


@settings(max_examples=8, deadline=None)
@given(
    st.tuples(st.floats(-1, 1), st.floats(-1, 1), st.floats(-1, 1)),
    st.tuples(st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-0.1, 0.1)),
)
def test_floor_is_the_independent_solution(
    error: tuple[float, float, float], speed: tuple[float, float, float]
) -> None:
    steps, h, a = 25, 0.4, 2 / 30
    ours = least_square_integral(
        np.array(error),
        np.array(speed),
        np.zeros((3 * steps + 1, 3)),
        np.tile(LEVEL, (steps, 1)),
        h,
        a,
    )
    other = sum(
        box_least_squares(*condensed(e, v, steps, h), a) for e, v in zip(error, speed, strict=True)
    )
    assert ours == pytest.approx(other, rel=1e-4, abs=1e-7)


def straight(
    q: np.ndarray, direction: tuple[float, float, float], distance_m: float = 0.85
) -> float:
    steps, h = 300, 0.05
    start = distance_m * np.array(direction)
    references = np.zeros((3 * steps + 1, 3))
    return (
        least_square_integral(start, np.zeros(3), references, np.tile(q, (steps, 1)), h, 2 / 30)
        / 120
    )


def test_floor_of_known_transients() -> None:
    """Bang-bang, rest to rest: 0.767 d^2.5 / sqrt(a) over the time; the best is a little below.
    Notes: 1.63e-2, 1.25e-2.
    """
    bang_bang = (
        2
        * (1 - 1 / 3 + 1 / 20 + 1 / 20)
        / math.sqrt(4)
        * 0.85**2
        * math.sqrt(0.85 / (2 / 30))
        / 120
    )
    along = straight(LEVEL, (-1, 0, 0))
    assert along == pytest.approx(1.63e-2, rel=0.01)
    assert 0.98 * bang_bang < along < bang_bang
    assert straight(LEVEL, (-0.6, 0.64, 0.48)) == pytest.approx(1.25e-2, rel=0.01)


def test_floor_knows_the_body_axes() -> None:
    """Turned by 45 degrees two axes push together, sqrt(2) as strong; a roll about the way changes
    nothing.
    """
    along = straight(LEVEL, (-1, 0, 0))
    rolled = straight(rotations.exp([0.575, 0, 0]), (-1, 0, 0))
    turned = straight(rotations.exp([0, 0, math.pi / 4]), (-1, 0, 0))
    assert rolled == pytest.approx(along, rel=1e-6)
    assert turned == pytest.approx(along / 2**0.25, rel=1e-3)


def test_floor_refuses_what_does_not_fit() -> None:
    with pytest.raises(ValueError, match="references_m must have shape"):
        least_square_integral(
            np.zeros(3), np.zeros(3), np.zeros((5, 3)), np.tile(LEVEL, (2, 1)), 0.1, 1.0
        )
    assert gauss_times(2, 0.1)[[1, 4, 6]] == pytest.approx([0.05, 0.15, 0.2])


# -- the loop --------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["single", "collision-avoidance"])
def test_perfect_estimate_is_the_worlds_target(name: str) -> None:
    s = scenario(name)
    estimator = PerfectEstimator(s.target)
    for time_s in (0.0, 2.5, 119.0):
        known, true = estimator.estimate_at(round(time_s * 1e9)), prescribed_state(s, time_s)
        assert np.allclose(known.position_m, true.position_m, atol=1e-12)
        assert rotations.angle_between(known.q_wxyz, true.q_wxyz) < 1e-9
        assert np.array_equal(known.velocity_m_s, true.velocity_m_s)
        assert np.array_equal(known.omega_rad_s, true.omega_rad_s)


def test_perfect_estimate_refuses_a_free_target() -> None:
    with pytest.raises(ValueError, match="needs constant_rates or static"):
        PerfectEstimator(scenario("single", "target.motion='torque_free'").target)


@pytest.mark.slow
def test_no_flight_is_better_than_the_floor() -> None:
    """And the paper's settings come near it: the table is about this transient."""
    summary = fly_alone(scenario("paper-single", "duration_s=25.0"), Alone(floor=True))
    position_mse_m2 = summary["chasers"]["0"]["position_mse_m2"]
    assert 1.0 < position_mse_m2 * 25.0 / summary["floor_m2_s"] < 1.2
    assert summary["solver"]["failures"] == 0


@pytest.mark.slow
def test_flight_on_images_has_the_errors_of_a_recorded_one(short_flight: Path) -> None:
    recorded = json.loads((short_flight / "summary.json").read_text())["chasers"]
    flown = fly_on_images(scenario("two-chaser-tracking", *SHORT))["chasers"]
    assert recorded.keys() == flown.keys() == {"0", "1"}
    for chaser, figures in flown.items():
        known = {name: recorded[chaser][name] for name in figures}
        for found, value in ((figures.pop("steady"), known.pop("steady")), (figures, known)):
            assert found == pytest.approx(value, rel=1e-9)


@pytest.mark.slow
def test_delay_makes_long_horizons_fail_first() -> None:
    """With a delay of half a second T = 10 diverges, T = 3 does not."""

    def worst(horizon_s: float, delay_s: float) -> float:
        s = scenario("paper-single", "duration_s=40.0", f"controller.horizon_s={horizon_s}")
        return float(
            record_flight(s, solve_delay_s=lambda _: delay_s).position_error_m[-150:].max()
        )

    assert worst(10.0, 0.1) < 0.02
    assert worst(3.0, 0.5) < 0.05
    assert worst(10.0, 0.5) > 1.0


def test_delay_counts_missed_ticks() -> None:
    s = scenario("paper-single", "duration_s=3.0")
    assert len(record_flight(s).solve_s) == 90
    assert len(record_flight(s, solve_delay_s=lambda _: 0.1).solve_s) == 30


@pytest.mark.slow
def test_collision_avoidance_keeps_away_from_the_target() -> None:
    """From exact symmetry: the straight way leads through the centre."""
    trace = record_flight(scenario("collision-avoidance"))
    positions = trace.states[:, :, :3]
    assert np.linalg.norm(positions[:, 0], axis=1).min() >= 0.35
    assert np.linalg.norm(positions[:, 0] - positions[:, 1], axis=1).min() >= 0.35
    there = np.linalg.norm(positions[:, 0] - [1.0, 0.0, 0.0], axis=1) < 0.02
    assert there[trace.time_s >= 70.0].all()
