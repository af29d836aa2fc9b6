# SPDX-License-Identifier: Apache-2.0
"""The gateway states what it adds to the latency of what passes it."""

from __future__ import annotations

import pytest
from chaserdock_agents.gateway.actuation import RobotActuation
from chaserdock_agents.gateway.latency import AddedLatency
from chaserdock_models.clock import Timing
from chaserdock_protocol.messages import ActuatorCommand
from chaserdock_protocol.scenario.bodies import Body

TIMING = Timing(physics_hz=240, rate_hz=15, image_hz=15, latency_steps=8)
MS = 1_000_000


def test_median_and_99th_percentile_of_each_kind_are_stated() -> None:
    added = AddedLatency()
    assert str(added) == ""
    for k in range(101):
        added.note("images", 7 * k * MS, 7 * k * MS + (k % 101) * MS // 10)
    added.note("commands", 5 * MS, 8 * MS)
    assert str(added) == "images 5.00 ms, p99 9.90 ms of 101; commands 3.00 ms, p99 3.00 ms of 1"


@pytest.mark.parametrize(("late_ns", "due_late_ns"), [(-20 * MS, 0), (9 * MS, 9 * MS)])
def test_a_command_is_due_when_it_has_arrived_and_acts(late_ns: int, due_late_ns: int) -> None:
    """``late_ns``: arrival after the time at which it is to act."""
    acts_ns = TIMING.effective_ns(3)
    actuation = RobotActuation(
        Body.model_validate({"actuation": "ideal"}), TIMING, lambda: acts_ns + late_ns
    )
    command = ActuatorCommand(
        tick=3, sim_time_ns=TIMING.tick_time_ns(3), chaser=0, effective_time_ns=acts_ns,
        source="command", force_N=(0.1, -0.2, 0.3), torque_N_m=(0.01, 0.02, -0.03),
    )  # fmt: skip
    taken_ns = acts_ns + 30 * MS
    actuation.command(command, TIMING.step_of_time(acts_ns), TIMING.step_of_time(taken_ns - MS))
    assert actuation.take(acts_ns + 40 * MS) is not None
    assert actuation.due_ns == acts_ns + due_late_ns
    assert actuation.take(acts_ns + 50 * MS) is None
    assert actuation.due_ns is None
