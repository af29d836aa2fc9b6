# SPDX-License-Identifier: Apache-2.0
"""Tables, typed messages and tracks of a finished log."""

from __future__ import annotations

import csv
import json
import shutil
import subprocess
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pyarrow.parquet as pq
import pytest
from chaserdock_protocol import messages as m
from chaserdock_protocol import topics
from chaserdock_protocol.recording.log import LogError, Record, count_messages, read_log
from message_samples import BY_TYPE

from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.summary import estimate_errors
from chaserdock.logs import open_log
from chaserdock.logs.export import export
from chaserdock.logs.tables import TopicTable, table_name
from chaserdock.logs.tracks import write_tracks

GOLDEN = Path(__file__).parents[1] / "golden" / "two-chasers.mcap"


# -- tables and tracks -----------------------------------------------------------------------------


def check_part(row: dict[str, Any], name: str, values: dict[str, Any]) -> None:
    """Check the columns of a structure in a message, and of those in it."""
    for part, value in values.items():
        if isinstance(value, dict):
            check_part(row, f"{name}_{part}", value)
        elif part == "q_wxyz":
            assert [row[f"{name}_q_{axis}"] for axis in "wxyz"] == list(value)
        elif f"{name}_{part}" in row:
            assert row[f"{name}_{part}"] == (list(value) if isinstance(value, tuple) else value)
        else:
            assert [row[f"{name}_{part}_{axis}"] for axis in "xyz"] == list(value)


@pytest.mark.parametrize("topic", topics.TOPICS, ids=lambda t: t.key)
def test_every_message_fits_its_table(topic: topics.Topic) -> None:
    sample: Any = BY_TYPE[topic.kind]
    place = 3 if "{chaser}" in topic.key else "chaser/0" if "{process}" in topic.key else None
    table = TopicTable(topic)
    table.add(Record(topic.key_of(place), topic, str(place), sample, 99))
    whole = dict(table.take_all())
    (row,) = whole[table_name(topic)].to_pylist()
    assert (row["sent_ns"], row["tick"], row["time_s"]) == (99, 12, 0.8)
    for name in sample.__struct_fields__:
        value = getattr(sample, name)
        if name == "q_wxyz":
            assert [row[f"q_{axis}"] for axis in "wxyz"] == list(value)
        elif f"{name}_x" in row:
            assert [row[f"{name}_{axis}"] for axis in "xyz"] == list(value or [None] * 3)
        elif isinstance(value, tuple) and value and isinstance(value[0], msgspec.Struct):
            inner = whole[f"{table_name(topic)}_{name}"].to_pylist()
            assert [r["index"] for r in inner] == list(range(len(value)))
            first: Any = msgspec.to_builtins(value[0])
            plain = {
                k: list(v) if isinstance(v, tuple) else v for k, v in first.items() if k in inner[0]
            }
            assert plain
            assert all(inner[0][k] == v for k, v in plain.items())
        elif isinstance(value, msgspec.Struct):
            check_part(row, name, msgspec.to_builtins(value))
        elif value == () and name not in row:
            assert (
                len(whole[f"{table_name(topic)}_{name}"]) == 0
            )  # a list of structures, none this time
        elif isinstance(value, dict):
            assert json.loads(row[name]) == value
        elif isinstance(value, bytes):
            assert row[f"{name}_bytes"] == len(value)
        else:
            assert row[name] == json.loads(json.dumps(value))  # lists, as tables have them


