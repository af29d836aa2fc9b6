# SPDX-License-Identifier: Apache-2.0
"""Audit log of access-control denials: process, action, key and count of each; allowed messages are
not logged.
"""

from __future__ import annotations

import itertools
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest
import zenoh
from chaserdock_agents.router.acl_audit import (
    MAX_DISTINCT,
    TARGET,
    TLS_TARGET,
    Denial,
    DenialCounter,
    DenialParser,
)
from chaserdock_protocol import codec
from chaserdock_protocol.messages import Event
from chaserdock_protocol.transport import Node, RawSample
from chaserdock_protocol.transport.zenoh_network import zenoh_config
from harness import chaserdock
from mission_keys import EVERYONE, NAMESPACE, PATIENCE_S, client, keys_with_owners, make_keys

from chaserdock.exit_codes import STOPPED
from chaserdock.launch.launcher import free_port

SUBJECT = "on Interface(lo)+CertCommonName(chaser-1)+Transport(Tls)+4fc8"
HEAD = f"2026-11-22T11:59:22.013715Z TRACE rx-1 ThreadId(10) {TARGET}:"
OTHER_THREAD = HEAD.replace("rx-1 ThreadId(10)", "rx-0 ThreadId(09)")


def parse(*lines: str) -> list[str]:
    """Return the denials that Zenoh's log lines report."""
    parser = DenialParser("rights")
    return [str(denial) for line in lines if (denial := parser.parse(line)) is not None]


def test_denied_messages_are_reported_but_not_cached_decisions() -> None:
    put = f"4fc8 {SUBJECT} is unauthorized to Put (ingress) on rights/world/tick"
    assert parse(f"{HEAD} {put}") == ["chaser-1 may not publish on world/tick"]
    in_advance = (
        f"{HEAD} ACL (ingress): caching permissions for `rights/world/tick` ...",
        f"{HEAD} {put}",
        # another thread: a message, not caching
        f"{OTHER_THREAD} 4fc8 {SUBJECT} is unauthorized to Query (ingress) on rights/x",
        f"{HEAD} 4fc8 {SUBJECT} is unauthorized to Declare Liveliness Subscriber (ingress) on "
        "rights/world/tick",
    )
    assert parse(*in_advance) == ["chaser-1 may not query x"]
    used = f"{HEAD} Using cached result: 4fc8 is unauthorized to Put (ingress) on rights/world/tick"
    assert parse(*in_advance, used) == [
        "chaser-1 may not query x",
        "chaser-1 may not publish on world/tick",
    ]


def test_allowed_and_outgoing_messages_and_other_lines_are_not_reported() -> None:
    assert parse(f"{HEAD} 4fc8 {SUBJECT} is authorized to Put (ingress) on rights/world/tick") == []
    assert (
        parse(f"{HEAD} 4fc8 {SUBJECT} is unauthorized to Put (egress) on rights/world/tick") == []
    )
    assert parse(f"{HEAD} something else", "", "is unauthorized to Put (ingress) on x") == []


def test_client_without_role_is_reported() -> None:
    line = (
        f"{HEAD.replace('TRACE', ' INFO')} 4fc8 did not match any configured ACL subject. Default"
    )
    assert parse(line) == ["a client without a role (4fc8) may not do anything on **"]


@pytest.mark.parametrize(
    "why", ["peer sent no certificates", "invalid peer certificate: BadSignature"]
)
def test_client_without_valid_certificate_is_reported(why: str) -> None:
    line = (
        f"2026-11-22T12:02:55Z  WARN acc-0 ThreadId(05) {TLS_TARGET}: {why}. Hint: increase the "
        "limit."
    )
    assert parse(line) == [f"a client without a certificate of this mission may not connect: {why}"]
    assert parse(line.replace(why, "tls handshake eof")) == []  # a port scan or health check


def test_hostile_keys_are_reported_in_one_short_printable_line() -> None:
    (text,) = parse(
        f"{HEAD} 4fc8 {SUBJECT} is unauthorized to Put (ingress) on \x1b[31m" + "k" * 5000
    )
    assert text.isprintable()
    assert len(text) < 300


def test_repeated_denials_are_reported_at_powers_of_ten_with_bounded_memory() -> None:
    counter, denial = DenialCounter(), Denial("chaser-1", "publish on", "world/tick")
    reported = [text for _ in range(1000) if (text := counter.add(denial)) is not None]
    assert reported == [str(denial), *(f"{denial}: {n} times" for n in (10, 100, 1000))]
    for i in range(2 * MAX_DISTINCT):
        counter.add(Denial("chaser-1", "publish on", f"k/{i}"))
    assert len(counter.counts) == MAX_DISTINCT
    assert counter.total == 1000 + 2 * MAX_DISTINCT


