# SPDX-License-Identifier: Apache-2.0
"""Real time, four chasers at 30 Hz: ``python benchmarks/realtime.py [--flights 1] [--only SUBJECT] [--seconds 5]
[--rounds 3] [--keep DIR] [--quick] [--json FILE]``.

Flies ``four-chaser-docking`` in real time with ticks and images at 30 Hz, 640 x 480, every process on this machine, and
measures from an image's sending to the sending of the actuator command that answers it (both stamps are the senders');
the images of a tick are sent together, as cameras do that expose at once. Beside it, from the tick's sending, when
the images have still to be drawn, to that command.
A flight for each subject, ``recorder`` and ``viewer`` (the recorder runs in both; the viewer is asked for by one client that
reads all it gets). In windows of ``--seconds`` that take turns in the same flight, the subject is left as it is, frozen
(SIGSTOP), left as it is, and slow (runs for a tenth of the time): what the machine does meanwhile touches all of them.
``lost``: ticks of a chaser without any command from the controller; ``missed``: commands later than 33 ms; ``ratio``: the
99th percentile over that of the windows as it is. Also each process' share of a core. Wall-clock figures: nothing else
should run beside it.
"""

from __future__ import annotations

import asyncio
import signal
import tempfile
import threading
import time
import uuid
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np
import psutil
import viser
import websockets
from chaserdock_protocol import topics
from chaserdock_protocol.messages import MissionEnd
from chaserdock_protocol.transport import Node, RawSample
from results import options_of, write_json
from websockets.asyncio.client import connect

from chaserdock.launch.launcher import Fleet, free_port, open_hub

ROOT = Path(__file__).resolve().parents[1]
SCENARIO = ROOT / "scenarios" / "four-chaser-docking.toml"
CHASERS = 4
RATE_HZ = 30
SETTLE_S = 6.0
PAUSE_S = 1.0
"""Between windows: whoever was stopped catches up."""
LATE_S = 0.033
SUBJECTS = ("recorder", "viewer")
LEASE_MS = 60_000  # as under `chaserdock run`
OVERRIDES = (
    f"time.rate_hz={RATE_HZ}",
    f"time.image_hz={RATE_HZ}",
    "camera.width_px=640",
    "camera.height_px=480",
    "timeline=[]",
    "success.docked=[]",
)


class Head(msgspec.Struct):
    """What is read of a tick, an image or an actuator command."""

    tick: int
    chaser: int = -1
    source: str = ""


_head = msgspec.msgpack.Decoder(Head)


@dataclass
class Ear:
    """When ticks, images and commands were sent, by tick or by chaser and tick (wall clock, ns)."""

    ticks: dict[int, int] = field(default_factory=dict)
    images: dict[tuple[int, int], int] = field(default_factory=dict)
    commands: dict[tuple[int, int], int] = field(default_factory=dict)
    last_tick: int = -1

    def take(self, raw: RawSample) -> None:
        """Called on Zenoh's thread."""
        # No more than is needed: what is measured shares the cores with this.
        head = _head.decode(raw.payload)
        if raw.key == topics.TICK.key:
            self.ticks.setdefault(head.tick, raw.sent_ns)
        elif raw.key.endswith("/image"):
            self.images[head.chaser, head.tick] = raw.sent_ns
            self.last_tick = max(self.last_tick, head.tick)
        elif head.source == "command":
            self.commands.setdefault((head.chaser, head.tick), raw.sent_ns)


@dataclass(frozen=True)
class Window:
    """One condition for a while: ticks of which all answers count, and each process' share of a core."""

    condition: str
    first: int
    last: int
    cpu_share: dict[str, float]


@dataclass(frozen=True)
class Flown:
    """All windows of one condition: latencies of all commands from image and from tick (s), how many ticks of chasers had
    no command."""

    latency_s: np.ndarray
    from_tick_s: np.ndarray
    ticks: int
    lost: int
    cpu_share: dict[str, float]

    @property
    def missed(self) -> int:
        return int(np.sum(self.latency_s > LATE_S))


def quantile(values_s: np.ndarray, q: float) -> float:
    return float(np.quantile(values_s, q)) if len(values_s) else float("nan")


def as_it_is(subject: psutil.Process, stop: threading.Event) -> None:
    """Not touched."""


def frozen(subject: psutil.Process, stop: threading.Event) -> None:
    """Stopped until the end."""
    subject.send_signal(signal.SIGSTOP)
    stop.wait()
    subject.send_signal(signal.SIGCONT)


