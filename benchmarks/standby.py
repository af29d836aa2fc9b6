# SPDX-License-Identifier: Apache-2.0
"""A standby takes over: ``python benchmarks/standby.py [--flights 5] [--only KIND] [--quick] [--json FILE]``.

Flies ``fault-drill`` in real time, all processes as clients of a router, and in its final approach does to the commanding
controller: ``kill`` (SIGKILL), ``freeze`` (SIGSTOP for 3 s, then SIGCONT), ``partition`` (nothing passes between it and the
router for 3 s, either way; no connection is closed). Measured from the fault to the sending of the first command of the
standby, by one wall clock. ``two_commanding``: commands that a chaser flew of an older term than one before. ``identity``:
pairs of lock-step flights, one with the controller killed, whose bodies moved differently. Wall-clock figures: nothing
else should run beside it.
"""

from __future__ import annotations

import json
import random
import signal
import socket
import tempfile
import threading
import time
import uuid
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil
from chaserdock_protocol import codec, topics
from chaserdock_protocol.messages import ActuatorCommand, MissionEnd, Tick, WrenchCommand
from chaserdock_protocol.recording.log import read_log
from chaserdock_protocol.transport import Link, Node, RawSample
from results import options_of, write_json

from chaserdock.analysis.flight import load_flight
from chaserdock.analysis.summary import summarize
from chaserdock.launch.launcher import Fleet, fly_mission, free_port

ROOT = Path(__file__).resolve().parents[1]
SCENARIO = ROOT / "scenarios" / "fault-drill.toml"
CHASERS = 4
AWAY_S = 3.0
LEASE_MS = 2000
FIRST_S, LAST_S = 7.0, 14.0
"""The fault strikes in between: chasers 0 and 3 have been coming in since 5 s."""


class Wire:
    """A TCP connection to ``port`` that can be cut: then nothing passes, and no end is told."""

    def __init__(self, port: int) -> None:
        self.passes = threading.Event()
        self.passes.set()
        self._to = port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port = int(self._listener.getsockname()[1])
        self._sockets: list[socket.socket] = [self._listener]
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
                self.passes.wait()
                far = socket.create_connection(("127.0.0.1", self._to))
            except OSError:
                return
            for a, b in ((near, far), (far, near)):
                a.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._sockets.append(a)
                threading.Thread(target=self._pass_on, args=(a, b), daemon=True).start()

    def _pass_on(self, a: socket.socket, b: socket.socket) -> None:
        try:
            while data := a.recv(65536):
                self.passes.wait()
                b.sendall(data)
            b.shutdown(socket.SHUT_WR)
        except OSError:
            return

    def close(self) -> None:
        self.passes.set()
        for one in self._sockets:
            one.close()


@dataclass
class Ear:
    """When each term's first command was sent (wall clock, ns), and how far the flight is."""

    first_ns: dict[int, int] = field(default_factory=dict)
    time_s: float = 0.0
    commander: str = ""
    term: int = 0
    ended: bool = False

    def take(self, raw: RawSample) -> None:
        """Called on Zenoh's thread."""
        found = topics.topic_of_key(raw.key)
        message = codec.decode(found[0].kind, raw.payload) if found is not None else None
        if isinstance(message, WrenchCommand):
            self.first_ns.setdefault(message.term, raw.sent_ns)
        elif isinstance(message, Tick):
            self.time_s = message.sim_time_ns / 1e9
            self.commander, self.term = message.commander, message.term
        elif isinstance(message, MissionEnd):
            self.ended = True


@dataclass(frozen=True)
class Taken:
    """One flight: seconds to the standby's first command, and what became of it."""

    first_s: float
    docked: bool
    collisions: int
    two_commanding: int
    hand_overs: int
    refused: int


Fault = Callable[[psutil.Process, Wire], None]


def kill(controller: psutil.Process, wire: Wire) -> None:
    """As by ``kill -9``."""
    controller.kill()


def freeze(controller: psutil.Process, wire: Wire) -> None:
    """Stops it, and lets it go on."""
    controller.send_signal(signal.SIGSTOP)
    threading.Timer(AWAY_S, lambda: controller.send_signal(signal.SIGCONT)).start()


def partition(controller: psutil.Process, wire: Wire) -> None:
    """Cuts it off, and joins it up again."""
    wire.passes.clear()
    threading.Timer(AWAY_S, wire.passes.set).start()


FAULTS: dict[str, Fault] = {"kill": kill, "freeze": freeze, "partition": partition}


def start(fleet: Fleet, folder: Path, namespace: str, port: int, wires: dict[str, Wire]) -> None:
    """All processes of the mission; controllers reach the router by wires of their own."""
    words = folder / "processes"
    words.mkdir()

    def client(by: int) -> list[str]:
        where = ["-m", "client", "-e", f"tcp/127.0.0.1:{by}", "--lease", str(LEASE_MS / 1000)]
        return ["--namespace", namespace, *where]

    world = ["world", str(SCENARIO), "--mode", "realtime", "--set", "controller.standby=true", *client(port)]
    patient = [*client(port), "--timeout", "120"]
    fleet.start("world", world, words)
    for i in range(CHASERS):
        fleet.start(f"chaser/{i}", ["chaser", str(i), *patient], words)
    fleet.start("recorder", ["record", "--out", str(folder), *patient], words)
    for name, wire in wires.items():
        as_what = ["--standby"] if name == "standby" else []
        fleet.start(name, ["controller", *as_what, *client(wire.port), "--timeout", "120"], words)


