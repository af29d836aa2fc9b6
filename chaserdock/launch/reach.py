# SPDX-License-Identifier: Apache-2.0
"""Why a mission does not answer: keys without the rights, nothing at its address, or a busy or
other mission there.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from chaserdock_protocol import topics
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.topics import Topic, may_read
from chaserdock_protocol.transport import Link
from chaserdock_protocol.transport.access_control import QUERIES, identities

from .container import is_listening

_TCP = re.compile(r"(?:tcp|tls|ws)/(?:\[([\da-fA-F:.%\w]+)\]|([^\s:/\[\]]+)):(\d{1,5})(?:[?#].*)?")
_ANY_CHASER = re.compile(r"chaser-\d+")


class RightsError(ChaserdockError):
    """The keys are those of a process that may not do this."""


@dataclass(frozen=True)
class Rights:
    """What a command does on the network: the keys that it queries, and the topics that it
    reads.
    """

    queries: tuple[str, ...] = ()
    reads: tuple[Topic, ...] = ()

    def holders(self) -> list[str]:
        """Return the names of the keys with these rights; all chasers have the same."""
        queried = [q.clients for q in QUERIES if q.key in self.queries]
        return [
            who.common_name
            for who in identities(chasers=1)
            if all(who.role in clients for clients in queried)
            and all(may_read(who.role, topic) for topic in self.reads)
        ]


STATUS_TOPICS = (
    topics.TICK,
    topics.REFERENCE,
    topics.TARGET,
    topics.MAP,
    topics.END,
    topics.PRESENCE,
    topics.EVENT,
)
"""Topics that ``chaserdock status`` reads."""
TO_COMMAND = Rights((topics.OPERATE_KEY,))
TO_CHOOSE_PORTS = Rights((topics.PORT_KEY,))
TO_INJECT_FAULTS = Rights((topics.THRUSTER_FAULT_KEY,))
TO_ARM = Rights((topics.ARMING_KEY,))
TO_OBSERVE = Rights((topics.JOIN_KEY,), STATUS_TOPICS)
TO_JUDGE = Rights((topics.JOIN_KEY, topics.SCENARIO_KEY), (topics.TICK, topics.END))
TO_VIEW = TO_OBSERVE


def check_rights(link: Link, what: str, rights: Rights) -> None:
    """Raise RightsError if a link has the keys of a process that the router denies what the command
    ``what`` does. Without keys there is no router that denies it.
    """
    if link.tls is None:
        return
    check_holder(link.tls.certificate, what, rights.holders())


def check_holder(certificate: Path, what: str, holders: list[str]) -> None:
    """Raise RightsError unless a certificate is that of one of these processes."""
    own = holder_of(certificate)
    if own not in holders and not (_ANY_CHASER.fullmatch(own) and "chaser-0" in holders):
        raise RightsError(
            f"--keys {certificate.parent}: these are the keys of {own}; {what} needs those of "
            f"{' or '.join(holders)}"
        )


def holder_of(certificate: Path) -> str:
    """Return the name in a certificate, such as ``chaser-0``. Raises RightsError."""
    from cryptography import x509  # slow
    from cryptography.x509.oid import NameOID

    try:
        found = x509.load_pem_x509_certificate(certificate.read_bytes())
        return str(found.subject.get_attributes_for_oid(NameOID.COMMON_NAME)[0].value)
    except (OSError, ValueError, IndexError) as error:
        raise RightsError(f"{certificate}: not a certificate of a mission: {error}") from None


def is_reachable(link: Link) -> bool:
    """Return whether an endpoint of the link accepts connections, or cannot be tried."""
    found = [_TCP.fullmatch(endpoint) for endpoint in link.connect]
    return any(f is None or is_listening(f[1] or f[2], int(f[3])) for f in found)


def why_silent(link: Link) -> str:
    """Return why nobody may have answered on a link, and what would be right."""
    where = ", ".join(link.connect)
    if not is_reachable(link):
        return f"nothing listens at {where}: no mission is running there"
    return (
        f"{where} accepts connections: its mission has another namespace than {link.namespace}, or "
        "is too busy; a longer time may help"
    )