def slow(subject: psutil.Process, stop: threading.Event) -> None:
    """It runs for 20 ms of every 200."""
    while not stop.is_set():
        subject.send_signal(signal.SIGSTOP)
        stop.wait(0.18)
        subject.send_signal(signal.SIGCONT)
        stop.wait(0.02)


CONDITIONS = {"as_it_is": as_it_is, "frozen": frozen, "slow": slow}
ROUND = ("as_it_is", "frozen", "as_it_is", "slow")


def start(fleet: Fleet, folder: Path, seconds: float, network: list[str], subject: str) -> None:
    """All processes of the mission, and the viewer where it is the subject."""
    words = folder / "processes"
    words.mkdir()
    sets = [part for o in (*OVERRIDES, f"duration_s={seconds}") for part in ("--set", o)]
    world = ["world", str(SCENARIO), "--mode", "realtime", *sets, *network, "-l", "tcp/127.0.0.1:0"]
    fleet.start("world", world, words)
    fleet.start("controller", ["controller", *network, "--timeout", "120"], words)
    for i in range(CHASERS):
        fleet.start(f"chaser/{i}", ["chaser", str(i), *network, "--timeout", "120"], words)
    fleet.start("recorder", ["record", "--out", str(folder), *network, "--timeout", "120"], words)
    if subject == "viewer":
        port = free_port()
        fleet.start("viewer", ["view", *network, "--port", str(port)], words)
        threading.Thread(target=lambda: asyncio.run(look(port)), daemon=True).start()


async def look(port: int) -> None:
    """A client of the viewer that takes whatever it is sent, as a browser elsewhere would."""
    offered = [websockets.Subprotocol(f"viser-v{viser.__version__}")]
    while True:
        try:
            async with connect(f"ws://127.0.0.1:{port}", subprotocols=offered, max_size=None) as socket:
                async for _ in socket:
                    pass
        except (OSError, websockets.WebSocketException):
            await asyncio.sleep(0.2)  # the viewer is not there yet


def measured(
    ear: Ear, fleet: Fleet, hub: Node, subject: psutil.Process, condition: str, seconds: float
) -> Window:
    """One window, with the subject in that condition."""
    stop = threading.Event()
    disturbing = threading.Thread(target=CONDITIONS[condition], args=(subject, stop))
    disturbing.start()
    try:
        first = ear.last_tick + 3  # sent after the condition began
        before, begun_s = cpu_s(fleet), time.monotonic()
        wait_for(ear, first + round(seconds * RATE_HZ), fleet, hub)
        after, took_s = cpu_s(fleet), time.monotonic() - begun_s
        last = ear.last_tick - 5  # whose answers have had their time
    finally:
        stop.set()
        disturbing.join()
    share = {name: (after[name] - before[name]) / took_s for name in after if name in before}
    return Window(condition, first, last, share)


def fly(subject: str, seconds: float, rounds: int, keep: Path | None = None) -> dict[str, Flown]:
    """One flight, by condition of the subject. ``keep``: a folder for its log."""
    namespace = f"realtime-{uuid.uuid4().hex[:8]}"
    if keep is not None:
        keep.mkdir(parents=True)
    windows: list[Window] = []
    with tempfile.TemporaryDirectory() if keep is None else nullcontext(str(keep)) as folder:
        hub, endpoint = open_hub(namespace, LEASE_MS, name="observer", role="analysis")
        fleet, ear = Fleet(), Ear()
        try:
            hub.subscribe(topics.END)
            for topic in (topics.TICK, topics.IMAGE, topics.ACTUATORS):
                hub.subscribe_raw(topic.key.format(chaser="*"), ear.take)
            total_s = SETTLE_S + rounds * len(ROUND) * (seconds + PAUSE_S) + 5.0
            network = ["-e", endpoint, "--namespace", namespace, "--lease", str(LEASE_MS / 1000)]
            start(fleet, Path(folder), total_s, network, subject)
            touched = psutil.Process(next(c.process.pid for c in fleet.children if c.name == subject))
            wait_for(ear, round(SETTLE_S * RATE_HZ), fleet, hub)
            for condition in ROUND * rounds:
                windows.append(measured(ear, fleet, hub, touched, condition, seconds))
                wait_for(ear, ear.last_tick + round(PAUSE_S * RATE_HZ), fleet, hub)
        finally:
            fleet.end()
            hub.close()
    return {name: together([w for w in windows if w.condition == name], ear) for name in CONDITIONS}


