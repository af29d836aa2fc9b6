"""Studies of the controller by itself: what is asked, and what comes back. One case a line, as JSON."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import msgspec
from msgspec import Struct

from .errors import ChaserdockError


class StudyError(ChaserdockError):
    """A file of study cases or results that cannot be read."""


class StudyCase(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A scenario (path) with overrides, flown on perfect knowledge.

    ``delay_s``: the command acts so long after its tick, unknown to the controller, which skips the ticks meanwhile.
    ``delay_measured``: the same with the wall-clock time that the solve took. ``floor``: also the least possible
    mean square position error of a chaser that turns as this one did.
    """

    name: str
    scenario: str
    overrides: tuple[str, ...] = ()
    delay_s: float | None = None
    delay_measured: bool = False
    floor: bool = False


class StudyResult(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Chaser 0's errors from its commanded reference pose: mean squares over the run, and after ``settling_s``."""

    case: StudyCase
    duration_s: float
    position_mse_m2: float
    orientation_mse_rad2: float
    steady_position_mse_m2: float
    steady_orientation_mse_rad2: float
    failed_solves: int
    solve_p50_s: float
    solve_max_s: float
    floor_m2_s: float | None = None


_Kind = TypeVar("_Kind", bound=Struct)


def read_lines(path: Path, kind: type[_Kind]) -> list[_Kind]:
    """One Struct of ``kind`` a line; raises StudyError, naming file and line."""
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise StudyError(f"{path}: cannot be read: {error}") from None
    out = []
    for number, line in enumerate(lines, start=1):
        try:
            out.append(msgspec.json.decode(line, type=kind))
        except msgspec.DecodeError as error:
            raise StudyError(f"{path}: line {number}: {error}") from None
    return out


def line_of(item: Struct) -> str:
    """The line that ``read_lines`` reads."""
    return msgspec.json.encode(item).decode() + "\n"
