"""``chaserdock run``: starts every process of a scenario, watches over them, ends them all, has the flight judged."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
import uuid
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from types import FrameType

import psutil
from chaserdock_agents.router.process import NAME as ROUTER
from chaserdock_protocol import topics
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.messages import MissionEnd
from chaserdock_protocol.process import SINGLE_THREADED
from chaserdock_protocol.recording.scan import LOG_NAME
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_protocol.topics import Role
from chaserdock_protocol.transport import Link, Node, Tls, TransportError

from chaserdock.exit_codes import DONE, FAILED, STOPPED
from chaserdock.viewer.address import DEFAULT_HOST, url_of
from chaserdock.viewer.address import free_port as free_page_port

from . import container as member
from .json_events import Failed, Result, Start
from .progress import ProgressReporter, Show

_PATIENCE_S = 120
_END_S = 30.0


class RunError(ChaserdockError):
    """The run could not be started; one clear line."""


@dataclass
class Child:
    """One process of the mission and where its own words go."""

    name: str
    process: subprocess.Popen[bytes]
    words: Path

    def last_words(self) -> str:
        """The last line it said."""
        lines = self.words.read_text(errors="replace").strip().splitlines()
        return lines[-1].removeprefix("chaserdock: ") if lines else f"{self.name}: ended without a word"


# Of Zenoh's two receiving threads the second mostly wakes up in vain: with one, seven processes on two cores answer in two
# thirds of the time (benchmarks/realtime.py). Not for a router, where one that waits for a slow reader would hold up all.
_ZENOH_THREADS = "(rx: (worker_threads: 1))"


@dataclass
class Fleet:
    """All processes of a run."""

    children: list[Child] = field(default_factory=list)
    peak_memory_bytes: int = 0
    cpu_s: dict[str, float] = field(default_factory=dict)

    def start(self, name: str, arguments: list[str], folder: Path) -> None:
        """Starts one; it ends by itself when this launcher dies, however that happens (its stdin closes)."""
        words = folder / f"{name.replace('/', '-')}.txt"
        threads = {"ZENOH_RUNTIME": _ZENOH_THREADS} if name != ROUTER else {}
        with words.open("wb") as out:
            process = subprocess.Popen(
                [sys.executable, "-m", "chaserdock", *arguments, "--watch-parent"],
                stdin=subprocess.PIPE,
                stdout=out,
                stderr=subprocess.STDOUT,
                env={**threads, **os.environ, **SINGLE_THREADED},
                # Ctrl-C is the launcher's to pass on. Not a session of its own: Linux would share the cores between
                # sessions ("autogroup") whatever the processes' priorities, and who woke up last would wait longest.
                process_group=0,
            )
        self.children.append(Child(name, process, words))

    def running(self) -> list[Child]:
        return [c for c in self.children if c.process.poll() is None]

    def is_made_up_for(self, child: Child) -> bool:
        """Whether it is a controller whose loss another one, that flew to the end, has made up for."""
        others = [c for c in self.children if c.name in topics.CONTROLLERS and c is not child]
        return child.name in topics.CONTROLLERS and any(c.process.poll() == 0 for c in others)

    def measure(self) -> None:
        """Notes every process' CPU time and their memory together (proportional set size where the system tells it)."""
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
        """Waits until all have ended, at most so long."""
        deadline = time.monotonic() + seconds
        while self.running() and time.monotonic() < deadline:
            time.sleep(0.02)

    def end(self) -> None:
        """Ends whatever still runs: asked first, then made to."""
        for child in self.running():
            child.process.send_signal(signal.SIGTERM)
        self.wait(5.0)
        for child in self.running():
            child.process.kill()
        for child in self.children:
            child.process.wait()
            if child.process.stdin is not None:
                child.process.stdin.close()


def free_port() -> int:
    """A TCP port that nobody listens on now."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def open_hub(
    namespace: str, lease_ms: int, name: str = "operator", role: Role = "operator"
) -> tuple[Node, str]:
    """A launcher's own node, which the processes connect to first, and its endpoint. Raises TransportError."""
    for attempt in range(5):
        endpoint = f"tcp/127.0.0.1:{free_port()}"
        try:
            return Node(name, role, Link(namespace, (), (endpoint,), lease_ms=lease_ms)), endpoint
        except TransportError:
            if attempt == 4:
                raise
    raise TransportError("no free port")


