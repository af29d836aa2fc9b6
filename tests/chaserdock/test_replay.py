# SPDX-License-Identifier: Apache-2.0
"""Replay of logs through current code; comparison of messages and of runs."""

from __future__ import annotations

import dataclasses
import re
import shutil
import zlib
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
from chaserdock_controller.estimation.joint import JointEstimator
from chaserdock_controller.estimation.types import Estimate, EstimatorInputs
from chaserdock_protocol import codec, topics
from chaserdock_protocol import messages as m
from chaserdock_protocol.recording.log import LogWriter, Record, read_log, read_scenario
from chaserdock_protocol.recording.provenance import blas_in_use
from chaserdock_protocol.recording.scan import stored_messages
from chaserdock_protocol.recording.schema_migrations import UPGRADES, current_key, decode_logged
from chaserdock_protocol.replay_node import order_by_tick
from chaserdock_protocol.transport import ReceivedMessage
from harness import finished
from message_samples import BY_TYPE
from motion_cases import rewritten

from chaserdock.analysis.flight import load_flight
from chaserdock.replay.compare import compare, comparison_lines
from chaserdock.replay.difference import (
    Comparison,
    difference_lines,
    field_differences,
    first_difference,
)
from chaserdock.replay.run import replay

FOLDER = Path(__file__).parents[1] / "golden"
GOLDEN = FOLDER / "two-chasers.mcap"
STAGES = ("perception", "fusion", "controller")
REPLAYS = [(GOLDEN, s) for s in STAGES] + [
    (FOLDER / "capture.mcap", s) for s in ("fusion", "controller")
]
# Another kind of CPU differs in the last bits, and a plan's inputs magnify them; nothing else may.
TOLERANCE = 1e-4


# -- golden logs -----------------------------------------------------------------------------------


def test_every_golden_log_is_replayed() -> None:
    assert {log for log, _ in REPLAYS} == set(FOLDER.glob("*.mcap"))


@pytest.mark.parametrize(("log", "through"), REPLAYS, ids=lambda p: getattr(p, "stem", p))
def test_golden_logs_replay_equal(log: Path, through: str) -> None:
    found = replay(log, through, tolerance=TOLERANCE)
    differences = "\n".join(difference_lines(found.topics, ("recorded", "now")))
    assert found.equal, differences
    assert sum(t.compared for t in found.topics) >= 18, differences
    assert found.notes == []


@pytest.mark.parametrize("through", STAGES)
def test_replay_is_deterministic(through: str) -> None:
    what_if = ("limits.min_distance_target_m=0.5", "estimator.name='paper'")
    assert replay(GOLDEN, through, what_if) == replay(GOLDEN, through, what_if)


def test_replay_does_not_depend_on_the_order_in_the_file(tmp_path: Path) -> None:
    """A recorder receives the processes in any order; here the keys are shuffled within a tick."""
    shuffled, path = (
        sorted(
            read_log(GOLDEN), key=lambda r: r.message.tick * 1000 + zlib.crc32(r.key.encode()) % 7
        ),
        tmp_path / "s.mcap",
    )
    writer = LogWriter(path)
    writer.describe(read_scenario(GOLDEN)[0], {"mode": "lockstep"})
    for r in shuffled:
        writer.write(r.key, m.encoding_of(type(r.message)), codec.encode(r.message), r.sent_ns)
    writer.close()
    assert replay(path, "controller", tolerance=TOLERANCE).equal


def test_replay_finds_a_change_in_the_filter(monkeypatch: pytest.MonkeyPatch) -> None:
    """The filter's estimate moved by a tenth of a millimetre from half a second on: the diff says
    where and when.
    """
    original = JointEstimator.update

    def changed(self: JointEstimator, inputs: EstimatorInputs) -> Estimate:
        estimate = original(self, inputs)
        if inputs.time_ns < 500_000_000:
            return estimate
        moved = estimate.target.position_m + np.array([1e-4, 0.0, 0.0])
        return dataclasses.replace(
            estimate, target=dataclasses.replace(estimate.target, position_m=moved)
        )

    monkeypatch.setattr(JointEstimator, "update", changed)
    found = replay(GOLDEN, "fusion", tolerance=1e-6)
    (target,) = found.topics
    assert target.key == "controller/target"
    (field,) = target.fields.values()
    assert field.name == "position_m"
    assert field.first_tick == 8
    assert field.first_time_s == pytest.approx(8 / 15, abs=1e-6)
    assert field.largest == pytest.approx(1e-4, rel=0.02)
    assert target.unequal == target.compared - 8
    assert first_difference(found.topics) == "controller/target: position_m at 0.533 s (tick 8)"


