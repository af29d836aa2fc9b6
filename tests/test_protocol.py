"""Clock, codec, message types and the topics table: what every process relies on."""

from __future__ import annotations

import json
import math
import re
from contextlib import suppress
from fractions import Fraction
from typing import Any

import msgpack
import msgspec
import pytest
from chaserdock_protocol import codec, topics
from chaserdock_protocol import messages as m
from chaserdock_protocol.clock import Timing
from chaserdock_protocol.codec import Rejected
from chaserdock_protocol.topics import FLYING, TOPICS, Role
from hypothesis import given, settings
from hypothesis import strategies as st

quick = settings(derandomize=True, deadline=None, max_examples=100)

# -- clock ------------------------------------------------------------------------------------------------


@st.composite
def timings(draw: st.DrawFn) -> Timing:
    picture_hz = draw(st.integers(1, 60))
    rate_hz = picture_hz * draw(st.integers(1, 8))
    physics_hz = rate_hz * draw(st.integers(1, 200))
    return Timing(physics_hz, rate_hz, picture_hz, draw(st.integers(0, 4 * physics_hz)))


@given(timings(), st.integers(0, 10**9))
@quick
def test_every_step_has_its_time_and_every_time_its_step(timing: Timing, step: int) -> None:
    time_ns = timing.time_ns(step)
    assert timing.step_of_time(time_ns) == step
    assert timing.time_ns(step + 1) > time_ns
    assert timing.step_of_time(time_ns + 1) == step + 1
    exact = Fraction(step * 10**9, timing.physics_hz)
    assert exact - 1 < time_ns <= exact


@given(timings(), st.integers(0, 10**6))
@quick
def test_ticks_are_whole_steps(timing: Timing, tick: int) -> None:
    assert timing.steps_per_tick * timing.rate_hz == timing.physics_hz
    assert timing.step_of_tick(tick) == tick * timing.physics_hz // timing.rate_hz
    assert timing.step_of_time(timing.tick_time_ns(tick)) == timing.step_of_tick(tick)
    answered = timing.step_of_time(timing.effective_ns(tick))
    assert answered == timing.step_of_tick(tick) + timing.latency_steps


@given(timings())
@quick
def test_pictures_come_at_their_rate(timing: Timing) -> None:
    ticks = range(3 * timing.rate_hz)
    assert sum(timing.has_pictures(t) for t in ticks) == 3 * timing.picture_hz
    assert timing.has_pictures(0)


@given(st.integers(0, 10**18))
@quick
def test_step_of_time_is_the_first_at_or_after(time_ns: int) -> None:
    timing = Timing(1920, 15, 15, 64)
    step = timing.step_of_time(time_ns)
    assert timing.time_ns(step) >= time_ns
    assert step == 0 or timing.time_ns(step - 1) < time_ns


def test_whole_seconds_are_exact_at_the_default_rates() -> None:
    timing = Timing(physics_hz=1920, rate_hz=15, picture_hz=15, latency_steps=64)
    assert timing.ticks_in(120.0) == 1800
    assert timing.tick_time_ns(1800) == 120_000_000_000
    assert timing.effective_ns(0) == 33_333_333
    assert timing.ticks_in(0.1) == 2  # 1.5 ticks; rounded to even


# -- one sample of every message --------------------------------------------------------------------------

EYE12 = tuple(1.0 if i % 13 == 0 else 0.0 for i in range(144))
EYE6 = tuple(1.0 if i % 7 == 0 else 0.0 for i in range(36))
V, Q = (0.25, -1.5, 3.0), (0.5, -0.5, 0.5, -0.5)
HEAD: dict[str, Any] = {"seq": 7, "tick": 12, "sim_time_ns": 800_000_000}
SOLUTION = m.PoseSolution(position_m=V, q_wxyz=Q, covariance=EYE6, reprojection_rms_px=0.125)

