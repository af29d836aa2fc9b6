# SPDX-License-Identifier: Apache-2.0
"""Processes of the fork server are those of an interpreter of their own, and end as those."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Generator
from contextlib import suppress
from pathlib import Path

import psutil
import pytest

from chaserdock.launch.fork_server import ForkedProcess, ForkServer
from chaserdock.launch.launcher import free_port

pytestmark = pytest.mark.skipif(os.uname().sysname != "Linux", reason="Linux only")


@pytest.fixture(scope="module")
def server() -> Generator[ForkServer]:
    forks = ForkServer()
    yield forks
    forks.close()


def start(server: ForkServer, output: Path, *arguments: str, **environment: str) -> ForkedProcess:
    with output.open("wb") as out:
        return server.start(arguments, {**os.environ, **environment}, out)


def waiting(server: ForkServer, output: Path) -> ForkedProcess:
    """Start a process that waits for a world until it is stopped."""
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    process = start(server, output, "world", "single", "-l", endpoint, "--watch-parent")
    while b"waiting for" not in output.read_bytes():
        assert process.poll() is None, output.read_text()
        time.sleep(0.02)
    return process


def test_status_output_and_environment_are_its_own(server: ForkServer, tmp_path: Path) -> None:
    shown, refused = tmp_path / "shown.txt", tmp_path / "refused.txt"
    process = start(server, shown, "scenario", "single", "--show")
    wrong = start(server, refused, "scenario", "no-such-scenario", "--show")
    assert (process.wait(), wrong.wait()) == (0, 2)
    assert 'name = "single"' in shown.read_text()
    assert refused.read_text().startswith("chaserdock: ")
    narrow = start(server, shown, "run", "--help", COLUMNS="60")
    assert narrow.wait() == 0
    assert max(map(len, shown.read_text().splitlines())) <= 60


def test_it_is_named_alone_in_its_group_and_stops(server: ForkServer, tmp_path: Path) -> None:
    process = waiting(server, tmp_path / "out.txt")
    assert psutil.Process(process.pid).cmdline()[0].startswith("chaserdock world single ")
    assert os.getpgid(process.pid) == process.pid
    assert process.poll() is None
    process.send_signal(signal.SIGTERM)
    assert process.wait() == 130
    process.send_signal(signal.SIGTERM)  # has ended: nothing is sent
    killed = waiting(server, tmp_path / "killed.txt")
    killed.kill()
    assert killed.wait() == -signal.SIGKILL


def test_it_ends_with_its_standard_input(server: ForkServer, tmp_path: Path) -> None:
    process = waiting(server, tmp_path / "out.txt")
    process.stdin.close()
    assert process.wait() is not None


def test_a_lost_server_takes_its_processes_with_it(tmp_path: Path) -> None:
    server = ForkServer()
    process = waiting(server, tmp_path / "out.txt")
    server._server.send_signal(signal.SIGSTOP)
    process.send_signal(signal.SIGCONT)  # it is lost before it reads this
    server._server.kill()
    assert process.wait() == -signal.SIGKILL
    with suppress(psutil.NoSuchProcess):
        psutil.Process(process.pid).wait(10.0)
    with pytest.raises(OSError, match=r"lost|Broken pipe"):
        start(server, tmp_path / "more.txt", "scenario", "list")
    server.close()