def test_override_changes_only_dependent_messages() -> None:
    """Other weights: other commands, the same estimate."""
    found = {
        t.key: t for t in replay(GOLDEN, "controller", ("controller.weight_force=5.0",)).topics
    }
    assert found["controller/chaser/0/wrench"].unequal > 10
    assert "force_N" in found["controller/chaser/0/wrench"].fields
    estimate = replay(GOLDEN, "fusion", ("controller.weight_force=5.0",)).topics
    assert estimate == replay(GOLDEN, "fusion").topics


def test_missing_and_extra_answers_are_reported(tmp_path: Path) -> None:
    def change(record: Record) -> Any:
        if (
            record.topic is topics.SIGHTING
            and record.message.chaser == 1
            and record.message.tick == 5
        ):
            return None
        return record.message

    log = rewritten(GOLDEN, tmp_path / "a.mcap", change)
    found = {t.key: t for t in replay(log, "perception", tolerance=TOLERANCE).topics}
    assert found["chaser/1/sighting"].alone == [0, 1]
    assert found["chaser/1/sighting"].alone_time_s == pytest.approx(5 / 15, abs=1e-6)
    assert found["chaser/0/sighting"].equal


def test_operator_commands_are_replayed(tmp_path: Path) -> None:
    """A recorded command takes effect in the replay at its tick."""
    command = m.OperatorCommand(tick=9, sim_time_ns=600_000_000, command="hold", chaser=1)

    def with_command(path: Path, commanded: bool) -> Path:
        source = rewritten(GOLDEN, path.with_suffix(".tmp"))
        writer = LogWriter(path)
        writer.describe(read_scenario(source)[0], {"mode": "lockstep"})
        for r in read_log(source):
            writer.write(r.key, m.encoding_of(type(r.message)), codec.encode(r.message), r.sent_ns)
        if commanded:
            writer.write(
                "controller/operated", m.encoding_of(m.OperatorCommand), codec.encode(command), 1
            )
        writer.close()
        return path

    for commanded, extra in ((False, 0), (True, 1)):
        found = {
            t.key: t
            for t in replay(
                with_command(tmp_path / f"{commanded}.mcap", commanded), "controller"
            ).topics
        }
        # Today's reply has no recorded counterpart.
        assert found["controller/command"].alone == [0, extra]


@pytest.mark.slow
def test_replay_command(tmp_path: Path) -> None:
    log = str(GOLDEN)
    status, said = finished("replay", log, "--through", "fusion", "--tolerance", str(TOLERANCE))
    assert (status, said.splitlines()[-1]) == (0, "equal to the log"), said
    status, said = finished("replay", log, "--through", "fusion", "--set", "estimator.name='paper'")
    assert status == 1, said
    assert "first difference: controller/target: " in said
    for arguments, words in (
        (
            ["replay", log, "--through", "thought"],
            "--through thought: must be one of controller, fusion, perception",
        ),
        (
            ["replay", log, "--through", "fusion", "--set", "limits.nonsense=1"],
            "unknown key limits.nonsense",
        ),
        (["replay", str(tmp_path), "--through", "fusion"], "holds no log"),
    ):
        status, said = finished(*arguments)
        assert status == 2, said
        assert words in said
        assert "Traceback" not in said


# -- order -----------------------------------------------------------------------------------------


