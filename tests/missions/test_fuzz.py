# SPDX-License-Identifier: Apache-2.0
"""Decoders under mutated input (a short benchmarks/fuzz.py), and the check of what they accept."""

from __future__ import annotations

import random

import msgpack
import msgspec
import pytest
from chaserdock_protocol import codec
from chaserdock_protocol import messages as m
from chaserdock_protocol.messages import MAX_COUNT
from fuzzing import boundaries, fuzz_logs, fuzz_messages, fuzz_scenarios, garbage_in, mutate
from message_samples import BY_TYPE

KINDS = sorted(set(boundaries().values()), key=lambda kind: kind.__name__)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_mutated_messages_are_rejected_or_valid(kind: type[msgspec.Struct]) -> None:
    out = fuzz_messages(kind, 2000, seed=7)
    assert (out.crashes, out.garbage) == ([], [])
    assert sum(out.refused.values()) > 1000
    assert out.accepted > 20  # mutations are mild enough that some inputs stay valid


def test_mutated_scenarios_raise_scenario_error_only() -> None:
    out = fuzz_scenarios(120, seed=7)
    assert (out.crashes, out.garbage) == ([], [])
    assert out.refused["ScenarioError"] > 60
    assert out.accepted > 1


def test_mutated_logs_raise_log_error_only() -> None:
    out = fuzz_logs(15, seed=7)
    assert (out.crashes, out.garbage) == ([], [])
    assert out.refused["LogError"] > 5


def test_equal_seed_makes_equal_mutations() -> None:
    payload = codec.encode(BY_TYPE[m.Odometry])
    one, other = random.Random(3), random.Random(3)
    assert [mutate(payload, one) for _ in range(200)] == [
        mutate(payload, other) for _ in range(200)
    ]


def test_check_finds_invalid_messages() -> None:
    """The check does not depend on the codec: it also finds messages that the codec would
    reject.
    """
    odometry = BY_TYPE[m.Odometry]
    assert garbage_in(odometry) is None
    for name, bad in (
        ("position_m", (1.0, 2.0)),
        ("position_m", (1.0, 2.0, float("nan"))),
        ("position_m", (1.0, 2.0, 1e16)),
        ("position_m", (1.0, 2.0, 3)),
        ("q_wxyz", (1.0, 1.0, 0.0, 0.0)),
        ("chaser", 256),
        ("chaser", True),
        ("seq", MAX_COUNT + 1),
    ):
        assert garbage_in(msgspec.structs.replace(odometry, **{name: bad})) is not None, (name, bad)
    assert garbage_in(msgspec.structs.replace(BY_TYPE[m.WrenchCommand], mode="ram")) is not None


@pytest.mark.parametrize(
    ("kind", "field", "bad", "reason"),
    [
        (m.Odometry, "seq", 2**63, "format"),
        (m.Odometry, "sim_time_ns", MAX_COUNT + 1, "format"),
        (m.Odometry, "position_m", [0.0, 0.0, 1e16], "range"),
        (m.Health, "lost", 2**64 - 1, "format"),
        (m.Farewell, "published", {"k": 2**63}, "format"),
        (m.Presence, "heard", {str(k): "x" for k in range(2000)}, "format"),
        (m.Tick, "chasers", [0] * 300, "format"),
        (m.TargetEstimate, "covariance", [-1.0] + [0.0] * 143, "not_a_covariance"),
    ],
)
def test_inputs_found_by_fuzzing_are_rejected(
    kind: type[msgspec.Struct], field: str, bad: object, reason: str
) -> None:
    values = msgpack.unpackb(codec.encode(BY_TYPE[kind])) | {field: bad}
    payload = msgpack.packb(values)
    assert isinstance(payload, bytes)
    with pytest.raises(codec.Rejected) as caught:
        codec.decode(kind, payload)
    assert caught.value.reason == reason
