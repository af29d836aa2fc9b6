# SPDX-License-Identifier: Apache-2.0
"""A mission in containers by compose.yaml, for the tests and ``benchmarks/transport.py``."""

from __future__ import annotations

import os
import subprocess
import time
import uuid
from pathlib import Path

from chaserdock_protocol.recording.log import LogError, read_log

ROOT = Path(__file__).resolve().parents[1]
_MISSION_S = 900.0


def compose_command() -> list[str]:
    """Return the installed Compose: Docker's plugin or docker-compose; raises SystemExit without
    any.
    """
    for command in (["docker", "compose"], ["docker-compose"]):
        try:
            if (
                subprocess.run([*command, "version"], capture_output=True, check=False).returncode
                == 0
            ):
                return command
        except FileNotFoundError:
            continue
    raise SystemExit("neither `docker compose` nor `docker-compose` is installed")


class Project:
    """A mission in containers, with a unique project name."""

    def __init__(self, scenario: str, overrides: str, folder: Path = ROOT) -> None:
        self.name = f"chaserdock-{uuid.uuid4().hex[:8]}"
        self.folder = folder
        self._environment = {**os.environ, "SCENARIO": scenario, "SET": overrides}
        self._command = [*compose_command(), "-p", self.name]
        self._before = set(folder.glob("runs/*/mission.mcap"))

    def compose(
        self, *arguments: str, timeout_s: float = _MISSION_S
    ) -> subprocess.CompletedProcess[str]:
        """Run Compose in the project; its output is in the result."""
        return subprocess.run(
            [*self._command, *arguments],
            cwd=self.folder,
            env=self._environment,
            capture_output=True,
            text=True,
            check=False,
            timeout=timeout_s,
        )

    def container(self, service: str) -> str:
        """Return the id of a service's container."""
        ids = self.compose("ps", "-q", service).stdout.split()
        if not ids:
            raise SystemExit(f"{self.name}: no container of {service}")
        return ids[0]

    def network(self) -> str:
        """Return the name of the project's network."""
        return f"{self.name}_default"

    def log(self, timeout_s: float = 300.0) -> Path:
        """Wait for the mission's log and return its path."""
        deadline = time.monotonic() + timeout_s
        while time.monotonic() < deadline:
            new = set(self.folder.glob("runs/*/mission.mcap")) - self._before
            if new:
                return new.pop()
            time.sleep(0.2)
        raise SystemExit(
            f"{self.name}: no log after {timeout_s:g} s:\n{self.compose('logs').stdout[-3000:]}"
        )

    def wait_for_tick(self, log: Path, tick: int, timeout_s: float = 300.0) -> None:
        """Wait until a tick has been recorded."""
        deadline = time.monotonic() + timeout_s
        while last_tick(log) < tick:
            if time.monotonic() > deadline:
                raise SystemExit(
                    f"{self.name}: tick {tick} was not recorded within {timeout_s:g} s"
                )
            time.sleep(0.5)

    def wait(self) -> int:
        """Wait for the mission's end and return its status."""
        done = docker("wait", self.container("mission"), timeout_s=_MISSION_S)
        return int(done.stdout.strip())

    def down(self) -> None:
        """Remove containers, networks and volumes."""
        self.compose("down", "--volumes", "--timeout", "5")


def last_tick(log: Path) -> int:
    """Return the newest tick in a log that is being written; -1 before the first."""
    try:
        return max((r.message.tick for r in read_log(log, ["world/tick"])), default=-1)
    except LogError:  # created but not flushed yet
        return -1


def docker(*arguments: str, timeout_s: float = 60.0) -> subprocess.CompletedProcess[str]:
    """Run docker; raises CalledProcessError if it fails."""
    return subprocess.run(
        ["docker", *arguments], capture_output=True, text=True, check=True, timeout=timeout_s
    )
