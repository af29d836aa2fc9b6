# SPDX-License-Identifier: Apache-2.0
"""``[[fault]]`` tables: valid ones load, each invalid one is a single line with its path."""

from __future__ import annotations

from pathlib import Path

import pytest
from chaserdock_protocol.scenario import load_scenario
from chaserdock_protocol.scenario.errors import ScenarioError
from chaserdock_protocol.scenario.faults import faults_of

ROOT = Path(__file__).resolve().parents[2]
DRILL = ROOT / "scenarios" / "fault-drill.toml"
CAPTURE = ROOT / "scenarios" / "four-chaser-capture.toml"

GOOD = [
    'kind = "kill", process = "controller"',
    'kind = "kill", process = "recorder"',
    'kind = "freeze", process = "world", duration_s = 2.0',
    'kind = "cut", process = "chaser/0", peer = "controller", duration_s = 2.0',
    'kind = "drop", process = "chaser/3", topic = "wrench", duration_s = 2.0, share = 0.5',
    'kind = "delay", process = "world", topic = "actuators", duration_s = 2.0, delay_s = 0.3',
    (
        'kind = "duplicate", process = "controller", topic = "sighting", duration_s = 2.0, '
        'peer = "chaser/1"'
    ),
    'kind = "reorder", process = "controller", topic = "odometry", duration_s = 2.0',
    'kind = "corrupt", process = "chaser/0", topic = "image", duration_s = 2.0',
    'kind = "flood", process = "world", topic = "image", duration_s = 2.0, copies = 10',
    'kind = "clock_jump", process = "chaser/0", duration_s = 2.0, offset_s = -3.0',
    'kind = "camera_off", process = "chaser/0", duration_s = 2.0',
    'kind = "lying_sensor", process = "chaser/0", duration_s = 2.0, offset_m = [0.1, 0.0, 0.0]',
    'kind = "odometry_lie", process = "chaser/0", duration_s = 2.0, rotation_deg = [0.0, 0.0, 5.0]',
]
BAD = [
    ('kind = "bomb", process = "controller"', "fault.0.kind"),
    ('kind = "kill", process = "world"', "kill cannot happen to world"),
    ('kind = "kill", process = "moon"', "'moon' is no process"),
    (
        'kind = "kill", process = "chaser/7"',
        "there is no chaser/7; this mission has chaser/0 to chaser/3",
    ),
    (
        'kind = "cut", process = "chaser/0", peer = "chaser/9", duration_s = 1',
        "there is no chaser/9",
    ),
    (
        'kind = "cut", process = "chaser/0", peer = "chaser/0", duration_s = 1',
        "receives no message that can be faulty from",
    ),
    ('kind = "freeze", process = "chaser/0"', "freeze needs duration_s"),
    ('kind = "drop", process = "chaser/0", duration_s = 1', "drop needs topic"),
    ('kind = "drop", process = "chaser/0", topic = "tick", duration_s = 1', "fault.0.topic"),
    (
        'kind = "drop", process = "chaser/0", topic = "sighting", duration_s = 1',
        "chaser/0 receives no sighting",
    ),
    (
        'kind = "flood", process = "chaser/0", topic = "wrench", copies = 3, duration_s = 1',
        "publishes no wrench",
    ),
    (
        'kind = "drop", process = "chaser/0", topic = "wrench", duration_s = 1, share = 1.5',
        "fault.0.share",
    ),
    (
        'kind = "camera_off", process = "chaser/0", duration_s = 1, share = 0.5',
        "share does not go with camera_off",
    ),
    (
        'kind = "delay", process = "chaser/0", topic = "wrench", duration_s = 1',
        "delay needs delay_s",
    ),
    (
        'kind = "lying_sensor", process = "chaser/0", duration_s = 1',
        "needs offset_m or rotation_deg",
    ),
    (
        'kind = "drop", process = "controller", topic = "thrusters", duration_s = 1',
        "thrusters exist only with",
    ),
    (
        'kind = "drop", process = "chaser/0", topic = "docking", duration_s = 1',
        "docking sensors exist only with",
    ),
    ('kind = "camera_off", process = "chaser/0", duration_s = -1', "fault.0.duration_s"),
    ('kind = "camera_off", process = "chaser/0", duration_s = 1, colour = "red"', "fault.0.colour"),
]


