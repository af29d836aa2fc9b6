# SPDX-License-Identifier: Apache-2.0
"""The MEKF with blind, faulty and ambiguous cameras, and with a target that jumps."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from chaserdock_controller.estimation import Measurement, Mekf, MekfParameters, PoseHypothesis
from chaserdock_controller.estimation.types import no_estimate
from chaserdock_models import rotations as rot
from estimation_cases import (
    HZ,
    NO_BIAS,
    V,
    W,
    errors,
    eye_of,
    fly,
    nees,
    ns,
    see,
)
from scipy.stats import chi2

NEES_LIMIT = float(chi2.ppf(0.999, 12))


def test_prediction_without_measurements_stays_consistent() -> None:
    f = Mekf(NO_BIAS)
    rng = np.random.default_rng(4)
    last = fly(f, 2, 10.0, seed=4)[-1]
    e = no_estimate(0)
    for k in range(10 * HZ, 15 * HZ):
        e = f.update([Measurement(c, ns(k), (), 0, eye_of(c, ns(k))) for c in range(2)], ns(k))
    assert (e.status, e.sightings) == ("predicting", 0)
    assert nees(e) < NEES_LIMIT
    assert np.all(np.diag(e.covariance) > np.diag(last.covariance))
    e = f.update([see(rng, c, ns(15 * HZ)) for c in range(2)], ns(15 * HZ))
    assert (e.status, e.sightings, e.rejected) == ("tracking", 2, ())
    assert f.reinitialisations == 0


def test_reacquisition_keeps_the_rates() -> None:
    f = Mekf()
    rng = np.random.default_rng(4)
    fly(f, 1, 5.0, seed=4)
    omega = f.estimate_at(ns(5 * HZ)).omega_rad_s
    k = 400 * HZ
    assert f.update([], ns(k)).status == "lost"
    assert [t for _, _, t in f.drain_events()].count("lost") == 1
    e = f.update([see(rng, 0, ns(k + 1))], ns(k + 1))
    assert e.status == "tracking"
    assert np.linalg.norm(e.omega_rad_s - omega) < 1e-12
    assert f.reinitialisations == 1
    assert "reacquired by chaser 0" in [t for _, _, t in f.drain_events()]


def test_vague_first_measurements_accumulate() -> None:
    """One small far marker, 8 degrees a frame: "lost" at first, but not begun again every time."""
    f = Mekf()
    rng = np.random.default_rng(16)
    vague = np.diag([0.01**2] * 3 + [math.radians(8.0) ** 2] * 3)
    states = []
    for k in range(4 * HZ):
        m = see(rng, 0, ns(k), markers=1)
        h = m.hypotheses[0]
        q = rot.multiply(h.q_wxyz, rot.exp(rng.normal(size=3) * math.radians(8.0)))
        h = PoseHypothesis(h.position_m + rng.normal(size=3) * 0.01, q, vague)
        states.append(f.update([replace(m, hypotheses=(h,))], ns(k)))
    assert states[0].status == "lost"
    assert states[-1].status == "tracking"
    assert f.reinitialisations == 0
    assert f.accepted == 4 * HZ
    assert nees(states[-1]) < NEES_LIMIT
    assert math.degrees(np.linalg.norm(errors(states[-1])[6:9])) < 6.0


def test_faulty_first_camera_is_outvoted_by_cameras_at_other_times() -> None:
    f = Mekf()
    rng = np.random.default_rng(17)
    e = no_estimate(0)
    for k in range(4 * HZ):
        for c in range(3):
            t = ns(k) + c * 20_000_000
            if c == 0 or k > HZ:
                shift = np.array([0.0, 0.2, 0.0]) if c == 0 else None
                e = f.update([see(rng, c, t, shift=shift)], t)
    assert f.reinitialisations == 1
    assert (e.sightings, e.rejected) == (1, ())
    assert np.linalg.norm(errors(e)[:3]) < 2e-3
    assert f.estimate_at(ns(4 * HZ - 1)).rejected == (0,)


@pytest.mark.parametrize("faulty", [0, 1, 2])
@pytest.mark.parametrize("alone_s", [0, 1])
def test_faulty_camera_among_three_is_gated_out(faulty: int, alone_s: int) -> None:
    """20 cm and 15 degrees off all the time; also when it was the only one to see the target at
    first.
    """
    f = Mekf()
    rng = np.random.default_rng(6)
    shift, turn = np.array([0.2, 0.0, 0.0]), np.array([0.0, 0.0, math.radians(15.0)])
    e = no_estimate(0)
    for k in range((5 + alone_s) * HZ):
        group = [
            see(rng, c, ns(k), shift=shift, turn=turn) if c == faulty else see(rng, c, ns(k))
            for c in range(3)
            if c == faulty or k >= alone_s * HZ
        ]
        e = f.update(group, ns(k))
    assert e.rejected == (faulty,)
    assert e.sightings == 2
    assert np.linalg.norm(errors(e)[:3]) < 2e-3
    assert np.linalg.norm(errors(e)[6:9]) < math.radians(0.3)
    texts = [t for _, _, t in f.drain_events()]
    assert f"chaser {faulty} gated out: 10 in a row" in texts
    assert f.reinitialisations == (1 if alone_s else 0)


def test_faulty_camera_does_not_lead_while_the_prediction_is_vague() -> None:
    """All cameras return together after an outage that left a wide but not lost prediction."""
    f = Mekf(
        replace(
            MekfParameters(),
            acceleration_noise_m_s2_sqrt_hz=3e-3,
            angular_noise_rad_s2_sqrt_hz=3e-3,
        )
    )
    rng = np.random.default_rng(8)
    fly(f, 3, 4.0, seed=8)
    k = 12 * HZ
    assert f.estimate_at(ns(k)).status == "predicting"
    group = [
        see(rng, 0, ns(k), shift=np.array([0.03, 0.0, 0.0])),
        see(rng, 1, ns(k)),
        see(rng, 2, ns(k)),
    ]
    e = f.update(group, ns(k))
    assert e.rejected == (0,)
    assert e.sightings == 2


def test_gross_outliers_are_rejected() -> None:
    f = Mekf()
    rng = np.random.default_rng(9)
    bad = 0
    e = no_estimate(0)
    for k in range(10 * HZ):
        outlier = k > 10 and rng.random() < 0.2
        shift = rng.normal(size=3) if outlier else None
        e = f.update([see(rng, 0, ns(k), shift=shift), see(rng, 1, ns(k))], ns(k))
        bad += outlier
    assert bad > 15
    assert f.gated == bad
    assert np.linalg.norm(errors(e)[:3]) < 2e-3


def test_a_jump_of_the_target_re_initialises_and_keeps_the_rates() -> None:
    f = Mekf()
    rng = np.random.default_rng(10)
    fly(f, 2, 5.0, seed=10)
    jump = np.array([0.0, 0.5, 0.0])
    states = [
        f.update([see(rng, c, ns(k), shift=jump) for c in range(2)], ns(k)) for k in range(75, 95)
    ]
    assert [s.sightings for s in states] == [0] * 9 + [2] * 11
    assert states[8].status == "predicting"
    assert f.reinitialisations == 1
    assert any(t.startswith("re-initialised") for _, _, t in f.drain_events())
    e = states[9]
    assert np.linalg.norm(e.omega_rad_s - W) < math.radians(1.0)
    assert np.linalg.norm(e.velocity_m_s - V) < 0.02


FLIP = np.array([0.0, math.radians(40.0), 0.0])


def test_ambiguous_measurements_are_resolved_by_innovation() -> None:
    f = Mekf()
    rng = np.random.default_rng(11)
    fly(f, 1, 2.0, seed=11)
    for k in range(30, 90):
        e = f.update([see(rng, 0, ns(k), flip=FLIP, wrong_first=bool(k % 3))], ns(k))
        assert np.linalg.norm(errors(e)[6:9]) < math.radians(1.5)
    assert f.gated == 0


@pytest.mark.parametrize("wrong_first", [False, True])
@pytest.mark.parametrize("helper", ["same exposure", "later", "own second look"])
def test_an_ambiguous_start_is_resolved(wrong_first: bool, helper: str) -> None:
    f = Mekf()
    rng = np.random.default_rng(12)
    e = no_estimate(0)
    for k in range(40):
        flip = None if helper == "own second look" and k >= 10 else FLIP
        group = [see(rng, 0, ns(k), flip=flip, wrong_first=wrong_first, markers=1)]
        if helper == "same exposure" or (helper == "later" and k >= 10):
            group.append(see(rng, 1, ns(k)))
        e = f.update(group, ns(k))
        if (
            helper != "same exposure" and k == 5
        ):  # both attitudes are still open, and the covariance says so
            assert math.sqrt(e.covariance[7, 7]) > math.radians(10.0)
    assert np.linalg.norm(errors(e)[6:9]) < math.radians(0.5)
    assert math.sqrt(e.covariance[7, 7]) < math.radians(1.0)
    resolved = "ambiguity resolved" in [t for _, _, t in f.drain_events()]
    assert resolved == (helper != "same exposure")
    assert f.reinitialisations == 0


def test_unresolved_ambiguity_times_out() -> None:
    f = Mekf()
    rng = np.random.default_rng(13)
    e = no_estimate(0)
    for k in range(6 * HZ):
        e = f.update([see(rng, 0, ns(k), flip=FLIP)], ns(k))
    assert any("timed out" in t for _, _, t in f.drain_events())
    assert math.sqrt(e.covariance[7, 7]) < math.radians(2.0)


def test_a_single_first_marker_starts_wider() -> None:
    covariances = []
    for markers in (1, 4):
        e = Mekf(NO_BIAS).update([see(np.random.default_rng(0), 0, 0, markers=markers)], 0)
        covariances.append(np.diag(e.covariance)[[0, 1, 2, 6, 7, 8]])
    np.testing.assert_allclose(covariances[0], 9.0 * covariances[1])


def test_one_of_two_cameras_that_errs_does_not_re_initialise() -> None:
    """Half of the cameras are no majority."""
    f = Mekf()
    rng = np.random.default_rng(11)
    fly(f, 2, 5.0, seed=11)
    e = no_estimate(0)
    for k in range(75, 105):
        shift = np.array([0.0, 0.5, 0.0])
        e = f.update([see(rng, 0, ns(k)), see(rng, 1, ns(k), shift=shift)], ns(k))
    assert f.reinitialisations == 0
    assert (e.sightings, e.rejected) == (1, (1,))
    assert np.linalg.norm(errors(e)[:3]) < 5e-3