def test_by_tick_orders_messages_of_a_tick_for_the_stage() -> None:
    from chaserdock_controller.replay import CONTROLLER

    def received(topic: topics.Topic, tick: int, **changes: Any) -> ReceivedMessage:
        message: Any = msgspec.structs.replace(BY_TYPE[topic.kind], tick=tick, **changes)  # type: ignore[type-var]
        return ReceivedMessage(topic, None, message, 0)

    given = [
        received(topics.SIGHTING, 1),
        received(topics.TICK, 1, revision=1),
        received(topics.ODOMETRY, 0),
        received(topics.TICK, 1, revision=0),
        received(topics.ODOMETRY, 1),
        received(topics.TARGET, 1),
        received(topics.TICK, 0, revision=0),
    ]
    order = [
        (r.message.tick, r.topic.key, getattr(r.message, "revision", 0))
        for r in order_by_tick(CONTROLLER, given)
    ]
    assert order == [
        (0, "world/tick", 0),
        (0, "world/chaser/{chaser}/odometry", 0),
        (1, "controller/target", 0),
        (1, "world/tick", 0),
        (1, "world/chaser/{chaser}/odometry", 0),
        (1, "chaser/{chaser}/sighting", 0),
        (1, "world/tick", 1),
    ]


# -- comparison ------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "sample",
    [s for s in BY_TYPE.values() if isinstance(s, m.Message)],
    ids=lambda s: type(s).__name__,
)
def test_every_changed_field_is_found(sample: m.Message) -> None:
    assert list(field_differences(sample, sample)) == []
    for name in sample.__struct_fields__:
        value = getattr(sample, name)
        other: Any
        match value:
            case bool():
                other = not value
            case int() | float():
                other = value + 1
            case str():
                other = value + "?"
            case bytes():
                other = value + b"?"
            case (float(), *rest):
                other = (value[0] + 0.5, *rest)
            case tuple():
                other = (*value, *value, 1)
            case _:
                other = {"other": 1}
        found = list(field_differences(sample, msgspec.structs.replace(sample, **{name: other})))
        expected = [] if name == "seq" or name.startswith("wall_") else [name]
        assert [f[0] for f in found] == expected


def test_the_difference_of_numbers_has_no_sign() -> None:
    one, other = m.RecorderAck(tick=3), m.RecorderAck(tick=5)
    assert list(field_differences(one, other)) == [("tick", 3, 5, 2)]
    assert list(field_differences(other, one)) == [("tick", 5, 3, 2)]


def test_differences_in_nested_structures_are_located() -> None:
    sample: Any = BY_TYPE[m.Sighting]
    moved = msgspec.structs.replace(sample.solutions[1], position_m=(0.25, -1.0, 3.0))
    other = msgspec.structs.replace(sample, solutions=(sample.solutions[0], moved))
    assert list(field_differences(sample, other)) == [("solutions[1].position_m", -1.5, -1.0, 0.5)]


def ticks(number: int, x: float = 0.0, jump_at: int = 10**9) -> Iterator[m.Odometry]:
    for k in range(number):
        yield m.Odometry(
            tick=k,
            sim_time_ns=k * 100_000_000,
            chaser=0,
            position_m=(x if k >= jump_at else 0.0, 0.0, 0.0),
            velocity_m_s=(0.0, 0.0, 0.0),
            q_wxyz=(1.0, 0.0, 0.0, 0.0),
            omega_rad_s=(0.0, 0.0, 0.0),
        )


def compared(a: Iterable[m.Message], b: Iterable[m.Message], tolerance: float = 0.0) -> Any:
    comparison = Comparison(tolerance)
    for side, messages in enumerate((a, b)):
        for message in messages:
            comparison.add(side, "k", message)
    (topic,) = comparison.finish()
    return topic


def test_comparison_reports_first_and_largest_difference() -> None:
    topic = compared(ticks(50), ticks(50, x=0.5, jump_at=20))
    field = topic.fields["position_m"]
    assert (topic.compared, topic.unequal, topic.alone) == (50, 30, [0, 0])
    assert (field.first_tick, field.first_time_s, field.first, field.largest) == (
        20,
        2.0,
        (0.0, 0.5),
        0.5,
    )
    assert compared(ticks(50), ticks(50, x=0.5, jump_at=20), tolerance=0.5).equal
    assert not compared(ticks(50), ticks(50, x=0.5, jump_at=20), tolerance=0.49).equal
    assert compared(ticks(50), ticks(47)).alone == [3, 0]
    assert compared(ticks(3), ticks(9)).alone == [0, 6]


