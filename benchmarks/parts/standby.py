# SPDX-License-Identifier: Apache-2.0
"""Take-over by the standby controller: ``fault-drill`` in real time, all processes as clients of a
router.

During the final approach the commanding controller is killed (``kill``: SIGKILL), stopped for 3 s
(``freeze``: SIGSTOP, SIGCONT), or cut off from the router for 3 s in both directions without
closing a connection (``partition``). ``takeover``: wall time from the fault to the sending of the
standby's first command. ``two_commanding``: commands of an older term that a chaser executed after
one of a newer term.
"""

from __future__ import annotations

import random
import signal
import socket
import tempfile
import threading
import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np
import psutil
from chaserdock_protocol import codec, topics
from chaserdock_protocol.messages import ActuatorCommand, MissionEnd, Tick, WrenchCommand
from chaserdock_protocol.recording.log import read_log
from chaserdock_protocol.transport import Link, Node, RawSample
from common import ROOT, Figures, Group, Options, described, start_mission

from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.summary import summarize
from chaserdock.launch.launcher import Fleet, fly_mission, free_port

SCENARIO = ROOT / "scenarios" / "fault-drill.toml"
CHASERS = 4
OUTAGE_S = 3.0
"""Longer than the lease, so that the standby takes over."""
LEASE_MS = 2000
"""Of the router's links."""
EARLIEST_S, LATEST_S = 7.0, 14.0
"""Times of the fault: chasers 0 and 3 have been approaching since 5 s."""


class Proxy:
    """TCP proxy to a local port that can stop forwarding without closing connections."""

    def __init__(self, port: int) -> None:
        self.forwarding = threading.Event()
        self.forwarding.set()
        self._target_port = port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self._sockets: list[socket.socket] = [self._listener]
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
                self.forwarding.wait()
                far = socket.create_connection(("127.0.0.1", self._target_port))
            except OSError:
                return
            for a, b in ((near, far), (far, near)):
                a.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._sockets.append(a)
                threading.Thread(target=self._forward, args=(a, b), daemon=True).start()

    def _forward(self, a: socket.socket, b: socket.socket) -> None:
        try:
            while data := a.recv(65536):
                self.forwarding.wait()
                b.sendall(data)
            b.shutdown(socket.SHUT_WR)
        except OSError:
            return

    def close(self) -> None:
        self.forwarding.set()
        for one in self._sockets:
            one.close()


@dataclass
class TakeoverObserver:
    """Sending time of the first command of each controller (wall clock, ns), and progress of the
    flight.
    """

    first_command_ns: dict[str, int] = field(default_factory=dict)
    time_s: float = 0.0
    commander: str = ""
    ended: bool = False

    def first_of_another(self, commander: str) -> int | None:
        """Return when the first command of another controller was sent since ``first_command_ns``
        was cleared.
        """
        return min(
            (at for name, at in self.first_command_ns.items() if name != commander), default=None
        )

    def receive(self, raw: RawSample) -> None:
        """Note a message; called on a thread of Zenoh."""
        found = topics.topic_of_key(raw.key)
        message = codec.decode(found[0].kind, raw.payload) if found is not None else None
        if isinstance(message, WrenchCommand):
            if message.mode not in ("wait", "yield"):
                self.first_command_ns.setdefault(message.commander, raw.sent_ns)
                self.commander = message.commander
        elif isinstance(message, Tick):
            self.time_s = message.sim_time_ns / 1e9
        elif isinstance(message, MissionEnd):
            self.ended = True


@dataclass(frozen=True)
class Takeover:
    """How a standby took over in one flight.

    ``takeover_s``: from the fault to the first command of another controller; infinite without one.
    ``two_commanding``: commands of an older term that a chaser executed after one of a newer term.
    """

    takeover_s: float
    docked: bool
    collisions: int
    two_commanding: int
    hand_overs: int
    stale_refused: int


InjectedFault = Callable[[psutil.Process, Proxy], None]


def kill(controller: psutil.Process, proxy: Proxy) -> None:
    """Kill the controller."""
    controller.kill()


def freeze(controller: psutil.Process, proxy: Proxy) -> None:
    """Stop the controller and continue it after the outage."""
    controller.send_signal(signal.SIGSTOP)
    threading.Timer(OUTAGE_S, lambda: controller.send_signal(signal.SIGCONT)).start()


def partition(controller: psutil.Process, proxy: Proxy) -> None:
    """Cut the controller off from the router for the outage."""
    proxy.forwarding.clear()
    threading.Timer(OUTAGE_S, proxy.forwarding.set).start()


FAULTS: dict[str, InjectedFault] = {"kill": kill, "freeze": freeze, "partition": partition}


