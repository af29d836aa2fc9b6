# SPDX-License-Identifier: Apache-2.0
"""Flies a mission on this machine: starts every process, watches and stops them, judges the log."""

from __future__ import annotations

import json
import os
import shlex
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import uuid
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import IO, Any, get_args

import psutil
from chaserdock_agents.router.process import NAME as ROUTER
from chaserdock_protocol import topics
from chaserdock_protocol.errors import ChaserdockError, WriteError, errors_of_writing
from chaserdock_protocol.messages import MissionEnd
from chaserdock_protocol.output_files import write_atomically
from chaserdock_protocol.process import SINGLE_THREADED, Mode
from chaserdock_protocol.recording.log import LogError
from chaserdock_protocol.recording.scan import LOG_NAME
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_protocol.scenario.loading import SET_OPTION
from chaserdock_protocol.shipped_scenarios import find_scenario
from chaserdock_protocol.stall import DEFAULT_STALL_S, SHORTEST_STALL_S, StallTimer
from chaserdock_protocol.topics import Role
from chaserdock_protocol.transport import Link, Node, Tls, TransportError
from chaserdock_protocol.transport.session import find_world, ignore_foreign_publishers
from chaserdock_world.requirements import require_packages

from chaserdock.exit_codes import DONE, FAILED, STOPPED
from chaserdock.terminal import labelled

from .container import is_listening
from .fork_server import ForkedProcess, ForkServer
from .json_events import Failed, JsonLine, Result, Start
from .mission_address import MissionAddress, remove_address, write_address
from .progress import ProgressReporter, Show, print_json_line
from .signals import deferred_signals

_START_TIMEOUT_S = 120
"""Time (s) that processes have to start and find each other. Larger: a failed start is noticed
later; smaller: missions fail on busy machines.
"""
_END_TIMEOUT_S = 30.0
"""Time (s) that processes have to end after the mission; in it the recorder closes its log. Larger:
a hanging process delays the verdict; smaller: a long log may be cut off.
"""
_WORLD_ENDS_S = 15.0
"""Time (s) that the world has to end a stalled mission itself."""
STOPPED_BY_OPERATOR = "stopped by the operator"


class RunError(ChaserdockError):
    """The mission could not be started."""


@dataclass(frozen=True)
class MissionOutcome:
    """Outcome of a mission. ``summary``: None without a readable log; ``failure`` then states
    why.
    """

    folder: Path
    status: int
    summary: dict[str, Any] | None
    failure: str | None


@dataclass
class Child:
    """A process of the mission, and the file of its output."""

    name: str
    process: subprocess.Popen[bytes] | ForkedProcess
    output: Path

    def last_line(self) -> str:
        """Return the last line of its output, or the signal that ended it."""
        if (status := self.process.poll()) is not None and status < 0:
            return f"{self.name}: killed (signal {-status})"
        lines = self.output.read_text(errors="replace").strip().splitlines()
        return (
            lines[-1].removeprefix("chaserdock: ")
            if lines
            else f"{self.name}: exited without output"
        )


# Zenoh starts two receiving threads, of which the second mostly wakes up without work. With one,
# seven processes on two cores need two thirds of the time per tick (benchmarks/transport.py). Not
# for a router, where one slow reader would block all others.
_ZENOH_THREADS = "(rx: (worker_threads: 1))"


