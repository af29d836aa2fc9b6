# SPDX-License-Identifier: Apache-2.0
"""What the router denies is noted: who, what, on which key, how often; and nothing that is allowed."""

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
from chaserdock_protocol.transport.node import zenoh_config
from harness import chaserdock
from mission_keys import EVERYONE, NAMESPACE, PATIENCE_S, client, keys_with_owners, make_keys

from chaserdock.launch.launcher import free_port

WHO = "on Interface(lo)+CertCommonName(chaser-1)+Transport(Tls)+4fc8"
HEAD = f"2026-11-22T11:59:22.013715Z TRACE rx-1 ThreadId(10) {TARGET}:"
OTHER = HEAD.replace("rx-1 ThreadId(10)", "rx-0 ThreadId(09)")


def read(*lines: str) -> list[str]:
    reader = DenialParser("rights")
    return [str(denial) for line in lines if (denial := reader.parse(line)) is not None]


def test_a_decision_on_a_message_is_told_and_one_in_advance_is_not() -> None:
    put = f"4fc8 {WHO} is unauthorized to Put (ingress) on rights/world/tick"
    assert read(f"{HEAD} {put}") == ["chaser-1 may not publish on world/tick"]
    in_advance = (
        f"{HEAD} ACL (ingress): caching permissions for `rights/world/tick` ...",
        f"{HEAD} {put}",
        f"{OTHER} 4fc8 {WHO} is unauthorized to Query (ingress) on rights/x",  # another thread, a real one
        f"{HEAD} 4fc8 {WHO} is unauthorized to Declare Liveliness Subscriber (ingress) on rights/world/tick",
    )
    assert read(*in_advance) == ["chaser-1 may not query x"]
    used = f"{HEAD} Using cached result: 4fc8 is unauthorized to Put (ingress) on rights/world/tick"
    assert read(*in_advance, used) == ["chaser-1 may not query x", "chaser-1 may not publish on world/tick"]


def test_what_is_allowed_or_goes_out_or_is_no_decision_is_not_told() -> None:
    assert read(f"{HEAD} 4fc8 {WHO} is authorized to Put (ingress) on rights/world/tick") == []
    assert read(f"{HEAD} 4fc8 {WHO} is unauthorized to Put (egress) on rights/world/tick") == []
    assert read(f"{HEAD} something else", "", "is unauthorized to Put (ingress) on x") == []


def test_a_client_without_a_role_is_told() -> None:
    line = f"{HEAD.replace('TRACE', ' INFO')} 4fc8 did not match any configured ACL subject. Default"
    assert read(line) == ["a client without a role (4fc8) may not do anything on **"]


@pytest.mark.parametrize("why", ["peer sent no certificates", "invalid peer certificate: BadSignature"])
def test_who_has_no_certificate_is_told(why: str) -> None:
    line = f"2026-11-22T12:02:55Z  WARN acc-0 ThreadId(05) {TLS_TARGET}: {why}. Hint: increase the limit."
    assert read(line) == [f"a client without a certificate of this mission may not connect: {why}"]
    assert read(line.replace(why, "tls handshake eof")) == []  # somebody looked whether the port is open


def test_keys_of_any_length_and_character_are_told_in_one_short_line() -> None:
    (told,) = read(f"{HEAD} 4fc8 {WHO} is unauthorized to Put (ingress) on \x1b[31m" + "k" * 5000)
    assert told.isprintable()
    assert len(told) < 300


def test_repetitions_are_told_ever_more_rarely_and_memory_is_bounded() -> None:
    account, denial = DenialCounter(), Denial("chaser-1", "publish on", "world/tick")
    told = [text for _ in range(1000) if (text := account.add(denial)) is not None]
    assert told == [str(denial), *(f"{denial}: {n} times" for n in (10, 100, 1000))]
    for i in range(2 * MAX_DISTINCT):
        account.add(Denial("chaser-1", "publish on", f"k/{i}"))
    assert len(account.counts) == MAX_DISTINCT
    assert account.total == 1000 + 2 * MAX_DISTINCT


def test_the_log_is_read_however_it_is_cut_and_other_lines_are_passed_on() -> None:
    block = [
        f"{HEAD} ACL (ingress): caching permissions for `rights/k` ...",
        f"{HEAD} 4fc8 {WHO} is unauthorized to Put (ingress) on rights/k",
        f"{HEAD} 4fc8 {WHO} is authorized to Declare Liveliness Subscriber (ingress) on rights/k",
        f"{HEAD} 4fc8 {WHO} is authorized to Put (ingress) on rights/mine",
        "another line",
        f"{HEAD} 4fc8 {WHO} is unauthorized to Put (ingress) on rights/real",
    ]
    text = "\n".join(block) + "\n"
    cuts = [0, text.index("`rights"), text.index(block[2]), text.index("mine"), len(text)]
    pieces = [text[a:b] for a, b in itertools.pairwise(cuts)]
    code = (
        "import os, sys, time\n"
        "from chaserdock_agents.router.acl_audit import ZenohLog\n"
        "log = ZenohLog('rights')\n"
        f"for piece in {pieces!r}:\n"
        "    os.write(1, piece.encode())\n"
        "    time.sleep(0.1)\n"
        "log.close()\n"
        "print(*log.take_denials())\n"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, check=True, text=True).stdout
    assert out == "another line\nchaser-1 may not publish on real\n"


# -- a router as a process ------------------------------------------------------------------------------------


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


def test_every_wrong_identity_on_every_key_is_noted(
    router: tuple[Path, str, subprocess.Popen[bytes]],
) -> None:
    """The table of ``test_rights``: every denial of it, with its number, is in the log and on standard error; no other."""
    keys, endpoint, process = router
    noted: list[str] = []

    def arrived(raw: RawSample) -> None:
        if raw.key == "router/event":
            event = codec.decode(Event, raw.payload, raw.encoding)
            assert (event.process, event.level, event.what) == ("router", "warning", "denied")
            noted.append(event.detail)

    node = Node("recorder", "recorder", client(keys, "recorder", endpoint))
    node.subscribe_raw("**", arrived)
    table = keys_with_owners()
    allowed = {(owner, key) for key, owner in table}
    wrong = {
        (who, key)
        for who in EVERYONE
        for key, _ in table
        if (who.process, key) not in allowed and who.process != "recorder"
    }
    for who in EVERYONE:
        if who.process == "recorder":
            continue  # is here already
        session = zenoh.open(zenoh_config(client(keys, who.process, endpoint)))
        for key in dict(table):
            session.put(key, "x")
        session.close()
    expected = Counter(f"{who.common_name} may not publish on {key}" for who, key in wrong)
    deadline = time.monotonic() + PATIENCE_S
    while len(noted) < len(expected) and time.monotonic() < deadline:
        time.sleep(0.1)
    time.sleep(0.5)
    assert Counter(noted) == expected
    node.close()
    process.terminate()
    out, err = process.communicate(timeout=PATIENCE_S)
    assert process.returncode == 0
    assert out == b""  # Zenoh's own lines go nowhere
    said = [line.removeprefix("router: denied: ") for line in err.decode().splitlines()]
    assert Counter(said[:-1]) == expected
    assert said[-1] == f"router: denied {len(wrong)} messages and declarations in all"


def test_a_client_without_a_certificate_is_refused_and_noted(
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
        "router: denied: a client without a certificate of this mission may not connect: peer sent no certificates\n"
    )
