# SPDX-License-Identifier: Apache-2.0
"""The pull after latching: errors of the estimate are not held against the latch, a slip is."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from chaserdock_controller.guidance import latch_test
from chaserdock_controller.guidance.latch_test import motion_between, why_untold
from chaserdock_controller.guidance.parameters import GUIDANCE
from chaserdock_controller.interfaces import RelativePose
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_protocol.scenario import ScenarioError
from docking_cases import DT_S, Pilot, scenario, senses
from flight_cases import at, drain, step
from general_position import attitude, covariance, matrix
from scipy.stats import chi

SHIPPED = (0.52e-3, 0.05)
"""Standard deviations of the estimate in `docking-contact` at its port, per axis: m, degrees."""


def covariance_of(position_m: float, angle_deg: float) -> Array:
    return np.diag([position_m**2] * 3 + [math.radians(angle_deg) ** 2] * 3)


def outcome_of(slip: Any, covariance: Array, **changes: Any) -> tuple[str, str]:
    """Return the phase after the pull and the last event, of a chaser whose estimated place moves
    by ``slip(t)`` (3,), m, with the time since the pull began.
    """
    pilot = Pilot(**changes)
    pilot.ask("approach")
    pilot.fly_to("latched")
    (chaser,) = pilot.guidance.chasers
    began_s = chaser.state.since_s + pilot.scenario.docking.settle_s
    place = at(chaser.state.move, pilot.now_s)[0]
    while pilot.phase() == "latched":
        assert pilot.now_s < began_s + 5.0
        pilot.now_s += DT_S
        pulled = chaser.state.held is not None
        moved = slip(pilot.now_s - began_s) if pulled else np.zeros(3)
        port = replace(senses(place + moved, latched=True), covariance=covariance)
        step(chaser, pilot.now_s, port=port)
    return pilot.phase(), drain(pilot.guidance)[-1][2]


def test_an_error_that_the_covariance_explains_is_not_held_against_the_latch() -> None:
    """5.07 mm, as with a few markers in view; the same with a certain estimate is a slip."""
    moved = np.array([-3.0, 4.0, 0.837]) * 1e-3
    phase, event = outcome_of(lambda _: moved, covariance_of(1.0e-3, 0.1))
    assert (phase, "moved 5.07 mm (at most 7.07)" in event) == ("verified", True), event
    phase, event = outcome_of(lambda _: moved, covariance_of(*SHIPPED))
    assert (phase, "moved 5.07 mm (at most 5.00)" in event) == ("retreat", True), event


@pytest.mark.parametrize(("sigma_m", "found_m"), [(SHIPPED[0], 5.1e-3), (1e-3, 7.2e-3)])
def test_a_latch_that_slips_slowly_is_found(sigma_m: float, found_m: float) -> None:
    """At a constant speed, 5 or 7 mm in 2 s; a slip of the tolerance or of five sigmas is found."""
    for direction in np.eye(3):
        phase, event = outcome_of(
            lambda t, along=direction: along * found_m * min(1.0, t / 1.9),
            covariance_of(sigma_m, 0.05),
        )
        assert phase == "retreat", event
        assert event.endswith("under the pull")


def test_an_open_latch_is_found_or_the_test_says_that_it_cannot_tell() -> None:
    """The body of `tetra12` moves by 28 mm; with sigmas of 5 mm, 35 mm may be an error."""
    force_N, mass_kg = scenario().docking.pull_N, scenario().chaser.mass_kg

    def free(t: float) -> Array:
        into_s, out_s = min(t, 1.0), min(max(t - 1.0, 0.0), 1.0)
        metres = into_s**2 / 2.0 + into_s * out_s - out_s**2 / 2.0
        return np.array([-metres * force_N / mass_kg, 0.0, 0.0])

    assert free(2.0)[0] == pytest.approx(-28.09e-3, abs=1e-5)
    for sigma_m in (0.5e-3, 1e-3, 2e-3, 3e-3):
        phase, event = outcome_of(free, covariance_of(sigma_m, 0.05))
        assert (phase, event.endswith("under the pull")) == ("retreat", True), event
    wide = covariance_of(5e-3, 0.05)
    phase, event = outcome_of(lambda _: np.zeros(3), wide)
    assert phase == "retreat"
    assert event.endswith("err by 35.36 mm along the pull, which moves an open latch by 28.09 mm")


def test_what_hides_an_open_latch_is_the_error_along_the_pull() -> None:
    """Along X of the chaser, in the target's axes."""
    rng, mission = np.random.default_rng(4), scenario(docking={"pull_N": 0.37})
    q = attitude(rng)
    one, other = (covariance(rng, [0.02, 0.05, 0.09, 1.0, 1.0, 1.0]) for _ in range(2))
    before, now = (RelativePose(np.zeros(3), q, c) for c in (one, other))
    along = matrix(q)[:, 0]
    error_m = GUIDANCE.pull_sigmas * math.sqrt(along @ (one + other)[:3, :3] @ along)
    assert f"may err by {error_m * 1e3:.2f} mm along" in why_untold(before, now, mission)


