# SPDX-License-Identifier: Apache-2.0
"""Cost of a tick with 1 to 16 chasers, by part: the first N of ``sixteen-chasers``.

In one process (``chaserdock.experiments.in_process``) each part is timed by the thread's processor
time, medians over ticks: render, physics, perceive, fuse, solve, guide (references, prediction,
messages). Then ``chaserdock run`` flies the same mission in lock-step: wall time per tick, and
processor time of its processes. ``record`` is the recorder's; ``transport`` is what world, chasers
and controller use beyond the parts: encoding, Zenoh, decoding and waiting.
"""

from __future__ import annotations

import subprocess
import tempfile
import time
from argparse import ArgumentParser
from collections import defaultdict
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from chaserdock_agents.chaser.vision import Vision
from chaserdock_protocol import topics
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_world.rendering.cameras import Cameras
from common import ROOT, Figures, Group, Options, chaserdock_command

from chaserdock.experiments.in_process import InProcessMission
from chaserdock.experiments.perception import RenderedImages
from chaserdock.logs import open_log

SCENARIO = ROOT / "scenarios" / "sixteen-chasers.toml"
WARM_TICKS = 15
"""Excluded from every figure: first calls and the estimator's start."""
SAMPLE_S = 0.2
"""Time between samples of the processor time of processes."""
TOLERANT = (
    "settling_s=1.0",
    "success.steady_position_rms_m=0.3",
    "success.steady_orientation_rms_deg=20.0",
)
PARTS = ("render", "physics", "perceive", "fuse", "solve", "guide")


def first(n: int) -> str:
    """Return the scenario's text with its first ``n`` chasers."""
    head, *chasers = SCENARIO.read_text(encoding="utf-8").split("[[chasers]]")
    return "[[chasers]]".join([head, *chasers[:n]])


class Clock:
    """Processor time of this thread in wrapped functions, by part; nested parts are not counted
    twice.
    """

    def __init__(self) -> None:
        self.spent: dict[str, float] = defaultdict(float)
        self._inside: list[float] = []

    def wrap(self, owner: Any, name: str, part: str) -> None:
        """Replace ``owner.name`` by a timed version."""
        work: Callable[..., Any] = getattr(owner, name)

        def timed(*args: Any, **more: Any) -> Any:
            begin_s = time.thread_time()
            self._inside.append(0.0)
            try:
                return work(*args, **more)
            finally:
                took = time.thread_time() - begin_s
                self.spent[part] += took - self._inside.pop()
                if self._inside:
                    self._inside[-1] += took

        setattr(owner, name, timed)


def parts_of(scenario: Scenario, ticks: int) -> dict[str, float]:
    """Return median seconds of processor time per tick by part, in one process."""
    clock = Clock()
    kept = [(Vision, "look"), (Cameras, "image")]
    before = [getattr(owner, name) for owner, name in kept]
    for (owner, name), part in zip(kept, ("perceive", "render"), strict=True):
        clock.wrap(owner, name, part)
    mission = InProcessMission(scenario, RenderedImages(scenario))
    clock.wrap(mission, "advance", "physics")
    clock.wrap(mission.controller, "step", "guide")
    clock.wrap(mission.controller.estimation, "run", "fuse")
    clock.wrap(mission.controller.planning.solver, "solve", "solve")
    rows = []
    for _ in range(WARM_TICKS + ticks):
        clock.spent.clear()
        mission.step()
        rows.append([clock.spent[part] for part in PARTS])
    mission.close()
    for (owner, name), work in zip(kept, before, strict=True):
        setattr(owner, name, work)
    return dict(zip(PARTS, np.median(rows[WARM_TICKS:], axis=0).tolist(), strict=True))


def cpu_s_of(launcher: psutil.Process) -> dict[str, float]:
    """Return the processor time, s, of the mission's processes so far by command."""
    used: dict[str, float] = defaultdict(float)
    for child in launcher.children(recursive=True):
        with suppress(psutil.NoSuchProcess, psutil.AccessDenied):
            words, times = " ".join(child.cmdline()).split(), child.cpu_times()
            if "chaserdock" in words:
                used[words[words.index("chaserdock") + 1]] += times.user + times.system
    return used


