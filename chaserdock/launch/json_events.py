# SPDX-License-Identifier: Apache-2.0
"""JSON lines that ``--json`` prints while a mission flies: one object per line, told apart by
``type``.

SI units and radians. docs/cli.md is generated from these types (``docs/make_cli.py``).
"""

from __future__ import annotations

from typing import Any, Literal

import msgspec
from msgspec import Struct

from .mission_address import MissionAddress


class ChaserProgress(Struct, frozen=True, kw_only=True):
    """State of a chaser as the controller estimates it: errors are relative to its reference on the
    *estimated* target.
    """

    chaser: int
    phase: str
    phase_time_s: float
    position_error_m: float
    orientation_error_rad: float
    reference_distance_m: float


class Start(Struct, frozen=True, kw_only=True, tag_field="type", tag="start"):
    """First line: the mission, the folder of its files, and where `chaserdock command` reaches it.
    ``duration_s`` is simulated time. ``address`` has ``namespace``, ``endpoint`` and ``keys``
    (folder, or null)."""

    scenario: str
    seed: int
    mode: Literal["lockstep", "realtime"]
    duration_s: float
    chasers: int
    folder: str
    address: MissionAddress


class Progress(Struct, frozen=True, kw_only=True, tag_field="type", tag="progress"):
    """Progress, every second of wall time from the first tick on, and at the end.

    ``speed`` is simulated over wall time since the first tick, ``speed_now`` over the last seconds.
    ``target`` is the status of the target estimate. ``chasers`` lists the chasers that have a
    reference.
    """

    sim_time_s: float
    tick: int
    wall_time_s: float
    speed: float
    speed_now: float
    target: str
    chasers: tuple[ChaserProgress, ...]


class EventNotice(Struct, frozen=True, kw_only=True, tag_field="type", tag="event"):
    """An event that a process published, or that was detected: messages rejected or lost, no plan
    from the solver, a process that exited."""

    sim_time_s: float
    process: str
    level: Literal["info", "warning", "error"]
    what: str
    detail: str = ""


class CommandNotice(Struct, frozen=True, kw_only=True, tag_field="type", tag="command"):
    """A command of an operator or of the timeline, and the controller's reply."""

    sim_time_s: float
    command: str
    chaser: int
    accepted: bool
    reason: str
    operator: str = ""


class Result(Struct, frozen=True, kw_only=True, tag_field="type", tag="result"):
    """Last line of a finished mission: the exit status, and ``summary`` as in summary.json
    (docs/summary.md).
    """

    status: int
    folder: str
    summary: dict[str, Any]


class Failed(Struct, frozen=True, kw_only=True, tag_field="type", tag="error"):
    """Last line without a result: invalid input (``status`` 2), or a mission without a readable
    log.
    """

    status: int
    text: str


JsonLine = Start | Progress | EventNotice | CommandNotice | Result | Failed


def encode_line(line: JsonLine) -> str:
    """Return the line as JSON text."""
    return msgspec.json.encode(line).decode()
