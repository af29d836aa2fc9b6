"""The boundaries under mutated input, a quick version of benchmarks/fuzz.py; and that the judge sees garbage."""

from __future__ import annotations

import random

import msgpack
import msgspec
import pytest
from chaserdock_protocol import codec
from chaserdock_protocol import messages as m
from chaserdock_protocol.messages.fields import MAX_COUNT
from fuzz import boundaries, fuzz_logs, fuzz_messages, fuzz_scenarios
from message_samples import BY_TYPE
from mutations import garbage_in, mutate

KINDS = sorted(set(boundaries().values()), key=lambda kind: kind.__name__)


@pytest.mark.parametrize("kind", KINDS, ids=lambda kind: kind.__name__)
def test_mutated_messages_are_refused_or_sound(kind: type[msgspec.Struct]) -> None:
    out = fuzz_messages(kind, 2000, seed=7)
    assert (out.crashes, out.garbage) == ([], [])
    assert sum(out.refused.values()) > 1000
    assert out.accepted > 20  # the mutator is not so rough that nothing is ever left to judge


def test_mutated_scenarios_have_one_kind_of_error() -> None:
    out = fuzz_scenarios(120, seed=7)
    assert (out.crashes, out.garbage) == ([], [])
    assert out.refused["ScenarioError"] > 60
    assert out.accepted > 3


def test_mutated_logs_have_one_kind_of_error() -> None:
    out = fuzz_logs(15, seed=7)
    assert (out.crashes, out.garbage) == ([], [])
    assert out.refused["LogError"] > 5


def test_equal_seed_makes_equal_mutations() -> None:
    payload = codec.encode(BY_TYPE[m.Odometry])
    one, other = random.Random(3), random.Random(3)
    assert [mutate(payload, one) for _ in range(200)] == [mutate(payload, other) for _ in range(200)]


def test_the_judge_sees_garbage() -> None:
    """It must not lean on the codec: messages made past it are judged, too."""
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
def test_what_fuzzing_found_is_refused(
    kind: type[msgspec.Struct], field: str, bad: object, reason: str
) -> None:
    values = msgpack.unpackb(codec.encode(BY_TYPE[kind])) | {field: bad}
    payload = msgpack.packb(values)
    assert isinstance(payload, bytes)
    with pytest.raises(codec.Rejected) as caught:
        codec.decode(kind, payload)
    assert caught.value.reason == reason
