# SPDX-License-Identifier: Apache-2.0
"""Zenoh access-control rules of a mission, derived from the topics table.

The common name in its certificate identifies a process. The router denies everything that no rule
allows: a process publishes only on its own branch, and receives only topics that its role may read.
The router enforces the rules, so every other process connects as a client (peers would bypass it).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, get_args

from chaserdock_protocol import topics
from chaserdock_protocol.topics import TOPICS, Role, Topic, may_read, may_write


@dataclass(frozen=True)
class QueryAccess:
    """A query key, the roles that may query it, and the role that replies."""

    key: str
    clients: frozenset[Role]
    server: Role


# A starting world also queries the join key, to detect another world.
QUERIES = (
    QueryAccess(topics.JOIN_KEY, frozenset(get_args(Role)) - {"analysis"}, "world"),
    QueryAccess(
        topics.SCENARIO_KEY, frozenset({"recorder", "operator", "analysis", "viewer"}), "world"
    ),
    QueryAccess(topics.OPERATE_KEY, frozenset({"operator", "viewer", "bridge"}), "controller"),
    QueryAccess(topics.PORT_KEY, frozenset({"operator", "viewer", "bridge"}), "mapper"),
    QueryAccess(topics.THRUSTER_FAULT_KEY, frozenset({"operator"}), "world"),
    QueryAccess(topics.ARMING_KEY, frozenset({"operator"}), "world"),
)
OBSERVERS: frozenset[Role] = frozenset({"analysis", "viewer", "bridge"})
"""Roles that publish nothing and have no process name on the network."""


@dataclass(frozen=True)
class Identity:
    """One process and its role, such as ``chaser/0`` and ``chaser``."""

    process: str
    role: Role

    @property
    def common_name(self) -> str:
        """Return the name in its certificate, such as ``chaser-0``."""
        return common_name(self.process)


def common_name(process: str) -> str:
    """Return the name of a process without slashes, for certificates, folders and services."""
    return process.replace("/", "-")


def identities(chasers: int) -> tuple[Identity, ...]:
    """Return all processes that may connect to the router of a mission with at most ``chasers``
    chasers.
    """
    single: tuple[Role, ...] = (
        "world",
        "mapper",
        "recorder",
        "operator",
        "analysis",
        "viewer",
        "bridge",
    )
    return (
        *(Identity(role, role) for role in single),
        *(Identity(name, "controller") for name in topics.CONTROLLERS),
        *(Identity(f"chaser/{i}", "chaser") for i in range(chasers)),
    )


def _expression(topic: Topic, who: Identity, *, writes: bool) -> str:
    """Return the key expression of a topic, limited to the keys that the process may write or
    read.
    """
    if "{chaser}" in topic.key:
        return topic.key_of(who.process.partition("/")[2] if who.role == "chaser" else "*")
    if "{process}" in topic.key:
        return topic.key_of(who.process if writes and topic.writer == "any" else "**")
    return topic.key


def writes(who: Identity) -> list[str]:
    """Return the key expressions (without the namespace) on which a process may publish."""
    if who.role in OBSERVERS:
        return []
    return [_expression(t, who, writes=True) for t in TOPICS if may_write(who.role, t)]


def reads(who: Identity) -> list[str]:
    """Return the key expressions (without the namespace) that a process may subscribe; ``**`` if it
    may read all.
    """
    readable = [t for t in TOPICS if may_read(who.role, t)]
    if len(readable) == len(TOPICS):
        return ["**"]
    return [_expression(t, who, writes=False) for t in readable]


def access_control(namespace: str, chasers: int) -> dict[str, Any]:
    """Return Zenoh's ``access_control`` section for the router of a mission. Everything not listed
    is denied.
    """
    rules: list[dict[str, Any]] = []

    def rule(name: str, flow: str, messages: list[str], keys: list[str]) -> list[str]:
        if not keys:
            return []
        rules.append(
            {
                "id": name,
                "permission": "allow",
                "flows": [flow],
                "messages": messages,
                "key_exprs": [f"{namespace}/{key}" for key in keys],
            }
        )
        return [name]

    living = [topics.LIVE_KEY.format(process="**")]
    # Declarations that the router forwards between clients carry no data.
    common = [
        *rule(
            "all-receive-declarations",
            "egress",
            ["declare_subscriber", "declare_queryable"],
            ["**"],
        ),
        *rule("all-receive-liveliness", "egress", ["liveliness_token", "reply"], living),
        *rule(
            "all-query-liveliness",
            "ingress",
            ["declare_liveliness_subscriber", "liveliness_query"],
            living,
        ),
    ]

    policies: list[dict[str, Any]] = []
    everyone = identities(chasers)
    for who in everyone:
        name, live = who.common_name, [topics.LIVE_KEY.format(process=who.process)]
        queried = [q.key for q in QUERIES if who.role in q.clients]
        served = [q.key for q in QUERIES if who.role == q.server]
        own = [
            *rule(f"{name}-publishes", "ingress", ["put"], writes(who)),
            *rule(f"{name}-subscribes", "ingress", ["declare_subscriber"], reads(who)),
            *rule(f"{name}-receives", "egress", ["put"], reads(who)),
            *rule(f"{name}-queries", "ingress", ["query"], queried),
            *rule(f"{name}-receives-replies", "egress", ["reply"], queried),
            *rule(f"{name}-serves-queries", "ingress", ["declare_queryable", "reply"], served),
            *rule(f"{name}-receives-queries", "egress", ["query"], served),
            *rule(
                f"{name}-declares-liveliness",
                "ingress",
                ["liveliness_token"],
                live if who.role not in OBSERVERS else [],
            ),
        ]
        policies.append({"subjects": [name], "rules": [*common, *own]})

    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": w.common_name, "cert_common_names": [w.common_name]} for w in everyone],
        "policies": policies,
    }
