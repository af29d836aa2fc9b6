"""Capture from start to end, with the controller and the world that fly, in one process (``benchmarks/offline.py``)."""

from __future__ import annotations

import math

import numpy as np
import pytest
from chaserdock_protocol.messages import OperatorCommand
from chaserdock_protocol.scenario import ScenarioError, parse_scenario
from chaserdock_world.physics import TARGET
from docking import Conservation, mission
from docking_cases import PORTS, values
from offline import Offline, statistical_eye


def test_it_docks_within_the_issues_bars_and_backs_out_again() -> None:
    """A seed with fast rates, noise of 2 mm and 0.1 degrees: 5 mm, 1.5 degrees, 1.2 cm/s; momentum to 1e-4."""
    scenario = mission(1)
    flight = Offline(scenario, statistical_eye(scenario, 1, 0.002, math.radians(0.1)))
    conservation = Conservation(flight)
    for what, until, limit_s in (("approach", "verified", 60.0), ("abort", "hold", 30.0)):
        while flight.time_s < 4.0:
            flight.step()
        begun_s = flight.time_s
        flight.step((OperatorCommand(command=what, chaser=0),))  # type: ignore[arg-type]
        while flight.phase(0) != until:
            assert flight.time_s - begun_s < limit_s, flight.events
            out = flight.step()
            if flight.phase(0) == "verified":
                assert out.wrenches[0].mode in ("coast", "pull")
                assert out.target.status == "tracking"
                truth = flight.physics.state(TARGET)
                assert np.linalg.norm(np.array(out.target.velocity_m_s) - truth.velocity_m_s) < 0.005
    flight.close()
    assert flight.touched == set()
    (touch,) = [t for t in flight.touches if t.latched]
    assert touch.lateral_m <= 0.005
    assert touch.angle_rad <= math.radians(1.5)
    assert touch.closing_m_s <= 0.012
    assert conservation.linear is not None
    assert conservation.angular is not None
    assert max(conservation.linear, conservation.angular) <= 1e-4
    assert not flight.physics.latches["chaser/0"].latched


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"docking": {"ports": []}}, "kind capture needs at least one of"),
        ({"docking": {"ports": [PORTS[0], PORTS[0]]}}, "chaser 0 has more than one"),
        ({"docking": {"ports": [PORTS[1]]}}, "docking.ports.0.chaser: there is no chaser 1"),
        ({"docking": {"ports": [PORTS[0] | {"axis": [-0.98, 0.199, 0.0]}]}}, "degrees off the axis"),
        ({"docking": {"ports": [PORTS[0] | {"axis": [-2.0, 0.0, 0.0]}]}}, "must be a unit vector"),
        ({"docking": {"final_m": 0.5}}, "must be less than entry_m"),
        ({"docking": {"contact_speed_m_s": 0.05}}, "must not exceed approach_speed_m_s"),
        ({"docking": {"entry_m": 0.15}}, "its corridor begins"),
        ({"target": {"motion": "constant_rates"}}, "needs torque_free"),
        ({"docking": {"kind": "held"}, "success": {"latched": [0]}}, "chaser 0 has no port"),
    ],
)
def test_a_docking_section_that_cannot_be_flown_is_refused(changes: dict, told: str) -> None:
    with pytest.raises(ScenarioError) as error:
        parse_scenario(values(**changes), "test")
    assert told in str(error.value)
