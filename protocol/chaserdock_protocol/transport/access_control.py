"""Who may do what on a mission's network, worked out of the topics table as Zenoh access-control rules.

A process is known by the common name in its certificate. The router denies whatever no rule allows: a process
publishes on its own branch alone, and receives only what the table lets its role read. The rules hold where
they are enforced, so every process but the router connects as a client (peers would go past it).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, get_args

from chaserdock_protocol import topics
from chaserdock_protocol.topics import TOPICS, Role, Topic, may_read, may_write


@dataclass(frozen=True)
class Query:
    """A question over the network: who may ask it, and which role answers."""

    key: str
    askers: frozenset[Role]
    answerer: Role


# A world asks, too: whether there is one already.
QUERIES = (
    Query(topics.JOIN_KEY, frozenset(get_args(Role)) - {"analysis"}, "world"),
    Query(topics.OPERATE_KEY, frozenset({"operator", "viewer"}), "controller"),
    Query(topics.THRUSTER_FAULT_KEY, frozenset({"operator"}), "world"),
)
LOOK_ON: frozenset[Role] = frozenset({"analysis", "viewer"})
"""These publish nothing, and have no name of their own on the network."""


@dataclass(frozen=True)
class Identity:
    """One process and its role, such as ``chaser/0`` and ``chaser``."""

    process: str
    role: Role

    @property
    def common_name(self) -> str:
        """The name in its certificate: ``chaser-0``."""
        return common_name(self.process)


def common_name(process: str) -> str:
    """The name of a process where no slash may stand: in certificates, folders and services."""
    return process.replace("/", "-")


def identities(chasers: int) -> tuple[Identity, ...]:
    """Everyone who may connect to the router of a mission with at most so many chasers."""
    single: tuple[Role, ...] = ("world", "recorder", "operator", "analysis", "viewer")
    return (
        *(Identity(role, role) for role in single),
        *(Identity(name, "controller") for name in topics.CONTROLLERS),
        *(Identity(f"chaser/{i}", "chaser") for i in range(chasers)),
    )


def _expression(topic: Topic, who: Identity, *, writes: bool) -> str:
    """A topic's keys as far as they are this process' own to write, or meant for it to read."""
    if "{chaser}" in topic.key:
        return topic.key_of(who.process.partition("/")[2] if who.role == "chaser" else "*")
    if "{process}" in topic.key:
        return topic.key_of(who.process if writes and topic.writer == "any" else "**")
    return topic.key


def writes(who: Identity) -> list[str]:
    """Key expressions, without the namespace, on which a process may publish."""
    if who.role in LOOK_ON:
        return []
    return [_expression(t, who, writes=True) for t in TOPICS if may_write(who.role, t)]


def reads(who: Identity) -> list[str]:
    """Key expressions, without the namespace, that a process may subscribe; ``**`` for those who read all."""
    readable = [t for t in TOPICS if may_read(who.role, t)]
    if len(readable) == len(TOPICS):
        return ["**"]
    return [_expression(t, who, writes=False) for t in readable]


def access_control(namespace: str, chasers: int) -> dict[str, Any]:
    """Zenoh's ``access_control`` section for the router of a mission. Whatever it does not list is denied."""
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
    # What the router tells its clients of one another's interests carries no data.
    common = [
        *rule("all-hear-of-interests", "egress", ["declare_subscriber", "declare_queryable"], ["**"]),
        *rule("all-see-who-lives", "egress", ["liveliness_token", "reply"], living),
        *rule("all-ask-who-lives", "ingress", ["declare_liveliness_subscriber", "liveliness_query"], living),
    ]
    policies: list[dict[str, Any]] = []
    everyone = identities(chasers)
    for who in everyone:
        name, live = who.common_name, [topics.LIVE_KEY.format(process=who.process)]
        asks = [q.key for q in QUERIES if who.role in q.askers]
        answers = [q.key for q in QUERIES if who.role == q.answerer]
        own = [
            *rule(f"{name}-publishes", "ingress", ["put"], writes(who)),
            *rule(f"{name}-subscribes", "ingress", ["declare_subscriber"], reads(who)),
            *rule(f"{name}-receives", "egress", ["put"], reads(who)),
            *rule(f"{name}-asks", "ingress", ["query"], asks),
            *rule(f"{name}-is-answered", "egress", ["reply"], asks),
            *rule(f"{name}-offers-answers", "ingress", ["declare_queryable", "reply"], answers),
            *rule(f"{name}-is-asked", "egress", ["query"], answers),
            *rule(f"{name}-lives", "ingress", ["liveliness_token"], live if who.role not in LOOK_ON else []),
        ]
        policies.append({"subjects": [name], "rules": [*common, *own]})
    return {
        "enabled": True,
        "default_permission": "deny",
        "rules": rules,
        "subjects": [{"id": w.common_name, "cert_common_names": [w.common_name]} for w in everyone],
        "policies": policies,
    }
