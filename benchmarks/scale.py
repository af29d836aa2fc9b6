# SPDX-License-Identifier: Apache-2.0
"""Cost of a tick with 1 to 16 chasers, by part: ``python benchmarks/scale.py [--quick] [--json FILE]``.

The first N chasers of ``sixteen-chasers``. In one process (``chaserdock.evaluation.in_process``) each part is timed by
the thread's processor time, medians over ticks: render, physics, perceive, fuse, solve, guide (references, prediction,
messages). Then ``chaserdock run`` flies the same mission in lock-step: wall time per tick, and processor time of its
processes. ``record`` is the recorder's; ``transport`` is what world, chasers and controller use beyond the parts:
encoding, Zenoh, decoding and waiting. ``--quick``: 1, 2 and 4 chasers. ``--chasers`` (repeatable) chooses;
``--parts-only`` omits the lock-step missions.
"""

from __future__ import annotations

import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from chaserdock_protocol import topics
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_world.rendering.cameras import Cameras
from results import options_of, write_json

from chaserdock.evaluation import perception
from chaserdock.evaluation.in_process import InProcessMission
from chaserdock.evaluation.perception import RenderedImages
from chaserdock.logs import open_log

ROOT = Path(__file__).resolve().parents[1]
SCENARIO = ROOT / "scenarios" / "sixteen-chasers.toml"
WARM_TICKS = 15
"""Excluded from every figure: first calls and the estimator's start."""
SAMPLE_S = 0.2
PARTS = ("render", "physics", "perceive", "fuse", "solve", "guide")


def first(n: int) -> str:
    """Return the scenario's text with its first ``n`` chasers."""
    head, *chasers = SCENARIO.read_text(encoding="utf-8").split("[[chasers]]")
    return "[[chasers]]".join([head, *chasers[:n]])


class Clock:
    """Processor time of this thread in wrapped functions, by part; nested parts are not counted twice."""

    def __init__(self) -> None:
        self.spent: dict[str, float] = defaultdict(float)
        self._inside: list[float] = []

    def wrap(self, owner: Any, name: str, part: str) -> None:
        """Replace ``owner.name`` by a timed version."""
        work: Callable[..., Any] = getattr(owner, name)

        def timed(*args: Any, **more: Any) -> Any:
            begun = time.thread_time()
            self._inside.append(0.0)
            try:
                return work(*args, **more)
            finally:
                took = time.thread_time() - begun
                self.spent[part] += took - self._inside.pop()
                if self._inside:
                    self._inside[-1] += took

        setattr(owner, name, timed)


def parts_of(scenario: Scenario, ticks: int) -> dict[str, float]:
    """Return median seconds of processor time per tick by part, in one process."""
    clock = Clock()
    kept = [(perception, "look"), (Cameras, "image")]
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


def processes_of(launcher: psutil.Process) -> dict[str, float]:
    """Return the processor time, s, of the mission's processes so far."""
    used: dict[str, float] = {}
    for child in launcher.children():
        try:
            words, times = child.cmdline(), child.cpu_times()
        except (psutil.NoSuchProcess, psutil.AccessDenied):
            continue
        if "chaserdock" in words:
            name = words[words.index("chaserdock") + 1]
            used[name] = used.get(name, 0.0) + times.user + times.system
    return used


def fly(n: int, flown_s: float) -> dict[str, float]:
    """Run the mission with ``n`` chasers: seconds of wall time per tick, and of processor time by kind of process.

    Raises SystemExit if it fails.
    """
    with tempfile.TemporaryDirectory() as folder:
        path, out = Path(folder) / f"{n}-chasers.toml", Path(folder) / "run"
        path.write_text(first(n), encoding="utf-8")
        rules = [
            f"duration_s={flown_s}",
            "settling_s=1.0",
            "success.steady_position_rms_m=0.3",
            "success.steady_orientation_rms_deg=20.0",
        ]
        command = [sys.executable, "-m", "chaserdock", "run", str(path), "--out", str(out), "-q"]
        command += [item for rule in rules for item in ("--set", rule)]
        said = (Path(folder) / "said.txt").open("w+")
        done = subprocess.Popen(command, cwd=ROOT, stdout=said, stderr=subprocess.STDOUT)
        launcher, samples = psutil.Process(done.pid), []
        while done.poll() is None:
            try:
                samples.append((time.time_ns(), processes_of(launcher)))
            except psutil.NoSuchProcess:
                break
            time.sleep(SAMPLE_S)
        if done.wait() != 0:
            said.seek(0)
            raise SystemExit(f"the flight of {n} failed:\n{said.read()}")
        sent = [record.sent_ns for record in open_log(out).records(topics.TICK)]
    begun, ended, ticks = sent[WARM_TICKS], sent[-1], len(sent) - 1 - WARM_TICKS
    figures = {"wall": (ended - begun) / 1e9 / ticks}
    at = np.array([t for t, _ in samples], dtype=float)
    for kind in ("world", "chaser", "controller", "record"):
        # Processes that have ended keep their last sample.
        used = np.maximum.accumulate([s.get(kind, 0.0) for _, s in samples])
        from_s, to_s = np.interp([begun, ended], at, used)
        figures[kind] = float(to_s - from_s) / ticks
    return figures


def measure(n: int, ticks: int, flown_s: float | None) -> dict[str, float]:
    """Return seconds per tick with ``n`` chasers by part; without lock-step mission if ``flown_s`` is None."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "scenario.toml"
        path.write_text(first(n), encoding="utf-8")
        out = parts_of(load_scenario(path), ticks)
    if flown_s is None:
        return out | {"sum": sum(out.values())}
    flown = fly(n, flown_s)
    processes = flown["world"] + flown["chaser"] + flown["controller"]
    out["transport"] = processes - sum(out.values())
    out["record"] = flown["record"]
    out["cpu"] = processes + flown["record"]
    out["wall"] = flown["wall"]
    return out


def main() -> None:
    parser = options_of(__doc__)
    parser.add_argument("--chasers", type=int, action="append", choices=range(1, 17), metavar="N")
    parser.add_argument("--ticks", type=int, default=60, help="ticks timed in one process")
    parser.add_argument(
        "--seconds", type=float, default=12.0, help="simulated time of the lock-step missions"
    )
    parser.add_argument("--parts-only", action="store_true", help="no lock-step missions")
    options = parser.parse_args()
    sizes = options.chasers or ([1, 2, 4] if options.quick else [1, 2, 4, 8, 16])
    flown_s = None if options.parts_only else options.seconds
    names = (*PARTS, *(("sum",) if flown_s is None else ("transport", "record", "cpu", "wall")))
    legend = "; cpu: all processes; wall: in lock-step, on this machine"
    print("ms per tick" + ("" if flown_s is None else legend))
    print(f"{'N':>3}" + "".join(f"{name:>11}" for name in names))
    result: dict[str, float] = {}
    for n in sizes:
        row = measure(n, options.ticks, flown_s)
        print(f"{n:3d}" + "".join(f"{1e3 * row[name]:11.2f}" for name in names), flush=True)
        result |= {f"n{n}_{name}_s": row[name] for name in names}
    for name in names:
        if {f"n4_{name}_s", f"n16_{name}_s"} <= result.keys():
            result[f"{name}_16_over_4"] = result[f"n16_{name}_s"] / result[f"n4_{name}_s"]
            print(f"{name}: 16 chasers over 4: {result[f'{name}_16_over_4']:.2f}")
    write_json(options.json, result)


if __name__ == "__main__":
    main()