def test_log_stream_is_parsed_across_arbitrary_chunks_and_other_lines_pass_through() -> None:
    lines = [
        f"{HEAD} ACL (ingress): caching permissions for `rights/k` ...",
        f"{HEAD} 4fc8 {SUBJECT} is unauthorized to Put (ingress) on rights/k",
        f"{HEAD} 4fc8 {SUBJECT} is authorized to Declare Liveliness Subscriber (ingress) on "
        "rights/k",
        f"{HEAD} 4fc8 {SUBJECT} is authorized to Put (ingress) on rights/mine",
        "another line",
        f"{HEAD} 4fc8 {SUBJECT} is unauthorized to Put (ingress) on rights/real",
    ]
    text = "\n".join(lines) + "\n"
    cuts = [0, text.index("`rights"), text.index(lines[2]), text.index("mine"), len(text)]
    chunks = [text[a:b] for a, b in itertools.pairwise(cuts)]
    code = (
        "import os, sys, time\n"
        "from chaserdock_agents.router.acl_audit import ZenohLog\n"
        "log = ZenohLog('rights')\n"
        f"for chunk in {chunks!r}:\n"
        "    os.write(1, chunk.encode())\n"
        "    time.sleep(0.1)\n"
        "log.close()\n"
        "print(*log.take_denials())\n"
    )
    out = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, check=True, text=True
    ).stdout
    assert out == "another line\nchaser-1 may not publish on real\n"


# -- a router as a process -------------------------------------------------------------------------


@pytest.fixture
def router(tmp_path: Path) -> Iterator[tuple[Path, str, subprocess.Popen[bytes]]]:
    keys = make_keys(tmp_path / "keys")
    endpoint = f"tls/127.0.0.1:{free_port()}"
    arguments = ("--keys", str(keys / "router"), "-l", endpoint, "--namespace", NAMESPACE)
    process = chaserdock("router", *arguments, stderr=subprocess.PIPE, stdout=subprocess.PIPE)
    try:
        assert process.stderr is not None
        assert b"with access rules" in process.stderr.readline()
        yield keys, endpoint, process
    finally:
        process.kill()
        process.communicate()


def test_every_unauthorized_publication_is_logged_once(
    router: tuple[Path, str, subprocess.Popen[bytes]],
) -> None:
    """Each process publishes on each key: exactly the denied ones appear as events and on standard
    error.
    """
    keys, endpoint, process = router
    logged: list[str] = []

    def on_sample(raw: RawSample) -> None:
        if raw.key == "router/event":
            event = codec.decode(Event, raw.payload, raw.encoding)
            assert (event.process, event.level, event.what) == ("router", "warning", "denied")
            logged.append(event.detail)

    node = Node("recorder", "recorder", client(keys, "recorder", endpoint))
    node.subscribe_raw("**", on_sample)
    table = keys_with_owners()
    allowed = {(owner, key) for key, owner in table}
    denied = {
        (identity, key)
        for identity in EVERYONE
        for key, _ in table
        if (identity.process, key) not in allowed and identity.process != "recorder"
    }
    for identity in EVERYONE:
        if identity.process == "recorder":
            continue  # connected above
        session = zenoh.open(zenoh_config(client(keys, identity.process, endpoint)))
        for key in dict(table):
            session.put(key, "x")
        session.close()
    expected = Counter(
        f"{identity.common_name} may not publish on {key}" for identity, key in denied
    )
    deadline = time.monotonic() + PATIENCE_S
    while len(logged) < len(expected) and time.monotonic() < deadline:
        time.sleep(0.1)
    time.sleep(0.5)
    assert Counter(logged) == expected
    node.close()
    process.terminate()
    out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == STOPPED
    assert out == b""  # Zenoh's own lines are suppressed
    reported = [line.removeprefix("router: denied: ") for line in err.decode().splitlines()]
    assert Counter(reported[:-2]) == expected
    assert reported[-2] == f"router: denied {len(denied)} messages and declarations in all"
    assert reported[-1] == "router: ended"


def test_connection_without_certificate_is_rejected_and_logged(
    router: tuple[Path, str, subprocess.Popen[bytes]],
) -> None:
    keys, endpoint, process = router
    link = client(keys, "chaser/0", endpoint)
    assert link.tls is not None
    config = zenoh_config(replace(link, tls=None))
    config.insert_json5("transport/link/tls", f'{{root_ca_certificate: "{link.tls.ca}"}}')
    config.insert_json5("connect/timeout_ms", "1000")
    config.insert_json5("connect/exit_on_failure", "true")
    with pytest.raises(zenoh.ZError):
        zenoh.open(config).close()
    assert process.stderr is not None
    assert process.stderr.readline().decode() == (
        "router: denied: a client without a certificate of this mission may not connect: peer sent "
        "no certificates\n"
    )
