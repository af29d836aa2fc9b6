# SPDX-License-Identifier: Apache-2.0
"""Failures of containers: a mission by compose.yaml for each fault, with access control, each in
its own project. Needs Docker.

Figures: wall time until every process is expected again, simulated time without one, and whether
the mission was a success.
"""

from __future__ import annotations

import itertools
import json
import subprocess
import time
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

from chaserdock_protocol.recording.log import read_log
from common import ROOT, BenchmarkFailed, Figures, Group, Options, described
from compose_project import Project, compose_command, docker

SMALL = "camera.width_px=640 camera.height_px=480 settling_s=10.0"
TOLERANT = "success.steady_position_rms_m=0.5 success.steady_orientation_rms_deg=20.0"
FAULT_AT_TICK = 60
"""All containers have been up for some seconds."""


def crash(container: str) -> None:
    """Kill the chaserdock process; the container's main process ends with it, and Docker restarts
    the container.
    """
    code = (
        "import os,glob\n"
        "for f in glob.glob('/proc/[0-9]*/cmdline'):\n"
        "    arguments = open(f, 'rb').read().split(b'\\0')\n"
        "    if b'chaserdock' in arguments: os.kill(int(f.split('/')[2]), 9)\n"
    )
    docker("exec", container, "python", "-c", code)


def kill(project: Project, container: str) -> None:
    """Kill the container and start it after 2 s."""
    docker("kill", container)
    time.sleep(2.0)
    docker("start", container)


def pause(project: Project, container: str) -> None:
    """Pause the container for 5 s."""
    docker("pause", container)
    time.sleep(5.0)
    docker("unpause", container)


def disconnect(project: Project, container: str) -> None:
    """Disconnect the container from the network for 5 s."""
    docker("network", "disconnect", project.network(), container)
    time.sleep(5.0)
    docker("network", "connect", project.network(), container)


FAULTS: dict[str, tuple[str, Callable[[Project, str], object], str]] = {
    "none": ("chaser-1", lambda project, container: None, "Fly without a fault."),
    "crash": (
        "chaser-1",
        lambda project, container: crash(container),
        "Kill the process of a chaser; Docker restarts its container.",
    ),
    "kill": ("chaser-1", kill, "Kill the container of a chaser, and start it after 2 s."),
    "pause": ("chaser-1", pause, "Pause the container of a chaser for 5 s."),
    "disconnect": ("chaser-1", disconnect, "Disconnect a chaser from the network for 5 s."),
    "router": (
        "router",
        lambda project, container: docker("restart", "-t", "2", container),
        "Restart the router.",
    ),
    "controller": (
        "controller",
        lambda project, container: crash(container),
        "Kill the process of the controller; Docker restarts its container.",
    ),
}
"""Service, cause and description of each fault."""


def fly(fault: str, scenario: str, overrides: str) -> Figures:
    """Return the figures of a flight with a fault."""
    project = Project(scenario, overrides)
    service, cause, _ = FAULTS[fault]
    try:
        begin_s = time.monotonic()
        up = project.compose("up", "-d", "--no-build")
        if up.returncode != 0:
            raise SystemExit(f"docker compose up failed:\n{up.stdout}{up.stderr}")
        log = project.log()
        project.wait_for_tick(log, FAULT_AT_TICK)
        fault_ns = time.time_ns()
        cause(project, project.container(service))
        status = project.wait()
        took_s = time.monotonic() - begin_s
        output = project.compose("logs", "--no-color").stdout
    finally:
        project.down()
    if not log.exists():
        raise SystemExit(f"{fault}: no log\n{output[-3000:]}")
    print(f"  {fault}: status {status}, {log.parent.name}", flush=True)
    return figures(fault, log, fault_ns, status, took_s)


def figures(fault: str, log: Path, fault_ns: int, status: int, took_s: float) -> Figures:
    """Return the figures of a flight from its logged ticks, which state the expected processes."""
    ticks = [(r.sent_ns, r.message) for r in read_log(log, ["world/tick"])]
    chasers = max(len(t.chasers) for _, t in ticks)
    after = [(ns, t) for ns, t in ticks if ns > fault_ns]
    incomplete = [(ns, t) for ns, t in after if len(t.chasers) < chasers or not t.controller]
    gap_ns = [b[0] - a[0] for a, b in itertools.pairwise(ticks)]
    period_s = ticks[1][1].sim_time_ns / 1e9 if len(ticks) > 1 else 0.0
    last_incomplete = max((ns for ns, _ in incomplete), default=None)
    back = [ns for ns, _ in after if last_incomplete is not None and ns > last_incomplete]
    complete_at_end = len(ticks[-1][1].chasers) == chasers and ticks[-1][1].controller
    summary = json.loads((log.parent / "summary.json").read_text())
    return {
        f"{fault}_success": float(status == 0),
        f"{fault}_all_back": float(complete_at_end),
        f"{fault}_recovery_wall_s": (back[0] - fault_ns) / 1e9 if back else 0.0,
        f"{fault}_incomplete_sim_s": len({t.tick for _, t in incomplete}) * period_s,
        f"{fault}_longest_pause_wall_s": max(gap_ns) / 1e9,
        f"{fault}_collisions": float(summary["collisions"]),
        f"{fault}_mission_wall_s": took_s,
    }


@cache
def build_image() -> None:
    """Build the image. Raises BenchmarkFailed if it cannot be built."""
    (ROOT / "runs").mkdir(exist_ok=True)
    built = subprocess.run([*compose_command(), "build", "router"], cwd=ROOT, check=False)
    if built.returncode != 0:
        raise BenchmarkFailed("the image cannot be built", {})


def measure(fault: str, options: Options) -> Figures:
    """Fly with a fault."""
    build_image()
    if options.quick:
        return fly(fault, "two-chaser-tracking", f"duration_s=120.0 {SMALL} {TOLERANT}")
    return fly(fault, "four-chaser-docking", TOLERANT)


PARTS = {
    f"containers-{name}": described(partial(measure, name), text)
    for name, (_, _, text) in FAULTS.items()
}
GROUP = Group(PARTS, on_request=tuple(PARTS))