SAMPLES: tuple[msgspec.Struct, ...] = (
    m.Tick(**HEAD, revision=1, pictures=True, chasers=(0, 3), controller=False),
    m.MissionEnd(**HEAD, reason="flown to its end", complete=True),
    m.Image(**HEAD, chaser=2, width_px=4, height_px=2, encoding="mono8", data=bytes(range(8))),
    m.Odometry(**HEAD, chaser=255, position_m=V, velocity_m_s=V, q_wxyz=Q, omega_rad_s=V),
    m.BodyTruth(**HEAD, body="chaser/0", position_m=V, velocity_m_s=V, q_wxyz=Q, omega_rad_s=V),
    m.WorldTruth(**HEAD, contacts=(("chaser/0", "target"),), saturated=(1,), late_commands=2),
    m.Sighting(
        **HEAD,
        chaser=1,
        status="seen",
        solutions=(SOLUTION, SOLUTION),
        marker_ids=(0, 4),
        corners_px=tuple(float(i) for i in range(16)),
        rejected_ids=(17,),
        wall_estimate_s=0.01,
    ),
    m.TargetEstimate(
        **HEAD,
        status="tracking",
        position_m=V,
        velocity_m_s=V,
        q_wxyz=Q,
        omega_rad_s=V,
        covariance=EYE12,
        accepted=(0,),
        rejected=(),
    ),
    m.Reference(
        **HEAD,
        chaser=0,
        phase="approach",
        phase_time_s=1.5,
        position_m=V,
        q_wxyz=Q,
        offset_m=V,
        min_distance_target_m=0.35,
    ),
    m.WrenchCommand(
        **HEAD, chaser=0, effective_time_ns=9, expires_ns=10, mode="nmpc", force_N=V, torque_N_m=V
    ),
    m.Plan(**HEAD, chaser=0, step_s=0.1, positions_m=V * 2, quaternions_wxyz=Q * 2, inputs=V * 2),
    m.SolverStatus(
        **HEAD,
        solver="rti",
        chasers=(0,),
        status=("solved",),
        iterations=(3,),
        cost=(1.5,),
        max_violation_m=(0.0,),
        wall_solve_s=0.01,
    ),
    m.ActuatorCommand(**HEAD, chaser=0, effective_time_ns=9, source="brake", force_N=V, torque_N_m=V),
    m.Event(**HEAD, process="world", level="warning", what="process lost", detail="chaser/1 — ∆"),
    m.Health(**HEAD, process="chaser/0", rejected={"world/tick:format": 2}, lost=1, stale=0),
    m.RecorderAck(**HEAD),
    m.OperatorCommand(**HEAD, command="goto", chaser=1, offset_m=V),
    m.CommandReply(**HEAD, command="goto", chaser=1, accepted=False, reason="no"),
    m.Presence(**HEAD, process="chaser/0", instance="abc", heard=("controller", "world")),
    m.Farewell(**HEAD, process="chaser/0", published={"chaser/0/sighting": 4}),
    m.JoinRequest(process="chaser/0", instance="abc"),
    m.JoinReply(accepted=True, reason="", run_id="r", mode="realtime", scenario_json="{}"),
)
BY_TYPE: dict[type[msgspec.Struct], msgspec.Struct] = {type(s): s for s in SAMPLES}


def named(sample: msgspec.Struct) -> str:
    return type(sample).__name__


def plain(message: msgspec.Struct) -> dict[str, Any]:
    """What a reader that knows nothing of our types sees, as one who wants to write the same would send it."""
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
    # Every message type of the module stands in the table; a pose solution never stands alone.
    types = {t for t in vars(m).values() if isinstance(t, type) and issubclass(t, msgspec.Struct)}
    assert types - set(m.VERSION) - {msgspec.Struct, m.Message, m.PoseSolution} == set()


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


# -- what must not pass -----------------------------------------------------------------------------------


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
def test_flipped_bytes_raise_nothing_but_rejected(sample: msgspec.Struct, data: st.DataObject) -> None:
    payload = bytearray(codec.encode(sample))
    for _ in range(data.draw(st.integers(1, 4))):
        payload[data.draw(st.integers(0, len(payload) - 1))] = data.draw(st.integers(0, 255))
    with suppress(Rejected):
        codec.check_numbers(codec.decode(type(sample), bytes(payload)))


