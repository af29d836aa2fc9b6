# SPDX-License-Identifier: Apache-2.0
"""Count access-control denials from Zenoh's log, as Zenoh drops messages without notice.

At level ``trace`` Zenoh writes a line for every decision. Some are not attempts: when a client
declares a key, all permissions for it are cached (between "caching permissions" and the ninth
decision, on one thread). Other lines with "is unauthorized to ... (ingress)" are messages that a
client sent and that were dropped.
"""

from __future__ import annotations

import fcntl
import os
import re
import threading
import time
from collections import Counter
from contextlib import suppress
from dataclasses import dataclass, field

TARGET = "zenoh::net::routing::interceptor::access_control"
TLS_TARGET = "zenoh_link_tls::unicast"
MAX_DISTINCT = 4096
"""Most distinct denials that are counted separately. Bounds the memory for clients that use ever
new keys.
"""
_MAX_KEY_LENGTH = 200
"""Characters of a denied key that are printed: longer than all keys of ours; bounds the log."""
_PIPE_BYTES = 1 << 20
"""Size of the pipe of Zenoh's log, 1 MiB, the largest that Linux allows without privileges: it must
hold the lines of ``_POLL_S``.
"""
_POLL_S = 0.02
"""Interval at which the pipe is read: waking the reader for every line costs more than the lines.
"""

_DECISION = re.compile(
    rf"\S+ +TRACE (?P<thread>.*ThreadId\(\d+\)) {TARGET}: (?P<cached>Using cached result: "
    rf")?(?P<client>[0-9a-f]+)"
    r"(?: on (?P<subject>\S+))? is (?P<un>un)?authorized to (?P<what>[\w /]+) "
    r"\((?P<flow>ingress|egress)\) on (?P<key>.*)"
)
_CACHING = re.compile(
    rf"\S+ +TRACE (?P<thread>.*ThreadId\(\d+\)) {TARGET}: ACL \(\w+\): caching permissions"
)
_NO_SUBJECT = re.compile(
    rf".*{TARGET}: (?P<client>[0-9a-f]+) did not match any configured ACL subject"
)
_REFUSED = re.compile(
    rf".*{TLS_TARGET}: (?P<why>peer sent no certificates|invalid peer certificate: \w+|received "
    rf"fatal alert: \w+)"
)
_NAME = re.compile(r"CertCommonName\((?P<name>[^)]*)\)")
_LAST_CACHED = "Declare Liveliness Subscriber"
_TARGETS = (TARGET.encode(), TLS_TARGET.encode())
_AUTHORIZED = b" is authorized to "
_RELEVANT = (b" is unauthorized to ", b" caching permissions ", b"did not match")
_ACTIONS = {
    "Put": "publish on",
    "Delete": "delete",
    "Query": "query",
    "Reply": "reply on",
    "Declare Subscriber": "subscribe",
    "Declare Queryable": "serve queries on",
    "Liveliness Token": "declare liveliness of",
    "Liveliness Query": "query liveliness of",
    "Declare Liveliness Subscriber": "watch liveliness of",
}


@dataclass(frozen=True)
class Denial:
    """A denied action of a client (certificate name) on a key without the namespace, or a denied
    connection.
    """

    client: str
    what: str
    key: str

    def __str__(self) -> str:
        return f"{self.client} may not {self.what} {self.key}"


