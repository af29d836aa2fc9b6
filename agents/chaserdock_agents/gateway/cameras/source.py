# SPDX-License-Identifier: Apache-2.0
"""The interface of a source of images, and what it delivers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal, Protocol

import msgspec
import numpy as np
from chaserdock_protocol.errors import ChaserdockError
from numpy.typing import NDArray

Stamp = Literal["exposure", "arrival", "position"]
"""What the time of an image states.

``exposure``: when it was exposed, by the clock of the device or recording, whose zero is its own.
``arrival``: when it had arrived, by the clock of this machine (UTC), later than its exposure.
``position``: its place in a file, from 0.
"""


class ImageSourceError(ChaserdockError):
    """A source of images cannot be opened, or has ended by a fault. The text says what to do."""


@dataclass(frozen=True, eq=False)
class CapturedImage:
    """An image. ``pixels``: uint8, grey (h, w) or BGR (h, w, 3).

    ``time_ns``: see ``stamp``. ``arrival_ns``: when it had arrived, by the clock of this machine
    (UTC); None in recordings. ``sequence``: number of the image from 0; numbers that are missing
    are images that were not waited for.
    """

    pixels: NDArray[np.uint8]
    time_ns: int
    stamp: Stamp
    arrival_ns: int | None
    sequence: int


@dataclass(frozen=True)
class UnreadableImage:
    """An image that is damaged or of an unknown kind, and why."""

    sequence: int
    reason: str


Captured = CapturedImage | UnreadableImage


class OpeningOptions(msgspec.Struct, frozen=True):
    """How to open a source; a source ignores what it does not have.

    ``width_px``, ``height_px``: image size to set on a device. ``fps``: images a second, to set on
    a device, and of files that state no times. ``topic``: of a recording. ``silent_s``: time
    without an image after which a live source ends with an error.
    """

    width_px: int | None = None
    height_px: int | None = None
    fps: float | None = None
    topic: str | None = None
    silent_s: float = 5.0


class ImageSource(Protocol):
    """A source of images.

    ``name``: for messages. ``live``: images come at their own pace, and those that are not waited
    for are lost. ``frames`` may be called once; it ends where a recording ends, and raises
    ImageSourceError where a live source fails.
    """

    name: str
    live: bool

    def frames(self) -> Iterator[Captured]: ...

    def close(self) -> None: ...
