# SPDX-License-Identifier: Apache-2.0
"""Run a chaser's perception, with what it remembers from image to image. No I/O."""

from __future__ import annotations

import threading
from collections import deque

from chaserdock_protocol.messages import (
    ExpectedPose,
    FeatureTracks,
    GeometryEstimate,
    Image,
    LandmarkMap,
    Odometry,
    Sighting,
    TargetEstimate,
    Tick,
    WrenchCommand,
)
from chaserdock_protocol.topics import Topic

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
    A perception that fails gives a sighting of nothing, and ``failure`` says why. ``refused``: why
    a geometry that came during an image was refused after it. ``look`` may run in a thread beside
    the other methods.
    ``perception``: None for a chaser that gets no images, as in studies with drawn sightings.
    ``tracks``: points in the last image, of a perception that does not know the target's shape.
    """

    def __init__(self, perception: PerceptionMethod | None) -> None:
        self.perception = perception
        self.sighting: Sighting | None = None
        self.failure = self.refused = ""
        self.tracks: FeatureTracks | None = None
        self._looking = threading.Lock()
        self._geometry: GeometryEstimate | None = None
        self._expected: ExpectedPose | None = None
        self._processed: deque[tuple[int, int]] = deque(maxlen=REMEMBERED_IMAGES)

    def look(self, image: Image) -> Sighting | None:
        """Return the sighting in an image; None if the image of its exposure was processed
        before.
        """
        with self._looking:
            geometry, self._geometry = self._geometry, None
            self.refused = apply_geometry(self.perception, geometry) or ""
            return self._sighting_in(image)

    def _sighting_in(self, image: Image) -> Sighting | None:
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

    def take(self, message: Odometry | LandmarkMap | TargetEstimate) -> None:
        """Take the chaser's own state, or what is known of the target and of other chasers."""

    def missing(self, image: Image, tick: Tick | None, realtime: bool) -> Topic | None:
        """Return the topic of a message without which an image cannot be looked at yet, or None.

        ``tick``: the newest one.
        """
        return None

    def without_image(self, missed: Sighting) -> None:
        """Note that an image will not come; ``missed``: what is published in place of a
        sighting.
        """

    def has_processed(self, tick: int) -> bool:
        """Return whether an image of a tick was processed."""
        processed = tuple(self._processed)  # a copy: ``look`` appends
        return any(known == tick for known, _ in processed)

    def inform(self, command: WrenchCommand) -> str | None:
        """Pass on what a command states about the target: its geometry and its expected pose.

        Return why the geometry was refused, or None. During an image it waits for its end.
        """
        self._expected = command.expected
        if not self._looking.acquire(blocking=False):
            self._geometry = command.geometry or self._geometry
            return None
        try:
            return apply_geometry(self.perception, command.geometry)
        finally:
            self._looking.release()