def together(windows: list[Window], ear: Ear) -> Flown:
    """What the ear heard in these windows."""
    keys = [(i, tick) for w in windows for tick in range(w.first, w.last + 1) for i in range(CHASERS)]
    latency = [(ear.commands[k] - ear.images[k]) / 1e9 for k in keys if k in ear.commands and k in ear.images]
    share = {name: float(np.mean([w.cpu_share[name] for w in windows])) for name in windows[0].cpu_share}
    lost = sum(k not in ear.commands for k in keys)
    since_tick = [
        (ear.commands[k] - ear.ticks[k[1]]) / 1e9 for k in keys if k in ear.commands and k[1] in ear.ticks
    ]
    return Flown(np.array(latency), np.array(since_tick), len(keys) // CHASERS, lost, share)


def wait_for(ear: Ear, tick: int, fleet: Fleet, hub: Node) -> None:
    """Waits until a tick's images have been sent; raises SystemExit when a process ends before."""
    while ear.last_tick < tick:
        received = hub.receive(0.05)
        dead = [c.last_line() for c in fleet.children if c.process.poll() is not None]
        if dead or (received is not None and isinstance(received.message, MissionEnd)):
            raise SystemExit(f"the mission ended at tick {ear.last_tick}: {'; '.join(dead)}")


def cpu_s(fleet: Fleet) -> dict[str, float]:
    times = {c.name: psutil.Process(c.process.pid).cpu_times() for c in fleet.running()}
    return {name: t.user + t.system for name, t in times.items()}


def show(subject: str, condition: str, flown: Flown) -> dict[str, float]:
    """Prints and returns the figures of one condition."""
    name = f"{condition.replace('_', ' ')} {subject}" if condition != "as_it_is" else f"{subject} as it is"
    shares = "  ".join(f"{process} {share:.2f}" for process, share in flown.cpu_share.items())
    p50, p99, most = (1e3 * quantile(flown.latency_s, q) for q in (0.5, 0.99, 1.0))
    print(
        f"{name:18} exposure to command: p50 {p50:.1f} ms, p99 {p99:.1f} ms, max {most:.1f} ms; "
        f"{flown.lost} of {flown.ticks * CHASERS} lost, {flown.missed} later than 33 ms"
    )
    tick50, tick99 = (1e3 * quantile(flown.from_tick_s, q) for q in (0.5, 0.99))
    print(f"{'':18} tick to command: p50 {tick50:.1f} ms, p99 {tick99:.1f} ms")
    print(f"{'':18} CPU: {shares}  together {sum(flown.cpu_share.values()):.2f}", flush=True)
    return {
        f"{subject}_{condition}_p50_s": quantile(flown.latency_s, 0.5),
        f"{subject}_{condition}_p99_s": quantile(flown.latency_s, 0.99),
        f"{subject}_{condition}_max_s": quantile(flown.latency_s, 1.0),
        f"{subject}_{condition}_tick_p50_s": quantile(flown.from_tick_s, 0.5),
        f"{subject}_{condition}_tick_p99_s": quantile(flown.from_tick_s, 0.99),
        f"{subject}_{condition}_lost": flown.lost,
        f"{subject}_{condition}_missed": flown.missed,
        f"{subject}_{condition}_commands": len(flown.latency_s),
    }


def main() -> None:
    parser = options_of(__doc__)
    parser.add_argument("--flights", type=int, default=1, help="of each subject")
    parser.add_argument("--only", choices=SUBJECTS, help="this subject alone")
    parser.add_argument("--seconds", type=float, default=5.0, help="of each window")
    parser.add_argument("--rounds", type=int, default=3, help="of four windows each")
    parser.add_argument("--keep", type=Path, help="keep logs and the processes' words here")
    options = parser.parse_args()
    rounds = 1 if options.quick else options.rounds
    flights: list[dict[str, float]] = []
    for number in range(1 if options.quick else options.flights):
        figures: dict[str, float] = {}
        for subject in [options.only] if options.only else SUBJECTS:
            keep = options.keep and options.keep / f"{subject}-{number}"
            flown = fly(subject, options.seconds, rounds, keep)
            for condition, one in flown.items():
                figures |= show(subject, condition, one)
            for condition in ("frozen", "slow"):
                ratio = quantile(flown[condition].latency_s, 0.99) / quantile(
                    flown["as_it_is"].latency_s, 0.99
                )
                figures[f"{subject}_{condition}_p99_ratio"] = ratio
                print(f"{condition} {subject}: p99 {ratio:.2f} of that with the {subject} as it is")
        flights.append(figures)
    medians = {name: float(np.median([f[name] for f in flights])) for name in flights[0]}
    if len(flights) > 1:
        print(
            f"medians of {len(flights)} flights:", {name: round(value, 4) for name, value in medians.items()}
        )
    write_json(options.json, medians)


if __name__ == "__main__":
    main()