def check_keys(keys: Path, chasers: int) -> None:
    """Raises RunError unless a mission's keys are there for so many chasers, and hold."""
    from .keys import why_not_usable  # the cryptography takes its time to load

    if reason := why_not_usable(keys, chasers, datetime.now(UTC)):
        raise RunError(f"--keys {keys}: {reason}; make a mission's keys with `chaserdock keys init {keys}`")


def meet_at_router(
    onlookers: Fleet, words: Path, namespace: str, lease_ms: int, keys: Path
) -> tuple[Node, list[str]]:
    """Starts a router that holds everyone to the rights of the mission's ``keys``; a launcher's own node, as its client, and
    how the processes reach it. Raises RunError when the router does not come up."""
    port = free_port()
    endpoint, common = f"tls/127.0.0.1:{port}", ["--namespace", namespace, "--keys", str(keys)]
    onlookers.start(ROUTER, ["router", "-l", endpoint, "--lease-ms", str(lease_ms), *common], words)
    router, deadline = onlookers.children[-1], time.monotonic() + _PATIENCE_S
    while not member.router_there("127.0.0.1", port):
        if router.process.poll() is not None or time.monotonic() > deadline:
            raise RunError(f"the router does not listen: {router.last_words()}")
        time.sleep(0.05)
    link = Link(namespace, (endpoint,), (), "client", lease_ms=lease_ms, tls=Tls.in_folder(keys / "operator"))
    return Node("operator", "operator", link), ["-e", endpoint, "--lease-ms", str(lease_ms), *common]


def run_mission(
    path: Path,
    folder: Path,
    mode: str,
    seed: int | None,
    overrides: tuple[str, ...],
    show: Show,
    view: bool = False,
    keys: Path | None = None,
) -> int:
    """Flies a scenario; log, summary and the processes' words go to ``folder``. The exit status (``statuses``).

    ``view``: with the viewer's page beside it, to the end of the flight. ``keys``: through a router, over TLS, each process
    held to its rights. Raises ViewError, RunError, ScenarioError or TransportError when it cannot be started at all.
    """
    overrides = overrides if seed is None else (*overrides, f"seed={seed}")
    scenario = load_scenario(path, overrides)
    words = folder / "processes"
    if keys is not None:
        check_keys(keys, len(scenario.chasers))
    if (folder / LOG_NAME).exists():
        raise RunError(
            f"{folder} holds a mission.mcap already; a log is never overwritten, choose another --out"
        )
    try:
        words.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RunError(f"{folder}: cannot be made: {error.strerror or error}") from None
    namespace = f"run-{uuid.uuid4().hex[:12]}"
    # A silent peer is given up after the lease; in lock-step a stopped process is waited for instead.
    lease_ms = 2_000 if mode == "realtime" else 600_000
    fleet, onlookers, hub = Fleet(), Fleet(), None
    stop = _Stop()
    try:
        if keys is not None:
            hub, network = meet_at_router(onlookers, words, namespace, lease_ms, keys.resolve())
        else:
            hub, endpoint = open_hub(namespace, lease_ms)
            network = ["-e", endpoint, "--namespace", namespace, "--lease-ms", str(lease_ms)]
        if view:
            start_viewer(onlookers, words, network)
        start_all(fleet, scenario, path, folder, mode, overrides, network)
        reporter = ProgressReporter(scenario, show)
        reporter.tell(
            Start(
                scenario=scenario.name,
                seed=scenario.seed,
                mode="realtime" if mode == "realtime" else "lockstep",
                duration_s=scenario.duration_s,
                chasers=len(scenario.chasers),
                folder=str(folder),
            )
        )
        try:
            failure = watch(fleet, hub, reporter, stop)
        finally:
            reporter.close()
    finally:
        fleet.end()
        if hub is not None:
            hub.close()
        onlookers.end()
        stop.restore()
    return judge(fleet, folder, failure, reporter, stopped=stop.asked)