def test_the_rate_of_false_alarms_is_the_stated_one(monkeypatch: pytest.MonkeyPatch) -> None:
    """Errors drawn from covariances of any shape exceed three sigmas no more often than a chi of
    three degrees of freedom; at five sigmas that is one test of 1000.
    """
    draw, mission = np.random.default_rng(1), scenario()
    monkeypatch.setattr(latch_test, "GUIDANCE", replace(GUIDANCE, pull_sigmas=3.0))
    factor = draw.normal(size=(2, 6, 6)) * np.array([[2e-2], [2e-2], [2e-2], [0.1], [0.1], [0.1]])
    covariances = factor @ factor.transpose(0, 2, 1)
    alarms, count = 0, 3000
    for _ in range(count):
        before, now = (
            RelativePose(e[:3], rotations.exp(e[3:] * 1e-2), c)
            for e, c in zip(
                np.einsum("kij,kj->ki", factor, draw.normal(size=(2, 6))), covariances, strict=True
            )
        )
        motion = motion_between(before, now, mission)
        alarms += motion.moved_m > motion.most_m
    assert 0.001 * count < alarms < (chi.sf(3.0, 3) + 0.006) * count
    assert chi.sf(GUIDANCE.pull_sigmas, 3) * 2.0 * 30 < 1e-3


@pytest.mark.parametrize(("mass_kg", "pull_N"), [(120.0, 0.5), (400.0, 1.9), (17.8, 0.13)])
def test_pull_that_cannot_tell_an_open_latch_is_refused_with_the_one_that_can(
    mass_kg: float, pull_N: float
) -> None:
    """The one that can moves a free chaser by more than the tolerance, in small steps."""
    heavy = {"mass_kg": mass_kg, "inertia_kg_m2": [8.0, 9.0, 10.0], "force_max_N": 9.0}
    with pytest.raises(ScenarioError, match=f"docking.pull_N: {pull_N:g} N moves a chaser") as no:
        scenario(chaser=heavy, docking={"pull_N": pull_N})
    stated_mm, needed_N = (
        float(re.findall(pattern, str(no.value))[0])
        for pattern in (r"open by ([\d.]+) mm", r"([\d.]+) N$")
    )
    moved = []
    for force_N in (pull_N, needed_N):
        place, speed, count = 0.0, 0.0, 20_000
        for k in range(count):
            push_m_s2 = (1.0 if 2 * k < count else -1.0) * force_N / mass_kg
            place, speed = place + speed * 2.0 / count, speed + push_m_s2 * 2.0 / count
        moved.append(place)
    assert moved[0] * 1e3 == pytest.approx(stated_mm, rel=1e-2)
    assert moved[1] == pytest.approx(1.5 * scenario().docking.verify_position_m, rel=1e-2)
    scenario(chaser=heavy, docking={"pull_N": 1.01 * needed_N})


def test_pull_beyond_the_chasers_force_is_refused() -> None:
    with pytest.raises(ScenarioError, match=r"more than chaser.force_max_N \(0.3 N\)"):
        scenario(chaser={"force_max_N": 0.3}, docking={"pull_N": 0.4})
