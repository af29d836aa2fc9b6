# SPDX-License-Identifier: Apache-2.0
"""Memory growth over a long mission: ``endurance`` in lock-step as separate processes.

The recorder rotates its log every simulated hour; finished parts are deleted. The resident set of
each process is sampled twice a simulated hour, at least twelve times. Growth: median of the last
three samples relative to that of the first three.
"""

from __future__ import annotations

import statistics
import tempfile
import time
import uuid
from argparse import ArgumentParser
from pathlib import Path

import psutil
from chaserdock_protocol import topics
from chaserdock_protocol.messages import MissionEnd, Tick
from chaserdock_protocol.transport import Node
from common import ROOT, BenchmarkFailed, Figures, Group, Options, start_mission

from chaserdock.launch.launcher import Fleet, open_hub

SCENARIO = ROOT / "scenarios" / "endurance.toml"
CHASERS = 2
SAMPLE_S = 1800.0
"""Simulated time between samples of the memory."""
LARGEST_GROWTH = 0.05
"""Bar of a process's growth, share."""

Samples = dict[str, list[float]]
"""Resident set, bytes, by process."""


def delete_finished_parts(folder: Path) -> None:
    for part in sorted(folder.glob("mission-*.mcap"))[:-2]:
        part.unlink()


def sample(fleet: Fleet, hub: Node, folder: Path, period_s: float) -> tuple[Samples, bool]:
    """Return samples until the flight ends, and whether it was complete."""
    hub.subscribe(topics.TICK)
    hub.subscribe(topics.END)
    samples: Samples = {c.name: [] for c in fleet.children}
    next_s, begin_s = period_s, time.monotonic()
    while all(c.process.poll() is None for c in fleet.children):
        received = hub.receive(0.2)
        match received.message if received is not None else None:
            case Tick(sim_time_ns=now_ns) if now_ns / 1e9 >= next_s:
                for child in fleet.running():
                    samples[child.name].append(
                        float(psutil.Process(child.process.pid).memory_info().rss)
                    )
                delete_finished_parts(folder)
                shown = "  ".join(f"{name} {v[-1] / 1e6:.1f}" for name, v in samples.items() if v)
                print(
                    f"{next_s / 3600:5.2f} h ({time.monotonic() - begin_s:.0f} s): {shown} MB",
                    flush=True,
                )
                next_s += period_s
            case MissionEnd(complete=complete):
                fleet.wait(60.0)
                return samples, complete and all(c.process.poll() == 0 for c in fleet.children)
    return samples, False


def endurance(options: Options) -> Figures:
    """Fly 24 simulated hours (``--quick``: half an hour): memory growth of each process, at most
    5 %.
    """
    duration_s = 3600.0 * (0.5 if options.quick else options.endurance_h)
    namespace = f"endurance-{uuid.uuid4().hex[:8]}"
    with tempfile.TemporaryDirectory() as name:
        folder, fleet = Path(name), Fleet()
        hub, endpoint = open_hub(namespace, lease_ms=600_000)
        network = ["-e", endpoint, "--namespace", namespace, "--lease", "600"]
        world = ["--set", f"duration_s={duration_s}", "-l", "tcp/127.0.0.1:0"]
        try:
            start_mission(
                fleet, folder, SCENARIO, CHASERS, network, world, ("--rotate-time", "3600")
            )
            samples, complete = sample(fleet, hub, folder, min(SAMPLE_S, duration_s / 12))
            failures = [c.last_line() for c in fleet.children if c.process.poll() != 0]
        finally:
            fleet.end()
            hub.close()
    figures: Figures = {"simulated_s": duration_s, "complete": complete}
    growth = {}
    for name, values in samples.items():
        if values:
            key = name.replace("/", "_")
            growth[name] = statistics.median(values[-3:]) / statistics.median(values[:3]) - 1.0
            figures |= {
                f"{key}_first_bytes": values[0],
                f"{key}_last_bytes": values[-1],
                f"{key}_growth": growth[name],
            }
    if not complete or max(growth.values()) > LARGEST_GROWTH:
        grown = [name for name, share in growth.items() if share > LARGEST_GROWTH]
        raise BenchmarkFailed(f"grown: {grown}; ended: {failures or complete}", figures)
    return figures


def add_options(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--endurance-h", type=float, default=24.0, metavar="H", help="simulated time of endurance"
    )


GROUP = Group({"endurance": endurance}, add_options=add_options, on_request=("endurance",))
