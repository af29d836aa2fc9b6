"""Real time, four chasers at 30 Hz: ``python benchmarks/realtime.py [--seconds 15] [--only NAME] [--keep DIR] [--quick]
[--json FILE]``.

Flies ``four-chaser-docking`` in real time with ticks and pictures at 30 Hz, 640 x 480, every process on this machine, and
measures from a picture's sending to the sending of the actuator command that answers it (both stamps are the senders').
Three flights: with the recorder as it is, with one that is frozen (SIGSTOP) while it is measured, and with one that
runs a tenth of the time. ``lost``: ticks of a chaser without any command from the controller; ``missed``: commands later
than 33 ms. Also each process' CPU time. Wall-clock figures: nothing else should run beside it.
"""

from __future__ import annotations

import signal
import tempfile
import threading
import time
import uuid
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np
import psutil
from chaserdock_agents.launcher import Child, Fleet, open_hub
from chaserdock_protocol import topics
from chaserdock_protocol.messages import MissionEnd
from chaserdock_protocol.transport import Node, Raw
from results import options_of, write_json

ROOT = Path(__file__).resolve().parents[1]
SCENARIO = ROOT / "scenarios" / "four-chaser-docking.toml"
CHASERS = 4
RATE_HZ = 30
SETTLE_S = 6.0
LATE_S = 0.033
LEASE_MS = 60_000  # as under `chaserdock run`
OVERRIDES = (
    f"time.rate_hz={RATE_HZ}",
    f"time.picture_hz={RATE_HZ}",
    "camera.width_px=640",
    "camera.height_px=480",
    "timeline=[]",
    "success.docked=[]",
)


class Head(msgspec.Struct):
    """What is read of a picture or an actuator command."""

    tick: int
    chaser: int
    source: str = ""


_head = msgspec.msgpack.Decoder(Head)


@dataclass
class Ear:
    """When pictures and commands were sent, by chaser and tick (wall clock, ns)."""

    pictures: dict[tuple[int, int], int] = field(default_factory=dict)
    commands: dict[tuple[int, int], int] = field(default_factory=dict)
    last_tick: int = -1

    def take(self, raw: Raw) -> None:
        """Called on Zenoh's thread."""
        # No more than is needed: what is measured shares the cores with this.
        head = _head.decode(raw.payload)
        if raw.key.endswith("/image"):
            self.pictures[head.chaser, head.tick] = raw.sent_ns
            self.last_tick = max(self.last_tick, head.tick)
        elif head.source == "command":
            self.commands.setdefault((head.chaser, head.tick), raw.sent_ns)


@dataclass(frozen=True)
class Flown:
    """One flight: latencies of all commands (s), and how many ticks of chasers had none."""

    latency_s: np.ndarray
    ticks: int
    lost: int
    cpu_share: dict[str, float]

    def quantile(self, q: float) -> float:
        return float(np.quantile(self.latency_s, q)) if len(self.latency_s) else float("nan")


def alone(recorder: psutil.Process, stop: threading.Event) -> None:
    """The recorder as it is."""


def frozen(recorder: psutil.Process, stop: threading.Event) -> None:
    """Stopped until the end."""
    recorder.send_signal(signal.SIGSTOP)
    stop.wait()
    recorder.send_signal(signal.SIGCONT)


def slow(recorder: psutil.Process, stop: threading.Event) -> None:
    """It runs for 20 ms of every 200."""
    while not stop.is_set():
        recorder.send_signal(signal.SIGSTOP)
        stop.wait(0.18)
        recorder.send_signal(signal.SIGCONT)
        stop.wait(0.02)


DISTURBANCES = {"recorder": alone, "frozen_recorder": frozen, "slow_recorder": slow}


def start(fleet: Fleet, folder: Path, seconds: float, network: list[str]) -> Child:
    """All processes of the mission; the recorder's."""
    words = folder / "processes"
    words.mkdir()
    sets = [part for o in (*OVERRIDES, f"duration_s={seconds}") for part in ("--set", o)]
    world = ["world", str(SCENARIO), "--mode", "realtime", *sets, *network, "-l", "tcp/127.0.0.1:0"]
    fleet.start("world", world, words)
    fleet.start("controller", ["controller", *network, "--patience", "120"], words)
    for i in range(CHASERS):
        fleet.start(f"chaser/{i}", ["chaser", str(i), *network, "--patience", "120"], words)
    fleet.start("recorder", ["record", "--out", str(folder), *network, "--patience", "120"], words)
    return fleet.children[-1]