def fly(fault: InjectedFault, at_s: float) -> Takeover:
    """Fly in real time with a fault at ``at_s`` (simulated time)."""
    namespace, port = f"standby-{uuid.uuid4().hex[:8]}", free_port()

    def network(router_port: int) -> list[str]:
        endpoint = [
            "-m",
            "client",
            "-e",
            f"tcp/127.0.0.1:{router_port}",
            "--lease",
            str(LEASE_MS / 1000),
        ]
        return ["--namespace", namespace, *endpoint]

    with tempfile.TemporaryDirectory() as name:
        folder, observer, fleet = Path(name), TakeoverObserver(), Fleet()
        proxies = {process: Proxy(port) for process in topics.CONTROLLERS}
        router = Link(namespace, (), (f"tcp/127.0.0.1:{port}",), "router", lease_ms=LEASE_MS)
        node = Node("observer", "analysis", router)
        try:
            controllers = {
                process: [
                    *(["--standby"] if process == "standby" else []),
                    *network(proxy.port),
                    "--timeout",
                    "120",
                ]
                for process, proxy in proxies.items()
            }
            world = ["--mode", "realtime", "--set", "controller.standby=true"]
            start_mission(
                fleet, folder, SCENARIO, CHASERS, network(port), world, controllers=controllers
            )
            for topic in (topics.WRENCH, topics.TICK, topics.END):
                node.subscribe_raw(topic.key.format(chaser="*"), observer.receive)
            wait(lambda: observer.time_s >= at_s, fleet, 120.0)
            commander = observer.commander
            observer.first_command_ns.clear()
            pid = next(c.process.pid for c in fleet.children if c.name == commander)
            fault_ns = time.time_ns()
            fault(psutil.Process(pid), proxies[commander])
            wait(lambda: observer.ended, fleet, 60.0)
            fleet.wait(20.0)
        finally:
            fleet.end()
            for proxy in proxies.values():
                proxy.close()
            node.close()
        return evaluate(folder / "mission.mcap", observer.first_of_another(commander), fault_ns)


def wait(done: Callable[[], bool], fleet: Fleet, timeout_s: float) -> None:
    """Wait for a condition. Raise SystemExit after the timeout, or if the world exits before."""
    deadline = time.monotonic() + timeout_s
    world = next(c for c in fleet.children if c.name == "world")
    while not done():
        time.sleep(0.005)
        if time.monotonic() > deadline or (world.process.poll() is not None and not done()):
            raise SystemExit(
                f"the flight does not continue: {[c.last_line() for c in fleet.children]}"
            )


def evaluate(log: Path, first_command_ns: int | None, fault_ns: int) -> Takeover:
    """Evaluate the log of a flight."""
    newest: dict[int, int] = {}
    two_commanding = 0
    for record in read_log(log, [topics.ACTUATORS.key_of(i) for i in range(CHASERS)]):
        message: ActuatorCommand = record.message
        if message.source == "command":
            two_commanding += message.term < newest.get(message.chaser, 0)
            newest[message.chaser] = max(message.term, newest.get(message.chaser, 0))
    flight = load_flight(log)
    summary = summarize(log)
    return Takeover(
        takeover_s=(first_command_ns - fault_ns) / 1e9
        if first_command_ns is not None
        else float("inf"),
        docked=all(summary["chasers"][i]["docked"] for i in ("0", "3")),
        collisions=summary["collisions"],
        two_commanding=two_commanding,
        hand_overs=sum(e.what == "hand-over" for e in flight.events),
        stale_refused=sum(
            n for reason, n in flight.rejected.items() if reason.endswith("stale term")
        ),
    )


def takeovers(name: str, flights: int) -> Figures:
    """Fly with one kind of fault at random times."""
    draw = random.Random(name)
    flown = [fly(FAULTS[name], draw.uniform(EARLIEST_S, LATEST_S)) for _ in range(flights)]
    return {
        f"{name}_flights": flights,
        f"{name}_takeover_median_s": float(np.median([f.takeover_s for f in flown])),
        f"{name}_takeover_max_s": max(f.takeover_s for f in flown),
        f"{name}_docked": sum(f.docked for f in flown),
        f"{name}_collisions": sum(f.collisions for f in flown),
        f"{name}_two_commanding": sum(f.two_commanding for f in flown),
        f"{name}_stale_refused": sum(f.stale_refused for f in flown),
        f"{name}_hand_overs": sum(f.hand_overs for f in flown),
    }


def is_identical(at_s: float) -> bool:
    """Return whether all bodies move identically in lock-step if the controller is killed."""
    truths = []
    for fault in ("[]", f'[{{kind="kill", at_s={at_s}, process="controller"}}]'):
        with tempfile.TemporaryDirectory() as name:
            overrides = ("controller.standby=true", f"fault={fault}")
            fly_mission(SCENARIO, Path(name), overrides=overrides)
            flight = load_flight(Path(name) / "mission.mcap")
            truths.append({body: track.position_m for body, track in flight.motion.items()})
    return all(np.array_equal(truths[0][body], truths[1][body]) for body in truths[0])


def identity(options: Options) -> Figures:
    """Compare pairs of lock-step flights, one with the controller killed: equal motion."""
    pairs = 1 if options.quick else 2
    draw = random.Random("identity")
    same = [is_identical(round(draw.uniform(EARLIEST_S, LATEST_S), 1)) for _ in range(pairs)]
    return {"identity_pairs": pairs, "identity_different": same.count(False)}


def measure(fault: str, options: Options) -> Figures:
    """Return the figures of five take-overs (``--quick``: one)."""
    return takeovers(fault, 1 if options.quick else options.flights or 5)


GROUP = Group(
    {
        **{
            f"standby-{name}": described(partial(measure, name), fault.__doc__ or "")
            for name, fault in FAULTS.items()
        },
        "standby-identity": identity,
    },
    ("flights",),
)
