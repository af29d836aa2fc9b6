# SPDX-License-Identifier: Apache-2.0
"""Flies missions as a user does: the ``chaserdock`` program, separate processes, real Zenoh."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import psutil
from chaserdock_protocol.process import SINGLE_THREADED

from chaserdock.analysis.flight import load_flight
from chaserdock.launch.launcher import free_port
from chaserdock.simulation.mission import simulate

ROOT = Path(__file__).resolve().parents[1]
SHORT = (
    "duration_s=6.0",
    "settling_s=4.0",
    "camera.width_px=640",
    "camera.height_px=480",
    "success.steady_position_rms_m=0.2",
    "success.steady_orientation_rms_deg=10.0",
)
"""Turns a shipped scenario into a short one with small images."""
DRILL = (
    "fault-drill",
    "duration_s=6.0",
    "timeline=[]",
    "success.docked=[]",
    "settling_s=1.0",
)
"""Four chasers with small images for six seconds: a scenario and its overrides."""


def chaserdock(*arguments: str, **options: Any) -> subprocess.Popen[bytes]:
    """Starts the program, as an installed command would."""
    env = {**os.environ, **SINGLE_THREADED, **options.pop("env", {})}
    command = [sys.executable, "-m", "chaserdock", *arguments]
    process: Any = subprocess.Popen(command, env=env, cwd=ROOT, **options)
    return process


def finished(*arguments: str, timeout_s: float = 120.0, **options: Any) -> tuple[int, str]:
    """Status and everything printed by a program run to its end."""
    process = chaserdock(*arguments, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, **options)
    out, _ = process.communicate(timeout=timeout_s)
    return process.returncode, out.decode(errors="replace")


def sets(*overrides: str) -> list[str]:
    return [item for override in overrides for item in ("--set", override)]


def run(
    scenario: str, out: Path, *overrides: str, timeout_s: float = 600.0, **options: Any
) -> tuple[int, str]:
    """``chaserdock run``; status and output."""
    arguments = [
        "run",
        scenario,
        "--out",
        str(out),
        *options.pop("arguments", ()),
        *sets(*overrides),
    ]
    return finished(*arguments, timeout_s=timeout_s, **options)


def simulated_digest(scenario: str, out: Path, *overrides: str) -> str:
    """Simulate a shipped scenario in this process, every process of it to its end; the digest of
    its log.
    """
    flight = simulate(ROOT / "scenarios" / f"{scenario}.toml", out, overrides)
    assert (flight.crashes, flight.stalled) == ({}, ())
    return load_flight(out / "mission.mcap").digest


def summary(out: Path) -> dict[str, Any]:
    return json.loads((out / "summary.json").read_text())


def descendants(process: subprocess.Popen[bytes]) -> list[psutil.Process]:
    return psutil.Process(process.pid).children(recursive=True)


def find_child(
    process: subprocess.Popen[bytes], *words: str, timeout_s: float = 20.0
) -> psutil.Process:
    """The child of a launcher whose command line holds all ``words`` in a row."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        for child in descendants(process):
            try:
                line = " ".join(child.cmdline()).split()  # a process' title is one word
            except (psutil.NoSuchProcess, psutil.ZombieProcess):
                continue
            if any(tuple(line[k : k + len(words)]) == words for k in range(len(line))):
                return child
        time.sleep(0.05)
    raise AssertionError(f"no child {' '.join(words)}")


def wait_for_log(log: Path, size: int, timeout_s: float = 90.0) -> None:
    """Waits until a log has grown to ``size`` bytes: the mission flies."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        if log.exists() and log.stat().st_size >= size:
            return
        time.sleep(0.05)
    raise AssertionError(f"{log} has not grown to {size} bytes")


def all_gone(processes: list[psutil.Process], timeout_s: float = 15.0) -> bool:
    """Whether all of them end within the time."""
    _, alive = psutil.wait_procs(processes, timeout=timeout_s)
    return not [p for p in alive if p.status() != psutil.STATUS_ZOMBIE]


@dataclass
class ByHand:
    """The processes of a mission, started one by one as in separate terminals."""

    namespace: str
    endpoint: str
    processes: dict[str, subprocess.Popen[bytes]]

    @classmethod
    def at_free_port(cls, namespace: str) -> ByHand:
        return cls(namespace, f"tcp/127.0.0.1:{free_port()}", {})

    def start(self, name: str, *arguments: str, **options: Any) -> subprocess.Popen[bytes]:
        where = ["-l", self.endpoint] if arguments[0] == "world" else ["-e", self.endpoint]
        process = chaserdock(
            *arguments,
            "--namespace",
            self.namespace,
            *where,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            **options,
        )
        self.processes[name] = process
        return process

    def output_of(self, name: str, timeout_s: float = 120.0) -> tuple[int, str]:
        out, _ = self.processes[name].communicate(timeout=timeout_s)
        return self.processes[name].returncode, out.decode(errors="replace")

    def end(self) -> None:
        for process in self.processes.values():
            if process.poll() is None:
                process.send_signal(signal.SIGKILL)
            process.wait()
            if process.stdout is not None:
                process.stdout.close()


def install_example(example: Path, folder: Path) -> dict[str, str]:
    """Puts an example's module and entry points into ``folder``; the environment that finds them
    there.

    What ``pip install --no-deps --target`` does, without the build back end, which is not at hand
    off line.
    """
    project = tomllib.loads((example / "pyproject.toml").read_text())
    for name in project["tool"]["hatch"]["build"]["targets"]["wheel"]["include"]:
        (folder / name).write_bytes((example / name).read_bytes())
    name, version = project["project"]["name"], project["project"]["version"]
    info = folder / f"{name.replace('-', '_')}-{version}.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n")
    groups = project["project"]["entry-points"]
    lines = [
        line
        for group, names in groups.items()
        for line in (f"[{group}]", *(f"{k} = {v}" for k, v in names.items()))
    ]
    (info / "entry_points.txt").write_text("\n".join(lines) + "\n")
    return {"PYTHONPATH": str(folder)}