@dataclass
class Fleet:
    """Processes of a mission. ``server``: starts them in place of a Python interpreter for each."""

    server: ForkServer | None = None
    children: list[Child] = field(default_factory=list[Child])
    peak_memory_bytes: int = 0
    cpu_s: dict[str, float] = field(default_factory=dict[str, float])

    def start(self, name: str, arguments: list[str], folder: Path) -> None:
        """Start a process. It exits when this process ends for any reason, as its standard input
        closes.
        """
        output = folder / f"{name.replace('/', '-')}.txt"
        threads = {"ZENOH_RUNTIME": _ZENOH_THREADS} if name != ROUTER else {}
        with errors_of_writing(output, RunError):
            out = output.open("wb")
        environment = {**threads, **os.environ, **SINGLE_THREADED}
        with out, deferred_signals():
            process = self._started([*arguments, "--watch-parent"], environment, out)
            # Append now: a signal handler may raise an exception, after which ``end`` ends the
            # listed processes.
            self.children.append(Child(name, process, output))

    def _started(
        self, arguments: list[str], environment: dict[str, str], out: IO[bytes]
    ) -> subprocess.Popen[bytes] | ForkedProcess:
        if self.server is not None:
            try:
                return self.server.start(arguments, environment, out)
            except OSError as error:
                raise RunError(f"{arguments[0]}: cannot be started: {error}") from None
        return subprocess.Popen(
            [sys.executable, "-m", "chaserdock", *arguments],
            stdin=subprocess.PIPE,
            stdout=out,
            stderr=subprocess.STDOUT,
            env=environment,
            # The launcher forwards Ctrl-C. Not a new session: Linux would share the cores between
            # sessions ("autogroup") whatever the processes' priorities, and the last one to wake up
            # would wait longest.
            process_group=0,
        )

    def running(self) -> list[Child]:
        """Return the processes that have not exited."""
        return [c for c in self.children if c.process.poll() is None]

    def is_replaced(self, child: Child) -> bool:
        """Return whether it is a controller while another controller flew to the end."""
        others = [c for c in self.children if c.name in topics.CONTROLLERS and c is not child]
        return child.name in topics.CONTROLLERS and any(c.process.poll() == 0 for c in others)

    def measure(self) -> None:
        """Measure each process' CPU time, and their total memory (proportional set size where
        available).
        """
        total = 0
        for child in self.running():
            try:
                process = psutil.Process(child.process.pid)
                info, times = process.memory_full_info(), process.cpu_times()
                total += getattr(info, "pss", 0) or info.rss
                self.cpu_s[child.name] = times.user + times.system
            except (psutil.NoSuchProcess, psutil.AccessDenied):
                continue
        self.peak_memory_bytes = max(self.peak_memory_bytes, total)

    def wait(self, seconds: float) -> None:
        """Wait until all have exited, at most ``seconds``."""
        deadline = time.monotonic() + seconds
        while self.running() and time.monotonic() < deadline:
            time.sleep(0.02)

    def end(self) -> None:
        """Terminate, then kill, all running processes."""
        for child in self.running():
            child.process.send_signal(signal.SIGTERM)
        self.wait(5.0)
        for child in self.running():
            child.process.kill()
        for child in self.children:
            child.process.wait()
            if child.process.stdin is not None:
                child.process.stdin.close()
        if self.server is not None:
            self.server.close()


def _forked_fleet() -> Fleet:
    """Return a fleet with a fork server, where the system has what it needs."""
    return Fleet(ForkServer() if sys.platform == "linux" else None)


@dataclass
class Viewer:
    """The page of a mission on a TCP port: shows the flight, then its log until its last tab is
    closed. Leaving the context ends it.
    """

    port: int
    _fleet: Fleet = field(default_factory=Fleet)

    def __enter__(self) -> Viewer:
        return self

    def __exit__(self, *_: object) -> None:
        self._fleet.end()

    def start(self, folder: Path, lease_ms: int) -> None:
        """Start the viewer of the mission that writes to ``folder``."""
        options = ["--run", str(folder), "--lease", f"{lease_ms / 1000:g}"]
        output = folder / "processes"
        self._fleet.start("viewer", ["view", "--port", str(self.port), *options], output)

    def is_shown(self) -> bool:
        """Return whether it still serves the page."""
        return bool(self._fleet.running())

    def wait(self, stop_requested: Callable[[], bool]) -> None:
        """Wait until its last tab has been closed, or a stop is requested."""
        while self.is_shown() and not stop_requested():
            time.sleep(0.1)


