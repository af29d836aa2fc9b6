# SPDX-License-Identifier: Apache-2.0
"""A mission over a router, with rights, from the command line: keys, router, status, judge."""

from __future__ import annotations

import json
import os
import signal
import socket
import stat
import subprocess
import sys
import threading
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from chaserdock_protocol import topics
from chaserdock_protocol.messages import Tick
from chaserdock_protocol.recording.log import read_log
from chaserdock_protocol.transport import Link, Node, Tls
from cryptography import x509
from harness import ROOT, SHORT, all_gone, chaserdock, find_child, finished, run, sets, wait_for_log
from mission_keys import make_keys
from typer.testing import CliRunner

from chaserdock.cli.main import app
from chaserdock.launch import container
from chaserdock.launch.keys import KeysError, init_keys, names, why_not_usable
from chaserdock.launch.launcher import free_port
from chaserdock.launch.operator import OperatorError, send_command
from chaserdock.launch.reach import TO_COMMAND, Rights, RightsError, check_rights
from chaserdock.launch.status import MissionStatus, StatusError, expected, observe

NOW = datetime(2026, 1, 1, tzinfo=UTC)


# -- keys ------------------------------------------------------------------------------------------


def test_each_process_gets_its_own_key_and_the_authority_key_is_not_kept(tmp_path: Path) -> None:
    init_keys(tmp_path, 2, ("example.org", "10.0.0.7"), 7, NOW)
    authorities, private = set(), set()
    for name in names(2):
        folder = tmp_path / name
        assert {f.name for f in folder.iterdir()} == {"ca.pem", "cert.pem", "key.pem"}
        assert stat.S_IMODE((folder / "key.pem").stat().st_mode) == 0o600
        authority = x509.load_pem_x509_certificate((folder / "ca.pem").read_bytes())
        certificate = x509.load_pem_x509_certificate((folder / "cert.pem").read_bytes())
        certificate.verify_directly_issued_by(authority)
        assert certificate.subject.rfc4514_string() == f"CN={name}"
        assert not certificate.extensions.get_extension_for_class(x509.BasicConstraints).value.ca
        authorities.add((folder / "ca.pem").read_bytes())
        private.add((folder / "key.pem").read_bytes())
    assert len(authorities) == 1
    assert len(private) == len(names(2))
    assert {f.name for f in tmp_path.iterdir()} == set(names(2))
    router = x509.load_pem_x509_certificate((tmp_path / "router" / "cert.pem").read_bytes())
    hosts = router.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    assert hosts.get_values_for_type(x509.DNSName) == ["example.org"]
    assert [str(a) for a in hosts.get_values_for_type(x509.IPAddress)] == ["10.0.0.7"]


def test_keys_are_not_overwritten_and_expire(tmp_path: Path) -> None:
    assert why_not_usable(tmp_path, 1, NOW) == "it contains no keys"
    init_keys(tmp_path, 1, ("localhost",), 2, NOW)
    before = (tmp_path / "world" / "key.pem").read_bytes()
    with pytest.raises(KeysError, match="never overwritten"):
        init_keys(tmp_path, 1, ("localhost",), 2, NOW)
    assert (tmp_path / "world" / "key.pem").read_bytes() == before
    assert why_not_usable(tmp_path, 1, NOW) is None
    assert "expire at 2026-01-03" in (why_not_usable(tmp_path, 1, NOW + timedelta(days=2)) or "")
    (tmp_path / "chaser-0" / "key.pem").unlink()
    assert why_not_usable(tmp_path, 1, NOW) == "the keys of chaser-0 are missing"


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["chaser", "0", "--keys", "{empty}"], "make a mission's keys"),
        (["chaser", "0", "--keys", "{keys}", "-e", "tcp/127.0.0.1:1"], "must be tls/HOST:PORT"),
        (["router", "--keys", "{keys}", "-l", "tcp/127.0.0.1:0"], "must be tls/HOST:PORT"),
        (["router", "--until", "nobody"], "--until nobody"),
        (
            ["status", "-e", "tcp/127.0.0.1:1", "--duration", "0.5"],
            "nothing listens at tcp/127.0.0.1:1",
        ),
        (["command", "hold", "0", "-e", "tcp/127.0.0.1:1", "--timeout", "0.5"], "nothing listens"),
    ],
)
def test_invalid_network_options_are_one_line(
    arguments: list[str], words: str, tmp_path: Path
) -> None:
    (tmp_path / "empty").mkdir()
    keys = make_keys(tmp_path / "keys")
    filled = [a.format(empty=tmp_path / "empty", keys=keys) for a in arguments]
    status, said = finished(*filled, timeout_s=60)
    assert status == 2, said
    assert words in said
    assert len(said.strip().splitlines()) == 1


