# SPDX-License-Identifier: Apache-2.0
"""Rendezvous from far range: the estimate that passive safety needs, and the last leg to the
verified latch.
"""

from __future__ import annotations

import numpy as np
import pytest
from flights import load_shipped
from flights.rendezvous import last_leg, rendezvous

from chaserdock.experiments.in_process import InProcessMission
from chaserdock.experiments.perception import RenderedImages


def test_last_leg_starts_at_the_last_hold_point() -> None:
    scenario = load_shipped("v-bar")
    leg = last_leg(scenario)
    assert leg.chasers[0].position_m == scenario.timeline[-2].offset_m
    assert [(entry.at_s, entry.command) for entry in leg.timeline] == [(30.0, "approach")]


@pytest.mark.slow
def test_relative_velocity_at_200_m_is_known_well_enough_for_a_passively_safe_move() -> None:
    """After 20 s: the errors agree with their covariance, and the move to the first hold point is
    not refused.
    """
    scenario = load_shipped("v-bar", "duration_s=40.0", "timeline=[]")
    with InProcessMission(scenario, RenderedImages(scenario)) as flight:
        record = flight.step()
        while record.time_s < 20.0:
            record = flight.step()
        known = flight.controller.guidance.chasers[0].relative
        assert known is not None
    own, target = record.states["chaser/0"], record.states["target"]
    error = known.state[3:] - (own.velocity_m_s - target.velocity_m_s)
    sigma = np.sqrt(np.diag(known.disturbed.covariance))[3:6]
    assert np.all(np.abs(error) < 4.0 * sigma)
    assert sigma[1] < 5e-4
    assert np.linalg.norm(known.target.omega_rad_s) < 3e-5


@pytest.mark.slow
def test_last_leg_of_v_bar_ends_with_a_verified_latch_and_a_hand_over_without_a_jump() -> None:
    scenario = last_leg(load_shipped("v-bar"))
    out = rendezvous(scenario, RenderedImages(scenario))
    assert out.verified_s is not None
    assert not out.contacts
    assert out.keep_out_margin_m > 0.0
    assert out.hand_over is not None
    assert out.hand_over.step_sigmas < 4.0
    assert out.contact_lateral_m < scenario.docking.tolerances.lateral_m
    assert out.contact_closing_m_s < scenario.docking.tolerances.closing_m_s


def test_target_at_a_kilometre_is_not_lost_by_the_error_of_the_mounting() -> None:
    """At 985 m the mounting of the camera (0.05 degrees) makes the position uncertain by 0.9 m."""
    scenario = load_shipped(
        "arch-comp-rendezvous", "duration_s=5.0", "timeline=[]", "settling_s=0.0"
    )
    with InProcessMission(scenario, RenderedImages(scenario)) as flight:
        while flight.tick < scenario.ticks:
            record = flight.step()
            assert record.outputs is not None
            assert record.outputs.target.status == "tracking"
        assert flight.phase(0) == "hold"


@pytest.mark.slow
def test_ranging_and_images_hand_over_in_one_flight_without_a_jump() -> None:
    """From 11 m, where no marker is found, to 8 m."""
    scenario = load_shipped(
        "v-bar-images",
        "duration_s=50.0",
        "chasers.0.position_m=[-11.0, 0.0, -0.05]",
        "timeline.0.at_s=8.0",
        "timeline.0.offset_m=[-8.0, 0.0, -0.05]",
        "approach.max_speed_m_s=0.1",
        "time.rate_hz=5",
        "time.image_hz=5",
    )
    out = rendezvous(scenario, RenderedImages(scenario))
    assert out.hand_over is not None
    assert 8.3 < out.hand_over.range_m < 10.5
    assert out.hand_over.step_sigmas < 4.0
    assert out.hand_over.error_sigmas < 4.0
