# SPDX-License-Identifier: Apache-2.0
"""Main process of a container: run ``chaserdock ARGUMENTS`` as one process of a mission in Docker
Compose.

``python -m chaserdock.launch.container ARGUMENTS``. With ``--exit-code-from`` Compose stops all
containers as soon as one exits, so a finished process waits until the router has exited; the router
exits after the judge. Environment: SCENARIO, SET (overrides separated by blanks), ROUTER
(``host:port``), CHASERS (number of chaser services).
"""

from __future__ import annotations

import math
import os
import shlex
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import psutil

from chaserdock.exit_codes import STOPPED

if TYPE_CHECKING:
    from chaserdock_protocol.scenario import Scenario

ROUTER_TIMEOUT_S = 60.0
"""Time, s, without a connection to the router after which a process considers the mission over."""
_NOT_IN_SCENARIO = 10
"""Exit status of ``--check`` if the scenario does not have this process."""


def is_linked(port: int) -> bool:
    """Return whether this container has an open connection to a router's port, or listens on it."""
    return any(
        (c.raddr and c.raddr.port == port and c.status == psutil.CONN_ESTABLISHED)
        or (c.laddr and c.laddr.port == port and c.status == psutil.CONN_LISTEN)
        for c in psutil.net_connections(kind="tcp")
    )


def is_listening(host: str, port: int) -> bool:
    """Return whether an address accepts connections."""
    try:
        socket.create_connection((host, port), timeout=2.0).close()
    except OSError:
        return False
    return True


def with_overrides(arguments: list[str], overrides: str) -> list[str]:
    """Return the arguments of ``chaserdock``; those of a world get the scenario overrides."""
    if arguments[:1] != ["world"]:
        return arguments
    return [
        *arguments,
        *(part for override in shlex.split(overrides) for part in ("--set", override)),
    ]


def count_chasers(scenario: str, overrides: str) -> int:
    """Return the number of chasers of a scenario. Raises ScenarioError, ScenarioNotFound."""
    return len(_loaded(scenario, overrides).chasers)


def _loaded(scenario: str, overrides: str) -> Scenario:
    from chaserdock_protocol.scenario import load_scenario
    from chaserdock_protocol.shipped_scenarios import find_scenario

    return load_scenario(find_scenario(scenario), tuple(shlex.split(overrides)))


def too_many_chasers(scenario: str, overrides: str, services: int) -> str | None:
    """Return why a scenario cannot fly with ``services`` chaser services; None if it can."""
    needed = count_chasers(scenario, overrides)
    if needed <= services:
        return None
    return (
        f"SCENARIO={scenario} has {needed} chasers, but there are {services} chaser services; "
        f"make others with chaserdock deploy --chasers {needed} > compose.yaml"
    )


def run(arguments: list[str], host: str, port: int) -> int:
    """Run the program to its end and forward signals to it. Returns its status, ``STOPPED`` if
    a forwarded signal killed it, or 0 when the router is gone for good.
    """
    process: subprocess.Popen[bytes] | None = None
    stopping: int | None = None

    def forward(number: int, frame: object) -> None:
        nonlocal stopping
        stopping = number
        if process is not None:
            process.send_signal(number)

    # Install before the start: a lost signal would leave the program behind.
    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, forward)
    process = subprocess.Popen([sys.executable, "-m", "chaserdock", *arguments])
    if stopping is not None:
        process.send_signal(stopping)
    linked_s = math.inf  # until the first connection: starting can take long on a busy machine
    while True:
        try:
            status = process.wait(timeout=2.0)
            break
        except subprocess.TimeoutExpired:
            now_s = time.monotonic()
            linked_s = now_s if is_linked(port) else linked_s
            if now_s - linked_s > ROUTER_TIMEOUT_S:
                log(
                    f"{' '.join(arguments[:2])}: no router for {ROUTER_TIMEOUT_S:g} s, the mission "
                    "is over"
                )
                process.terminate()
                process.wait()
                return 0
    if stopping is not None and status == -stopping:
        return STOPPED  # before it could handle the signal
    if status == 0 and stopping is None and arguments[0] not in ("router", "judge"):
        wait_for_router_exit(host, port, lambda: stopping is not None)
    return status


def wait_for_router_exit(host: str, port: int, stopped: Callable[[], bool]) -> None:
    """Return when three attempts in a row, a second apart, do not reach the router, or when
    ``stopped()``.
    """
    failures = 0
    while failures < 3 and not stopped():
        failures = 0 if is_listening(host, port) else failures + 1
        time.sleep(1.0)


def log(text: str) -> None:
    """Print a line on standard error."""
    print(text, file=sys.stderr, flush=True)


def main() -> int:
    """Run this container's process and return the exit status."""
    arguments, environment = sys.argv[1:], os.environ
    host, _, port = environment.get("ROUTER", "router:7447").rpartition(":")
    scenario, overrides = environment.get("SCENARIO", ""), environment.get("SET", "")
    if arguments[:1] in (["chaser"], ["mapper"], ["judge"]):
        # In a process of its own: loading the scenario would keep tens of megabytes for the whole
        # flight.
        check = subprocess.run(
            [sys.executable, "-m", "chaserdock.launch.container", "--check", *arguments]
        )
        if check.returncode == _NOT_IN_SCENARIO:
            name = "/".join(arguments[:2]) if arguments[0] == "chaser" else arguments[0]
            log(f"{name}: not in {scenario}")
            stopped: list[int] = []
            signal.signal(signal.SIGTERM, lambda number, frame: stopped.append(number))
            wait_for_router_exit(host, int(port), lambda: bool(stopped))
            return 0
        if check.returncode != 0:
            return check.returncode
    if arguments[:1] == ["--check"]:
        return _check(arguments[1:], scenario, overrides, int(environment.get("CHASERS", "4")))
    return run(with_overrides(arguments, overrides), host, int(port))


def _check(arguments: list[str], scenario: str, overrides: str, services: int) -> int:
    from chaserdock_protocol.errors import ChaserdockError

    try:
        if arguments[0] == "chaser":
            return (
                _NOT_IN_SCENARIO if int(arguments[1]) >= count_chasers(scenario, overrides) else 0
            )
        if arguments[0] == "mapper":
            return 0 if _loaded(scenario, overrides).maps_target else _NOT_IN_SCENARIO
        reason = too_many_chasers(scenario, overrides, services)
    except ChaserdockError as error:
        reason = str(error)
    if reason is None:
        return 0
    for line in reason.splitlines():
        log(f"chaserdock: {line}")
    return 2


if __name__ == "__main__":
    sys.exit(main())
