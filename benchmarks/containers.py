# SPDX-License-Identifier: Apache-2.0
"""Faults on containers: ``python benchmarks/containers.py [--quick] [--json FILE] [--only FAULT]``.

Builds the image, then flies a mission by compose.yaml once for each fault, with rights on, each in a project of its own,
and tells how long (wall time) until every process was expected again in a tick, how much simulated time the world flew
without one, and whether the mission was a success. The faults: ``crash`` of a chaser (its process killed, Docker starts it
again), ``kill`` of a chaser (``docker kill``: Docker does not start that again, so ``docker start`` follows after 2 s),
``pause`` of a chaser for 5 s, ``disconnect`` of a chaser from the network for 5 s, ``router`` restarted,
``controller`` crashed. ``--quick``: 120 s of two chasers, small images (a shorter one may end before a container is back).
"""

from __future__ import annotations

import itertools
import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from chaserdock_protocol.recording.log import read_log
from results import ROOT, options_of, write_json

sys.path.insert(0, str(ROOT / "tests"))

from compose_project import Project, compose_command, docker

SMALL = "camera.width_px=640 camera.height_px=480 settling_s=10.0"
LOOSE = "success.steady_position_rms_m=0.5 success.steady_orientation_rms_deg=20.0"
FLYING_TICKS = 60


def crash(container: str) -> None:
    """kill -9 of the chaserdock process; the container's main process ends with it, and Docker starts it again."""
    code = (
        "import os,glob\n"
        "for f in glob.glob('/proc/[0-9]*/cmdline'):\n"
        "    words = open(f, 'rb').read().split(b'\\0')\n"
        "    if b'chaserdock' in words: os.kill(int(f.split('/')[2]), 9)\n"
    )
    docker("exec", container, "python", "-c", code)


def fault_of(name: str) -> tuple[str, Callable[[Project, str], None]]:
    """The service that a fault hits, and what it does to that container."""

    def kill(project: Project, container: str) -> None:
        docker("kill", container)
        time.sleep(2.0)
        docker("start", container)

    def pause(project: Project, container: str) -> None:
        docker("pause", container)
        time.sleep(5.0)
        docker("unpause", container)

    def disconnect(project: Project, container: str) -> None:
        docker("network", "disconnect", project.network(), container)
        time.sleep(5.0)
        docker("network", "connect", project.network(), container)

    faults: dict[str, tuple[str, Callable[[Project, str], None]]] = {
        "none": ("chaser-1", lambda project, container: None),
        "crash": ("chaser-1", lambda project, container: crash(container)),
        "kill": ("chaser-1", kill),
        "pause": ("chaser-1", pause),
        "disconnect": ("chaser-1", disconnect),
        "router": ("router", lambda project, container: docker("restart", "-t", "2", container) and None),
        "controller": ("controller", lambda project, container: crash(container)),
    }
    return faults[name]


FAULTS = ("none", "crash", "kill", "pause", "disconnect", "router", "controller")


def fly(fault: str, scenario: str, overrides: str) -> dict[str, float]:
    """One flight with a fault in it: its figures."""
    project = Project(scenario, overrides)
    service, strike = fault_of(fault)
    try:
        begun_s = time.monotonic()
        up = project.compose("up", "-d", "--no-build")
        if up.returncode != 0:
            raise SystemExit(f"docker compose up failed:\n{up.stdout}{up.stderr}")
        log = project.log()
        project.wait_for_tick(log, FLYING_TICKS)
        struck_ns = time.time_ns()
        strike(project, project.container(service))
        status = project.wait()
        took_s = time.monotonic() - begun_s
        words = project.compose("logs", "--no-color").stdout
    finally:
        project.down()
    if not log.exists():
        raise SystemExit(f"{fault}: no log\n{words[-3000:]}")
    print(f"-- {fault}: status {status}, {log.parent.name}", flush=True)
    return figures(log, struck_ns, status, took_s)


def figures(log: Path, struck_ns: int, status: int, took_s: float) -> dict[str, float]:
    """From the ticks in a log: who was expected, when and for how long not."""
    ticks = [(r.sent_ns, r.message) for r in read_log(log, ["world/tick"])]
    everyone = max(len(t.chasers) for _, t in ticks)
    after = [(ns, t) for ns, t in ticks if ns > struck_ns]
    short = [(ns, t) for ns, t in after if len(t.chasers) < everyone or not t.controller]
    gap_ns = [b[0] - a[0] for a, b in itertools.pairwise(ticks)]
    rate_s = ticks[1][1].sim_time_ns / 1e9 if len(ticks) > 1 else 0.0
    last_short = max((ns for ns, _ in short), default=None)
    back = [ns for ns, _ in after if last_short is not None and ns > last_short]
    whole = len(ticks[-1][1].chasers) == everyone and ticks[-1][1].controller
    summary = json.loads((log.parent / "summary.json").read_text())
    return {
        "success": float(status == 0),
        "all_back": float(whole),
        "recovery_wall_s": (back[0] - struck_ns) / 1e9 if back else 0.0,
        "incomplete_sim_s": len({t.tick for _, t in short}) * rate_s,
        "longest_pause_wall_s": max(gap_ns) / 1e9,
        "collisions": float(summary["collisions"]),
        "mission_wall_s": took_s,
    }


def main() -> None:
    parser = options_of(__doc__)
    parser.add_argument("--only", choices=FAULTS, action="append")
    options = parser.parse_args()
    (ROOT / "runs").mkdir(exist_ok=True)
    built = subprocess.run([*compose_command(), "build", "router"], cwd=ROOT, check=False)
    if built.returncode != 0:
        raise SystemExit("the image cannot be built")
    scenario = "two-chaser-tracking" if options.quick else "four-chaser-docking"
    overrides = f"duration_s=120.0 {SMALL} {LOOSE}" if options.quick else LOOSE
    result: dict[str, Any] = {}
    for fault in options.only or FAULTS:
        for name, value in fly(fault, scenario, overrides).items():
            result[f"{fault}_{name}"] = value
            print(f"{fault}_{name:24} {value:.5g}", flush=True)
    write_json(options.json, result)


if __name__ == "__main__":
    main()
