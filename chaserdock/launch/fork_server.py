# SPDX-License-Identifier: Apache-2.0
"""Start the processes of a mission by fork, from a server that has imported what they need.

Each of them would otherwise import the same packages, which takes most of its start.
"""

from __future__ import annotations

import gc
import json
import os
import runpy
import select
import shlex
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from importlib import import_module
from typing import IO, Any

import setproctitle
from chaserdock_protocol.process import SINGLE_THREADED

_MESSAGE_BYTES = 1 << 20
"""Largest message: arguments and environment of a process."""
_ENDED = os.WEXITED | os.WNOHANG | os.WNOWAIT


class ForkServer:
    """A server for the processes of one mission, on Linux; begins to import at once.

    Used by one thread. Closing it ends the server, not the processes that it has started. A server
    that is lost takes them with it.
    """

    def __init__(self) -> None:
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._status: dict[int, int | None] = {}
        with theirs:
            self._server = subprocess.Popen(
                [sys.executable, "-m", __name__, str(theirs.fileno())],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                env={**os.environ, **SINGLE_THREADED},
                pass_fds=[theirs.fileno()],
                process_group=0,
            )

    def start(
        self, arguments: Sequence[str], environment: Mapping[str, str], output: IO[bytes]
    ) -> ForkedProcess:
        """Start ``chaserdock ARGUMENTS`` in a process group of its own, which writes to
        ``output``; wait until the server has imported. Raises OSError if it is lost.
        """
        request = {"arguments": list(arguments), "environment": dict(environment)}
        stdin, ours = os.pipe()
        try:
            files = [stdin, output.fileno()]
            socket.send_fds(self._socket, [json.dumps(request).encode()], files)
            while (pid := self._receive().get("started")) is None:
                pass
        except OSError:
            os.close(ours)
            raise
        finally:
            os.close(stdin)
        self._status[pid] = None
        return ForkedProcess(self, pid, os.fdopen(ours, "wb", buffering=0))

    def send_signal(self, pid: int, number: int) -> None:
        """Let the server send a signal: it knows whether the process still has this number."""
        with suppress(OSError):
            self._socket.send(json.dumps({"signal": number, "pid": pid}).encode())

    def status_of(self, pid: int, wait: bool) -> int | None:
        """Return a process' exit status, or minus the signal that ended it; None while it runs."""
        with suppress(ConnectionError):
            while self._status[pid] is None and (wait or _is_readable(self._socket)):
                self._receive()
        return self._status[pid]

    def close(self) -> None:
        """End the server."""
        self._socket.close()
        self._server.wait()

    def _receive(self) -> dict[str, int]:
        try:
            message = self._socket.recv(_MESSAGE_BYTES)
        except ConnectionError:  # it was lost before it had read a request
            message = b""
        if not message:
            self._end_all()
            raise ConnectionError("the server of this mission's processes is lost")
        reply: dict[str, int] = json.loads(message)
        if "ended" in reply:
            self._status[reply["ended"]] = reply["status"]
        return reply

    def _end_all(self) -> None:
        """Kill what a lost server has started: nobody can tell any more how it ends."""
        for pid, status in self._status.items():
            if status is None:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
                self._status[pid] = -signal.SIGKILL


class ForkedProcess:
    """A process of a fork server, with what a launcher needs of `subprocess.Popen`.

    ``stdin``: the end of its standard input to write to.
    """

    def __init__(self, server: ForkServer, pid: int, stdin: IO[bytes]) -> None:
        self._server = server
        self.pid, self.stdin = pid, stdin

    def poll(self) -> int | None:
        """Return its exit status, or minus the signal that ended it; None while it runs."""
        return self._server.status_of(self.pid, wait=False)

    def wait(self) -> int | None:
        """Wait until it has ended, and return its exit status."""
        return self._server.status_of(self.pid, wait=True)

    def send_signal(self, number: int) -> None:
        """Send it a signal unless it has ended."""
        self._server.send_signal(self.pid, number)

    def kill(self) -> None:
        """Kill it unless it has ended."""
        self.send_signal(signal.SIGKILL)


def serve(launcher: socket.socket) -> list[str] | None:
    """Fork a process for each request, and tell when one ends, until the launcher has ended.

    Returns the arguments in each new process, and None in the server.
    """
    setproctitle.setproctitle("chaserdock fork server")  # also needed before environments change
    _import_what_processes_need()
    gc.freeze()  # a collection would copy the pages that processes share
    woken, waker = socket.socketpair()
    for end in (woken, waker):
        end.setblocking(False)
    signal.signal(signal.SIGCHLD, _wake)
    signal.set_wakeup_fd(waker.fileno())
    running: set[int] = set()
    while True:
        select.select([launcher, woken], [], [])
        with suppress(BlockingIOError):
            woken.recv(_MESSAGE_BYTES)
        _report_ended(running, launcher)
        if not _is_readable(launcher):
            continue
        data, files, *_ = socket.recv_fds(launcher, _MESSAGE_BYTES, maxfds=2)
        if not data:
            return None
        request: dict[str, Any] = json.loads(data)
        if "signal" in request:
            if request["pid"] in running:
                os.kill(request["pid"], request["signal"])
            continue
        if (pid := os.fork()) == 0:
            for end in (launcher, woken, waker):
                end.close()
            _become(request["environment"], *files)
            return request["arguments"]
        running.add(pid)
        for file in files:
            os.close(file)
        launcher.send(json.dumps({"started": pid}).encode())


def _import_what_processes_need() -> None:
    with suppress(ImportError):  # the process that needs it says what is missing
        import_module("chaserdock_world.process")
        import_module("chaserdock_controller.process")
        import_module("chaserdock_agents.chaser.process")
        import_module("chaserdock_agents.recorder.process")
        import_module("typer")


def _wake(*_: object) -> None:
    """Let Python write to the wake-up descriptor: an ignored signal would not."""


def _report_ended(running: set[int], launcher: socket.socket) -> None:
    for pid in [pid for pid in running if os.waitid(os.P_PID, pid, _ENDED) is not None]:
        running.remove(pid)
        status = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        with suppress(OSError):
            launcher.send(json.dumps({"ended": pid, "status": status}).encode())


def _become(environment: dict[str, str], stdin: int, output: int) -> None:
    """Take over environment, standard input and output as a new process."""
    signal.set_wakeup_fd(-1)
    signal.signal(signal.SIGCHLD, signal.SIG_DFL)
    os.setpgid(0, 0)
    for file, number in ((stdin, 0), (output, 1), (output, 2)):
        os.dup2(file, number)
    for file in (stdin, output):
        os.close(file)
    os.environ.clear()
    os.environ.update(environment)


def _is_readable(end: socket.socket) -> bool:
    return bool(select.select([end], [], [], 0)[0])


if __name__ == "__main__":
    if (arguments := serve(socket.socket(fileno=int(sys.argv[1])))) is not None:
        sys.argv = ["chaserdock", *arguments]
        setproctitle.setproctitle(shlex.join(sys.argv))
        runpy.run_module("chaserdock", run_name="__main__")
