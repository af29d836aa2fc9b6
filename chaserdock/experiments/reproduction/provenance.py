# SPDX-License-Identifier: Apache-2.0
"""Where and when flights were flown."""

from __future__ import annotations

import os
import platform
import subprocess
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from msgspec import Struct

_FOLDER = Path(__file__).resolve().parent


class Provenance(Struct, frozen=True, kw_only=True):
    """Date (UTC), commit and machine of flights. ``commit`` ends with ``-dirty`` where tracked
    files were changed.
    """

    date: str
    commit: str
    machine: str

    def __str__(self) -> str:
        return f"{self.date}, commit {self.commit}, {self.machine}"


def provenance() -> Provenance:
    """Return date, commit and machine of this process."""
    return Provenance(
        date=f"{datetime.now(UTC):%Y-%m-%d}", commit=commit_of(_FOLDER), machine=_machine()
    )


def commit_of(folder: Path) -> str:
    """Return the commit of the working copy that tracks ``folder``; without one, the package's
    version.
    """

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder), *arguments]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
        except OSError:  # git is not installed
            return ""
        return done.stdout.strip() if done.returncode == 0 else ""

    if not git("ls-files", "."):
        return f"unknown (chaserdock {version('chaserdock')}, not a git checkout)"
    return git("describe", "--always", "--dirty", "--abbrev=12", "--exclude=*")


def _machine() -> str:
    cpu = platform.processor() or platform.machine()
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
        cpu = next(
            line.partition(":")[2].strip() for line in lines if line.startswith("model name")
        )
    except (OSError, StopIteration):
        pass  # not Linux, or a CPU without a model name
    return (
        f"{cpu} ({os.cpu_count()} logical CPUs), {platform.system()}, Python "
        f"{platform.python_version()}"
    )