def test_exported_files_hold_every_message_with_units(tmp_path: Path) -> None:
    rows = export(GOLDEN, tmp_path / "parquet", "parquet", images=True)
    assert rows["controller_target.parquet"] == 18
    # Lists of structures within a message have tables of their own.
    nested = tuple(
        f"_{name}.parquet" for name in ("solutions", "relative", "cameras", "bodies", "innovations")
    )
    messages = sum(n for name, n in rows.items() if not name.endswith(nested))
    assert messages == sum(count_messages(GOLDEN).values())
    truth = pq.read_table(tmp_path / "parquet" / "truth_body.parquet")
    field = truth.schema.field("velocity_m_s_x")
    assert field.metadata == {b"unit": b"m/s"}
    assert truth.schema.field("q_w").metadata is None
    odometry = pq.read_schema(tmp_path / "parquet" / "world_chaser_odometry.parquet")
    assert odometry.field("velocity_covariance_m2_s2").metadata == {b"unit": "m²/s²".encode()}
    expected = [r.message.velocity_m_s[0] for r in read_log(GOLDEN) if r.topic is topics.TRUTH_BODY]
    assert truth["velocity_m_s_x"].to_pylist() == expected
    images = pq.read_table(tmp_path / "parquet" / "world_chaser_image.parquet")["data"].to_pylist()
    assert images == [r.message.data for r in read_log(GOLDEN) if r.topic is topics.IMAGE]
    assert open_log(GOLDEN).table("truth/body/{process}").equals(truth)

    assert {
        k.replace("csv", "parquet"): n for k, n in export(GOLDEN, tmp_path / "csv", "csv").items()
    } == rows
    with (tmp_path / "csv" / "truth_body.csv").open(newline="") as file:
        table = list(csv.DictReader(file))
    assert [float(row["velocity_m_s_x"]) for row in table] == expected  # to the last bit
    with pytest.raises(LogError, match="already exists; export into an empty folder"):
        export(GOLDEN, tmp_path / "csv", "csv")


def test_open_log_iterates_typed_messages_by_topic() -> None:
    log = open_log(GOLDEN)
    assert log.scenario.name == "two-chaser-tracking"
    assert [type(x) for x in log.messages(topics.TARGET)] == [m.TargetEstimate] * 18
    assert {x.chaser for x in log.messages("chaser/{chaser}/sighting")} == {0, 1}
    assert {x.chaser for x in log.messages("chaser/1/sighting")} == {1}
    assert {r.key for r in log.records(topics.TRUTH_BODY)} == {
        f"truth/body/{b}" for b in ("target", "chaser/0", "chaser/1")
    }
    assert sum(1 for _ in log.records()) == sum(log.counts.values())
    with pytest.raises(
        LogError, match="nonsense: no such topic or table; known topics: world/tick"
    ):
        log.table("nonsense")


def test_tracks_are_the_poses_in_tum_order(tmp_path: Path) -> None:
    points = write_tracks(GOLDEN, tmp_path)
    assert points["target_truth.tum"] == 19
    assert points["target_estimate.tum"] == 18
    flight = load_flight(GOLDEN)
    rows = np.loadtxt(tmp_path / "chaser_1_truth.tum")
    track = flight.motion["chaser/1"]
    assert np.array_equal(rows[:, 1:4], track.position_m)
    assert np.array_equal(rows[:, [7, 4, 5, 6]], track.q_wxyz)
    assert np.allclose(rows[:, 0], track.time_s, atol=1e-9)
    assert write_tracks(GOLDEN, tmp_path / "late", from_s=0.5, to_s=0.8)["target_truth.tum"] == 5
    with pytest.raises(LogError, match="contains no track between 5 and 6 s"):
        write_tracks(GOLDEN, tmp_path / "none", 5.0, 6.0)


@pytest.mark.skipif(
    shutil.which("evo_ape") is None, reason="evo is a check from outside (GPL), not a dependency"
)
def test_errors_equal_those_of_evo(tmp_path: Path) -> None:
    write_tracks(GOLDEN, tmp_path)
    errors = estimate_errors(load_flight(GOLDEN))
    for relation, ours in (
        ("trans_part", errors["position_m"]),
        ("angle_rad", errors["orientation_rad"]),
    ):
        result = tmp_path / f"{relation}.zip"
        tracks = [str(tmp_path / "target_truth.tum"), str(tmp_path / "target_estimate.tum")]
        subprocess.run(
            ["evo_ape", "tum", *tracks, "-r", relation, "--save_results", str(result)], check=True
        )
        shutil.unpack_archive(result, tmp_path / relation)
        theirs = json.loads((tmp_path / relation / "stats.json").read_text())["rmse"]
        assert theirs == pytest.approx(float(np.sqrt(np.mean(ours**2))), rel=0.01)


def test_every_exported_file_is_a_table_of_the_same_name(tmp_path: Path) -> None:
    """Names of files and of `Log.table` are one set, with the lists of structures."""
    export(GOLDEN, tmp_path, "parquet")
    log = open_log(GOLDEN)
    files = sorted(tmp_path.glob("*.parquet"))
    assert "chaser_sighting_solutions" in [file.stem for file in files]
    for file in files:
        assert log.table(file.stem).equals(pq.read_table(file)), file.stem
    assert log.table("chaser_sighting").equals(log.table("chaser/{chaser}/sighting"))
