# SPDX-License-Identifier: Apache-2.0
"""Rights: every wrong identity on every key is dropped by the router, every right one gets
through.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import pytest
import zenoh
from chaserdock_protocol import topics
from chaserdock_protocol.transport import access_control as rights
from chaserdock_protocol.transport.access_control import Identity, access_control
from chaserdock_protocol.transport.zenoh_network import zenoh_config
from mission_keys import (
    CHASERS,
    EVERYONE,
    PATIENCE_S,
    PUBLISHERS,
    client,
    keys_with_owners,
    make_keys,
    router_with_rights,
)

SETTLE_S = 0.5


def repeat_until(act: Callable[[], None], holds: Callable[[], bool]) -> None:
    """Act until what is wanted has arrived, for PATIENCE_S at most; then once more, for what is not
    wanted and may arrive later.
    """
    deadline = time.monotonic() + PATIENCE_S
    while True:
        act()
        time.sleep(SETTLE_S)
        if holds() or time.monotonic() > deadline:
            break
    act()
    time.sleep(2 * SETTLE_S)


def readers_of(key: str) -> set[str]:
    """Processes that the table lets read a concrete key; of what is one chaser's, that chaser
    alone.
    """
    found = topics.topic_of_key(key)
    assert found is not None
    topic, place = found
    return {
        w.process
        for w in EVERYONE
        if topics.may_read(w.role, topic)
        and not (w.role == "chaser" and "{chaser}" in topic.key and w.process != f"chaser/{place}")
    }


@dataclass
class Mission:
    keys: Path
    endpoint: str
    sessions: dict[str, zenoh.Session]


@pytest.fixture(scope="module")
def mission(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Mission]:
    keys = make_keys(tmp_path_factory.mktemp("keys"))
    with router_with_rights(keys) as endpoint:
        sessions = {
            w.process: zenoh.open(zenoh_config(client(keys, w.process, endpoint))) for w in EVERYONE
        }
        yield Mission(keys, endpoint, sessions)
        for session in sessions.values():
            session.close()


def test_every_wrong_identity_on_every_key_is_dropped(mission: Mission) -> None:
    """The table: keys by identities. The recorder may read all, so whatever gets through reaches
    it.
    """
    arrived: set[tuple[str, str]] = set()
    subscriber = mission.sessions["recorder"].declare_subscriber(
        "**", lambda s: arrived.add((str(s.key_expr), s.payload.to_string()))
    )
    table = keys_with_owners()
    assert len(table) > 50
    # The recorder's own session hears itself without any router.
    texts = ("recorder", "recorder declared", "")
    own = {(key, text) for key, _ in table for text in texts}
    allowed = {(key, owner + how) for key, owner in table for how in ("", " declared")}

    def publish() -> None:
        for name, session in mission.sessions.items():
            for key, _ in table:
                session.put(key, name)
                # Declared publishers and deletions go other ways through the router's rules.
                publisher = session.declare_publisher(key)
                publisher.put(f"{name} declared")
                publisher.delete()
                publisher.undeclare()

    repeat_until(publish, lambda: allowed <= arrived | own)
    subscriber.undeclare()
    assert arrived - own == allowed - own


@pytest.mark.slow
def test_every_key_reaches_its_readers_only(mission: Mission) -> None:
    arrived: dict[str, set[str]] = {w.process: set() for w in EVERYONE}
    subscribers = []
    for name, session in mission.sessions.items():
        heard = arrived[name]
        callback = lambda s, heard=heard: heard.add(str(s.key_expr))  # noqa: E731
        # The key itself, what lies around it, and everything.
        expressions = {key for key, _ in keys_with_owners()} | {
            "**",
            "truth/**",
            "reference/**",
            "*/body/target",
            "world/*",
        }
        subscribers += [
            session.declare_subscriber(expression, callback) for expression in expressions
        ]
    table = keys_with_owners()
    own = {name: {key for key, owner in table if owner == name} for name in arrived}
    meant = {name: {key for key, _ in table if name in readers_of(key)} for name in arrived}

    def publish() -> None:
        for key, owner in table:
            mission.sessions[owner].put(key, owner)

    repeat_until(publish, lambda: all(meant[n] <= arrived[n] | own[n] for n in arrived))
    for subscriber in subscribers:
        subscriber.undeclare()
    for name, heard in arrived.items():
        assert heard - own[name] == meant[name] - own[name], name
        if name in (*topics.CONTROLLERS, *(f"chaser/{i}" for i in range(CHASERS))):
            assert not any(key.startswith(("truth", "reference")) for key in heard), name


@pytest.mark.parametrize("query", rights.QUERIES, ids=lambda q: q.key)
def test_only_its_answerer_answers_a_query_and_only_those_meant_may_ask(
    query: rights.QueryAccess, mission: Mission
) -> None:
    def answer(name: str):
        def arrived(asked: zenoh.Query) -> None:
            asked.reply(query.key, name)
            asked.drop()

        return arrived

    offered = [
        session.declare_queryable(query.key, answer(name))
        for name, session in mission.sessions.items()
        if name != "operator"  # a session answers itself without any router
    ]
    time.sleep(SETTLE_S)
    for who in EVERYONE:
        meant = {query.server} - {who.process} if who.role in query.clients else set()
        deadline = time.monotonic() + PATIENCE_S
        while True:
            replies = mission.sessions[who.process].get(
                query.key, timeout=0.5, target=zenoh.QueryTarget.ALL
            )
            answers = {r.ok.payload.to_string() for r in replies if r.ok is not None} - {
                who.process
            }
            answers = {
                "controller" if name == "standby" else name for name in answers
            }  # either may
            if not answers < meant or time.monotonic() > deadline:
                # a slow machine's answers may still be on their way; what is too much stays too
                # much
                break
        assert answers == meant, who
    for queryable in offered:
        queryable.undeclare()


def test_flight_identities_cannot_query_the_full_scenario_by_any_expression(
    mission: Mission,
) -> None:
    def reply(query: zenoh.Query) -> None:
        query.reply(topics.SCENARIO_KEY, "full scenario")
        query.drop()

    served = mission.sessions["world"].declare_queryable(topics.SCENARIO_KEY, reply)
    time.sleep(SETTLE_S)

    def answers(name: str, expression: str) -> set[str]:
        replies = mission.sessions[name].get(expression, timeout=0.5, target=zenoh.QueryTarget.ALL)
        return {r.ok.payload.to_string() for r in replies if r.ok is not None}

    deadline = time.monotonic() + PATIENCE_S
    while not answers("recorder", topics.SCENARIO_KEY) and time.monotonic() < deadline:
        pass
    assert answers("recorder", topics.SCENARIO_KEY) == {"full scenario"}
    for name in (*topics.CONTROLLERS, *(f"chaser/{i}" for i in range(CHASERS))):
        for expression in (topics.SCENARIO_KEY, "truth/*", "truth/**", "*/scenario", "**"):
            assert answers(name, expression) == set(), (name, expression)
    served.undeclare()


def test_presence_under_another_name_is_denied(mission: Mission) -> None:
    tokens = [
        session.liveliness().declare_token(topics.LIVE_KEY.format(process=other))
        for name, session in mission.sessions.items()
        for other in (*PUBLISHERS, "chaser/9")
        if name not in rights.OBSERVERS
        and other != name  # a session sees its own tokens without any router
    ]
    own = mission.sessions["chaser/1"].liveliness().declare_token("live/chaser/1")
    found: set[str] = set()

    def look() -> None:
        replies = mission.sessions["analysis"].liveliness().get("live/**", timeout=2.0)
        found.update(str(r.ok.key_expr) for r in replies if r.ok is not None)

    repeat_until(look, lambda: "live/chaser/1" in found)
    assert found == {"live/chaser/1"}
    for token in (*tokens, own):
        token.undeclare()


def test_connection_needs_a_certificate_of_the_mission(mission: Mission, tmp_path: Path) -> None:
    link = client(mission.keys, "chaser/0", mission.endpoint)
    strangers = make_keys(tmp_path / "strangers")
    foreign = client(strangers, "chaser/0", mission.endpoint)
    own_ca = client(mission.keys, "chaser/0", mission.endpoint).tls
    assert own_ca is not None
    assert foreign.tls is not None
    # Trusts our router, but its own certificate is of another mission.
    mixed = replace(foreign, tls=replace(foreign.tls, ca=own_ca.ca))
    for wrong in (foreign, mixed, replace(link, tls=None)):
        config = zenoh_config(wrong)
        config.insert_json5("connect/timeout_ms", "1500")
        config.insert_json5("connect/exit_on_failure", "true")
        if wrong.tls is None:
            config.insert_json5("transport/link/tls", f'{{root_ca_certificate: "{own_ca.ca}"}}')
        with pytest.raises(zenoh.ZError):
            zenoh.open(config).close()
    config = zenoh_config(link)
    config.insert_json5("connect/exit_on_failure", "true")
    zenoh.open(config).close()  # the right one gets in that way


def test_every_query_key_has_its_rights() -> None:
    keys = {v for k, v in vars(topics).items() if k.endswith("_KEY") and v != topics.LIVE_KEY}
    assert keys == {q.key for q in rights.QUERIES}


def test_rules_are_of_one_namespace_and_default_to_no() -> None:
    section = access_control("apollo", 2)
    assert section["default_permission"] == "deny"
    assert all(key.startswith("apollo/") for rule in section["rules"] for key in rule["key_exprs"])
    assert all(rule["permission"] == "allow" for rule in section["rules"])
    named = {name for policy in section["policies"] for name in policy["rules"]}
    assert named == {rule["id"] for rule in section["rules"]}


def test_a_chaser_commands_nothing_and_reads_no_truth() -> None:
    chaser = Identity("chaser/1", "chaser")
    assert {key.rpartition("/")[0] for key in rights.writes(chaser)} == {"chaser/1"}
    for who in EVERYONE:
        for branch in ("truth", "reference"):
            read = [key for key in rights.reads(who) if key == "**" or key.startswith(branch)]
            assert bool(read) == (who.role in ("recorder", "analysis", "viewer")), who
        assert any(key.endswith("/wrench") for key in rights.writes(who)) == (
            who.role == "controller"
        )