# -- a mission -------------------------------------------------------------------------------------


@pytest.mark.slow
def test_mission_over_a_router_with_rights(tmp_path: Path) -> None:
    """Every process has only its own keys; the router restarts in flight; the flight is a
    success.
    """
    keys, runs = make_keys(tmp_path / "keys"), tmp_path / "runs"
    endpoint = f"tls/127.0.0.1:{free_port()}"
    reach = ["-e", endpoint, "--lease", "10"]
    short = sets(
        *SHORT, "duration_s=20.0"
    )  # long enough for `status` and for the restart of the router
    processes: dict[str, subprocess.Popen[bytes]] = {}

    def start(name: str, *arguments: str) -> None:
        processes[name] = chaserdock(
            *arguments,
            "--keys",
            str(keys / name),
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
        )

    def start_router() -> None:
        start("router", "router", "-l", endpoint, "--until", "operator")

    try:
        start("world", "world", "two-chaser-tracking", *short, "--rejoin-timeout", "30", *reach)
        start("controller", "controller", *reach)
        start("chaser-0", "chaser", "0", *reach)
        start("chaser-1", "chaser", "1", *reach)
        start("recorder", "record", "--out", str(runs), "--by-run", *reach)
        start("operator", "judge", str(runs), "--live", *reach)
        start_router()  # the last, as order must not matter
        deadline = time.monotonic() + 60
        while not (logs := list(runs.glob("two-chaser-tracking-*/mission.mcap"))):
            assert time.monotonic() < deadline
            time.sleep(0.1)
        wait_for_log(logs[0], 300_000, timeout_s=240.0)  # the solver may have to be compiled
        status, said = finished(
            "status", "--keys", str(keys), "-e", endpoint, "--json", timeout_s=60
        )
        assert status == 0, said
        seen = json.loads(said)
        assert set(seen["processes"]) == {
            "world",
            "controller",
            "chaser/0",
            "chaser/1",
            "recorder",
            "operator",
        }
        assert seen["processes"]["chaser/1"]["expected"] is True
        assert seen["tick"] > 0
        assert set(seen["phases"]) == {"0", "1"}
        processes["router"].kill()
        processes["router"].wait()
        start_router()
        said_by = {}
        for name, process in processes.items():
            out, _ = process.communicate(timeout=120)
            said_by[name] = out.decode()
        statuses = {name: p.returncode for name, p in processes.items()}
    finally:
        for process in processes.values():
            if process.poll() is None:
                process.kill()
            process.wait()
    # What was on its way when the router died is lost, and the recorder says so; the flight itself
    # is a success.
    assert statuses.pop("recorder") in (0, 1), said_by
    assert set(statuses.values()) == {0}, said_by
    assert "denied" not in said_by["router"]  # no process tries what it may not do
    summary = json.loads((logs[0].parent / "summary.json").read_text())
    assert summary["success"]
    assert summary["sim_time_s"] == 20.0
    assert "</html>" in (logs[0].parent / "report.html").read_text()
    ticks = [r.message for r in read_log(logs[0], ["world/tick"])]
    assert ticks[-1].chasers == (0, 1)
    assert "controller" in ticks[-1].controllers


@pytest.mark.slow
def test_run_with_keys_equals_run_without(short_flight: Path, tmp_path: Path) -> None:
    """The digests are equal; the router enforced access rights and denied nothing."""
    keys = ["--keys", str(make_keys(tmp_path / "keys"))]
    status, said = run("two-chaser-tracking", tmp_path / "run", *SHORT, arguments=keys)
    assert status == 0, said
    digests = [
        json.loads((f / "summary.json").read_text())["digest"]
        for f in (tmp_path / "run", short_flight)
    ]
    assert digests[0] == digests[1]
    words = (tmp_path / "run" / "processes" / "router.txt").read_text()
    assert "TLS, with access rules" in words
    assert "denied" not in words
    assert not (short_flight / "processes" / "router.txt").exists()


