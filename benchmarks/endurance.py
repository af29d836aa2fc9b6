# SPDX-License-Identifier: Apache-2.0
"""Whether anything grows with time: ``python benchmarks/endurance.py [--hours 24] [--quick] [--json FILE]``.

Flies the scenario ``endurance`` in lock-step as separate processes, the recorder rotating its log every simulated
hour (finished parts are deleted), and notes every process' resident set twice a simulated hour, at least twelve
times. Growth is that of the median of the last three samples over the median of the first three. Status 1 when a
process has grown by more than 5 %, or the flight did not reach its end. ``--quick``: two hours.
"""

from __future__ import annotations

import statistics
import sys
import tempfile
import time
import uuid
from pathlib import Path

import psutil
from chaserdock_protocol import topics
from chaserdock_protocol.messages import MissionEnd, Tick
from chaserdock_protocol.transport import Node
from results import options_of, write_json

from chaserdock.launch.launcher import Fleet, open_hub

ROOT = Path(__file__).resolve().parents[1]
SCENARIO = ROOT / "scenarios" / "endurance.toml"
CHASERS = 2
SAMPLE_S = 1800
ALLOWED = 0.05

Samples = dict[str, list[float]]


def start(fleet: Fleet, folder: Path, hours: float, network: list[str]) -> None:
    """World, controller, chasers and a recorder that rotates."""
    words = folder / "processes"
    words.mkdir()
    duration = ["--set", f"duration_s={hours * 3600}"]
    fleet.start("world", ["world", str(SCENARIO), *duration, *network, "-l", "tcp/127.0.0.1:0"], words)
    fleet.start("controller", ["controller", *network, "--timeout", "120"], words)
    for i in range(CHASERS):
        fleet.start(f"chaser/{i}", ["chaser", str(i), *network, "--timeout", "120"], words)
    rotation = ["--rotate-time", "3600"]
    fleet.start("recorder", ["record", "--out", str(folder), *rotation, *network, "--timeout", "120"], words)


def memory_mb(fleet: Fleet) -> dict[str, float]:
    """Resident set of every process of the fleet, MB."""
    return {c.name: psutil.Process(c.process.pid).memory_info().rss / 1e6 for c in fleet.running()}


def delete_finished_parts(folder: Path) -> None:
    for part in sorted(folder.glob("mission-*.mcap"))[:-2]:
        part.unlink()


def watch(fleet: Fleet, hub: Node, folder: Path, every_s: float) -> tuple[Samples, bool]:
    """Samples by process until the flight ends; whether it was complete."""
    hub.subscribe(topics.TICK)
    hub.subscribe(topics.END)
    samples: Samples = {c.name: [] for c in fleet.children}
    next_s, begun_s = every_s, time.monotonic()
    while all(c.process.poll() is None for c in fleet.children):
        received = hub.receive(0.2)
        match received.message if received is not None else None:
            case Tick(sim_time_ns=now_ns) if now_ns / 1e9 >= next_s:
                for name, mb in memory_mb(fleet).items():
                    samples[name].append(mb)
                delete_finished_parts(folder)
                shown = "  ".join(f"{name} {values[-1]:.1f}" for name, values in samples.items())
                print(f"{next_s / 3600:5.2f} h ({time.monotonic() - begun_s:.0f} s): {shown} MB", flush=True)
                next_s += every_s
            case MissionEnd(complete=complete):
                fleet.wait(60.0)
                return samples, complete and all(c.process.poll() == 0 for c in fleet.children)
    return samples, False


def growth(values: list[float]) -> float:
    """Median of the last three samples over the median of the first three, less one."""
    return statistics.median(values[-3:]) / statistics.median(values[:3]) - 1.0


def main() -> None:
    parser = options_of(__doc__)
    parser.add_argument("--hours", type=float, default=24.0, help="simulated")
    options = parser.parse_args()
    hours = 2.0 if options.quick else options.hours
    namespace = f"endurance-{uuid.uuid4().hex[:8]}"
    with tempfile.TemporaryDirectory() as folder:
        hub, endpoint = open_hub(namespace, lease_ms=600_000)
        fleet = Fleet()
        begun_s = time.monotonic()
        try:
            start(fleet, Path(folder), hours, ["-e", endpoint, "--namespace", namespace, "--lease", "600"])
            samples, complete = watch(fleet, hub, Path(folder), min(SAMPLE_S, hours * 3600 / 12))
            said = [c.last_line() for c in fleet.children if c.process.poll() != 0]
        finally:
            fleet.end()
            hub.close()
    grown = {name: growth(values) for name, values in samples.items() if values}
    for name, share in grown.items():
        values = samples[name]
        print(f"{name:12} {values[0]:6.1f} -> {values[-1]:6.1f} MB, largest {max(values):6.1f}; {share:+.2%}")
    print(f"{hours:g} h flown in {time.monotonic() - begun_s:.0f} s; complete: {complete}", *said, sep="\n")
    figures: dict[str, float] = {"hours": hours, "complete": float(complete)}
    for name, share in grown.items():
        key = name.replace("/", "_")
        figures |= {
            f"{key}_first_MB": samples[name][0],
            f"{key}_last_MB": samples[name][-1],
            f"{key}_growth": share,
        }
    write_json(options.json, figures)
    sys.exit(0 if complete and max(grown.values()) <= ALLOWED else 1)


if __name__ == "__main__":
    main()