def places_of_floats(values: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    if isinstance(values, float):
        return [path]
    items = (
        values.items() if isinstance(values, dict) else enumerate(values) if isinstance(values, list) else ()
    )
    return [place for key, value in items for place in places_of_floats(value, (*path, key))]


def with_value(values: Any, path: tuple[Any, ...], value: Any) -> Any:
    copy = msgpack.unpackb(repacked(values))
    place = copy
    for key in path[:-1]:
        place = place[key]
    place[path[-1]] = value
    return copy


def telling(place: str | int) -> bool:
    """Of long tuples, some numbers do."""
    return isinstance(place, str) or place in (0, 5, 35, 143)


FLOATS = [(s, p) for s in SAMPLES for p in places_of_floats(plain(s)) if telling(p[-1])]


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
            for bad in ([0.0] * 4, [1.0, 0.0, 0.0, 0.01], [1e200, 1e200, 0.0, 0.0], [0.5, 0.5, 0.5, 0.50001]):
                owner["q_wxyz"] = bad
                assert rejection(type(sample), repacked(values)).reason == "not_unit_quaternion"
            owner["q_wxyz"] = [0.5, 0.5, 0.5, 0.5 + 1e-8]  # rounding passes
            codec.decode(type(sample), repacked(values))
    assert seen == 6


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
        (m.Tick, "pictures", 1),
        (m.Tick, "chasers", [0, 300]),
        (m.TargetEstimate, "covariance", list(EYE12[:-1])),
        (m.TargetEstimate, "covariance", list(EYE6)),
        (m.TargetEstimate, "status", "fine"),
        (m.Sighting, "solutions", [as_lists(SOLUTION)] * 5),
        (m.Sighting, "solutions", [as_lists(SOLUTION) | {"covariance": [1.0] * 35}]),
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
def test_wrong_types_shapes_and_ranges_are_rejected(kind: type[msgspec.Struct], field: str, bad: Any) -> None:
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
                assert getattr(codec.decode(kind, repacked(values)), field.name) == field.default


def test_another_type_or_version_is_rejected_by_its_encoding() -> None:
    payload = codec.encode(BY_TYPE[m.Odometry])
    for encoding in (
        "application/msgpack;chaserdock.Odometry.v2",
        "application/msgpack;chaserdock.Odometry.v11",
        "application/msgpack;chaserdock.BodyTruth.v1",
        "application/json",
        "zenoh/bytes",
        "",
    ):
        assert rejection(m.Odometry, payload, encoding).reason == "encoding"
    codec.decode(m.Odometry, payload, "application/msgpack;chaserdock.Odometry.v1")


def test_oversize_is_rejected_before_it_is_opened() -> None:
    assert rejection(m.RecorderAck, b"\xc1" * (codec.MAX_BYTES + 1)).reason == "size"
    assert rejection(m.RecorderAck, b"\xc1" * codec.MAX_BYTES).reason == "format"
    biggest = msgspec.structs.replace(BY_TYPE[m.Image], data=bytes(16_000_000))
    assert codec.decode(m.Image, codec.encode(biggest)) == biggest


# -- growing ----------------------------------------------------------------------------------------------


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


# -- topics -----------------------------------------------------------------------------------------------

ROLES: tuple[Role, ...] = ("world", "chaser", "controller", "recorder", "operator", "analysis")
PROCESSES = ("world", "target", "controller", "recorder", "operator", "chaser/0", "chaser/15")


def concrete_keys() -> list[tuple[topics.Topic, str | None, str]]:
    out = []
    for topic in TOPICS:
        if "{chaser}" in topic.key:
            out += [(topic, str(i), topic.key_of(i)) for i in (0, 7, 15, 255)]
        elif "{process}" in topic.key:
            out += [(topic, name, topic.key_of(name)) for name in PROCESSES]
        else:
            out.append((topic, None, topic.key_of()))
    return out


def test_keys_are_unique_and_lead_back_to_their_topics() -> None:
    keys = concrete_keys()
    assert len({key for _, _, key in keys}) == len(keys)
    for topic, place, key in keys:
        assert topics.topic_of_key(key) == (topic, place)
        assert topic.key_of(place) == key


def test_the_table_holds_every_topic_of_the_module_once() -> None:
    assert sorted(t.key for t in vars(topics).values() if isinstance(t, topics.Topic)) == sorted(
        t.key for t in TOPICS
    )
    assert len({t.key for t in TOPICS}) == len(TOPICS)


@pytest.mark.parametrize(
    "key",
    [
        "",
        "/",
        "world",
        "world/tick/",
        "/world/tick",
        "world/tick/0",
        "World/tick",
        "world/chaser//image",
        "world/chaser/x/image",
        "world/chaser/-1/image",
        "world/chaser/0/0/image",
        "world/chaser/٣/image",
        "world/chaser/²/image",
        "world/chaser/*/image",
        "truth/body/",
        "truth/body/nobody",
        "truth/body/chaser/",
        "truth/body/chaser/x",
        "truth/target",
        "chaser/sighting",
        "chaser/0/sighting/more",
        "stranger/event",
        "chaser/event",
        "chaser/0/1/event",
        "/event",
        "event",
        "**",
        "live/world",
        topics.JOIN_KEY,
        topics.OPERATE_KEY,
    ],
)
def test_foreign_keys_belong_to_no_topic(key: str) -> None:
    assert topics.topic_of_key(key) is None


@given(st.text(max_size=40))
@quick
def test_any_text_is_a_foreign_key_or_leads_back(key: str) -> None:
    found = topics.topic_of_key(key)
    assert found is None or found[0].key_of(found[1]) == key


def test_a_chaser_has_one_name() -> None:
    assert topics.is_process_name("chaser/0")
    assert topics.is_process_name("chaser/10")
    for alias in ("chaser/00", "chaser/007", "chaser/+1", "chaser/ 1", "chaser/1_0", "chaser/٣"):
        assert not topics.is_process_name(alias), alias
    assert topics.topic_of_key("world/chaser/00/image") is None


def test_a_key_with_a_place_needs_one_and_one_without_takes_none() -> None:
    for topic in TOPICS:
        with pytest.raises(ValueError, match=re.escape(topic.key)):
            topic.key_of(None if "{" in topic.key else 0)


def test_nobody_who_flies_may_read_the_truth() -> None:
    truths = [t for t in TOPICS if t.key.startswith("truth")]
    assert {t.key for t in truths} == {"truth/body/{process}", "truth/world"}
    for topic in truths:
        assert topic.writer == "world"
        assert [r for r in ROLES if topics.may_read(r, topic)] == ["recorder", "analysis"]
    # Nor by another name: the types of the truth travel on its own branch alone.
    assert {t.kind for t in truths} == {m.BodyTruth, m.WorldTruth}
    assert not any(t.kind in (m.BodyTruth, m.WorldTruth) for t in TOPICS if t not in truths)
    assert {"chaser", "controller"} == FLYING


def test_everyone_writes_on_their_own_branch_only() -> None:
    for topic in TOPICS:
        if topic.writer == "any":
            assert topic.key.startswith("{process}/")
            assert all(topics.may_write(r, topic) for r in ROLES)
        else:
            first = topic.key.partition("/")[0]
            assert first == topic.writer or (first, topic.writer) == ("truth", "world")
            assert [r for r in ROLES if topics.may_write(r, topic)] == [topic.writer]


def test_the_log_may_hold_everything_and_nobody_reads_own_topics_back() -> None:
    for topic in TOPICS:
        assert topics.may_read("recorder", topic)
        if topic.writer != "any":
            assert topic.writer == "recorder" or not topics.may_read(topic.writer, topic)


def test_every_topic_has_a_version_and_a_json_schema() -> None:
    for topic in TOPICS:
        assert m.VERSION[topic.kind] >= 1
        name = topic.kind.__name__
        assert m.encoding_of(topic.kind) == f"application/msgpack;chaserdock.{name}.v{m.VERSION[topic.kind]}"
    for kind in m.VERSION:
        schema = json.loads(m.schema_of(kind))
        properties = schema["$defs"][kind.__name__]["properties"]
        assert set(properties) == set(kind.__struct_fields__)


def test_keys_and_qos_are_what_zenoh_takes() -> None:
    for topic, _, key in concrete_keys():
        assert re.fullmatch(r"[a-z0-9]+(/[a-z0-9]+)*", key)
        assert topic.qos in ("bulk", "state", "command", "event")
        assert issubclass(topic.kind, m.Message)