@pytest.mark.slow
def test_run_with_missing_keys_is_rejected(tmp_path: Path) -> None:
    keys = ["--keys", str(tmp_path / "none")]
    status, said = run("two-chaser-tracking", tmp_path / "out", arguments=keys)
    assert status == 2
    assert "it contains no keys; make a mission's keys with `chaserdock deploy --keys" in said
    assert len(said.strip().splitlines()) == 1
    four = make_keys(tmp_path / "three")  # of three chasers
    status, said = finished(
        "run", "four-chaser-docking", "--keys", str(four), "--out", str(tmp_path / "out")
    )
    assert (status, "the keys of chaser-3 are missing" in said) == (2, True)
    assert not (tmp_path / "out").exists()


# -- a container's main process --------------------------------------------------------------------


def test_link_is_a_listening_or_connected_socket() -> None:
    with socket.socket() as listening, socket.socket() as calling:
        listening.bind(("127.0.0.1", 0))
        port = listening.getsockname()[1]
        assert not container.is_linked(port)
        listening.listen()
        assert container.is_linked(port)
        calling.connect(("127.0.0.1", port))
        answering, _ = listening.accept()
        assert container.is_listening("127.0.0.1", port)
        listening.close()
        with answering:
            assert container.is_linked(port)
    assert not container.is_listening("127.0.0.1", port)


def test_health_check_needs_a_link_or_a_listening_router(tmp_path: Path) -> None:
    """docker/healthy tests without Python what ``is_linked`` tests."""

    def health(port: int, call: str) -> int:
        environment = {
            **os.environ,
            "ROUTER": f"router:{port}",
            "HEALTHY_SEEN": str(
                tmp_path / call
            ),  # the first time in a container's life: it does not wait
        }
        return subprocess.run(
            [ROOT / "docker" / "healthy"], env=environment, check=False
        ).returncode

    with socket.socket() as listening, socket.socket() as calling:
        listening.bind(("127.0.0.1", 0))
        port = listening.getsockname()[1]
        assert health(port, "bound") != 0
        assert not (tmp_path / "bound").exists()
        listening.listen()
        assert health(port, "listening") == 0
        assert (tmp_path / "listening").exists()
        calling.connect(("127.0.0.1", port))
        answering, _ = listening.accept()
        listening.close()
        with answering:
            assert health(port, "connected") == 0
    assert health(port, "closed") != 0


def test_world_gets_overrides_and_too_many_chasers_are_rejected() -> None:
    assert container.with_overrides(["world", "x"], "a=1 b='q r'") == [
        "world",
        "x",
        "--set",
        "a=1",
        "--set",
        "b=q r",
    ]
    assert container.with_overrides(["chaser", "0"], "a=1") == ["chaser", "0"]
    assert container.count_chasers("two-chaser-tracking", "seed=3") == 2
    assert container.too_many_chasers("four-chaser-docking", "", 4) is None
    reason = container.too_many_chasers("four-chaser-docking", "", 3) or ""
    assert "has 4 chasers" in reason
    assert "chaserdock deploy --chasers 4 > compose.yaml" in reason


def test_container_forwards_signals_and_leaves_no_process(tmp_path: Path) -> None:
    """A recorder without a world, stopped as Docker stops a container."""
    arguments = ["record", "--out", str(tmp_path / "run"), "-e", f"tcp/127.0.0.1:{free_port()}"]
    process = subprocess.Popen([sys.executable, "-m", "chaserdock.launch.container", *arguments])
    recorder = find_child(process, "chaserdock", "record", timeout_s=60.0)
    process.send_signal(signal.SIGTERM)
    assert process.wait(timeout=60) == 130
    assert all_gone([recorder], timeout_s=60.0)


