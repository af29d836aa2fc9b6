# SPDX-License-Identifier: Apache-2.0
"""The paper's combiner: a mean over the last poses, with its known faults."""

from __future__ import annotations

import dataclasses
import math
import random

import msgspec
import numpy as np
import pytest
from chaserdock_controller.estimation.paper import (
    PaperEstimator,
    PaperParameters,
    average_quaternion,
)
from chaserdock_controller.estimation.types import Estimate, no_estimate
from chaserdock_controller.interfaces import TargetState
from chaserdock_models import rotations as rot
from estimation_cases import CAMERA, HZ, V, W, errors, inputs_of, ns, same, see, truth
from joint_cases import changed


def fly(estimator: PaperEstimator, chasers: int, seconds: float) -> list[TargetState]:
    rng = np.random.default_rng(0)
    return [
        estimator.update(inputs_of(ns(k), [see(rng, c, ns(k)) for c in range(chasers)])).target
        for k in range(int(seconds * HZ))
    ]


def test_average_quaternion_ignores_signs() -> None:
    a, b = rot.exp([0.0, 0.0, 0.2]), rot.exp([0.0, 0.0, 0.6])
    np.testing.assert_allclose(average_quaternion([a, -b]), rot.exp([0.0, 0.0, 0.4]), atol=1e-12)
    with pytest.raises(ValueError, match="no quaternions"):
        average_quaternion([])


def test_wrong_parameters_are_refused() -> None:
    with pytest.raises(ValueError, match="window"):
        PaperParameters(window=0)


def test_paper_estimator_follows_with_its_known_faults() -> None:
    d = np.array([errors(e) for e in fly(PaperEstimator(CAMERA), 2, 20.0)[10 * HZ :]])
    rms = np.sqrt((d.reshape(-1, 4, 3) ** 2).sum(axis=2).mean(axis=0))
    lag_s = 2.0 / HZ  # of a mean over five poses
    assert 0.8 * lag_s * np.linalg.norm(V) < rms[0] < 2.0 * lag_s * np.linalg.norm(V)
    assert 0.8 * lag_s * np.linalg.norm(W) < rms[2] < 2.0 * lag_s * np.linalg.norm(W)
    assert rms[1] < 5e-3
    assert math.radians(0.05) < rms[3] < math.radians(1.0)
    e = fly(PaperEstimator(CAMERA), 2, 1.0)[-1]
    assert np.isfinite(e.covariance).all()


def test_paper_estimator_removes_outliers_and_recovers() -> None:
    rng = np.random.default_rng(0)
    f = PaperEstimator(CAMERA)
    e = no_estimate(0)
    for k in range(30):
        shift = np.array([0.5, 0.0, 0.0]) if k == 20 else None
        seen = [see(rng, 0, ns(k), shift), see(rng, 1, ns(k)), see(rng, 2, ns(k))]
        e = f.update(inputs_of(ns(k), seen)).target
        assert e.rejected == ((0,) if k == 20 else ())
    assert np.linalg.norm(errors(e)[:3]) < 0.01
    jump = np.array([0.0, 3.0, 0.0])
    states = [f.update(inputs_of(ns(k), [see(rng, 0, ns(k), jump)])) for k in range(60, 80)]
    assert f.reinitialisations == 1
    assert [e.text for s in states for e in s.events] == ["re-initialised"]
    p, q = truth(ns(79))
    assert np.linalg.norm(p + rot.rotate(q, jump) - states[-1].target.position_m) < 0.05
    assert f.estimate_at(ns(79 + 10 * HZ)).status == "lost"
    assert same(Estimate(f.estimate_at(ns(80))), states[-1])  # held, not predicted


def test_order_within_a_tick_does_not_matter() -> None:
    """Also of sightings that arrive two ticks late."""
    rng, shuffle = np.random.default_rng(1), random.Random(1)
    a, b = PaperEstimator(CAMERA), PaperEstimator(CAMERA)
    for k in range(0, 30, 3):
        seen = [see(rng, c, ns(k + j)) for c in range(3) for j in range(3)]
        for n in range(2):  # their odometry was known before
            for f in (a, b):
                now = [x for x in seen if x[0].sim_time_ns == ns(k + n)]
                f.update(dataclasses.replace(inputs_of(ns(k + n), now), sightings=()))
        inputs = inputs_of(ns(k + 2), seen)
        other = list(inputs.sightings)
        shuffle.shuffle(other)
        found = [a.update(inputs), b.update(dataclasses.replace(inputs, sightings=tuple(other)))]
        assert same(*found)
        assert found[0].events == found[1].events
        assert found[0].target.sightings == 3


def test_sighting_without_its_odometry_waits_for_no_one() -> None:
    """It becomes a pose of the target only when odometry of its exposure is known."""
    f, (odometry, sighting) = PaperEstimator(CAMERA), see(np.random.default_rng(0), 0, ns(0))
    blind = dataclasses.replace(inputs_of(ns(0), []), sightings=(sighting,))
    assert f.update(blind).target.status == "none"
    late = dataclasses.replace(changed(blind, 0, outdated=odometry), time_ns=ns(1))
    assert f.update(late).target.status == "tracking"


def test_chaser_that_sees_nothing_is_left_out() -> None:
    rng, f = np.random.default_rng(0), PaperEstimator(CAMERA)
    far = np.array([0.1, 0.0, 0.0])
    f.update(inputs_of(ns(0), [see(rng, 0, ns(0), far), see(rng, 1, ns(0))]))
    odometry, sighting = see(rng, 0, ns(1))
    unseen = odometry, msgspec.structs.replace(sighting, solutions=(), status="nothing")
    e = f.update(inputs_of(ns(1), [unseen, see(rng, 1, ns(1))])).target
    assert (e.sightings, e.rejected) == (1, ())
