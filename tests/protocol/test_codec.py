# SPDX-License-Identifier: Apache-2.0
"""Message types and codec: what passes, what must not, and how messages may grow."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import suppress
from typing import Any

import msgpack
import msgspec
import pytest
from chaserdock_protocol import codec, topics
from chaserdock_protocol import messages as m
from chaserdock_protocol.codec import Rejected
from hypothesis import given, settings
from hypothesis import strategies as st
from message_samples import BY_TYPE, EYE6, EYE12, SAMPLES, SOLUTION
from msgspec import inspect

quick = settings(derandomize=True, deadline=None, max_examples=100)


def named(sample: msgspec.Struct) -> str:
    return type(sample).__name__


def plain(message: msgspec.Struct) -> dict[str, Any]:
    """Return the value as a reader without our types decodes it."""
    return msgpack.unpackb(codec.encode(message))


def repacked(values: Any) -> bytes:
    packed = msgpack.packb(values)
    assert isinstance(packed, bytes)
    return packed


def as_lists(value: Any) -> Any:
    """The value with msgpack's one kind of sequence."""
    if isinstance(value, msgspec.Struct):
        return {f: as_lists(getattr(value, f)) for f in value.__struct_fields__}
    if isinstance(value, tuple):
        return [as_lists(v) for v in value]
    return value


def rejection(kind: type[msgspec.Struct], payload: bytes, encoding: str | None = None) -> Rejected:
    with pytest.raises(Rejected) as caught:
        codec.decode(kind, payload, encoding)
    return caught.value


def test_there_is_a_sample_of_every_message() -> None:
    assert set(BY_TYPE) == set(m.VERSION)
    assert len(SAMPLES) == len(m.VERSION)
    # Every message type of the module stands in the table; parts of messages never stand alone.
    types = {t for t in vars(m).values() if isinstance(t, type) and issubclass(t, msgspec.Struct)}
    parts = {
        m.CameraCalibration,
        m.ChosenPort,
        m.CommandedWrench,
        m.DrawnBody,
        m.ExpectedPose,
        m.GeometryEstimate,
        m.GeometryMeasurement,
        m.Innovation,
        m.KnownTracks,
        m.MappedMotion,
        m.MassEstimate,
        m.PoseSolution,
        m.ProbeTouch,
        m.RangeMeasurement,
        m.RelativeEstimate,
        m.SightedMap,
        m.ThrusterPulse,
    }
    assert types - set(m.VERSION) - {msgspec.Struct, m.Message} - parts == set()


@pytest.mark.parametrize("sample", SAMPLES, ids=named)
def test_round_trip(sample: msgspec.Struct) -> None:
    payload = codec.encode(sample)
    back = codec.decode(type(sample), payload, m.encoding_of(type(sample)))
    assert back == sample
    assert type(back) is type(sample)
    assert codec.encode(back) == payload


@pytest.mark.parametrize("sample", SAMPLES, ids=named)
def test_plain_msgpack_reads_and_writes_the_same(sample: msgspec.Struct) -> None:
    values = plain(sample)
    assert values == as_lists(sample)
    assert codec.decode(type(sample), repacked(values)) == sample


# -- what must not pass ----------------------------------------------------------------------------