def test_container_forwards_a_signal_that_arrives_while_it_starts_its_process(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    forwarded: list[int] = []

    class Started:
        def __init__(self, command: list[str]) -> None:
            os.kill(os.getpid(), signal.SIGTERM)

        def send_signal(self, number: int) -> None:
            forwarded.append(number)

        def wait(self, timeout: float) -> int:
            return -forwarded[0]

    before = [(number, signal.getsignal(number)) for number in (signal.SIGTERM, signal.SIGINT)]
    monkeypatch.setattr(container.subprocess, "Popen", Started)
    # Without its handler the signal would end the tests.
    signal.signal(
        signal.SIGTERM, lambda number, frame: pytest.fail("the container has no handler yet")
    )
    try:
        assert container.run(["record"], "router", 7447) == 130
    finally:
        for number, handler in before:
            signal.signal(number, handler)
    assert forwarded == [signal.SIGTERM]


# -- status ----------------------------------------------------------------------------------------


def test_status_computes_speed_and_expected_processes() -> None:
    status = MissionStatus()
    ticks = [
        Tick(tick=k, sim_time_ns=k * 500_000_000, images=True, chasers=(0, 2)) for k in range(4)
    ]
    for tick in ticks:
        status.update(tick, 10.0 + tick.tick)
    assert status.speed == pytest.approx(0.5)
    assert [expected(n, ticks[-1]) for n in ("chaser/0", "chaser/1", "controller", "world")] == [
        True,
        False,
        False,
        None,
    ]
    assert MissionStatus().speed is None
    assert MissionStatus().as_dict()["tick"] is None


@pytest.mark.parametrize(
    ("arguments", "key", "needed"),
    [
        (["status"], "chaser-0", "recorder or operator or viewer or bridge"),
        (["command", "hold", "0"], "chaser-0", "operator or viewer or bridge"),
        (["command", "hold", "0"], "recorder", "operator or viewer or bridge"),
        (
            ["command", "thruster-fault", "0", "--thruster", "1", "--fault", "stuck_on"],
            "viewer",
            "thruster-fault needs those of operator",
        ),
        (["judge", "{out}", "--live"], "controller", "recorder or operator or viewer"),
        (["view"], "chaser-0", "recorder or operator or viewer or bridge"),
        (["chaser", "1"], "chaser-0", "chaser/1 needs those of chaser-1"),
        (["record", "--out", "{out}"], "operator", "recorder needs those of recorder"),
        (["router"], "world", "router needs those of router"),
    ],
)
def test_wrong_keys_are_named_with_the_right_ones(
    arguments: list[str], key: str, needed: str, tmp_path: Path
) -> None:
    """Nothing is asked of the network: the certificate says who the caller is."""
    keys = make_keys(tmp_path / "keys") / key
    filled = [a.format(out=tmp_path / "out") for a in arguments]
    said = CliRunner().invoke(app, [*filled, "--keys", str(keys)])
    assert f"these are the keys of {key}; " in str(said.exception)
    assert needed in str(said.exception)


def test_keys_of_any_process_with_the_rights_are_accepted(tmp_path: Path) -> None:
    keys = make_keys(tmp_path)
    for name in Rights(reads=(topics.TICK,)).holders():
        link = Link(tls=Tls.in_folder(keys / name))
        check_rights(link, "this", Rights(reads=(topics.TICK,)))
    check_rights(Link(tls=Tls.in_folder(keys / "chaser-2")), "this", Rights(reads=(topics.TICK,)))
    check_rights(Link(), "this", TO_COMMAND)
    (keys / "operator" / "cert.pem").write_text("none")
    with pytest.raises(RightsError, match=r"cert\.pem: not a certificate"):
        check_rights(Link(tls=Tls.in_folder(keys / "operator")), "this", TO_COMMAND)


def test_status_finds_a_mission_that_answers_late() -> None:
    """On a loaded machine a process is discovered after the time that `status` listens."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    world = Node("world", "world", Link("late", (), (endpoint,)))
    later = threading.Timer(1.0, world.declare_liveliness)
    try:
        later.start()
        seen = observe(Link("late", (endpoint,)), 0.2)
        assert seen.alive == {"world"}
    finally:
        later.join()
        world.close()


def test_silence_at_an_address_that_answers_is_not_called_no_mission(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("chaserdock.launch.status.DISCOVERY_S", 0.3)
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    world = Node("world", "world", Link("mine", (), (endpoint,)))
    try:
        with pytest.raises(StatusError, match="another namespace than yours, or is too busy"):
            observe(Link("yours", (endpoint,)), 0.1)
        with pytest.raises(OperatorError, match="another namespace than yours, or is too busy"):
            send_command(Link("yours", (endpoint,)), "hold", 0, None, 0.1)
    finally:
        world.close()
