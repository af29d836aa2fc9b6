# SPDX-License-Identifier: Apache-2.0
"""Real time: ``four-chaser-docking`` with ticks and images at 30 Hz, 640 x 480, in separate
processes on this machine.

``image_to_command``: from the sending of an image to the sending of the actuator command of that
tick, by the senders' time stamps; the images of a tick are sent together, as by cameras that expose
at once. ``tick_to_command``: the same from the sending of the tick, before the images are rendered.

Each part is a flight in which one process is disturbed: the recorder, or a viewer with one client.
Windows of ``--window-s`` alternate between ``undisturbed``, ``frozen`` (SIGSTOP) and ``slow`` (runs
a tenth of the time), so that other load on the machine affects all conditions. ``lost``: ticks of a
chaser without a command of the controller; ``late``: commands later than 33 ms; ``p99_ratio``: 99th
percentile relative to the undisturbed windows. Processor time is a share of one core.
"""

from __future__ import annotations

import asyncio
import os
import signal
import tempfile
import threading
import time
import uuid
from argparse import ArgumentParser
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
from common import ROOT, Figures, Group, Options, percentiles, start_mission
from websockets.asyncio.client import connect

from chaserdock.launch.launcher import Fleet, free_port, open_hub
from chaserdock.viewer.address import TOKEN_VARIABLE, page_token

SCENARIO = ROOT / "scenarios" / "four-chaser-docking.toml"
CHASERS = 4
RATE_HZ = 30
SETTLE_S = 6.0
"""Time until processes have imported and compiled what they use."""
PAUSE_S = 1.0
"""Between windows: a stopped process catches up."""
LATE_S = 0.033
"""A tick at 30 Hz: a later command is for the next one."""
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
    """Common fields of ticks, images and actuator commands."""

    tick: int
    chaser: int = -1
    source: str = ""


_head = msgspec.msgpack.Decoder(Head)


@dataclass
class LatencyObserver:
    """Sending times (wall clock, ns) of ticks, and of images and commands by chaser and tick."""

    ticks: dict[int, int] = field(default_factory=dict)
    images: dict[tuple[int, int], int] = field(default_factory=dict)
    commands: dict[tuple[int, int], int] = field(default_factory=dict)
    last_tick: int = -1

    def receive(self, raw: RawSample) -> None:
        """Note a message; called on a thread of Zenoh. Decodes as little as possible: the mission
        shares the cores.
        """
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
    """A span of ticks under one condition, and the share of a core that each process used."""

    condition: str
    first: int
    last: int
    cpu_share: dict[str, float]


def undisturbed(process: psutil.Process, stop: threading.Event) -> None:
    """Do nothing."""


def frozen(process: psutil.Process, stop: threading.Event) -> None:
    """Stop the process until the end of the window."""
    process.send_signal(signal.SIGSTOP)
    stop.wait()
    process.send_signal(signal.SIGCONT)


def slow(process: psutil.Process, stop: threading.Event) -> None:
    """Let the process run for 20 ms of every 200 ms."""
    while not stop.is_set():
        process.send_signal(signal.SIGSTOP)
        stop.wait(0.18)
        process.send_signal(signal.SIGCONT)
        stop.wait(0.02)


CONDITIONS = {"undisturbed": undisturbed, "frozen": frozen, "slow": slow}
ROUND = ("undisturbed", "frozen", "undisturbed", "slow")


async def read_viewer(port: int, token: str) -> None:
    """Read everything that the viewer sends, as a browser would."""
    offered = [websockets.Subprotocol(f"viser-v{viser.__version__}")]
    while True:
        try:
            async with connect(
                f"ws://127.0.0.1:{port}/{token}", subprotocols=offered, max_size=None
            ) as socket:
                async for _ in socket:
                    pass
        except (OSError, websockets.WebSocketException):
            await asyncio.sleep(0.2)  # the viewer has not started yet


def measure_window(
    observer: LatencyObserver,
    fleet: Fleet,
    hub: Node,
    process: psutil.Process,
    condition: str,
    seconds: float,
) -> Window:
    """Measure one window with the process under a condition."""
    stop = threading.Event()
    disturbance = threading.Thread(target=CONDITIONS[condition], args=(process, stop))
    disturbance.start()
    try:
        first = observer.last_tick + 3  # sent after the condition began
        before, begin_s = cpu_s(fleet), time.monotonic()
        wait_for_images(observer, first + round(seconds * RATE_HZ), fleet, hub)
        after, took_s = cpu_s(fleet), time.monotonic() - begin_s
        last = observer.last_tick - 5  # its commands have been sent
    finally:
        stop.set()
        disturbance.join()
    share = {name: (after[name] - before[name]) / took_s for name in after if name in before}
    return Window(condition, first, last, share)


