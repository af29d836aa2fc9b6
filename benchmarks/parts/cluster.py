# SPDX-License-Identifier: Apache-2.0
"""Random seeds as one job on two Dask workers of this machine, which are killed meanwhile."""

from __future__ import annotations

import argparse
import json
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
from common import (
    ROOT,
    BenchmarkFailed,
    Figures,
    Group,
    Options,
    chaserdock_command,
    read_lines,
    seeds_of,
)

from chaserdock.exit_codes import DONE, FAILED
from chaserdock.launch.signals import interrupts
from chaserdock.simulation.flight import SimulationResult
from chaserdock.simulation.seed_table import opened_table
from chaserdock.simulation.seeds import SeedOptions, fly_seed

SCENARIO = "fault-drill"
_WORKERS = ("worker 0", "worker 1")
_CLIENT_EVERY = 5
"""One kill in so many is of the client."""
_AGAIN_S = 2.0
"""Time, s, that a killed worker is away: the other one flies on alone meanwhile."""
_COMPARED = 3
"""Seeds that are flown again in this process."""


class Cluster:
    """A scheduler, two workers and a client that flies seeds; ``processor_s``: time used by the
    workers and what they started, also by those that were killed, s.
    """

    def __init__(self, folder: Path, seeds: range, table: Path) -> None:
        self._file, self._log = folder / "scheduler.json", (folder / "log").open("ab")
        self._seeds, self._table = f"{seeds[0]}:{seeds[-1]}", table
        self._processes: dict[str, subprocess.Popen[bytes]] = {}
        self._used: dict[tuple[int, float], float] = {}
        self._dask("scheduler", "--host", "127.0.0.1", "--port", "0")
        while not self._file.exists():
            time.sleep(0.1)
        for name in _WORKERS:
            self.start(name)

    def _dask(self, name: str, *arguments: str) -> None:
        program = f"distributed.cli.dask_{name.partition(' ')[0]}"
        shared = ("--scheduler-file", str(self._file), "--no-dashboard")
        self._run(name, [sys.executable, "-m", program, *shared, *arguments])

    def _run(self, name: str, command: list[str]) -> None:
        self._processes[name] = subprocess.Popen(
            command, cwd=ROOT, stdin=subprocess.DEVNULL, stdout=self._log, stderr=self._log
        )

    def start(self, name: str) -> None:
        """Start a worker or the client."""
        if name in _WORKERS:
            self._dask(name, "--nthreads", "1", "--no-nanny")
            return
        address = json.loads(self._file.read_text())["address"]
        arguments = ["simulate", SCENARIO, "--seeds", self._seeds, "--no-shrink"]
        where = ["--cluster", address, "--results", self._table]
        self._run(name, chaserdock_command(*arguments, *where))

    def kill(self, name: str) -> None:
        """Kill a process at once."""
        self._processes[name].send_signal(signal.SIGKILL)
        self._processes[name].wait()

    def status(self, name: str) -> int | None:
        """Return the exit status of a process, None while it runs."""
        return self._processes[name].poll()

    def look(self) -> None:
        """Count the processor time of all that runs on the workers; at least once a second, as it
        is lost with its process.
        """
        for name in _WORKERS:
            with suppress(psutil.Error):
                worker = psutil.Process(self._processes[name].pid)
                for process in (worker, *worker.children(recursive=True)):
                    times = process.cpu_times()
                    key = (process.pid, process.create_time())
                    self._used[key] = times.user + times.system

    @property
    def processor_s(self) -> float:
        return sum(self._used.values())

    def close(self) -> None:
        """End all processes at once: a worker without its scheduler would wait for it."""
        for process in self._processes.values():
            process.kill()
        for process in self._processes.values():
            process.wait()
        self._log.close()


def fly_job(cluster: Cluster, kill_s: float, draw: random.Random) -> Counter[str]:
    """Run the client to its end, which kills and restarts workers and client at random intervals of
    mean ``kill_s`` (none if 0). Returns the number of kills.
    """
    kills, away = Counter[str](), dict[str, float]()
    cluster.start("client")
    next_s = time.monotonic() + draw.expovariate(1.0 / kill_s) if kill_s else float("inf")
    while cluster.status("client") is None:
        time.sleep(0.5)
        now_s = time.monotonic()
        for name in [name for name, back_s in away.items() if now_s >= back_s]:
            cluster.start(name)
            del away[name]
        cluster.look()
        if now_s < next_s:
            continue
        next_s = now_s + draw.expovariate(1.0 / kill_s)
        name = draw.choice(_WORKERS) if kills.total() % _CLIENT_EVERY else "client"
        if name in away or cluster.status(name) is not None:
            continue
        cluster.kill(name)
        kills[name.partition(" ")[0]] += 1
        if name == "client":
            cluster.start(name)
        else:
            away[name] = now_s + _AGAIN_S
    for name in away:
        cluster.start(name)
    return kills


def results_in(table: Path) -> dict[int, SimulationResult]:
    """Return what a table has by seed, of the sources that fly now."""
    with opened_table(table, SeedOptions(SCENARIO)) as found:
        return found.results


def on_cluster(options: Options) -> Figures:
    """Fly 10,000 random seeds (``--quick``: 20) as one job on two Dask workers, which are killed
    and restarted meanwhile, as is the client. Each must be once in the table, ``--results``, and
    equal to a flight in this process, of which a few are made.
    """
    seeds, draw = seeds_of(options, 10_000, 20), random.Random(options.first)
    with interrupts(), tempfile.TemporaryDirectory(prefix="chaserdock-cluster-") as name:
        folder, kills = Path(name), Counter[str]()
        table = (options.results or folder / "seeds.jsonl").absolute()
        before = results_in(table)
        left, begin_s = len(set(seeds) - before.keys()), time.monotonic()
        cluster = Cluster(folder, seeds, table)
        try:
            while left:
                kills += fly_job(cluster, options.kill_s, draw)
                still = len(set(seeds) - results_in(table).keys())
                if cluster.status("client") not in (DONE, FAILED) or still == left:
                    raise SystemExit(f"the client failed:\n{(folder / 'log').read_text()}")
                left = still
        finally:
            cluster.close()
        wall_h, processor_h = (time.monotonic() - begin_s) / 3600.0, cluster.processor_s / 3600.0
        results, rows = results_in(table), Counter(map(_identity, read_lines(table)))
    compared = draw.sample(seeds, _COMPARED)
    flown = len(seeds) - len(before.keys() & set(seeds))
    figures: Figures = {
        "seeds": len(seeds),
        "rows_twice": sum(number > 1 for number in rows.values()),
        "compared": len(compared),
        "compared_differ": sum(
            results[seed] != fly_seed(SeedOptions(SCENARIO), seed) for seed in compared
        ),
        "violated": sum(bool(results[seed].violations) for seed in seeds),
        "flown_now": flown,
        "kills_of_workers": kills["worker"],
        "kills_of_client": kills["client"],
        "processor_h": processor_h,
        "wall_h": wall_h,
    }
    if flown:
        figures["seeds_per_core_h"] = flown / processor_h
    if figures["rows_twice"] or figures["compared_differ"]:
        raise BenchmarkFailed("a seed is twice in the table, or differs there", figures)
    return figures


def _identity(row: dict[str, Any]) -> tuple[str, int]:
    return row["flown"], row["seed"]


def _add_options(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--kill-s",
        type=float,
        default=60.0,
        metavar="S",
        help="cluster: mean time between kills, s (default: 60; 0: none)",
    )


GROUP = Group(
    {"cluster": on_cluster},
    ("flights", "first", "results"),
    _add_options,
    on_request=("cluster",),
)
