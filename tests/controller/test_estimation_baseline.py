# SPDX-License-Identifier: Apache-2.0
"""The paper's combiner: a mean over the last poses, with its known faults."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from chaserdock_controller.estimation import PaperEstimator
from chaserdock_controller.estimation.baseline import average_quaternion
from chaserdock_controller.estimation.types import no_estimate
from chaserdock_models import rotations as rot
from estimation_cases import (
    HZ,
    V,
    W,
    errors,
    fly,
    ns,
    same,
    see,
    truth,
)


def test_average_quaternion_ignores_signs() -> None:
    a, b = rot.exp([0.0, 0.0, 0.2]), rot.exp([0.0, 0.0, 0.6])
    np.testing.assert_allclose(average_quaternion([a, -b]), rot.exp([0.0, 0.0, 0.4]), atol=1e-12)
    with pytest.raises(ValueError, match="no quaternions"):
        average_quaternion([])


def test_paper_estimator_follows_with_its_known_faults() -> None:
    d = np.array([errors(e) for e in fly(PaperEstimator(), 2, 20.0)[10 * HZ :]])
    rms = np.sqrt((d.reshape(-1, 4, 3) ** 2).sum(axis=2).mean(axis=0))
    lag_s = 2.0 / HZ  # of a mean over five poses
    assert 0.8 * lag_s * np.linalg.norm(V) < rms[0] < 2.0 * lag_s * np.linalg.norm(V)
    assert 0.8 * lag_s * np.linalg.norm(W) < rms[2] < 2.0 * lag_s * np.linalg.norm(W)
    assert rms[1] < 5e-3
    assert math.radians(0.05) < rms[3] < math.radians(1.0)
    e = fly(PaperEstimator(), 2, 1.0)[-1]
    assert np.isfinite(e.covariance).all()


def test_paper_estimator_removes_outliers_and_recovers() -> None:
    rng = np.random.default_rng(0)
    f = PaperEstimator()
    e = no_estimate(0)
    for k in range(30):
        shift = np.array([0.5, 0.0, 0.0]) if k == 20 else None
        group = [see(rng, 0, ns(k), shift=shift), see(rng, 1, ns(k)), see(rng, 2, ns(k))]
        e = f.update(group, ns(k))
        assert e.rejected == ((0,) if k == 20 else ())
    assert np.linalg.norm(errors(e)[:3]) < 0.01
    jump = np.array([0.0, 3.0, 0.0])
    states = [f.update([see(rng, 0, ns(k), shift=jump)], ns(k)) for k in range(60, 80)]
    assert f.reinitialisations == 1
    p, q = truth(ns(79))
    assert np.linalg.norm(p + rot.rotate(q, jump) - states[-1].position_m) < 0.05
    assert f.estimate_at(ns(79 + 10 * HZ)).status == "lost"
    assert same(replace(f.estimate_at(ns(80)), time_ns=ns(79)), states[-1])  # held, not predicted
