# SPDX-License-Identifier: Apache-2.0
"""Where and when runs were flown, and the last recorded flights of the paper's chain, for machines without its solver.

``paper_chain.json`` beside this file is a copy of the one that ``chaserdock reproduce`` writes into its output folder.
"""

from __future__ import annotations

import os
import platform
import subprocess
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec
from chaserdock_protocol.errors import ChaserdockError
from msgspec import Struct

from chaserdock.evaluation.study_cases import StudyResult

RECORD_NAME = "paper_chain.json"
_FOLDER = Path(__file__).resolve().parent


class Provenance(Struct, frozen=True, kw_only=True):
    """Date (UTC), commit and machine of flights. ``commit`` ends with ``-dirty`` where tracked files were changed."""

    date: str
    commit: str
    machine: str

    def __str__(self) -> str:
        return f"{self.date}, commit {self.commit}, {self.machine}"


class ChainRecord(Struct, frozen=True, kw_only=True):
    """Flights of the paper's chain by name: summaries of missions (the fields that the page shows), and studies."""

    provenance: Provenance
    quick: bool
    missions: dict[str, dict[str, Any]]
    studies: dict[str, StudyResult]


def provenance() -> Provenance:
    """Return date, commit and machine of this process."""
    return Provenance(date=f"{datetime.now(UTC):%Y-%m-%d}", commit=commit_of(_FOLDER), machine=_machine())


def commit_of(folder: Path) -> str:
    """Return the commit of the working copy that tracks ``folder``; without one, the package's version."""

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
        cpu = next(line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        pass  # not Linux, or a CPU without a model name
    return f"{cpu} ({os.cpu_count()} logical CPUs), {platform.system()}, Python {platform.python_version()}"


_SHOWN = ("success", "failures", "sim_time_s", "min_distance_chasers_m")
_SHOWN_OF_CHASER = (
    "position_mse_m2",
    "orientation_mse_rad2",
    "steady",
    "docked",
    "dock_time_s",
    "reached_time_s",
    "min_distance_target_m",
)
_SHOWN_OF_ESTIMATE = ("max_orientation_error_rad", "orientation_rms_rad")


def shown_fields(summary: dict[str, Any]) -> dict[str, Any]:
    """Return the part of a ``summary.json`` that the page uses."""
    chasers = {i: {k: c[k] for k in _SHOWN_OF_CHASER} for i, c in summary["chasers"].items()}
    estimate = {k: summary["target_estimate"][k] for k in _SHOWN_OF_ESTIMATE}
    return {**{k: summary[k] for k in _SHOWN}, "chasers": chasers, "target_estimate": estimate}


def write_record(record: ChainRecord, folder: Path) -> None:
    """Write a record into ``folder``."""
    (folder / RECORD_NAME).write_bytes(msgspec.json.format(msgspec.json.encode(record)) + b"\n")


def read_record(folder: Path = _FOLDER) -> ChainRecord:
    """Return the record in ``folder``, by default the shipped one. Raise ChaserdockError if it cannot be read."""
    path = folder / RECORD_NAME
    try:
        return msgspec.json.decode(path.read_bytes(), type=ChainRecord)
    except (OSError, msgspec.DecodeError) as error:
        raise ChaserdockError(f"{path}: cannot be read: {error}") from None
