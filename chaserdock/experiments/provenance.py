# SPDX-License-Identifier: Apache-2.0
"""Where and when flights were flown."""

from __future__ import annotations

import os
import platform
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

from chaserdock_protocol.recording.provenance import commit_of
from msgspec import Struct


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
        date=f"{datetime.now(UTC):%Y-%m-%d}",
        commit=commit_of() or f"unknown (chaserdock {version('chaserdock')}, not a git checkout)",
        machine=_machine(),
    )


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