def fly(n: int, duration_s: float) -> dict[str, float]:
    """Run the mission with ``n`` chasers; return wall time and processor time of each command, s
    per tick.

    Raise SystemExit if it fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder) / f"{n}-chasers.toml", Path(folder) / "run"
        path.write_text(first(n), encoding="utf-8")
        overrides = (f"duration_s={duration_s}", *TOLERANT)
        changes = [word for override in overrides for word in ("--set", override)]
        command = chaserdock_command("run", path, "--out", out, "-q", *changes)
        with (Path(folder) / "output.txt").open("w+") as output:
            launcher = psutil.Popen(command, cwd=ROOT, stdout=output, stderr=subprocess.STDOUT)
            samples = []
            while launcher.poll() is None:
                with suppress(psutil.NoSuchProcess):
                    samples.append((time.time_ns(), cpu_s_of(launcher)))
                time.sleep(SAMPLE_S)
            if launcher.returncode != 0:
                output.seek(0)
                raise SystemExit(f"the flight of {n} failed:\n{output.read()}")
        sent_ns = [record.sent_ns for record in open_log(out).records(topics.TICK)]
    begin_ns, end_ns, ticks = sent_ns[WARM_TICKS], sent_ns[-1], len(sent_ns) - 1 - WARM_TICKS
    figures = {"wall": (end_ns - begin_ns) / 1e9 / ticks}
    times_ns = np.array([t for t, _ in samples], dtype=float)
    for kind in ("world", "chaser", "controller", "record"):
        # Processes that have exited keep their last sample.
        used = np.maximum.accumulate([s.get(kind, 0.0) for _, s in samples])
        from_s, to_s = np.interp([begin_ns, end_ns], times_ns, used)
        figures[kind] = float(to_s - from_s) / ticks
    return figures


def measure(n: int, ticks: int, duration_s: float) -> dict[str, float]:
    """Return seconds per tick with ``n`` chasers by part; without lock-step mission if
    ``duration_s`` is 0.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scenario.toml"
        path.write_text(first(n), encoding="utf-8")
        out = parts_of(load_scenario(path), ticks)
    if not duration_s:
        return out | {"sum": sum(out.values())}
    flown = fly(n, duration_s)
    processes = flown["world"] + flown["chaser"] + flown["controller"]
    out["transport"] = processes - sum(out.values())
    out["record"] = flown["record"]
    out["cpu"] = processes + flown["record"]
    out["wall"] = flown["wall"]
    return out


def scale(options: Options) -> Figures:
    """Measure a tick with 1 to 16 chasers by part, and missions in lock-step."""
    sizes = options.chasers or ([1, 4] if options.quick else [1, 2, 4, 8, 16])
    names = (*PARTS, *(("transport", "record", "cpu", "wall") if options.seconds else ("sum",)))
    print("ms per tick; cpu: all processes; wall: in lock-step, on this machine")
    print(f"{'N':>3}" + "".join(f"{name:>11}" for name in names))
    figures: Figures = {}
    for n in sizes:
        row = measure(n, options.ticks, options.seconds)
        print(f"{n:3d}" + "".join(f"{1e3 * row[name]:11.2f}" for name in names), flush=True)
        figures |= {f"n{n}_{name}_s_per_tick": row[name] for name in names}
    if {4, 16} <= set(sizes):
        figures |= {
            f"{name}_16_over_4": figures[f"n16_{name}_s_per_tick"]
            / figures[f"n4_{name}_s_per_tick"]
            for name in names
        }
    return figures


def add_options(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--chasers",
        type=int,
        nargs="+",
        choices=range(1, 17),
        metavar="N",
        help="numbers of chasers of scale",
    )
    parser.add_argument("--ticks", type=int, default=60, help="ticks that scale times")
    parser.add_argument(
        "--seconds",
        type=float,
        default=12.0,
        help="simulated time of the missions of scale; 0: no missions",
    )


GROUP = Group({"scale": scale}, add_options=add_options)