LATCHES = [
    'kind = "latch_slip", process = "chaser/0", duration_s = 2.0, force_N = 0.3',
    'kind = "latch_slip", process = "chaser/3", duration_s = 2.0, force_N = 0.3, torque_N_m = 0.1',
    'kind = "latch_open", process = "chaser/1", duration_s = 0.1',
    'kind = "latch_stuck", process = "chaser/0", duration_s = 20.0',
]
BAD_LATCHES = [
    (
        'kind = "latch_open", process = "chaser/2", duration_s = 1',
        "fault.0: latch_open cannot happen to chaser/2, which has no port; see docking.kind and "
        "[[docking.ports]]",
    ),
    (
        'kind = "latch_slip", process = "chaser/0", duration_s = 1',
        "latch_slip needs force_N or torque_N_m",
    ),
    ('kind = "latch_slip", process = "chaser/0", duration_s = 1, force_N = 0', "fault.0.force_N"),
    ('kind = "latch_stuck", process = "chaser/0"', "latch_stuck needs duration_s"),
    (
        'kind = "latch_stuck", process = "chaser/0", duration_s = 1, force_N = 1',
        "force_N does not go with latch_stuck",
    ),
    (
        'kind = "latch_open", process = "controller", duration_s = 1',
        "latch_open cannot happen to controller",
    ),
    ('kind = "latch_open", process = "chaser/9", duration_s = 1', "there is no chaser/9"),
]


@pytest.mark.parametrize("fault", LATCHES)
def test_faults_of_latches_stay_with_the_world(fault: str) -> None:
    scenario = load_scenario(CAPTURE, (f"fault=[{{{fault}, at_s = 1.0}}]",))
    assert type(scenario).model_validate_json(scenario.model_dump_json()) == scenario
    assert faults_of(scenario, "world").faults == scenario.fault
    assert faults_of(scenario, scenario.fault[0].process).faults == ()


@pytest.mark.parametrize(("fault", "words"), BAD_LATCHES)
def test_invalid_faults_of_latches_are_one_line(fault: str, words: str) -> None:
    with pytest.raises(ScenarioError) as error:
        load_scenario(CAPTURE, (f"fault=[{{{fault}, at_s = 1.0}}]",))
    assert words in str(error.value)
    assert len(str(error.value).splitlines()) == 1


def test_latches_need_ports() -> None:
    with pytest.raises(
        ScenarioError, match="latch_stuck cannot happen to chaser/0, which has no port"
    ):
        load_scenario(
            DRILL, ('fault=[{kind="latch_stuck",process="chaser/0",at_s=1.0,duration_s=1.0}]',)
        )
    with pytest.raises(
        ScenarioError, match=r'truth.latch.strength_N: latches exist only with docking.kind = "'
    ):
        load_scenario(DRILL, ("truth.latch.strength_N=3.0",))
    for bad in ("strength_N=0.0", "strength_N_m=-1.0", "play_m=0.02", "play_deg=6.0"):
        with pytest.raises(ScenarioError, match=rf"truth.latch.{bad.partition('=')[0]}: "):
            load_scenario(CAPTURE, (f"truth.latch.{bad}",))


@pytest.mark.parametrize("fault", GOOD)
def test_valid_faults_survive_serialization(fault: str) -> None:
    scenario = load_scenario(DRILL, (f"fault=[{{{fault}, at_s = 1.0}}]",))
    assert type(scenario).model_validate_json(scenario.model_dump_json()) == scenario
    assert scenario.fault[0].text().startswith(str(scenario.fault[0].kind))


@pytest.mark.parametrize(("fault", "words"), BAD)
def test_invalid_faults_are_one_line_with_their_path(fault: str, words: str) -> None:
    with pytest.raises(ScenarioError) as caught:
        load_scenario(DRILL, (f"fault=[{{{fault}, at_s = 1.0}}]",))
    assert words in str(caught.value)
    assert "fault.0" in str(caught.value)
    assert len(str(caught.value).splitlines()) == 1


def test_faults_begin_after_time_zero() -> None:
    with pytest.raises(ScenarioError, match=r"fault\.0\.at_s"):
        load_scenario(DRILL, ('fault=[{kind = "kill", process = "controller", at_s = 0.0}]',))


def test_faults_can_be_written_as_tables(tmp_path: Path) -> None:
    text = DRILL.read_text() + '\n[[fault]]\nkind = "kill"\nat_s = 3.0\nprocess = "chaser/2"\n'
    path = tmp_path / "drill.toml"
    path.write_text(text)
    assert load_scenario(path).fault[0].process == "chaser/2"