def fly(fault: Fault, at_s: float) -> Taken:
    """One flight in real time with a fault at ``at_s`` (simulated)."""
    namespace, port = f"standby-{uuid.uuid4().hex[:8]}", free_port()
    with tempfile.TemporaryDirectory() as name:
        folder, ear, fleet = Path(name), Ear(), Fleet()
        wires = {process: Wire(port) for process in topics.CONTROLLERS}
        router = Link(namespace, (), (f"tcp/127.0.0.1:{port}",), "router", lease_ms=LEASE_MS)
        node = Node("observer", "analysis", router)
        try:
            start(fleet, folder, namespace, port, wires)
            for topic in (topics.WRENCH, topics.TICK, topics.END):
                node.subscribe_raw(topic.key.format(chaser="*"), ear.take)
            wait(lambda: ear.time_s >= at_s, fleet, 120.0)
            victim, term = ear.commander, ear.term
            pid = next(c.process.pid for c in fleet.children if c.name == victim)
            struck_ns = time.time_ns()
            fault(psutil.Process(pid), wires[victim])
            wait(lambda: ear.ended, fleet, 60.0)
            fleet.wait(20.0)
        finally:
            fleet.end()
            for wire in wires.values():
                wire.close()
            node.close()
        return account(folder / "mission.mcap", ear.first_ns.get(term + 1), struck_ns)


def wait(done: Callable[[], bool], fleet: Fleet, seconds: float) -> None:
    """Raises SystemExit when it takes longer, or the world has ended before."""
    deadline = time.monotonic() + seconds
    while not done():
        time.sleep(0.005)
        world = next(c for c in fleet.children if c.name == "world")
        if time.monotonic() > deadline or (world.process.poll() is not None and not done()):
            raise SystemExit(f"the flight does not go on: {[c.last_line() for c in fleet.children]}")


def account(log: Path, first_ns: int | None, struck_ns: int) -> Taken:
    """What the log says of a flight."""
    newest: dict[int, int] = {}
    two = 0
    for record in read_log(log, [topics.ACTUATORS.key_of(i) for i in range(CHASERS)]):
        message: ActuatorCommand = record.message
        if message.source == "command":
            two += message.term < newest.get(message.chaser, 0)
            newest[message.chaser] = max(message.term, newest.get(message.chaser, 0))
    flight = load_flight(log)
    summary = summarize(log)
    refused = sum(n for what, n in flight.rejected.items() if what.endswith("stale term"))
    return Taken(
        first_s=(first_ns - struck_ns) / 1e9 if first_ns is not None else float("inf"),
        docked=all(summary["chasers"][i]["docked"] for i in ("0", "3")),
        collisions=summary["collisions"],
        two_commanding=two,
        hand_overs=sum(e.what == "hand-over" for e in flight.events),
        refused=refused,
    )


def identical(at_s: float) -> bool:
    """Whether a lock-step flight whose controller is killed is the same as one in which it is not."""
    truths = []
    for fault in ("[]", f'[{{kind="kill", at_s={at_s}, process="controller"}}]'):
        with tempfile.TemporaryDirectory() as name:
            overrides = ("controller.standby=true", f"fault={fault}")
            fly_mission(SCENARIO, Path(name), overrides=overrides)
            flight = load_flight(Path(name) / "mission.mcap")
            truths.append({body: track.position_m for body, track in flight.truth.items()})
    return all(np.array_equal(truths[0][body], truths[1][body]) for body in truths[0])


def main() -> None:
    parser = options_of(__doc__)
    parser.add_argument("--flights", type=int, default=5, help="of each kind")
    parser.add_argument("--only", choices=[*FAULTS, "identity"], help="this kind alone")
    options = parser.parse_args()
    flights = 1 if options.quick else options.flights
    figures: dict[str, object] = {}
    for name, fault in FAULTS.items():
        if options.only not in (None, name):
            continue
        draw = random.Random(name)
        taken = [fly(fault, draw.uniform(FIRST_S, LAST_S)) for _ in range(flights)]
        first = [t.first_s for t in taken]
        figures |= {
            f"{name}_flights": len(taken),
            f"{name}_first_command_median_s": float(np.median(first)),
            f"{name}_first_command_worst_s": max(first),
            f"{name}_docked": sum(t.docked for t in taken),
            f"{name}_collisions": sum(t.collisions for t in taken),
            f"{name}_two_commanding": sum(t.two_commanding for t in taken),
            f"{name}_stale_refused": sum(t.refused for t in taken),
        }
        print(
            f"{name:10} first command of the standby after {np.median(first) * 1e3:.0f} ms (median), "
            f"{max(first) * 1e3:.0f} ms (worst) of {len(taken)}; {sum(t.docked for t in taken)} docked, "
            f"{sum(t.collisions for t in taken)} collisions; {sum(t.two_commanding for t in taken)} times two "
            f"commanding; {sum(t.refused for t in taken)} stale commands refused; "
            f"hand-overs {[t.hand_overs for t in taken]}",
            flush=True,
        )
    if options.only in (None, "identity"):
        draw = random.Random("identity")
        same = [identical(round(draw.uniform(FIRST_S, LAST_S), 1)) for _ in range(1 if options.quick else 2)]
        figures |= {"identity_pairs": len(same), "identity_different": same.count(False)}
        print(f"identity   {same.count(False)} of {len(same)} pairs of lock-step flights differ")
    write_json(options.json, figures)
    if not options.json:
        print(json.dumps(figures))


if __name__ == "__main__":
    main()
