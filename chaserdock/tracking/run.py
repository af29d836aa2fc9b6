# SPDX-License-Identifier: Apache-2.0
"""Tracks the images of a source and passes the results on."""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from chaserdock_agents.gateway.cameras import (
    CapturedImage,
    ImageSource,
    ImageSourceError,
    UnreadableImage,
)
from numpy.typing import NDArray

from chaserdock.launch.signals import deferred_signals

from .overlay import lines_of, overlay
from .tracker import TrackedImage, Tracker

_WINDOW = 30
"""Images over which the speed is averaged: a second of a usual camera."""


@dataclass
class TrackCounts:
    """What a run has seen. ``first_unreadable``: why the first unreadable image is so. ``fault``:
    why the source has ended early, empty if it has not. ``stopped``: by a signal.
    """

    images: int = 0
    with_pose: int = 0
    unreadable: int = 0
    wall_s: float = 0.0
    first_unreadable: str = ""
    fault: str = ""
    stopped: bool = False

    def line(self) -> str:
        """Return the counts as a sentence."""
        speed = self.images / self.wall_s if self.wall_s > 0.0 else 0.0
        text = f"{self.images} images, {self.with_pose} with a pose, {speed:.1f} images/s"
        if self.unreadable:
            text += f"; {self.unreadable} unreadable, the first: {self.first_unreadable}"
        return text


@dataclass(frozen=True, eq=False)
class TrackStep:
    """An image with what was tracked in it. ``per_second``: images processed a second."""

    image: CapturedImage
    tracked: TrackedImage
    per_second: float
    tracker: Tracker

    @cached_property
    def overlay(self) -> NDArray[np.uint8]:
        """The BGR image with axes, ids and figures."""
        return overlay(
            self.image.pixels,
            self.tracker.camera,
            self.tracker.models,
            self.tracked,
            self.per_second,
        )

    @cached_property
    def lines(self) -> list[str]:
        """The figures as text."""
        return lines_of(self.tracked, self.per_second)


Sink = Callable[[TrackStep], object]


def track_source(
    source: ImageSource,
    tracker: Tracker,
    sinks: Sequence[Sink],
    most: int | None = None,
    now_s: Callable[[], float] = time.monotonic,
) -> TrackCounts:
    """Track the images of a source, at most ``most``; each result goes to all ``sinks``.

    A signal to stop, and a source that fails after its first image, end the run as its end would:
    what was tracked is kept. Raises ChaserdockError before that.
    """
    counts, begin_s = TrackCounts(), now_s()
    ends: deque[float] = deque([begin_s], maxlen=_WINDOW + 1)
    frames = source.frames()
    try:
        for captured in _limited(frames, most):
            with deferred_signals():  # whole rows and images are written
                if isinstance(captured, UnreadableImage):
                    counts.unreadable += 1
                    counts.first_unreadable = counts.first_unreadable or captured.reason
                    continue
                tracked = tracker.track(captured.pixels, captured.time_ns)
                ends.append(now_s())
                per_second = (len(ends) - 1) / max(ends[-1] - ends[0], 1e-6)
                counts.images += 1
                counts.with_pose += tracked.pose is not None or any(
                    target.pose is not None for target in tracked.targets
                )
                step = TrackStep(captured, tracked, per_second, tracker)
                for sink in sinks:
                    sink(step)
    except (KeyboardInterrupt, BrokenPipeError):  # the latter of `| head`
        counts.stopped = True
    except ImageSourceError as error:
        if not counts.images:
            raise
        counts.fault = str(error)
    finally:
        source.close()
    counts.wall_s = now_s() - begin_s
    return counts


def _limited(
    frames: Iterator[CapturedImage | UnreadableImage], most: int | None
) -> Iterator[CapturedImage | UnreadableImage]:
    for number, frame in enumerate(frames, 1):
        yield frame
        if number == most:
            return


HEADER = "# time_s target status x_m y_m z_m qw qx qy qz sigma_mm sigma_deg residual_px markers"


def pose_lines(tracked: TrackedImage) -> list[str]:
    """Return the best pose of each target as a line with the columns of ``HEADER``; of a target
    that is not seen, the first three.
    """
    seconds, nanoseconds = divmod(tracked.time_ns, 1_000_000_000)
    lines = []
    for target in tracked.targets:
        text = f"{seconds}.{nanoseconds:09d} {target.name} {target.status}"
        if (pose := target.pose) is not None:
            numbers = [*pose.position_m.tolist(), *pose.q_wxyz.tolist()]
            sigma_deg = math.degrees(pose.sigma_rad)
            text += " " + " ".join(f"{v:.6f}" for v in numbers)
            text += f" {1e3 * pose.sigma_m:.3f} {sigma_deg:.4f} {pose.residual_px:.3f}"
            text += " " + (",".join(map(str, target.marker_ids.tolist())) or "-")
        lines.append(text)
    return lines
