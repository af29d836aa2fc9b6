"""One container's main process: runs ``chaserdock ARGUMENTS`` as a member of a composed mission.

``python -m chaserdock.launch.container ARGUMENTS``. Docker Compose ends everything as soon as one container
ends when it is to pass on a status (``--exit-code-from``), so a member that is done waits for the router to go; the
router goes when the judge has. Environment: SCENARIO, SET (overrides with blanks between), ROUTER (``host:port``).
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
from pathlib import Path

ROUTER_AWAY_S = 60.0
"""A member that has lost its link to the router for so long takes the mission for over."""
_ESTABLISHED, _LISTEN = "01", "0A"


def sockets(table: str) -> list[tuple[int, int, str]]:
    """Local port, remote port and state of each TCP socket in the text of /proc/net/tcp (proc(5))."""
    rows = (line.split() for line in table.splitlines()[1:])
    return [(int(r[1].rpartition(":")[2], 16), int(r[2].rpartition(":")[2], 16), r[3]) for r in rows]


def linked(port: int) -> bool:
    """Whether this container has an open connection to a router's port, or listens on it."""
    rows = [
        row for f in ("/proc/net/tcp", "/proc/net/tcp6") if os.path.exists(f) for row in sockets(_text(f))
    ]
    return any(
        (remote == port and state == _ESTABLISHED) or (local == port and state == _LISTEN)
        for local, remote, state in rows
    )


def _text(path: str) -> str:
    return Path(path).read_text(encoding="ascii")


def router_there(host: str, port: int) -> bool:
    """Whether something accepts connections at the router's address."""
    try:
        socket.create_connection((host, port), timeout=2.0).close()
    except OSError:
        return False
    return True


def arguments_of(arguments: list[str], sets: str) -> list[str]:
    """What ``chaserdock`` is called with: a world gets the overrides, too."""
    if arguments[:1] != ["world"]:
        return arguments
    return [*arguments, *(part for override in shlex.split(sets) for part in ("--set", override))]


def chasers_of(scenario: str, sets: str) -> int:
    """How many chasers a scenario has. Raises ScenarioError."""
    from chaserdock_protocol.scenario import ScenarioError, load_scenario
    from chaserdock_protocol.shipped_scenarios import ScenarioNotFound, find_scenario

    try:
        path = find_scenario(scenario)
    except ScenarioNotFound as error:
        raise ScenarioError(f"SCENARIO={error}") from None
    return len(load_scenario(path, tuple(shlex.split(sets))).chasers)


def too_many_chasers(scenario: str, sets: str, services: int) -> str | None:
    """Why a scenario cannot be flown with so many chaser services, or None."""
    needed = chasers_of(scenario, sets)
    if needed <= services:
        return None
    return (
        f"SCENARIO={scenario} has {needed} chasers, and there are {services} chaser services; "
        "set COMPOSE_PROFILES=8-chasers or 16-chasers"
    )


def services_of(profiles: str) -> int:
    """How many chaser services compose.yaml starts under COMPOSE_PROFILES."""
    chosen = profiles.split(",")
    return 16 if "16-chasers" in chosen else 8 if "8-chasers" in chosen else 4


def run(arguments: list[str], host: str, port: int) -> int:
    """Runs the program to its end, passing signals on; its status, 0 when the router has gone for good."""
    process = subprocess.Popen([sys.executable, "-m", "chaserdock", *arguments])
    asked = False

    def pass_on(number: int, frame: object) -> None:
        nonlocal asked
        asked = True
        process.send_signal(number)

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, pass_on)
    linked_s = math.inf  # until it has been linked once: on a busy machine starting alone takes long
    while True:
        try:
            status = process.wait(timeout=2.0)
            break
        except subprocess.TimeoutExpired:
            now_s = time.monotonic()
            linked_s = now_s if linked(port) else linked_s
            if now_s - linked_s > ROUTER_AWAY_S:
                say(f"{' '.join(arguments[:2])}: no router for {ROUTER_AWAY_S:g} s, the mission is over")
                process.terminate()
                process.wait()
                return 0
    if status == 0 and not asked and arguments[0] != "router" and arguments[0] != "judge":
        wait_for_router_to_go(host, port, lambda: asked)
    return status


def wait_for_router_to_go(host: str, port: int, stopped: Callable[[], bool]) -> None:
    """Returns when the router has not been there three times in a row, a second apart, or when ``stopped()``."""
    away = 0
    while away < 3 and not stopped():
        away = 0 if router_there(host, port) else away + 1
        time.sleep(1.0)


def say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)


def main() -> int:
    """Entry point; the member's status."""
    arguments, environment = sys.argv[1:], os.environ
    host, _, port = environment.get("ROUTER", "router:7447").rpartition(":")
    scenario, sets = environment.get("SCENARIO", ""), environment.get("SET", "")
    if arguments[:1] in (["chaser"], ["judge"]):
        # In a process of its own, as it would keep tens of megabytes for the whole flight.
        check = subprocess.run([sys.executable, "-m", "chaserdock.launch.container", "--check", *arguments])
        if check.returncode == _SPARE:
            say(f"chaser/{arguments[1]}: {scenario} does not need it")
            stopped: list[int] = []
            signal.signal(signal.SIGTERM, lambda number, frame: stopped.append(number))
            wait_for_router_to_go(host, int(port), lambda: bool(stopped))
            return 0
        if check.returncode != 0:
            return check.returncode
    if arguments[:1] == ["--check"]:
        return _check(arguments[1:], scenario, sets, environment.get("COMPOSE_PROFILES", ""))
    return run(arguments_of(arguments, sets), host, int(port))


_SPARE = 10


def _check(arguments: list[str], scenario: str, sets: str, profiles: str) -> int:
    from chaserdock_protocol.errors import ChaserdockError

    try:
        if arguments[0] == "chaser":
            return _SPARE if int(arguments[1]) >= chasers_of(scenario, sets) else 0
        reason = too_many_chasers(scenario, sets, services_of(profiles))
    except ChaserdockError as error:
        reason = str(error)
    if reason is None:
        return 0
    for line in reason.splitlines():
        say(f"chaserdock: {line}")
    return 2


if __name__ == "__main__":
    sys.exit(main())
