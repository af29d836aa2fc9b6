"""Whom the router denied what, read from Zenoh's own log: its access control drops in silence otherwise.

At level ``trace`` Zenoh writes a line for every decision, of which some are no attempt: when a client names a key, all that
could ever be done with it is decided at once (between "caching permissions" and the ninth decision, on one thread). What
is left and says "is unauthorized to ... (ingress)" is a message that a client sent and nobody got.
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
MOST_NAMED = 4096
"""So many different denials are told apart; whoever sends on ever new keys does not fill the memory."""
_LONGEST_KEY = 200
_PIPE_BYTES = 1 << 20
_EVERY_S = 0.02
"""Zenoh's threads write into a pipe that is looked at this often: a reader woken by every line costs more than the lines."""

_DECISION = re.compile(
    rf"\S+ +TRACE (?P<thread>.*ThreadId\(\d+\)) {TARGET}: (?P<cached>Using cached result: )?(?P<client>[0-9a-f]+)"
    r"(?: on (?P<subject>\S+))? is (?P<un>un)?authorized to (?P<what>[\w /]+) \((?P<flow>ingress|egress)\) on (?P<key>.*)"
)
_CACHING = re.compile(rf"\S+ +TRACE (?P<thread>.*ThreadId\(\d+\)) {TARGET}: ACL \(\w+\): caching permissions")
_STRANGER = re.compile(rf".*{TARGET}: (?P<client>[0-9a-f]+) did not match any configured ACL subject")
_REFUSED = re.compile(
    rf".*{TLS_TARGET}: (?P<why>peer sent no certificates|invalid peer certificate: \w+|received fatal alert: \w+)"
)
_NAME = re.compile(r"CertCommonName\((?P<name>[^)]*)\)")
_LAST_CACHED = "Declare Liveliness Subscriber"
_TARGETS = (TARGET.encode(), TLS_TARGET.encode())
_ALLOWED = b" is authorized to "
_TELLING = (b" is unauthorized to ", b" caching permissions ", b"did not match")
_WORDS = {
    "Put": "publish on",
    "Delete": "delete",
    "Query": "ask",
    "Reply": "answer",
    "Declare Subscriber": "subscribe",
    "Declare Queryable": "offer answers on",
    "Liveliness Token": "live as",
    "Liveliness Query": "ask who lives on",
    "Declare Liveliness Subscriber": "watch who lives on",
}


@dataclass(frozen=True)
class Denial:
    """A client, by the name in its certificate, tried something on a key (without the namespace), or to connect."""

    client: str
    what: str
    key: str

    def __str__(self) -> str:
        return f"{self.client} may not {self.what} {self.key}"


@dataclass
class Reader:
    """Denials out of the lines of Zenoh's log, in their order."""

    namespace: str
    _names: dict[str, str] = field(default_factory=dict)
    _caching: set[str] = field(default_factory=set)

    @property
    def is_amid(self) -> bool:
        """Whether decisions in advance are still to come: then every line counts."""
        return bool(self._caching)

    def read(self, line: str) -> Denial | None:
        """What a line says was denied, or None."""
        if (caching := _CACHING.match(line)) is not None:
            self._caching.add(caching["thread"])
            return None
        if (stranger := _STRANGER.match(line)) is not None:
            return Denial(f"a client without a role ({stranger['client']})", "do anything on", "**")
        if (refused := _REFUSED.match(line)) is not None:
            return Denial("who has no certificate of this mission", "connect:", refused["why"])
        if (decision := _DECISION.match(line)) is None:
            return None
        thread, client, what = decision["thread"], decision["client"], decision["what"]
        if (named := _NAME.search(decision["subject"] or "")) is not None:
            if len(self._names) >= MOST_NAMED:
                self._names.clear()  # each connection is another client; until it is named again its id must do
            self._names[client] = named["name"]
        if thread in self._caching and not decision["cached"]:
            if what == _LAST_CACHED:
                self._caching.discard(thread)
            return None
        if not decision["un"] or decision["flow"] == "egress" or what not in _WORDS:
            return None
        return Denial(self._names.get(client, client), _WORDS[what], self._shown(decision["key"]))

    def _shown(self, key: str) -> str:
        """A key as it may be told: clients choose them, and may choose any length and character."""
        key = key.removeprefix(f"{self.namespace}/")
        cut = "..." if len(key) > _LONGEST_KEY else ""
        return "".join(c if c.isprintable() else "?" for c in key[:_LONGEST_KEY]) + cut


@dataclass
class Account:
    """How often each was denied. ``overflow``: of those that are not told apart any more."""

    counts: Counter[Denial] = field(default_factory=Counter)
    overflow: int = 0

    def add(self, denial: Denial) -> str | None:
        """A text to be told: at the first time, the tenth, the hundredth, and so on."""
        if denial not in self.counts and len(self.counts) >= MOST_NAMED:
            self.overflow += 1
            return f"{self.overflow} times on yet other keys" if _is_power_of_ten(self.overflow) else None
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
    """This process' standard output, into which Zenoh writes its log, read line by line; other lines are passed on.

    To be made before the process' first session. The user's ``RUST_LOG`` still holds for everything else.
    """

    def __init__(self, namespace: str) -> None:
        users = os.environ.get("RUST_LOG", "error")
        os.environ["RUST_LOG"] = f"{users},{TLS_TARGET}=warn,{TARGET}=trace"
        os.environ["NO_COLOR"] = "1"
        self._reader = Reader(namespace)
        self._found: list[Denial] = []
        self._lock = threading.Lock()
        self._output = os.dup(1)
        self._lines, writer = os.pipe()
        # Where that is not to be had, Zenoh waits a little more often.
        with suppress(OSError, AttributeError):
            fcntl.fcntl(writer, fcntl.F_SETPIPE_SZ, _PIPE_BYTES)
        os.dup2(writer, 1)
        os.close(writer)
        self._thread = threading.Thread(target=self._run, name="zenoh-log", daemon=True)
        self._thread.start()

    def take(self) -> list[Denial]:
        """What has been denied since the last call."""
        with self._lock:
            found, self._found = self._found, []
        return found

    def close(self) -> None:
        """Gives standard output back, when no session is open any more; what was written is read."""
        os.dup2(self._output, 1)
        self._thread.join()
        os.close(self._output)

    def _run(self) -> None:
        rest = b""
        while piece := os.read(self._lines, _PIPE_BYTES):
            whole, end, rest = (rest + piece).rpartition(b"\n")
            # Nearly always every line allows something: seen at one glance, as there may be thousands a second.
            dull = whole.count(_ALLOWED) == whole.count(b"\n") + len(end)
            if not dull or self._reader.is_amid or any(word in whole for word in _TELLING):
                for line in whole.split(b"\n") if end else ():
                    self._sort(line)
            time.sleep(_EVERY_S)
        os.close(self._lines)

    def _sort(self, line: bytes) -> None:
        if not any(target in line for target in _TARGETS):
            # Nobody reads that any more: no reason to stop, which would stop the router.
            with suppress(OSError):
                os.write(self._output, line + b"\n")
            return
        denial = self._reader.read(line.decode("utf-8", "replace"))
        if denial is not None:
            with self._lock:
                self._found.append(denial)
