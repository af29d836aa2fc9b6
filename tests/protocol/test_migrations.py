# SPDX-License-Identifier: Apache-2.0
"""Logs and scenarios of older formats open as if they had been written today."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import msgspec
import pytest
from chaserdock_protocol import codec, topics
from chaserdock_protocol import messages as m
from chaserdock_protocol.codec import Rejected
from chaserdock_protocol.recording import schema_migrations
from chaserdock_protocol.recording.log import LogWriter, read_log, read_scenario
from chaserdock_protocol.recording.schema_migrations import UPGRADES, current_key, decode_logged
from chaserdock_protocol.scenario import ScenarioError, load_scenario, scenario_from_json
from chaserdock_protocol.scenario.migrations import (
    FORMAT,
    drop_removed_keys,
    migrated,
    old_keys,
)
from message_samples import BY_TYPE
from source_tree import ROOT

PRESENT: dict[str, msgspec.Struct] = {
    **{kind.__name__: sample for kind, sample in BY_TYPE.items()},
    "Tick": msgspec.structs.replace(BY_TYPE[m.Tick], since={}),
    "BodyTruth": msgspec.structs.replace(
        BY_TYPE[m.BodyTruth], thruster_impulse_N_s=(0.5, 0.25), thruster_open_s=(0.125, 0.0)
    ),
    "Sighting": msgspec.structs.replace(BY_TYPE[m.Sighting], status="bad_image"),
    "OperatorCommand": msgspec.structs.replace(
        BY_TYPE[m.OperatorCommand], command="isolate", thruster=3
    ),
    "ControllerState": msgspec.structs.replace(
        BY_TYPE[m.ControllerState],
        operated=(m.OperatorCommand(command="restore", chaser=1, thruster=2),),
    ),
}
OLD_NAMES: dict[str, dict[str, str]] = {
    "Tick": {"images": "pictures"},
    "BodyTruth": {"thruster_impulse_N_s": "jet_impulse_N_s", "thruster_open_s": "jet_open_s"},
    "Odometry": {},
    "Sighting": {},
    "ActuatorCommand": {},
    "ThrusterReport": {"thrusters": "jets"},
    "ThrusterFaultCommand": {"thruster": "jet"},
    "OperatorCommand": {"thruster": "jet"},
    "ControllerState": {},
}
OLD_TYPES = {"ThrusterReport": "JetReport", "ThrusterFaultCommand": "JetFaultCommand"}


def version_1(message: msgspec.Struct) -> tuple[dict[str, Any], str]:
    """Return fields and encoding of a message as version 1 wrote them."""
    name = type(message).__name__
    fields: dict[str, Any] = msgspec.msgpack.decode(codec.encode(message))
    fields = {OLD_NAMES.get(name, {}).get(field, field): value for field, value in fields.items()}
    if fields.get("status") == "bad_image":
        fields["status"] = "bad_picture"
    if name == "Tick":
        del fields["since"]
        (commander, instance), *others = fields.pop("controllers").items()
        named = {"controller": True, "term": 2, "commander": commander, "instance": instance}
        fields |= named | {"standing_by": dict(others)}
    if name == "Odometry":
        fields = {field: value for field, value in fields.items() if "covariance" not in field}
    for field in ("pulses", "operated"):
        for item in fields.get(field, ()):
            item["jet"] = item.pop("thruster")
    return fields, f"application/msgpack;chaserdock.{OLD_TYPES.get(name, name)}.v1"


def kind_of(name: str) -> Any:
    return next(kind for kind in m.VERSION if kind.__name__ == name)


def test_every_upgrade_has_a_case_and_every_version_an_upgrade() -> None:
    assert {name for name, _ in UPGRADES} == set(OLD_NAMES)
    needed = {
        (kind.__name__, version) for kind, last in m.VERSION.items() for version in range(1, last)
    }
    assert set(UPGRADES) == needed


@pytest.mark.parametrize("name", sorted(OLD_NAMES))
def test_message_of_version_1_decodes_to_the_present_message(name: str) -> None:
    message = PRESENT[name]
    fields, encoding = version_1(message)
    assert fields != msgspec.msgpack.decode(codec.encode(message))
    assert decode_logged(kind_of(name), msgspec.msgpack.encode(fields), encoding) == message
    # On the wire only the present version is accepted.
    with pytest.raises(Rejected, match="encoding"):
        codec.decode(kind_of(name), msgspec.msgpack.encode(fields), encoding)


def test_old_ticks_without_names_list_the_only_controller() -> None:
    for controller, expected in ((True, {"controller": ""}), (False, {})):
        fields = {"images": False, "chasers": [0], "controller": controller}
        encoding = "application/msgpack;chaserdock.Tick.v2"
        assert (
            decode_logged(m.Tick, msgspec.msgpack.encode(fields), encoding).controllers == expected
        )


def test_old_thruster_reports_state_the_magnitude_of_the_net_impulse() -> None:
    sample: Any = BY_TYPE[m.ThrusterReport]
    net, turning = (0.01, -0.02, 0.03), (-1e-3, 2e-3, 3e-3)
    message = msgspec.structs.replace(
        sample, given_impulse_N_s=net, given_angular_impulse_N_m_s=turning
    )
    fields = msgspec.msgpack.decode(codec.encode(message))
    old = {k: v for k, v in fields.items() if "moment" not in k and "magnitude" not in k}
    encoding = "application/msgpack;chaserdock.ThrusterReport.v2"
    found = decode_logged(m.ThrusterReport, msgspec.msgpack.encode(old), encoding)
    assert found.given_magnitude_N_s == (0.01, 0.02, 0.03)
    assert found.given_angular_magnitude_N_m_s == (1e-3, 2e-3, 3e-3)
    assert found.given_moment_N_s2 == (0.0, 0.0, 0.0)


def test_migrated_messages_are_validated() -> None:
    fields, encoding = version_1(PRESENT["BodyTruth"])
    for changed in (
        {"jet_open_s": [float("nan")]},
        {"q_wxyz": [1.0, 1.0, 0.0, 0.0]},
        {"jet_open_s": "x"},
    ):
        with pytest.raises(Rejected):
            decode_logged(m.BodyTruth, msgspec.msgpack.encode(fields | changed), encoding)


@pytest.mark.parametrize(
    "encoding",
    [
        "application/msgpack;chaserdock.Tick.v4",
        "application/msgpack;chaserdock.Tick.v0",
        "application/msgpack;chaserdock.JetReport.v1",
        "application/json;chaserdock.Tick.v1",
    ],
)
def test_unknown_versions_and_types_are_rejected(encoding: str) -> None:
    with pytest.raises(Rejected, match="encoding"):
        decode_logged(m.Tick, codec.encode(PRESENT["Tick"]), encoding)


@pytest.mark.parametrize(
    ("key", "present"),
    [
        ("chaser/0/jets", "chaser/0/thrusters"),
        ("chaser/17/jets", "chaser/17/thrusters"),
        ("chaser/0/thrusters", "chaser/0/thrusters"),
        ("chaser/0/jets/more", "chaser/0/jets/more"),
        ("world/tick", "world/tick"),
    ],
)
def test_renamed_keys(key: str, present: str) -> None:
    assert current_key(key) == present


def test_every_renamed_type_exists_today() -> None:
    names = {kind.__name__ for kind in m.VERSION}
    assert set(schema_migrations._RENAMED_TYPES.values()) <= names
    assert not set(schema_migrations._RENAMED_TYPES) & names


# -- scenarios -------------------------------------------------------------------------------------

FORMAT_1: dict[str, Any] = {
    "name": "old",
    "time": {"picture_hz": 15, "rate_hz": 15},
    "chaser": {"jet_test_s": 2.0, "jet_faults_by_command": True, "mass_kg": 10.0},
    "timeline": [
        {"at_s": 1.0, "command": "isolate", "jet": 3},
        {"at_s": 2.0, "command": "approach"},
    ],
    "jet_failure": [{"jet": 1, "kind": "weak", "told": False}],
    "fault": [{"kind": "drop", "topic": "jets"}, {"kind": "drop", "topic": "wrench"}],
}
FORMAT_3: dict[str, Any] = {
    "format": FORMAT,
    "name": "old",
    "time": {"image_hz": 15, "rate_hz": 15},
    "chaser": {"thruster_test_s": 2.0, "thruster_faults_by_command": True, "mass_kg": 10.0},
    "timeline": [
        {"at_s": 1.0, "command": "isolate", "thruster": 3},
        {"at_s": 2.0, "command": "approach"},
    ],
    "thruster_failure": [{"thruster": 1, "kind": "weak", "reported": False}],
    "fault": [{"kind": "drop", "topic": "thrusters"}, {"kind": "drop", "topic": "wrench"}],
    "navigation": {"grade": "exact"},
}


def test_scenario_of_format_1_is_migrated() -> None:
    assert json.loads(migrated(json.dumps(FORMAT_1))) == FORMAT_3


def test_key_of_the_renderer_is_dropped() -> None:
    """Logs state it; in files only the value that is left is accepted."""
    camera: dict[str, Any] = {"renderer": "pybullet", "width_px": 640}
    text = json.dumps({"format": FORMAT, "camera": camera})
    assert json.loads(migrated(text))["camera"] == {"width_px": 640}
    (line,) = old_keys({"camera": camera})
    assert line.startswith("camera.renderer: PyBullet's renderer")
    exact = {"camera": camera | {"renderer": "exact"}}
    drop_removed_keys(exact)
    assert old_keys(exact) == []
    assert "renderer" not in exact["camera"]


def test_errors_of_format_2_become_figures_of_exact_navigation() -> None:
    text = json.dumps(
        {
            "format": 2,
            "odometry": {
                "position_noise_m": 0.003,
                "attitude_noise_deg": 0.05,
                "attitude_bias_deg": 0.0,
            },
            "camera": {
                "calibration_error": {"mounting_deg": 0.5, "centre_px": 1.0},
                "width_px": 640,
            },
            "estimator": {
                "name": "paper",
                "camera_bias_attitude_deg": 0.3,
                "camera_bias_position_m": 0.0,
            },
        }
    )
    assert json.loads(migrated(text)) == {
        "format": FORMAT,
        "camera": {"width_px": 640},
        "estimator": {"name": "paper"},
        "navigation": {
            "grade": "exact",
            "position_noise_m": 0.003,
            "attitude_noise_deg": 0.05,
            "attitude_roll_noise_deg": 0.05,
            "camera_turn_deg": 0.3,
            "camera_centre_px": 1.0,
        },
        "truth": {"camera": {"turn_deg": 0.4}},
    }


def test_scenario_of_the_present_format_stays_as_it_is() -> None:
    for text in (json.dumps(FORMAT_3), "no JSON", "[1, 2]"):
        assert migrated(text) == text


def test_removed_keys_are_accepted_with_the_value_that_holds_now() -> None:
    tables = {"docking": {"settle_s": 2.0, "pull_N": 0.4}, "detumble": {"response_s": 0.7}}
    values = json.loads(json.dumps(tables))
    drop_removed_keys(values)
    assert values == {"docking": {"pull_N": 0.4}, "detumble": {"response_s": 0.7}}
    assert old_keys(values) == [
        "detumble.response_s: it is 0.5 in every flight now; remove the key"
    ]
    assert json.loads(migrated(json.dumps({"format": FORMAT, **tables}))) == {
        "format": FORMAT, "docking": {"pull_N": 0.4}, "detumble": {},
    }  # fmt: skip


def test_parts_that_were_removed_are_named() -> None:
    used = {"chaser": {"modulation": {"modulator": "schmitt", "carry_over": True}}, "plume": None}
    values = json.loads(json.dumps(used))
    drop_removed_keys(values)
    assert old_keys(values) == [
        "chaser.modulation.modulator: the Schmitt trigger was removed: with it errors were ten "
        "times larger, and propellant three times; remove the key"
    ]
    assert json.loads(migrated(json.dumps({"format": FORMAT, **used})))["chaser"] == {
        "modulation": {}
    }


def test_old_keys_are_named_with_their_present_names() -> None:
    assert old_keys(FORMAT_3) == []
    lines = old_keys(FORMAT_1)
    for path, new in (
        ("time.picture_hz", "image_hz"),
        ("timeline.0.jet", "thruster"),
        ("jet_failure", "thruster_f"),
    ):
        assert any(line.startswith(path) and new in line for line in lines), path


# -- a whole log -----------------------------------------------------------------------------------


def test_log_of_version_1_reads_as_present_messages(tmp_path: Path) -> None:
    path = tmp_path / "old.mcap"
    writer = LogWriter(path)
    writer.describe(json.dumps(FORMAT_1), {"run_id": "r1"})
    written = []
    for topic in topics.TOPICS:
        message: Any = PRESENT[topic.kind.__name__]
        place = getattr(message, "chaser", 0) if "{chaser}" in topic.key else "controller"
        key = topic.key_of(place if "{" in topic.key else None)
        fields, encoding = version_1(message)
        old_key = key.replace("/thrusters", "/jets")
        writer.write(old_key, encoding, msgspec.msgpack.encode(fields), 1)
        written.append((key, message))
    writer.close()
    rejected: Counter[str] = Counter()
    assert [(r.key, r.message) for r in read_log(path, rejected=rejected)] == written
    assert not rejected
    assert json.loads(read_scenario(path)[0]) == FORMAT_3


def test_removed_estimator_is_one_line_in_a_file_and_can_be_read_from_a_log(
    tmp_path: Path,
) -> None:
    line = r"estimator.name: 'mekf' was removed; 'joint' estimates the chasers, too"
    single = ROOT / "scenarios" / "single.toml"
    with pytest.raises(ScenarioError, match=f"^--set estimator.name=mekf: {line}$"):
        load_scenario(single, ("estimator.name=mekf",))
    file = tmp_path / "old.toml"
    file.write_text('extends = "single"\n[estimator]\nname = "mekf"\n')
    with pytest.raises(ScenarioError, match=f"old.toml: {line}$"):
        load_scenario(file)
    logged = load_scenario(single).model_dump(mode="json") | {"estimator": {"name": "mekf"}}
    assert scenario_from_json(migrated(json.dumps(logged)), "a log").estimator.name == "mekf"
