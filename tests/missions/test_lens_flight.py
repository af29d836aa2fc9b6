# SPDX-License-Identifier: Apache-2.0
"""Flights with images through strong lenses: tracks as good as with a plain lens of this focal
length.
"""

import json

import numpy as np
import pytest
from chaserdock_protocol.shipped_scenarios import find_scenario

from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.summary import summary_of
from chaserdock.simulation.mission import simulate

CAMERA = {"width_px": 640, "height_px": 480, "cx_px": 318.2, "cy_px": 243.9}
LENSES = {
    "plain": {"fx_px": 320.0, "fy_px": 316.0},
    "fisheye": {
        "fx_px": 320.0,
        "fy_px": 316.0,
        "distortion": [-0.0023, 0.0412, -0.0387, 0.0067],
        "lens_model": "equidistant",
    },
    "rational": {
        "fx_px": 420.0,
        "fy_px": 411.0,
        "distortion": [0.41, -0.13, 8e-4, -6e-4, -0.012, 0.72, -0.09, -0.03],
    },
}


def toml(values) -> str:
    return "{" + ", ".join(f"{k} = {json.dumps(v)}" for k, v in values.items()) + "}"


@pytest.mark.slow(2)
@pytest.mark.parametrize("lens", LENSES)
def test_a_flight_tracks_through_every_lens(lens, tmp_path):
    """True cameras have errors of focal length, principal point and mounting."""
    changes = (
        f"camera.intrinsics={toml(CAMERA | LENSES[lens])}",
        "duration_s=10.0",
        "settling_s=6.0",
        "success={}",
        "navigation.grade='lab'",
    )
    ended = simulate(find_scenario("single"), tmp_path / "run", changes)
    assert not ended.crashes
    assert not ended.stalled
    flight = load_flight(tmp_path / "run" / "mission.mcap")
    estimate = summary_of(flight)["chasers"]["0"]["relative_estimate"]
    # Seeds 0 to 2: plain up to 3.2 mm, rational 4.9, fisheye 5.3; NEES 1.7 to 10.6.
    assert estimate["position_rms_m"] < 8e-3
    assert np.degrees(estimate["orientation_rms_rad"]) < 0.5
    assert 0.5 < estimate["nees_mean"] < 12.0
