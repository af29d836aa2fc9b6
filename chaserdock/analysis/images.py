# SPDX-License-Identifier: Apache-2.0
"""Camera images of a log with their sightings, streamed: only a few are in memory at a time."""

from __future__ import annotations

import math
from collections import defaultdict, deque
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from chaserdock_protocol.messages import Image, Sighting
from chaserdock_protocol.recording.log import read_log
from chaserdock_protocol.topics import IMAGE, SIGHTING

Pair = tuple[Image, Sighting | None]

_MAX_WAITING = 4
"""Images of a chaser that wait for their sightings. A sighting may follow the next image; larger:
one lost sighting delays more images.
"""


def pairs(log: Path, chasers: int) -> Iterator[Pair]:
    """Yield every image with the sighting of the same exposure, or None. Those of one chaser are in
    order of time.

    A log is in order of arrival: a sighting may precede its image or follow the next one. Raise
    LogError for an unreadable log.
    """
    waiting: dict[int, deque[Image]] = defaultdict(deque)
    early: dict[int, dict[int, Sighting]] = defaultdict(dict)
    keys = [t.key_of(i) for i in range(chasers) for t in (IMAGE, SIGHTING)]
    for record in read_log(log, keys):
        message: Any = record.message
        images, sightings = waiting[message.chaser], early[message.chaser]
        if isinstance(message, Image):
            images.append(message)
        else:
            sightings[message.sim_time_ns] = message
            if len(sightings) > _MAX_WAITING:
                del sightings[min(sightings)]
        while images and (images[0].sim_time_ns in sightings or len(images) > _MAX_WAITING):
            first = images.popleft()
            yield first, sightings.pop(first.sim_time_ns, None)
    for chaser, images in sorted(waiting.items()):
        for image in images:
            yield image, early[chaser].pop(image.sim_time_ns, None)


def shots(
    log: Path, chasers: int, every_s: float, first_s: float = 0.0
) -> Iterator[tuple[float, dict[int, Pair]]]:
    """Yield simulated times (s) and the latest image of each chaser then: at ``first_s``, then
    every ``every_s``.

    The last item lies at or after the last image; there is none if that precedes ``first_s``. Where
    the log is not in order of time, an image may be the one before the latest.
    """
    latest: dict[int, Pair] = {}
    number, time_s = 0, -math.inf
    for image, sighting in pairs(log, chasers):
        time_s = image.sim_time_ns / 1e9
        while time_s > first_s + number * every_s + 1e-9:
            if latest:
                yield first_s + number * every_s, dict(latest)
            number += 1
        latest[image.chaser] = (image, sighting)
    if time_s > first_s - every_s:
        yield first_s + number * every_s, latest


def columns_for(number: int, aspect: float, width_px: int, height_px: int) -> tuple[int, int]:
    """Return the number of columns that shows ``number`` images of this aspect ratio largest, and
    their width (px).
    """
    best = (1, 1)
    for columns in range(1, number + 1):
        rows = math.ceil(number / columns)
        width = int(min(width_px / columns, height_px / rows * aspect))
        if width > best[1]:
            best = (columns, width)
    return best


def latest_images(
    log: Path, chasers: int, times_s: Iterable[float]
) -> Iterator[tuple[float, dict[int, Pair]]]:
    """Yield each of the ascending simulated times (s) and the latest image of each chaser then.
    Where the log is not in order of time, an image may be the one before the latest.
    """
    coming = pairs(log, chasers)
    latest: dict[int, Pair] = {}
    pair = next(coming, None)
    for time_s in times_s:
        while pair is not None and pair[0].sim_time_ns / 1e9 <= time_s + 1e-9:
            latest[pair[0].chaser] = pair
            pair = next(coming, None)
        yield time_s, dict(latest)