def start_all(
    fleet: Fleet,
    scenario: Scenario,
    path: Path,
    folder: Path,
    mode: str,
    overrides: tuple[str, ...],
    network: list[str],
) -> None:
    """Starts recorder, world, controller and chasers; in which order does not matter."""
    words = folder / "processes"
    patient = ["--patience", str(_PATIENCE_S)]
    sets = [item for override in overrides for item in ("--set", override)]
    listen = [] if "--keys" in network else ["-l", "tcp/127.0.0.1:0"]
    fleet.start("world", ["world", str(path), "--mode", mode, *sets, *network, *listen], words)
    fleet.start("controller", ["controller", *network, *patient], words)
    if scenario.controller.standby:
        fleet.start("standby", ["controller", "--standby", *network, *patient], words)
    for i in range(len(scenario.chasers)):
        fleet.start(f"chaser/{i}", ["chaser", str(i), *network, *patient], words)
    fleet.start("recorder", ["record", "--out", str(folder), *network, *patient], words)


def start_viewer(onlookers: Fleet, words: Path, network: list[str]) -> None:
    """Starts a viewer and says where its page is. It is none of the mission's fleet: its end is no failure."""
    port = free_page_port(DEFAULT_HOST, None)
    onlookers.start("viewer", ["view", "--port", str(port), *network], words)
    print(f"{url_of(DEFAULT_HOST, port)} shows the mission", file=sys.stderr, flush=True)


def watch(fleet: Fleet, hub: Node, reporter: ProgressReporter, stop: _Stop) -> str | None:
    """Shows the flight until it has ended; why it failed, or None."""
    hub.subscribe(topics.END)
    reporter.subscribe(hub)
    ended: MissionEnd | None = None
    measured_s = 0.0
    while ended is None:
        received = hub.receive(0.1)
        if received is not None:
            reporter.take(received.message)
            if isinstance(received.message, MissionEnd):
                ended = received.message
        reporter.show()
        if time.monotonic() - measured_s > 2.0:
            measured_s = time.monotonic()
            fleet.measure()
        if stop.asked and not stop.passed_on:
            stop.passed_on = True
            reporter.say("stopping: the log is being closed")
            fleet.children[0].process.send_signal(signal.SIGTERM)
        dead = [c for c in fleet.children if c.process.poll() not in (None, 0)]
        if dead and ended is None:
            if dead[0].name == "world" or stop.asked or not reporter.flying:
                return "stopped by the operator" if stop.asked else dead[0].last_words()
            for child in dead:
                reporter.warn(child.name, child.last_words())
    fleet.wait(_END_S)
    if stop.asked:
        return "stopped by the operator"
    bad = [c for c in fleet.children if c.process.poll() != 0 and not fleet.is_made_up_for(c)]
    if not ended.complete:
        # The world ends with status 1 for having been left; whoever left it knows more.
        return "; ".join([ended.reason, *(f"{c.name}: {c.last_words()}" for c in bad if c.name != "world")])
    return bad[0].last_words() if bad else None


def judge(
    fleet: Fleet, folder: Path, failure: str | None, reporter: ProgressReporter, stopped: bool = False
) -> int:
    """Writes summary.json from the log, and tells it; the run's status."""
    from chaserdock_protocol.recording.log import LogError

    from chaserdock.analysis.summary import summarize, text_of

    log = folder / LOG_NAME
    try:
        summary = summarize(log)
    except LogError as error:
        status = STOPPED if stopped else FAILED
        reporter.tell(Failed(status=status, text=failure or str(error)))
        print(f"chaserdock: {failure or error}", file=sys.stderr)
        return status
    if failure is not None:
        summary["failures"] = [failure, *summary["failures"]]
        summary["success"] = False
    if fleet.children:  # processes elsewhere have not been measured
        summary |= {"peak_memory_bytes": fleet.peak_memory_bytes, "cpu_s": fleet.cpu_s}
    (folder / "summary.json").write_text(json.dumps(summary, indent=2) + "\n", encoding="utf-8")
    status = STOPPED if stopped else DONE if summary["success"] else FAILED
    if reporter.for_scripts:
        reporter.tell(Result(status=status, folder=str(folder), summary=summary))
    else:
        print(text_of(summary))
        print(f"log, summary and the processes' words: {folder}")
    if not summary["success"]:
        print(f"chaserdock: failed: {summary['failures'][0]}", file=sys.stderr)
    return status


class _Stop:
    """Ctrl-C or SIGTERM asked for the end; a second time makes no difference until all is put away."""

    def __init__(self) -> None:
        self.asked = False
        self.passed_on = False
        self._before = {s: signal.signal(s, self._ask) for s in (signal.SIGINT, signal.SIGTERM)}

    def _ask(self, number: int, frame: FrameType | None) -> None:
        self.asked = True

    def restore(self) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