def test_comparison_has_bounded_memory() -> None:
    """Memory is bounded when one side publishes a key at every tick that the other never does."""
    comparison = Comparison()
    for message in ticks(60_000):
        comparison.add(0, "only here", message)
        comparison.add(0, "both", message)
        comparison.add(1, "both", message)
    assert sum(map(len, comparison._waiting)) <= 21_000
    found = {t.key: t for t in comparison.finish()}
    assert found["only here"].alone == [60_000, 0]
    assert found["both"].equal


# -- two runs --------------------------------------------------------------------------------------


def test_equal_runs_compare_equal(tmp_path: Path) -> None:
    shutil.copy(GOLDEN, tmp_path / "mission.mcap")
    found = compare(GOLDEN, tmp_path)
    assert found.equal
    assert found.summary == {}
    assert comparison_lines(found) == [f"equal flights, digest {found.digests[0]}"]


def test_compare_reports_different_blas_kernels(tmp_path: Path) -> None:
    one, other = (
        rewritten(GOLDEN, tmp_path / name, blas=name) for name in ("a Haswell", "a SkylakeX")
    )
    found = compare(one, other)
    assert comparison_lines(found) == [
        "different BLAS of recorder, whose results differ in the last bits: a Haswell; a SkylakeX",
        f"equal flights, digest {found.digests[0]}",
    ]
    assert len(comparison_lines(compare(one, one))) == 1
    unstated = rewritten(GOLDEN, tmp_path / "unstated", blas="")  # as older logs
    assert len(comparison_lines(compare(one, unstated))) == 1


def test_every_process_states_its_blas(short_flight: Path) -> None:
    processes = ("world", "controller", "chaser/0", "chaser/1", "recorder")
    assert load_flight(short_flight).blas == dict.fromkeys(processes, blas_in_use())


def test_compare_names_the_process_whose_blas_differs(tmp_path: Path) -> None:
    def flown_with(blas: str) -> Any:
        def change(record: Record) -> Any:
            own = record.key == "controller/health"
            return msgspec.structs.replace(record.message, blas=blas) if own else record.message

        return change

    names = ("a Haswell", "a SkylakeX")
    one, other = (
        rewritten(GOLDEN, tmp_path / name, flown_with(name), blas="a Haswell") for name in names
    )
    assert comparison_lines(compare(one, other))[:-1] == [
        "different BLAS of controller, whose results differ in the last bits: a Haswell; a SkylakeX"
    ]


def test_compare_reports_deviations_of_bodies(tmp_path: Path) -> None:
    def change(record: Record) -> Any:
        message = record.message
        if record.key == "truth/body/chaser/1" and message.tick >= 6:
            x, y, z = message.position_m
            return msgspec.structs.replace(
                message, position_m=(x + 0.01 * (message.tick == 12), y, z + 0.002)
            )
        return message

    found = compare(GOLDEN, rewritten(GOLDEN, tmp_path / "b.mcap", change))
    assert not found.equal
    assert found.first_difference == "truth/body/chaser/1: position_m at 0.400 s (tick 6)"
    assert found.deviations["chaser/1"].position_m == pytest.approx((0.01**2 + 0.002**2) ** 0.5)
    assert found.deviations["chaser/1"].position_time_s == pytest.approx(0.8)
    assert found.deviations["chaser/0"].position_m == 0.0
    assert [t.key for t in found.topics if not t.equal] == ["truth/body/chaser/1"]
    assert any("chasers.1.position_mse_m2" in line for line in comparison_lines(found))


def test_golden_log_encodes_to_the_same_values_after_its_upgrades() -> None:
    """No field was renamed, retyped or reordered without an upgrade."""
    for channel, stored in stored_messages(GOLDEN):
        topic = topics.topic_of_key(current_key(channel.topic))
        if topic is None or channel.topic.startswith("/viewer/"):
            continue
        encoding = channel.metadata["zenoh_encoding"]
        recorded = re.fullmatch(r"application/msgpack;chaserdock\.(\w+)\.v(\d+)", encoding)
        assert recorded is not None
        values, version = msgspec.msgpack.decode(stored.data), int(recorded[2])
        while (upgrade := UPGRADES.get((topic[0].kind.__name__, version))) is not None:
            values, version = upgrade(values), version + 1
        message = decode_logged(topic[0].kind, stored.data, encoding)
        again = msgspec.msgpack.decode(codec.encode(message))
        assert {k: again[k] for k in values} == values