def fly(part: str, seconds: float, rounds: int, keep: Path | None) -> Figures:
    """Fly with one disturbed process. ``keep``: folder for the log."""
    namespace = f"realtime-{uuid.uuid4().hex[:8]}"
    if keep is not None:
        keep.mkdir(parents=True)
    windows: list[Window] = []
    with tempfile.TemporaryDirectory() if keep is None else nullcontext(str(keep)) as folder:
        hub, endpoint = open_hub(namespace, LEASE_MS, name="observer", role="analysis")
        fleet, observer = Fleet(), LatencyObserver()
        try:
            hub.subscribe(topics.END)
            for topic in (topics.TICK, topics.IMAGE, topics.ACTUATORS):
                hub.subscribe_raw(topic.key.format(chaser="*"), observer.receive)
            duration_s = SETTLE_S + rounds * len(ROUND) * (seconds + PAUSE_S) + 5.0
            network = ["-e", endpoint, "--namespace", namespace, "--lease", str(LEASE_MS / 1000)]
            changes = [
                word for o in (*OVERRIDES, f"duration_s={duration_s}") for word in ("--set", o)
            ]
            world = ["--mode", "realtime", *changes, "-l", "tcp/127.0.0.1:0"]
            output = start_mission(fleet, Path(folder), SCENARIO, CHASERS, network, world)
            if part == "viewer":
                port, token = free_port(), page_token()
                os.environ[TOKEN_VARIABLE] = token
                fleet.start("viewer", ["view", *network, "--port", str(port)], output)
                threading.Thread(
                    target=lambda: asyncio.run(read_viewer(port, token)), daemon=True
                ).start()
            process = psutil.Process(next(c.process.pid for c in fleet.children if c.name == part))
            wait_for_images(observer, round(SETTLE_S * RATE_HZ), fleet, hub)
            for condition in ROUND * rounds:
                windows.append(measure_window(observer, fleet, hub, process, condition, seconds))
                wait_for_images(observer, observer.last_tick + round(PAUSE_S * RATE_HZ), fleet, hub)
        finally:
            fleet.end()
            hub.close()
    out: Figures = {}
    for condition in CONDITIONS:
        chosen = [w for w in windows if w.condition == condition]
        out |= figures(f"{part}_{condition}", chosen, observer)
    reference = out[f"{part}_undisturbed_image_to_command_p99_s"]
    for condition in ("frozen", "slow"):
        out[f"{part}_{condition}_p99_ratio"] = (
            out[f"{part}_{condition}_image_to_command_p99_s"] / reference
        )
    return out


def figures(name: str, windows: list[Window], observer: LatencyObserver) -> Figures:
    """Return the figures of all windows of one condition."""
    keys = [
        (i, tick) for w in windows for tick in range(w.first, w.last + 1) for i in range(CHASERS)
    ]
    sent = {key: observer.commands[key] for key in keys if key in observer.commands}
    latency_s = np.array(
        [(sent[k] - observer.images[k]) / 1e9 for k in sent if k in observer.images]
    )
    tick_s = np.array(
        [(sent[k] - observer.ticks[k[1]]) / 1e9 for k in sent if k[1] in observer.ticks]
    )
    out: Figures = {
        **percentiles(latency_s, f"{name}_image_to_command", "s", "median", "p99", "max"),
        **percentiles(tick_s, f"{name}_tick_to_command", "s", "median", "p99"),
        f"{name}_commands": len(latency_s),
        f"{name}_lost": len(keys) - len(sent),
        f"{name}_late": int(np.sum(latency_s > LATE_S)),
    }
    for process in windows[0].cpu_share:
        share = float(np.mean([w.cpu_share[process] for w in windows]))
        out[f"{name}_cpu_{process.replace('/', '_')}_s_per_s"] = share
    return out


def wait_for_images(observer: LatencyObserver, tick: int, fleet: Fleet, hub: Node) -> None:
    """Wait until the images of a tick were sent. Raise SystemExit if the mission ends before."""
    while observer.last_tick < tick:
        received = hub.receive(0.05)
        exited = [c.last_line() for c in fleet.children if c.process.poll() is not None]
        if exited or (received is not None and isinstance(received.message, MissionEnd)):
            raise SystemExit(f"the mission ended at tick {observer.last_tick}: {'; '.join(exited)}")


def cpu_s(fleet: Fleet) -> dict[str, float]:
    """Return the processor time, s, of each process."""
    times = {c.name: psutil.Process(c.process.pid).cpu_times() for c in fleet.running()}
    return {name: t.user + t.system for name, t in times.items()}


def measure(process: str, options: Options) -> Figures:
    """Return medians over the flights in which a process is disturbed."""
    flights, rounds = (1, 1) if options.quick else (options.flights or 1, options.rounds)
    flown = []
    for number in range(flights):
        keep = options.keep and options.keep / f"{process}-{number}"
        flown.append(fly(process, options.window_s, rounds, keep))
    return {name: float(np.median([f[name] for f in flown])) for name in flown[0]}


def recorder(options: Options) -> Figures:
    """Time commands while the recorder is undisturbed, frozen, slow."""
    return measure("recorder", options)


def viewer(options: Options) -> Figures:
    """Time commands while a viewer with one client is undisturbed, frozen, slow."""
    return measure("viewer", options)


def add_options(parser: ArgumentParser) -> None:
    parser.add_argument("--window-s", type=float, default=5.0, help="of realtime: one condition")
    parser.add_argument("--rounds", type=int, default=3, help="of realtime: four windows each")
    parser.add_argument("--keep", type=Path, metavar="DIR", help="of realtime: keep logs, outputs")


GROUP = Group({"realtime-recorder": recorder, "realtime-viewer": viewer}, ("flights",), add_options)
