# SPDX-License-Identifier: Apache-2.0
"""Cases and results of ``chaserdock study``: JSON, one per line."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

import msgspec
from chaserdock_protocol.errors import ChaserdockError
from msgspec import Struct


class StudyError(ChaserdockError):
    """A file of study cases or results is not readable, or a case is not valid."""


class StudyCase(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A scenario (path) with overrides, flown with perfect knowledge of the target, or with
    ``images`` and an estimator.

    ``delay_s``: time from a tick to its command's effect, unknown to the controller, which skips
    the ticks meanwhile. ``delay_measured``: the wall-clock time of each solve as delay. ``floor``:
    compute the lower bound of the squared position error, too, for a chaser that turns as this one
    did.
    """

    name: str
    scenario: str
    overrides: tuple[str, ...] = ()
    images: bool = False
    delay_s: float | None = None
    delay_measured: bool = False
    floor: bool = False


class StudyResult(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Chaser 0's errors from its commanded reference pose: mean squares over the run, and after
    ``settling_s``.

    ``min_distance_target_m``: least distance of its centre to the target's. ``failed_solves``:
    ticks without a plan.
    """

    case: StudyCase
    duration_s: float
    position_mse_m2: float
    orientation_mse_rad2: float
    steady_position_mse_m2: float
    steady_orientation_mse_rad2: float
    min_distance_target_m: float
    failed_solves: int
    solve_p50_s: float
    solve_max_s: float
    floor_m2_s: float | None = None


_Kind = TypeVar("_Kind", bound=Struct)


def read_lines(path: Path, kind: type[_Kind]) -> list[_Kind]:
    """Decode one Struct of ``kind`` per line; raises StudyError, naming file and line."""
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
    """Encode one line for ``read_lines``."""
    return msgspec.json.encode(item).decode() + "\n"
