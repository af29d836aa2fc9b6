# SPDX-License-Identifier: Apache-2.0
"""Writes trajectories of a log as TUM files, which evo and others read: lines ``time_s x y z qx qy
qz qw``, in WRF.
"""

from __future__ import annotations

import math
from contextlib import ExitStack
from pathlib import Path
from typing import Any, TextIO

from chaserdock_protocol import topics
from chaserdock_protocol.errors import errors_of_writing
from chaserdock_protocol.output_files import replaced
from chaserdock_protocol.recording.log import LogError, LogSource, Record

from .reader import open_log


def _track_of(record: Record) -> str | None:
    """Return the name of the trajectory to which a message belongs, or None."""
    message: Any = record.message
    match record.topic:
        case topics.TRUTH_BODY:
            return f"{message.body.replace('/', '_')}_truth"
        case topics.BODY_REFERENCE:
            return f"{message.body.replace('/', '_')}_measured"
        case topics.TARGET if message.is_known:
            return "target_estimate"
        case topics.ODOMETRY:
            return f"chaser_{message.chaser}_odometry"
        case topics.REFERENCE:
            return f"chaser_{message.chaser}_reference"
        case _:
            return None


def write_tracks(
    log: LogSource, folder: Path, from_s: float = 0.0, to_s: float = math.inf
) -> dict[str, int]:
    """Write true and measured states, target estimate, odometry and references of the controller
    from ``from_s`` to ``to_s``.

    Returns the number of points by file name. Raises LogError if the log or the files cannot be
    used.
    """
    opened = open_log(log)
    wanted = (
        topics.TRUTH_BODY,
        topics.BODY_REFERENCE,
        topics.TARGET,
        topics.ODOMETRY,
        topics.REFERENCE,
    )
    files: dict[str, TextIO] = {}
    points: dict[str, int] = {}
    with errors_of_writing(folder, LogError), ExitStack() as open_files:
        folder.mkdir(parents=True, exist_ok=True)
        for record in opened.records(*wanted):
            time_ns = record.message.sim_time_ns
            name = _track_of(record)
            if name is None or not from_s <= time_ns / 1e9 <= to_s:
                continue
            if name not in files:
                path = folder / f"{name}.tum"
                if path.exists():
                    raise LogError(f"{path}: already exists; write into an empty folder")
                new = open_files.enter_context(replaced(path))
                files[name] = open_files.enter_context(new.open("w", encoding="ascii"))
            w, x, y, z = record.message.q_wxyz
            values = " ".join(repr(v) for v in (*record.message.position_m, x, y, z, w))
            files[name].write(
                f"{time_ns // 1_000_000_000}.{time_ns % 1_000_000_000:09d} {values}\n"
            )
            points[f"{name}.tum"] = points.get(f"{name}.tum", 0) + 1
    if not points:
        raise LogError(f"{log}: contains no track between {from_s:g} and {to_s:g} s")
    return dict(sorted(points.items()))
