"""What ``--json`` prints while a mission flies: one of these objects a line, told apart by ``type``.

SI units and radians. docs/cli.md is made from these types (``docs/make_cli.py``).
"""

from __future__ import annotations

from typing import Any, Literal

import msgspec
from msgspec import Struct


class ChaserLine(Struct, frozen=True, kw_only=True):
    """A chaser as the controller sees it: errors are from its reference on the *estimated* target."""

    chaser: int
    phase: str
    phase_time_s: float
    position_error_m: float
    orientation_error_rad: float
    reference_distance_m: float


class Start(Struct, frozen=True, kw_only=True, tag_field="type", tag="start"):
    """First line: what will be flown, and where its files go. ``duration_s`` is simulated time."""

    scenario: str
    seed: int
    mode: Literal["lockstep", "realtime"]
    duration_s: float
    chasers: int
    folder: str


class Progress(Struct, frozen=True, kw_only=True, tag_field="type", tag="progress"):
    """Each second of wall time, from the first tick on, and at the end.

    ``speed`` is simulated over wall time since the first tick, ``speed_now`` over the last seconds. ``target`` is the
    estimate's status. ``chasers`` lists those that have a reference.
    """

    sim_time_s: float
    tick: int
    wall_time_s: float
    speed: float
    speed_now: float
    target: str
    chasers: tuple[ChaserLine, ...]


class Told(Struct, frozen=True, kw_only=True, tag_field="type", tag="event"):
    """Something worth telling, once: what a process told, or what was noticed about it (messages refused or lost, no
    plan from the solver, a process that ended)."""

    sim_time_s: float
    process: str
    level: Literal["info", "warning", "error"]
    what: str
    detail: str = ""


class Commanded(Struct, frozen=True, kw_only=True, tag_field="type", tag="command"):
    """An operator's or the time line's command, and the controller's answer."""

    sim_time_s: float
    command: str
    chaser: int
    accepted: bool
    reason: str
    operator: str = ""


class Result(Struct, frozen=True, kw_only=True, tag_field="type", tag="result"):
    """Last line of a mission that was flown: the exit status, and ``summary`` as summary.json has it (docs/summary.md)."""

    status: int
    folder: str
    summary: dict[str, Any]


class Failed(Struct, frozen=True, kw_only=True, tag_field="type", tag="error"):
    """Last line when there is no result: bad input (``status`` 2), or a mission without a log that can be judged."""

    status: int
    text: str


Line = Start | Progress | Told | Commanded | Result | Failed


def line_of(line: Line) -> str:
    """The line as it is printed."""
    return msgspec.json.encode(line).decode()
