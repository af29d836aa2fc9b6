# SPDX-License-Identifier: Apache-2.0
"""Run a chaser's perception, with what it remembers from image to image. No I/O."""

from __future__ import annotations

from collections import deque

from chaserdock_protocol.messages import ExpectedPose, Image, Sighting, WrenchCommand

from .perception import PerceptionMethod
from .sighting import (
    PerceptionFailed,
    apply_geometry,
    look,
    prediction_from,
    without_sighting,
)

REMEMBERED_IMAGES = 64
"""Processed images that are remembered to recognize repeated ones. More than the delay of
any message, a few ticks; the number only bounds the memory.
"""


class Vision:
    """Turn the images of one chaser into sightings.

    Each image is searched near the last ``sighting``, or where the controller expects the target.
    A perception that fails gives a sighting of nothing, and ``failure`` says why.
    ``perception``: None for a chaser that gets no images, as in studies with drawn sightings.
    """

    def __init__(self, perception: PerceptionMethod | None) -> None:
        self.perception = perception
        self.sighting: Sighting | None = None
        self.failure = ""
        self._expected: ExpectedPose | None = None
        self._processed: deque[tuple[int, int]] = deque(maxlen=REMEMBERED_IMAGES)

    def look(self, image: Image) -> Sighting | None:
        """Return the sighting in an image; None if the image of its exposure was processed
        before.
        """
        exposure = (image.tick, image.sim_time_ns)
        if exposure in self._processed:
            return None
        assert self.perception is not None
        self._processed.append(exposure)
        predicted = prediction_from(self.sighting, self._expected, image.sim_time_ns)
        self.failure = ""
        try:
            self.sighting = look(self.perception, image, predicted)
        except PerceptionFailed as error:
            self.failure = str(error)
            self.sighting = without_sighting(image, self.failure)
        return self.sighting

    def has_processed(self, tick: int) -> bool:
        """Return whether an image of a tick was processed."""
        return any(processed == tick for processed, _ in self._processed)

    def inform(self, command: WrenchCommand) -> str | None:
        """Pass on what a command states about the target: its geometry and its expected pose.

        Return why the geometry was refused, or None.
        """
        self._expected = command.expected
        return apply_geometry(self.perception, command.geometry)
