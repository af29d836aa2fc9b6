# SPDX-License-Identifier: Apache-2.0
"""Each process' answers to recorded inputs, against what it answered when the golden log was made.

Recorded by ``tests/make_golden.py``. Compared with a tolerance, since another kind of CPU differs
in the last bits.
"""

from __future__ import annotations

from collections import defaultdict
from pathlib import Path

import numpy as np
import pytest
from chaserdock_agents.chaser.command_gate import passed_on, refusal
from chaserdock_agents.chaser.perception import make_perception
from chaserdock_agents.chaser.sighting import look, prediction_from
from chaserdock_controller.core import ControllerCore
from chaserdock_protocol.messages import (
    ActuatorCommand,
    Image,
    Odometry,
    Sighting,
    TargetEstimate,
    WrenchCommand,
)
from chaserdock_protocol.recording.log import Record, read_log, read_scenario
from chaserdock_protocol.scenario import Scenario, scenario_from_json
from chaserdock_world.physics.simulation import BodyState
from chaserdock_world.rendering.cameras import Cameras
from flight_cases import tick_inputs

LOG = Path(__file__).parents[1] / "golden" / "two-chasers.mcap"


@pytest.fixture(scope="module")
def scenario() -> Scenario:
    return scenario_from_json(read_scenario(LOG)[0], "golden log")


@pytest.fixture(scope="module")
def records() -> dict[type, list[Record]]:
    out: dict[type, list[Record]] = defaultdict(list)
    for record in read_log(LOG):
        out[type(record.message)].append(record)
    return out


def test_world_takes_the_same_images(scenario: Scenario, records: dict[type, list[Record]]) -> None:
    """Rendered from the recorded truth: equal but for a grey level here and there."""
    from chaserdock_agents.chaser.sighting import decode_image
    from chaserdock_protocol.messages import BodyTruth

    states: dict[int, dict[str, BodyState]] = defaultdict(dict)
    for record in records[BodyTruth]:
        m = record.message
        vectors = (m.position_m, m.velocity_m_s, m.q_wxyz, m.omega_rad_s)
        states[m.tick][m.body] = BodyState(*(np.array(v) for v in vectors))
    cameras = Cameras(scenario)
    for record in records[Image][:6]:
        then: Image = record.message
        now = cameras.image(then.chaser, then.tick, then.tick, then.sim_time_ns, states[then.tick])
        apart = np.abs(decode_image(now).astype(int) - decode_image(then).astype(int))
        assert apart.mean() < 0.2
        assert np.mean(apart > 8) < 1e-3


def test_chaser_sees_the_same(scenario: Scenario, records: dict[type, list[Record]]) -> None:
    perception = make_perception(scenario)
    then = {(r.message.chaser, r.message.tick): r.message for r in records[Sighting]}
    last: dict[int, Sighting] = {}
    for record in records[Image]:
        image: Image = record.message
        now = look(perception, image, prediction_from(last.get(image.chaser)))
        last[image.chaser] = now
        expected: Sighting = then[image.chaser, image.tick]
        assert now.status == expected.status
        assert now.marker_ids == expected.marker_ids
        np.testing.assert_allclose(now.corners_px, expected.corners_px, atol=1e-3)
        assert len(now.solutions) == len(expected.solutions)
        for a, b in zip(now.solutions, expected.solutions, strict=True):
            np.testing.assert_allclose(a.position_m, b.position_m, atol=2e-5)
            np.testing.assert_allclose(a.q_wxyz, b.q_wxyz, atol=2e-5)
    assert len(then) == len(records[Image]) == 36


def test_controller_answers_the_same(scenario: Scenario, records: dict[type, list[Record]]) -> None:
    odometry: dict[int, dict[int, Odometry]] = defaultdict(dict)
    sightings: dict[int, list[Sighting]] = defaultdict(list)
    for record in records[Odometry]:
        odometry[record.message.tick][record.message.chaser] = record.message
    for record in records[Sighting]:
        sightings[record.message.tick].append(record.message)
    targets = {r.message.tick: r.message for r in records[TargetEstimate]}
    wrenches = {(r.message.chaser, r.message.tick): r.message for r in records[WrenchCommand]}
    flight = ControllerCore(scenario, now_s=lambda: 0.0)
    for tick in range(scenario.ticks):
        time_ns = scenario.timing.tick_time_ns(tick)
        # Another order of arrival must not matter.
        seen = tuple(reversed(sightings[tick]))
        out = flight.step(tick_inputs(tick, time_ns, odometry[tick], seen))
        assert out.target.status == targets[tick].status
        np.testing.assert_allclose(out.target.position_m, targets[tick].position_m, atol=1e-7)
        np.testing.assert_allclose(out.target.q_wxyz, targets[tick].q_wxyz, atol=1e-7)
        for i, wrench in out.wrenches.items():
            expected: WrenchCommand = wrenches[i, tick]
            assert wrench.mode == expected.mode
            assert wrench.effective_time_ns == expected.effective_time_ns
            np.testing.assert_allclose(wrench.force_N, expected.force_N, atol=1e-5)
            np.testing.assert_allclose(wrench.torque_N_m, expected.torque_N_m, atol=1e-6)
    assert len(wrenches) == 2 * scenario.ticks


def test_chaser_executes_the_command(scenario: Scenario, records: dict[type, list[Record]]) -> None:
    executed = {(r.message.chaser, r.message.tick): r.message for r in records[ActuatorCommand]}
    for record in records[WrenchCommand]:
        command: WrenchCommand = record.message
        due_ns = scenario.timing.effective_ns(command.tick)
        body, before = scenario.chaser, command.tick - 1
        assert refusal(command, command.chaser, body, before, command.sim_time_ns, due_ns) is None
        expected: ActuatorCommand = executed[command.chaser, command.tick]
        assert passed_on(command) == ActuatorCommand(
            **{
                name: getattr(expected, name)
                for name in expected.__struct_fields__
                if name not in ("seq", "instance")  # stamped by the node and the process
            }
        )