@dataclass
class DenialParser:
    """Parses denials from consecutive lines of Zenoh's log."""

    namespace: str
    _names: dict[str, str] = field(default_factory=dict)
    _caching: set[str] = field(default_factory=set)

    @property
    def is_caching(self) -> bool:
        """Whether permissions are being cached, so that every line must be parsed."""
        return bool(self._caching)

    def parse(self, line: str) -> Denial | None:
        """Return the denial in a line, or None."""
        if (caching := _CACHING.match(line)) is not None:
            self._caching.add(caching["thread"])
            return None
        if (client_without_role := _NO_SUBJECT.match(line)) is not None:
            return Denial(
                f"a client without a role ({client_without_role['client']})", "do anything on", "**"
            )
        if (refused := _REFUSED.match(line)) is not None:
            return Denial(
                "a client without a certificate of this mission", "connect:", refused["why"]
            )
        if (decision := _DECISION.match(line)) is None:
            return None
        thread, client, what = decision["thread"], decision["client"], decision["what"]
        if (named := _NAME.search(decision["subject"] or "")) is not None:
            if len(self._names) >= MAX_DISTINCT:
                # every connection is a new client; its id is used until it is named again
                self._names.clear()
            self._names[client] = named["name"]
        if thread in self._caching and not decision["cached"]:
            if what == _LAST_CACHED:
                self._caching.discard(thread)
            return None
        if not decision["un"] or decision["flow"] == "egress" or what not in _ACTIONS:
            return None
        return Denial(
            self._names.get(client, client), _ACTIONS[what], self._printable(decision["key"])
        )

    def _printable(self, key: str) -> str:
        """Return a key as printable text of limited length, as clients choose it."""
        key = key.removeprefix(f"{self.namespace}/")
        cut = "..." if len(key) > _MAX_KEY_LENGTH else ""
        return "".join(c if c.isprintable() else "?" for c in key[:_MAX_KEY_LENGTH]) + cut


@dataclass
class DenialCounter:
    """Counts denials; ``overflow``: those beyond MAX_DISTINCT."""

    counts: Counter[Denial] = field(default_factory=Counter)
    overflow: int = 0

    def add(self, denial: Denial) -> str | None:
        """Count a denial; return a text to publish at the first, tenth, hundredth, ... occurrence,
        or None.
        """
        if denial not in self.counts and len(self.counts) >= MAX_DISTINCT:
            self.overflow += 1
            return (
                f"{self.overflow} times on further keys"
                if _is_power_of_ten(self.overflow)
                else None
            )
        self.counts[denial] += 1
        times = self.counts[denial]
        if not _is_power_of_ten(times):
            return None
        return str(denial) if times == 1 else f"{denial}: {times} times"

    @property
    def total(self) -> int:
        return self.counts.total() + self.overflow


def _is_power_of_ten(n: int) -> bool:
    return str(n).rstrip("0") == "1"


class ZenohLog:
    """Captures this process' standard output, to which Zenoh writes its log, and forwards all other
    lines.

    Must be created before the process' first session. The user's ``RUST_LOG`` still applies to
    everything else.
    """

    def __init__(self, namespace: str) -> None:
        users = os.environ.get("RUST_LOG", "error")
        os.environ["RUST_LOG"] = f"{users},{TLS_TARGET}=warn,{TARGET}=trace"
        os.environ["NO_COLOR"] = "1"
        self._parser = DenialParser(namespace)
        self._denials: list[Denial] = []
        self._lock = threading.Lock()
        self._output = os.dup(1)
        self._lines, writer = os.pipe()
        # Optional: with a smaller pipe Zenoh blocks more often.
        with suppress(OSError, AttributeError):
            fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        os.dup2(writer, 1)
        os.close(writer)
        self._thread = threading.Thread(target=self._run, name="zenoh-log", daemon=True)
        self._thread.start()

    def take_denials(self) -> list[Denial]:
        """Return the denials since the last call."""
        with self._lock:
            denials, self._denials = self._denials, []
        return denials

    def close(self) -> None:
        """Restore standard output after the last session has closed, and read what remains."""
        os.dup2(self._output, 1)
        self._thread.join()
        os.close(self._output)

    def _run(self) -> None:
        rest = b""
        while piece := os.read(self._lines, _PIPE_BYTES):
            whole, end, rest = (rest + piece).rpartition(b"\n")
            # Nearly all lines are authorizations, thousands per second: skip them without parsing.
            only_authorized = whole.count(_AUTHORIZED) == whole.count(b"\n") + len(end)
            if (
                not only_authorized
                or self._parser.is_caching
                or any(word in whole for word in _RELEVANT)
            ):
                for line in whole.split(b"\n") if end else ():
                    self._handle_line(line)
            time.sleep(_POLL_S)
        os.close(self._lines)

    def _handle_line(self, line: bytes) -> None:
        if not any(target in line for target in _TARGETS):
            # A closed standard output must not stop the router.
            with suppress(OSError):
                os.write(self._output, line + b"\n")
            return
        denial = self._parser.parse(line.decode("utf-8", "replace"))
        if denial is not None:
            with self._lock:
                self._denials.append(denial)