@pytest.mark.parametrize("sample", SAMPLES, ids=named)
def test_truncated_payloads_are_rejected_wherever_they_end(sample: msgspec.Struct) -> None:
    payload = codec.encode(sample)
    for end in range(0, len(payload), max(1, len(payload) // 50)):
        assert rejection(type(sample), payload[:end]).reason == "format"
    assert rejection(type(sample), payload + b"\x00").reason == "format"


JUNK = [
    b"",
    b"\xc1",
    b"\x00",
    b"\xff" * 100,
    b"junk",
    msgpack.packb([1, 2]),
    msgpack.packb({1: 2}),
    b"\x81\xa1x" + b"\x91" * 200_000,  # an unknown field, nested beyond any stack
    b"\xdf\xff\xff\xff\xff",  # a map that claims four thousand million entries
]


@pytest.mark.parametrize("payload", JUNK, ids=range(len(JUNK)))
def test_junk_is_rejected(payload: bytes) -> None:
    for kind in m.VERSION:
        assert rejection(kind, payload).reason == "format"


def test_text_must_be_utf8() -> None:
    payload = codec.encode(BY_TYPE[m.Event]).replace(b"process lost", b"process \xff\xfe\xfdt")
    assert rejection(m.Event, payload).reason == "format"


@given(st.binary(max_size=300), st.sampled_from(list(m.VERSION)))
@quick
def test_no_bytes_raise_anything_but_rejected(payload: bytes, kind: type[msgspec.Struct]) -> None:
    # Any other exception fails the test; whatever passes has its numbers checked.
    with suppress(Rejected):
        codec.check_numbers(codec.decode(kind, payload))


@given(st.sampled_from(SAMPLES), st.data())
@quick
def test_flipped_bytes_raise_nothing_but_rejected(
    sample: msgspec.Struct, data: st.DataObject
) -> None:
    payload = bytearray(codec.encode(sample))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    with suppress(Rejected):
        codec.check_numbers(codec.decode(type(sample), bytes(payload)))


def places_of_floats(values: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    if isinstance(values, float):
        return [path]
    items = (
        values.items()
        if isinstance(values, dict)
        else enumerate(values)
        if isinstance(values, list)
        else ()
    )
    return [place for key, value in items for place in places_of_floats(value, (*path, key))]


def with_value(values: Any, path: tuple[Any, ...], value: Any) -> Any:
    copy = msgpack.unpackb(repacked(values))
    place = copy
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return copy


def sampled(place: str | int) -> bool:
    """Select every field, and some elements of long tuples."""
    return isinstance(place, str) or place in (0, 5, 35, 143)


FLOATS = [(s, p) for s in SAMPLES for p in places_of_floats(plain(s)) if sampled(p[-1])]


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_every_float_of_every_message_must_be_finite(bad: float) -> None:
    assert len(FLOATS) > 50
    for sample, path in FLOATS:
        payload = repacked(with_value(plain(sample), path, bad))
        assert rejection(type(sample), payload).reason == "not_finite", (named(sample), path)


def test_every_quaternion_must_be_of_unit_length() -> None:
    seen = 0
    for sample in SAMPLES:
        values = plain(sample)
        for owner in (values, *values.get("solutions", ())):
            if "q_wxyz" not in owner:
                continue
            seen += 1
            for bad in (
                [0.0] * 4,
                [1.0, 0.0, 0.0, 0.01],
                [1e10, 1e10, 0.0, 0.0],
                [0.5, 0.5, 0.5, 0.50001],
            ):
                owner["q_wxyz"] = bad
                assert rejection(type(sample), repacked(values)).reason == "not_unit_quaternion"
            owner["q_wxyz"] = [0.5, 0.5, 0.5, 0.5 + 1e-8]  # rounding passes
            codec.decode(type(sample), repacked(values))
    assert seen == 8


@pytest.mark.parametrize(
    ("kind", "field", "bad"),
    [
        (m.Odometry, "position_m", [1.0, 2.0]),
        (m.Odometry, "position_m", [1.0, 2.0, 3.0, 4.0]),
        (m.Odometry, "position_m", [1.0, 2.0, "3"]),
        (m.Odometry, "position_m", None),
        (m.Odometry, "q_wxyz", [1.0, 0.0, 0.0]),
        (m.Odometry, "chaser", 256),
        (m.Odometry, "chaser", -1),
        (m.Odometry, "chaser", 1.5),
        (m.Odometry, "chaser", "0"),
        (m.Odometry, "seq", -1),
        (m.Odometry, "tick", -2),
        (m.Odometry, "tick", True),
        (m.Odometry, "sim_time_ns", -1),
        (m.Tick, "images", 1),
        (m.Tick, "chasers", [0, 300]),
        (m.TargetEstimate, "covariance", list(EYE12[:-1])),
        (m.TargetEstimate, "covariance", list(EYE6)),
        (m.TargetEstimate, "status", "fine"),
        (m.Sighting, "solutions", [as_lists(SOLUTION)] * 5),
        (m.Sighting, "solutions", [as_lists(SOLUTION) | {"covariance": [1.0] * 35}]),
        (m.FeatureTracks, "ids", [-1]),
        (m.FeatureTracks, "ids", list(range(1001))),
        (m.FeatureTracks, "places", [0.5, 1.0]),
        (m.FeatureTracks, "places", [2**20 + 1, 0]),
        (m.FeatureTracks, "ages", [-1]),
        (m.FeatureTracks, "descriptions", bytes(128 * 1000 + 1)),
        (m.FeatureTracks, "ellipses", [0.0] * (6 * 16 + 1)),
        (m.FeatureTracks, "status", "fine"),
        (m.LandmarkMap, "status", "fine"),
        (m.LandmarkMap, "landmarks_m", [0.0] * 3001),
        (m.LandmarkMap, "moments_m2", [0.0] * 6001),
        (m.LandmarkMap, "next_tick", -1),
        (m.LandmarkMap, "tracks", [{"chaser": 1, "ids": [0], "landmarks": [-1]}]),
        (m.Image, "encoding", "png"),
        (m.Image, "width_px", 0),
        (m.Image, "height_px", 8193),
        (m.Image, "data", "text"),
        (m.Image, "data", bytes(16_000_001)),
        (m.Reference, "phase", "wander"),
        (m.WrenchCommand, "mode", "ram"),
        (m.Plan, "inputs", [0.0] * 12_001),
        (m.Event, "what", "x" * 2001),
        (m.Health, "rejected", {"a": "many"}),
        (m.OperatorCommand, "command", "self-destruct"),
        (m.OperatorCommand, "offset_m", [0.0, 0.0]),
        (m.JoinReply, "mode", "fast"),
    ],
)
def test_wrong_types_shapes_and_ranges_are_rejected(
    kind: type[msgspec.Struct], field: str, bad: Any
) -> None:
    values = plain(BY_TYPE[kind])
    assert field in values
    assert rejection(kind, repacked(values | {field: bad})).reason == "format"


def test_a_missing_field_is_rejected_and_one_with_a_default_is_not() -> None:
    for sample in SAMPLES:
        kind = type(sample)
        for field in msgspec.structs.fields(kind):
            values = plain(sample)
            del values[field.name]
            if field.required:
                assert rejection(kind, repacked(values)).reason == "format"
            else:
                made = field.default_factory is not msgspec.NODEFAULT
                default = field.default_factory() if made else field.default
                assert getattr(codec.decode(kind, repacked(values)), field.name) == default


def test_another_type_or_version_is_rejected_by_its_encoding() -> None:
    payload = codec.encode(BY_TYPE[m.Odometry])
    for encoding in (
        "application/msgpack;chaserdock.Odometry.v1",
        "application/msgpack;chaserdock.Odometry.v21",
        "application/msgpack;chaserdock.BodyTruth.v1",
        "application/json",
        "zenoh/bytes",
        "",
    ):
        assert rejection(m.Odometry, payload, encoding).reason == "encoding"
    codec.decode(m.Odometry, payload, "application/msgpack;chaserdock.Odometry.v2")


def test_oversize_is_rejected_before_it_is_opened() -> None:
    assert rejection(m.RecorderAck, b"\xc1" * (codec.MAX_BYTES + 1)).reason == "size"
    assert rejection(m.RecorderAck, b"\xc1" * codec.MAX_BYTES).reason == "format"
    biggest = msgspec.structs.replace(BY_TYPE[m.Image], data=bytes(16_000_000))
    assert codec.decode(m.Image, codec.encode(biggest)) == biggest


# -- growing ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("sample", SAMPLES, ids=named)
def test_fields_of_later_versions_are_ignored(sample: msgspec.Struct) -> None:
    values = plain(sample) | {"later": [1, {"deep": math.nan}], "z": b"\x00"}
    assert codec.decode(type(sample), repacked(values)) == sample


def test_a_new_field_with_a_default_reads_old_payloads() -> None:
    class Odometry(m.Odometry, frozen=True, kw_only=True):
        battery_J: float = 5.0

    old = codec.encode(BY_TYPE[m.Odometry])
    grown = codec.decode(Odometry, old)
    assert grown.battery_J == 5.0
    assert codec.decode(m.Odometry, codec.encode(grown)) == BY_TYPE[m.Odometry]


def test_without_wall_time_leaves_out_wall_fields_only() -> None:
    sample = BY_TYPE[m.SolverStatus]
    assert isinstance(sample, m.SolverStatus)
    slower = msgspec.structs.replace(sample, wall_solve_s=9.0, wall_tick_s=9.0)
    assert codec.without_wall_time(slower) == codec.without_wall_time(sample)
    fields = set(type(sample).__struct_fields__)
    assert fields - set(codec.without_wall_time(sample)) == {"wall_solve_s", "wall_tick_s"}


def test_every_float_of_every_message_is_looked_at() -> None:
    for topic in topics.TOPICS:
        for field in inspect.type_info(topic.kind).fields:  # type: ignore[attr-defined]
            codec.holds_floats(field.type)  # raises for a type that would be passed over


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 2e15, -1e300])
@pytest.mark.parametrize("place", [0, 1, 38])
def test_a_bad_number_is_found_wherever_it_stands_in_a_long_list(bad: float, place: int) -> None:
    plan = BY_TYPE[m.Plan]
    values = [0.5] * 39
    values[place] = bad
    with pytest.raises(codec.Rejected, match="positions_m") as refusal:
        codec.check_numbers(msgspec.structs.replace(plan, positions_m=tuple(values)))
    assert refusal.value.reason == ("range" if math.isfinite(bad) else "not_finite")


def test_many_large_numbers_are_no_bad_one() -> None:
    codec.check_numbers(msgspec.structs.replace(BY_TYPE[m.Plan], positions_m=(0.9e15,) * 60))


BAD = [math.nan, math.inf, -math.inf, 1e15, 1.1e15, -1e16, 1.7e308, -1.0, 0.0, 1.0 + 2e-6]


def with_number(message: msgspec.Struct, at: int, value: float) -> tuple[msgspec.Struct, int]:
    """The message with its ``at``-th float replaced, as it may be decoded; how many it has left to
    count.
    """
    for name in message.__struct_fields__:
        held = getattr(message, name)
        parts = held if isinstance(held, tuple) else (held,)
        for k, part in enumerate(parts):
            changed = part
            if isinstance(part, msgspec.Struct):
                changed, at = with_number(part, at, value)
            elif isinstance(part, float):
                changed, at = (value if at == 0 else part), at - 1
            if changed is not part:
                new = (*parts[:k], changed, *parts[k + 1 :]) if isinstance(held, tuple) else changed
                return msgspec.structs.replace(message, **{name: new}), at
    return message, at


@pytest.mark.parametrize("kind", list(BY_TYPE), ids=lambda kind: kind.__name__)
def test_fast_check_agrees_with_detailed_check(kind: type[msgspec.Struct]) -> None:
    """Any of its floats bad: the whole check refuses with the words of the one that goes field by
    field, or neither does.
    """

    def refusal(check: Callable[[msgspec.Struct], None], message: msgspec.Struct) -> str | None:
        try:
            check(message)
        except codec.Rejected as refused:
            return str(refused)
        return None

    at = 0
    while with_number(BY_TYPE[kind], at, math.pi)[1] < 0:
        for value in BAD:
            message, _ = with_number(BY_TYPE[kind], at, value)
            assert refusal(codec.check_numbers, message) == refusal(codec._check_fields, message)
        at += 1
    assert refusal(codec.check_numbers, BY_TYPE[kind]) is None
