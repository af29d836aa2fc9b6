# SPDX-License-Identifier: Apache-2.0
"""Images of free-running cameras, exposed between ticks, are used at their own time."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import msgspec
import numpy as np
import pytest
from chaserdock_controller.estimation.joint import JointEstimator
from chaserdock_controller.estimation.joint.between_ticks import split_tick
from chaserdock_controller.estimation.joint.replay import FilterTick
from chaserdock_controller.estimation.types import MeasuredChaser
from chaserdock_controller.interfaces import AppliedImpulse
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.messages import Sighting
from chaserdock_protocol.scenario import load_scenario
from joint_cases import PERIOD_S, SyntheticFlight, navigation, parameters

SCENARIO = load_scenario(Path("scenarios/four-chaser-docking.toml"))
# A camera of 30 Hz that runs freely, and one at the tick's rate with another phase.
EXPOSURES_S = ({0: 0.011, 1: 0.048}, {0: 0.0443, 1: 0.0029})


class WatchersAtRest(SyntheticFlight):
    """Chasers that stay where they are while the target turns and drifts by."""

    def _pull(self, i: int) -> Array:
        s = self.chasers[i].state
        return rotations.rotate_inverse(s[6:10], -1.2 * self.body.mass_kg * s[3:6])

    def _turn(self, i: int) -> Array:
        s, inertia = self.chasers[i].state, np.array(self.body.inertia)
        return -1.2 * inertia * s[10:13] + np.cross(s[10:13], inertia * s[10:13])


def fly(seed: int, stamp_at_tick: bool = False, between: bool = True) -> tuple[float, float]:
    """Fly 12 s. Return the median error of the target's attitude relative to chaser 0, rad, and its
    mean NEES, over the second half. ``between``: expose between the ticks, not at them.
    """
    p = parameters(SCENARIO, navigation("lab"))
    flight = WatchersAtRest(SCENARIO, p.navigation, 2, seed, disturbance=0.005)
    estimator = JointEstimator(p, 2)
    errors, nees = [], []
    seen: list[Sighting] = []
    for k in range(180):
        inputs = flight.inputs()
        if stamp_at_tick:
            seen = [msgspec.structs.replace(s, sim_time_ns=inputs.time_ns) for s in seen]
        if between:
            inputs = dataclasses.replace(inputs, sightings=tuple(seen))
        estimator.update(inputs)
        if k >= 90:
            _, angle, normalized = flight.relative_error(estimator, 0)
            errors.append(angle)
            nees.append(normalized)
        seen = flight.step(EXPOSURES_S[k % 2])
    return float(np.median(errors)), float(np.mean(nees))


@pytest.mark.slow
def test_exposures_between_ticks_are_as_consistent_as_at_ticks() -> None:
    between = np.mean([fly(seed) for seed in range(12)], axis=0)
    at_ticks = np.mean([fly(seed, between=False) for seed in range(12)], axis=0)
    ratios = between / at_ticks
    assert (ratios > 0.7).all()
    assert (ratios < 1.4).all()


def test_a_sighting_stamped_at_the_tick_in_place_of_its_exposure_costs_accuracy() -> None:
    angle, nees = fly(7)
    shifted_angle, shifted_nees = fly(7, stamp_at_tick=True)
    assert shifted_angle > 2.0 * angle
    assert shifted_nees > 4.0 * nees


def test_the_order_of_arrival_of_exposures_between_ticks_changes_nothing() -> None:
    def states(late: bool) -> list[bytes]:
        p = parameters(SCENARIO, navigation("lab"))
        flight = SyntheticFlight(SCENARIO, p.navigation, 2, 5, disturbance=0.005)
        estimator, seen, held = JointEstimator(p, 2), [], []
        for k in range(30):
            given = (*held, *seen) if k % 3 == 2 else () if late else tuple(seen)
            held = [*held, *seen] if late and k % 3 != 2 else []
            estimator.update(dataclasses.replace(flight.inputs(), sightings=tuple(given)))
            seen = flight.step(EXPOSURES_S[k % 2])
        assert estimator.newest is not None
        return [h.covariance.tobytes() for h in estimator.newest.hypotheses]

    assert states(late=False) == states(late=True)


def test_a_doubled_exposure_is_used_once() -> None:
    p = parameters(SCENARIO, navigation("lab"))
    results = []
    for copies in (1, 2):
        flight = SyntheticFlight(SCENARIO, p.navigation, 2, 5, disturbance=0.005)
        estimator, seen = JointEstimator(p, 2), []
        for k in range(20):
            estimator.update(dataclasses.replace(flight.inputs(), sightings=(*seen,) * copies))
            seen = flight.step(EXPOSURES_S[k % 2])
        assert estimator.state is not None
        results.append(estimator.state.covariance.tobytes())
    assert results[0] == results[1]


def innovations(late: bool, doubled: bool = False) -> list[tuple[int, int]]:
    """Fly 30 ticks; return exposure and chaser of all innovations, as published."""
    p = parameters(SCENARIO, navigation("lab"))
    flight = SyntheticFlight(SCENARIO, p.navigation, 2, 5, disturbance=0.005)
    estimator, seen, held, found = JointEstimator(p, 2), [], [], []
    for k in range(30):
        given = () if late and k % 3 else (*held, *seen) * (1 + doubled)
        held = [*held, *seen] if late and k % 3 else []
        estimate = estimator.update(dataclasses.replace(flight.inputs(), sightings=tuple(given)))
        assert estimate.innovations is not None
        assert all(x.used and 0.0 < x.squared < 27.0 for x in estimate.innovations)
        found += [(x.sim_time_ns, x.chaser) for x in estimate.innovations]
        seen = flight.step(EXPOSURES_S[k % 2])
    return found


@pytest.mark.parametrize("late", [False, True])
def test_each_exposure_between_ticks_has_one_innovation_however_late_it_is(late: bool) -> None:
    """All but the first one, which starts the estimate."""
    found = innovations(late)
    assert len(set(found)) == len(found)
    assert len(found) >= (51 if late else 57)
    assert innovations(late, doubled=True) == found


@pytest.mark.parametrize("gap_s", [0.0, 0.4 * PERIOD_S, 1.3 * PERIOD_S])
def test_parts_of_a_tick_hold_its_impulse_and_its_first_moment(gap_s: float) -> None:
    """The last estimate may be older than what the impulse covers, as after a lost tick: what acted
    in the gap before is unknown, so that parts there have none.
    """
    rng = np.random.default_rng(4)
    given = AppliedImpulse(
        rng.normal(0, 1, 6), rng.normal(0, 0.01, 6), rng.uniform(1, 2, 6), measured=True
    )
    p = parameters(SCENARIO, navigation("lab"))
    flight = SyntheticFlight(SCENARIO, p.navigation, 2, 5)
    seen = flight.step({0: 0.011, 1: 0.048})
    time_ns = flight.time_ns
    covered_from_ns = time_ns - round(PERIOD_S * 1e9)
    begin_ns = covered_from_ns - round(gap_s * 1e9)
    if gap_s:
        early_ns = begin_ns + round(0.3 * gap_s * 1e9)
        seen = [msgspec.structs.replace(seen[1], sim_time_ns=early_ns), *seen]
    chasers = (MeasuredChaser(0, given, contact=True), MeasuredChaser(1, given))
    record = FilterTick(
        time_ns=time_ns, parameters=p.target, covered_s=PERIOD_S, chasers=chasers, between=seen
    )
    parts = split_tick(begin_ns, record)
    assert [q.time_ns for q in parts] == [*(s.sim_time_ns for s in seen), time_ns]
    total = sum(q.chasers[1].impulse.impulse for q in parts)
    np.testing.assert_allclose(total, given.impulse, rtol=1e-7)
    # Process noise, whose variance goes by the square of the magnitude, is that of the whole tick.
    noise = sum(q.chasers[1].impulse.magnitude ** 2 for q in parts)
    np.testing.assert_allclose(noise, given.magnitude**2, rtol=1e-7)
    # About the middle of what is covered: each part's own moment, and its impulse times its lead.
    middle_s, moment, end_ns = PERIOD_S / 2, np.zeros(6), begin_ns
    for part in parts:
        from_ns, end_ns = max(end_ns, covered_from_ns), part.time_ns
        from_s, to_s = ((t - covered_from_ns) / 1e9 for t in (from_ns, max(end_ns, from_ns)))
        own = part.chasers[1].impulse
        assert part.covered_s == pytest.approx(to_s - from_s, abs=1e-9)
        share = (to_s - from_s) / PERIOD_S
        np.testing.assert_allclose(own.impulse, share * given.impulse, rtol=1e-7)
        moment += own.moment + own.impulse * (middle_s - (from_s + to_s) / 2)
    np.testing.assert_allclose(moment, given.moment, atol=1e-8)
    assert [q.chasers[0].contact for q in parts] == [False] * len(seen) + [True]
