"""The cameras' pictures of a log in step with what was found in them, a few at a time, never all in memory."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from chaserdock_protocol.log import read_log
from chaserdock_protocol.messages import Image, Sighting
from chaserdock_protocol.topics import IMAGE, SIGHTING

Pair = tuple[Image, Sighting | None]


def pairs(log: Path, chasers: int) -> Iterator[Pair]:
    """Every picture with the sighting of the same exposure, or None where the log has none; by time, all chasers.

    Holds at most one picture a chaser; raises LogError where the log cannot be read.
    """
    waiting: dict[int, Image] = {}
    keys = [t.key_of(i) for i in range(chasers) for t in (IMAGE, SIGHTING)]
    for record in read_log(log, keys):
        message: Any = record.message
        last = waiting.pop(message.chaser, None)
        if isinstance(message, Image):
            waiting[message.chaser] = message
            if last is not None:
                yield last, None
        elif last is not None:
            yield last, message if message.sim_time_ns == last.sim_time_ns else None
    for _, last in sorted(waiting.items()):
        yield last, None


def shots(
    log: Path, chasers: int, every_s: float, first_s: float = 0.0
) -> Iterator[tuple[float, dict[int, Pair]]]:
    """At ``first_s`` and then ``every_s`` (simulated seconds): the time and each chaser's latest picture up to then.

    The last one comes at or after the end of the pictures. Pictures of one exposure belong together.
    """
    latest: dict[int, Pair] = {}
    number = 0
    for image, sighting in pairs(log, chasers):
        time_s = image.sim_time_ns / 1e9
        while time_s > first_s + number * every_s + 1e-9:
            if latest:
                yield first_s + number * every_s, dict(latest)
            number += 1
        latest[image.chaser] = (image, sighting)
    if latest:
        yield first_s + number * every_s, latest


def columns_for(number: int, aspect: float, width_px: int, height_px: int) -> tuple[int, int]:
    """In how many columns ``number`` pictures of this aspect (width over height) get largest, and how wide each then is."""
    best = (1, 1)
    for columns in range(1, number + 1):
        rows = math.ceil(number / columns)
        width = int(min(width_px / columns, height_px / rows * aspect))
        if width > best[1]:
            best = (columns, width)
    return best
