# SPDX-License-Identifier: Apache-2.0
"""The topics table: keys, who may write and who may read."""

from __future__ import annotations

import json
import re
from typing import get_args

import pytest
from chaserdock_protocol import messages as m
from chaserdock_protocol import topics
from chaserdock_protocol.topics import FLYING, TOPICS, Role
from hypothesis import given, settings
from hypothesis import strategies as st

quick = settings(derandomize=True, deadline=None, max_examples=100)


ROLES: tuple[Role, ...] = get_args(Role)
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
        topics.SCENARIO_KEY,
        topics.OPERATE_KEY,
        topics.PORT_KEY,
        topics.THRUSTER_FAULT_KEY,
        topics.ARMING_KEY,
    ],
)
def test_foreign_keys_belong_to_no_topic(key: str) -> None:
    assert topics.topic_of_key(key) is None


@pytest.mark.slow
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


def test_flight_roles_may_not_read_what_another_system_measures_of_the_bodies() -> None:
    topic = topics.BODY_REFERENCE
    assert topic.key_of("chaser/0") == "reference/body/chaser/0"
    assert topic.writer == "world"
    assert [r for r in ROLES if topics.may_read(r, topic)] == ["recorder", "analysis", "viewer"]
    assert [t for t in TOPICS if t.kind is m.BodyReference] == [topic]
    # A message on its branch counts only if it comes from the session of the mission's world.
    assert any(topic.key.startswith(branch) for branch in topics.WORLD_BRANCHES)


def test_flight_roles_may_not_read_the_truth() -> None:
    truths = [t for t in TOPICS if t.key.startswith("truth")]
    assert {t.key for t in truths} == {
        "truth/body/{process}",
        "truth/world",
        "truth/chaser/{chaser}/load",
        "truth/plume/{process}",
        "truth/drawn",
    }
    for topic in truths:
        assert topic.writer == "world"
        assert [r for r in ROLES if topics.may_read(r, topic)] == ["recorder", "analysis", "viewer"]
    # Nor by another name: the types of the truth travel on its own branch alone.
    assert {t.kind for t in truths} == {
        m.BodyTruth,
        m.WorldTruth,
        m.PortLoad,
        m.PlumeLoad,
        m.DrawnTruth,
    }
    assert not any(
        t.kind in (m.BodyTruth, m.WorldTruth, m.DrawnTruth) for t in TOPICS if t not in truths
    )
    assert {"chaser", "controller", "mapper"} == FLYING


def test_everyone_writes_on_their_own_branch_only() -> None:
    for topic in TOPICS:
        if topic.writer == "any":
            assert topic.key.startswith("{process}/")
            assert all(topics.may_write(r, topic) for r in ROLES)
        else:
            first = topic.key.partition("/")[0]
            owner = "world" if first in ("truth", "reference") else first
            assert owner == topic.writer
            assert [r for r in ROLES if topics.may_write(r, topic)] == [topic.writer]


def test_recorder_reads_every_topic_and_no_role_reads_its_own() -> None:
    for topic in TOPICS:
        assert topics.may_read("recorder", topic)
        if topic.writer != "any":
            # Of two controllers, one hears what the other says.
            between = topic.writer == "recorder" or topic is topics.STATE
            assert between or not topics.may_read(topic.writer, topic)


def test_every_topic_has_a_version_and_a_json_schema() -> None:
    for topic in TOPICS:
        assert m.VERSION[topic.kind] >= 1
        name = topic.kind.__name__
        assert (
            m.encoding_of(topic.kind)
            == f"application/msgpack;chaserdock.{name}.v{m.VERSION[topic.kind]}"
        )
    for kind in m.VERSION:
        schema = json.loads(m.schema_of(kind))
        properties = schema["$defs"][kind.__name__]["properties"]
        assert set(properties) == set(kind.__struct_fields__)


def test_keys_and_qos_are_what_zenoh_takes() -> None:
    for topic, _, key in concrete_keys():
        assert re.fullmatch(r"[a-z0-9]+(/[a-z0-9]+)*", key)
        assert topic.qos in ("bulk", "state", "command", "event")
        assert issubclass(topic.kind, m.Message)