def fly(
    seconds: float, disturb: Callable[[psutil.Process, threading.Event], None], keep: Path | None = None
) -> Flown:
    """A flight of which ``seconds`` are measured, with the recorder disturbed meanwhile. ``keep``: a folder for its log."""
    namespace = f"realtime-{uuid.uuid4().hex[:8]}"
    if keep is not None:
        keep.mkdir(parents=True)
    with tempfile.TemporaryDirectory() if keep is None else nullcontext(str(keep)) as folder:
        hub, endpoint = open_hub(namespace, LEASE_MS, name="observer", role="analysis")
        fleet, ear, stop = Fleet(), Ear(), threading.Event()
        try:
            for topic in (topics.IMAGE, topics.ACTUATORS):
                hub.subscribe_raw(topic.key.format(chaser="*"), ear.take)
            total_s = SETTLE_S + seconds + 2.0
            network = ["-e", endpoint, "--namespace", namespace, "--lease-ms", str(LEASE_MS)]
            recorder = psutil.Process(start(fleet, Path(folder), total_s, network).process.pid)
            wait_for(ear, round(SETTLE_S * RATE_HZ), fleet, hub)
            disturbing = threading.Thread(target=disturb, args=(recorder, stop))
            disturbing.start()
            before, begun_s = cpu_s(fleet), time.monotonic()
            first = ear.last_tick + 5
            wait_for(ear, first + round(seconds * RATE_HZ), fleet, hub)
            after, took_s = cpu_s(fleet), time.monotonic() - begun_s
            last = ear.last_tick - 10  # whose answers have had their time
            stop.set()
            disturbing.join()
        finally:
            stop.set()
            fleet.end()
            hub.close()
    sent = [key for key in ear.pictures if first <= key[1] <= last]
    latency = [(ear.commands[k] - ear.pictures[k]) / 1e9 for k in sent if k in ear.commands]
    expected = (last - first + 1) * CHASERS
    had = sum((i, tick) in ear.commands for i in range(CHASERS) for tick in range(first, last + 1))
    share = {name: (after[name] - before[name]) / took_s for name in after if name in before}
    return Flown(np.array(latency), last - first + 1, expected - had, share)


def wait_for(ear: Ear, tick: int, fleet: Fleet, hub: Node) -> None:
    """Waits until a tick's pictures have been sent; raises SystemExit when a process ends before."""
    hub.subscribe(topics.END)
    while ear.last_tick < tick:
        received = hub.receive(0.05)
        dead = [c.last_words() for c in fleet.children if c.process.poll() is not None]
        if dead or (received is not None and isinstance(received.message, MissionEnd)):
            raise SystemExit(f"the mission ended at tick {ear.last_tick}: {'; '.join(dead)}")


def cpu_s(fleet: Fleet) -> dict[str, float]:
    times = {c.name: psutil.Process(c.process.pid).cpu_times() for c in fleet.running()}
    return {name: t.user + t.system for name, t in times.items()}


def main() -> None:
    parser = options_of(__doc__)
    parser.add_argument("--seconds", type=float, default=15.0, help="measured in each flight")
    parser.add_argument("--only", choices=DISTURBANCES, help="one of the flights")
    parser.add_argument("--keep", type=Path, help="keep logs and the processes' words here")
    options = parser.parse_args()
    seconds = 5.0 if options.quick else options.seconds
    figures: dict[str, float] = {}
    for name in [options.only] if options.only else DISTURBANCES:
        flown = fly(seconds, DISTURBANCES[name], options.keep and options.keep / name)
        late = int(np.sum(flown.latency_s > LATE_S))
        figures |= {
            f"{name}_p50_s": flown.quantile(0.5),
            f"{name}_p99_s": flown.quantile(0.99),
            f"{name}_max_s": flown.quantile(1.0),
            f"{name}_lost": flown.lost,
            f"{name}_missed": late,
            f"{name}_commands": len(flown.latency_s),
        }
        shares = "  ".join(f"{process} {share:.2f}" for process, share in flown.cpu_share.items())
        p50, p99, most = (1e3 * flown.quantile(q) for q in (0.5, 0.99, 1.0))
        print(
            f"{name:16} exposure to command: p50 {p50:.1f} ms, p99 {p99:.1f} ms, max {most:.1f} ms; "
            f"{flown.lost} of {flown.ticks * CHASERS} lost, {late} later than 33 ms"
        )
        print(f"{'':16} CPU: {shares}  together {sum(flown.cpu_share.values()):.2f}", flush=True)
    for name in [n for n in DISTURBANCES if n != "recorder" and not options.only]:
        figures[f"{name}_p99_ratio"] = figures[f"{name}_p99_s"] / figures["recorder_p99_s"]
        print(f"{name}: p99 {figures[f'{name}_p99_ratio']:.2f} of that with the recorder as it is")
    write_json(options.json, figures)


if __name__ == "__main__":
    main()