def free_port() -> int:
    """Return a TCP port on which nothing listens."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def open_hub(
    namespace: str,
    lease_ms: int,
    name: str = "operator",
    role: Role = "operator",
    port: int | None = None,
) -> tuple[Node, str]:
    """Open the launcher's node, to which the processes connect, on ``port`` or a free one. Returns
    it and its endpoint.

    Raises TransportError.
    """
    for attempt in range(5):
        endpoint = f"tcp/127.0.0.1:{free_port() if port is None else port}"
        try:
            return Node(name, role, Link(namespace, (), (endpoint,), lease_ms=lease_ms)), endpoint
        except TransportError:
            if attempt == 4 or port is not None:
                raise
    raise TransportError("no free port")


def check_port(port: int) -> None:
    """Raise RunError if the port is not available."""
    with socket.socket() as probe:
        # As in Zenoh, a port with connections in TIME_WAIT is available.
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", port))
        except OSError as error:
            raise RunError(f"port {port}: {error.strerror}; choose another port") from None


def check_keys(keys: Path, chasers: int) -> None:
    """Raise RunError unless valid keys of a mission exist for so many chasers."""
    from .keys import why_not_usable  # imports cryptography, which is slow

    if reason := why_not_usable(keys, chasers, datetime.now(UTC)):
        raise RunError(
            f"keys {keys}: {reason}; make a mission's keys with `chaserdock deploy --keys {keys}`"
        )


def network_options(
    namespace: str, endpoint: str, lease_ms: int, keys: Path | None = None
) -> list[str]:
    """Return the command-line options with which a process joins the mission."""
    secured = [] if keys is None else ["--keys", str(keys)]
    return ["-e", endpoint, "--namespace", namespace, "--lease", f"{lease_ms / 1000:g}", *secured]


def start_router(
    observers: Fleet, output: Path, namespace: str, lease_ms: int, keys: Path, port: int
) -> tuple[Node, str]:
    """Start a router on ``port`` that enforces the access rights of the mission's ``keys``.

    Returns the launcher's node, a client of it, and the router's endpoint. Raises RunError when it
    does not start.
    """
    endpoint = f"tls/127.0.0.1:{port}"
    network = network_options(namespace, endpoint, lease_ms, keys)
    observers.start(ROUTER, ["router", "-l", *network[1:]], output)
    router, deadline = observers.children[-1], time.monotonic() + _START_TIMEOUT_S
    while not is_listening("127.0.0.1", port):
        if router.process.poll() is not None or time.monotonic() > deadline:
            raise RunError(f"the router does not listen: {router.last_line()}")
        time.sleep(0.05)
    link = Link(
        namespace,
        (endpoint,),
        (),
        "client",
        lease_ms=lease_ms,
        tls=Tls.in_folder(keys / "operator"),
        connect_timeout_s=_START_TIMEOUT_S,
    )
    return Node("operator", "operator", link), endpoint


def never() -> bool:
    """Return False: nothing requests a stop."""
    return False


def fly_mission(
    scenario_name: str | Path,
    folder: Path | None = None,
    mode: Mode = "lockstep",
    overrides: tuple[str, ...] = (),
    *,
    seed: int | None = None,
    show: Show = Show.none,
    viewer: Viewer | None = None,
    keys: Path | None = None,
    stop_requested: Callable[[], bool] = never,
    emit: Callable[[JsonLine], None] = print_json_line,
    stall_s: float = DEFAULT_STALL_S,
    port: int | None = None,
    namespace: str | None = None,
    option: str = SET_OPTION,
) -> MissionOutcome:
    """Fly a scenario. Writes log, summary and the processes' output to ``folder``, by default a new
    one in ``runs/``.

    ``scenario_name``: a file, or the name of a shipped scenario. ``viewer``: the page to start,
    which outlives the flight. ``keys``: connect through a router, over TLS, with
    access rights. ``stall_s``: longest time (s) without progress. ``port``, ``namespace``: where
    other processes reach the mission, by default a free port and a unique name; while the mission
    flies, ``network.json`` in the folder states them. ``stop_requested``: polled. ``option``: see
    ``load_scenario``. Installs no signal handler; an exception ends all processes. Raises RunError,
    ScenarioError, MissingPackageError or TransportError if the mission cannot start; it then leaves
    no folder.
    """
    path = find_scenario(str(scenario_name))
    overrides = overrides if seed is None else (*overrides, f"seed={seed}")
    scenario = load_scenario(path, overrides, option)
    require_packages(scenario)

    folder = folder or _new_folder(path.stem)
    output = folder / "processes"
    if keys is not None:
        check_keys(keys, len(scenario.chasers))
    if port is not None:
        check_port(port)
    if (folder / LOG_NAME).exists():
        raise RunError(
            f"{folder} contains a mission.mcap; a log is never overwritten, choose another folder"
        )
    if mode not in get_args(Mode):
        raise RunError(f"mode {mode!r}: must be one of {', '.join(get_args(Mode))}")
    if not stall_s >= SHORTEST_STALL_S:
        raise RunError(f"stall_s {stall_s!r}: must be at least {SHORTEST_STALL_S:g} s")

    created = [f for f in (output, *output.parents) if not f.exists()]
    try:
        output.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        _remove(created, folder)
        raise RunError(f"{folder}: cannot be created: {error.strerror or error}") from None

    namespace = namespace or f"run-{uuid.uuid4().hex[:12]}"
    # After the lease a silent peer counts as lost. In lock-step the mission waits for a stopped
    # process instead.
    lease_ms = 2_000 if mode == "realtime" else 600_000

    fleet, observers, hub = _forked_fleet(), Fleet(), None
    reporter = ProgressReporter(scenario, show, emit)

    try:
        if keys is not None:
            keys = keys.resolve()
            hub, endpoint = start_router(
                observers, output, namespace, lease_ms, keys, port or free_port()
            )
        else:
            hub, endpoint = open_hub(namespace, lease_ms, port=port)

        address = MissionAddress(
            namespace=namespace, endpoint=endpoint, keys=None if keys is None else str(keys)
        )
        write_address(folder, address)
        reporter.report(start_line(scenario, mode, folder, address))
        reporter.refresh()

        network = network_options(namespace, endpoint, lease_ms, keys)
        if viewer is not None:
            viewer.start(folder, lease_ms)

        stall = ["--stall-s", f"{stall_s:g}"]
        start_all(fleet, scenario, path, folder, mode, overrides, [*network, *stall])
        created.clear()
        failure = watch(fleet, hub, reporter, stop_requested, stall_s + _WORLD_ENDS_S)
    except BaseException:
        remove_address(folder)
        raise
    finally:
        reporter.close()
        fleet.end()
        if hub is not None:
            hub.close()
        observers.end()
        _remove(created, folder)
    try:
        return judge(fleet, folder, failure, reporter)
    finally:
        remove_address(folder)  # tells the viewer that log and summary are complete


def _remove(created: list[Path], folder: Path) -> None:
    """Remove the folders, the innermost first, that a refused mission created, with what it wrote
    to ``folder``. Its parents stay if another mission uses them.
    """
    for path in created:
        if path.is_relative_to(folder):
            shutil.rmtree(path, ignore_errors=True)
        else:
            with suppress(OSError):
                path.rmdir()


_folders: set[Path] = set()
_folders_lock = threading.Lock()


def _new_folder(name: str) -> Path:
    """Return a folder ``runs/NAME-TIME`` that does not exist, with a number appended if needed."""
    base = Path("runs") / f"{name}-{datetime.now():%Y%m%d-%H%M%S}"
    folder, number = base, 1
    with _folders_lock:
        while folder.exists() or folder in _folders:
            number += 1
            folder = base.with_name(f"{base.name}-{number}")
        _folders.add(folder)
    return folder


def start_line(scenario: Scenario, mode: Mode, folder: Path, address: MissionAddress) -> Start:
    """Return the first JSON line of a mission."""
    return Start(
        scenario=scenario.name,
        seed=scenario.seed,
        mode=mode,
        duration_s=scenario.duration_s,
        chasers=len(scenario.chasers),
        folder=str(folder),
        address=address,
    )


def start_all(
    fleet: Fleet,
    scenario: Scenario,
    path: Path,
    folder: Path,
    mode: str,
    overrides: tuple[str, ...],
    network: list[str],
) -> None:
    """Start all processes of a mission; their order does not matter."""
    output = folder / "processes"
    timeout = ["--timeout", str(_START_TIMEOUT_S)]
    sets = [item for override in overrides for item in ("--set", override)]
    listen = [] if "--keys" in network else ["-l", "tcp/127.0.0.1:0"]
    fleet.start(
        "world", ["world", str(path), "--mode", mode, *sets, *network, *listen, *timeout], output
    )
    fleet.start("controller", ["controller", *network, *timeout], output)
    if scenario.controller.standby:
        fleet.start("standby", ["controller", "--standby", *network, *timeout], output)
    for i in range(len(scenario.chasers)):
        fleet.start(f"chaser/{i}", ["chaser", str(i), *network, *timeout], output)
    if scenario.maps_target:
        fleet.start("mapper", ["mapper", *network, *timeout], output)
    fleet.start("recorder", ["record", "--out", str(folder), *network, *timeout], output)


def watch(
    fleet: Fleet,
    hub: Node,
    reporter: ProgressReporter,
    stop_requested: Callable[[], bool],
    silent_s: float,
) -> str | None:
    """Show the flight until it ends. Returns why it failed, or None.

    A flight without a tick for ``silent_s`` has failed: the world hangs.
    """
    hub.subscribe(topics.END)
    reporter.subscribe(hub)

    stopping = False
    measured_s = 0.0
    silence = StallTimer(time.monotonic)
    end: MissionEnd | None = None
    world: str | None = None

    while end is None:
        if world is None and (world := find_world(hub)) is not None:
            ignore_foreign_publishers(hub, world, reporter.report_foreign)
        if world is None:
            time.sleep(0.1)  # messages wait: it is unknown whether the world sent them

        received = None if world is None else hub.receive(0.1)
        if not reporter.flying or (received is not None and received.topic is topics.TICK):
            silence.reset()
        if received is not None:
            reporter.update(received.message)
            if isinstance(received.message, MissionEnd):
                end = received.message

        reporter.refresh()

        if time.monotonic() - measured_s > 2.0:
            measured_s = time.monotonic()
            fleet.measure()

        if stop_requested() and not stopping:
            stopping = True
            reporter.print_text("stopping: the log is being closed")
            fleet.children[0].process.send_signal(signal.SIGTERM)

        failure = None if end is not None else _premature_end(fleet, reporter, stopping)
        if silence.update() > silent_s and end is None:
            failure = f"world: hangs; no tick for {silence.waited_s:.0f} s"
        if failure is not None:
            return failure

    fleet.wait(_END_TIMEOUT_S)
    return STOPPED_BY_OPERATOR if stopping else _failure_at_end(fleet, end)


def _premature_end(fleet: Fleet, reporter: ProgressReporter, stopping: bool) -> str | None:
    """Return why the flight cannot continue, or None. Reports processes without which it can."""
    dead = [c for c in fleet.children if c.process.poll() not in (None, 0)]
    if dead and (dead[0].name == "world" or stopping or not reporter.flying):
        return STOPPED_BY_OPERATOR if stopping else dead[0].last_line()
    for child in dead:
        reporter.report_lost(child.name, child.last_line())
    return None


def _failure_at_end(fleet: Fleet, end: MissionEnd) -> str | None:
    bad = [c for c in fleet.children if c.process.poll() != 0 and not fleet.is_replaced(c)]
    if not end.complete:
        # The world exits with status 1 because processes left it; their output says why.
        return "; ".join(
            [end.reason, *(f"{c.name}: {c.last_line()}" for c in bad if c.name != "world")]
        )
    return bad[0].last_line() if bad else None


def judge(
    fleet: Fleet, folder: Path, failure: str | None, reporter: ProgressReporter
) -> MissionOutcome:
    """Write summary.json from the log in ``folder``. Returns and reports the outcome."""
    from chaserdock.analysis.flight import load_flight
    from chaserdock.analysis.summary import SUMMARY_NAME, add_run_failure, summary_of

    stopped = failure == STOPPED_BY_OPERATOR
    try:
        summary = summary_of(load_flight(folder / LOG_NAME))
    except LogError as error:
        outcome = MissionOutcome(
            folder, STOPPED if stopped else FAILED, None, failure or str(error)
        )
        reporter.report(Failed(status=outcome.status, text=outcome.failure or ""))
        return outcome
    if failure is not None:
        add_run_failure(summary, failure)
    if fleet.children:  # processes on other machines are not measured
        summary |= {"peak_memory_bytes": fleet.peak_memory_bytes, "cpu_s": fleet.cpu_s}
    try:
        write_atomically(folder / SUMMARY_NAME, json.dumps(summary, indent=2) + "\n")
    except WriteError as error:
        add_run_failure(summary, str(error))
    status = STOPPED if stopped else DONE if summary["success"] else FAILED
    reporter.report(Result(status=status, folder=str(folder), summary=summary))
    return MissionOutcome(
        folder, status, summary, summary["failures"][0] if summary["failures"] else None
    )


def print_outcome(outcome: MissionOutcome, show: Show) -> None:
    """Print the verdict, on standard output unless that carries JSON lines, and a failure on
    standard error.
    """
    from chaserdock.analysis.summary import print_summary

    if outcome.summary is not None and show is not Show.json:
        print_summary(outcome.summary)
    if outcome.failure is not None:
        prefix = "" if outcome.summary is None else "failed: "
        print(f"chaserdock: {prefix}{outcome.failure}", file=sys.stderr)


def print_where(outcome: MissionOutcome) -> None:
    """Print where the log of a mission is, and the command that makes its report."""
    print(labelled("log, summary, output of the processes", str(outcome.folder)))
    print(labelled("its report", shlex.join(["chaserdock", "report", str(outcome.folder)])))
