# SPDX-License-Identifier: Apache-2.0
"""Perception of the chasers in an in-process mission."""

from __future__ import annotations

from collections.abc import Callable

from chaserdock_agents.chaser.perception import make_perception
from chaserdock_agents.chaser.vision import Vision
from chaserdock_protocol.messages import Image, Sighting
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.rendering.cameras import States
from chaserdock_world.rendering.pose_cameras import make_cameras

PerceptionModel = Callable[[int, int, int, States], Sighting]
"""Maps chaser, tick, time (ns) and the true states of all bodies to the chaser's sighting."""


class RenderedImages:
    """Renders each chaser's image, with the scenario's camera errors and effects, and runs its
    perception on it.

    With statistical perception no image is rendered. ``on_image``: receives every image and returns
    the one that perception gets. ``visions``: perceptions of the chasers, which commands inform.
    """

    def __init__(
        self, scenario: Scenario, on_image: Callable[[Image], Image] = lambda image: image
    ) -> None:
        self._ticks_per_image = scenario.timing.ticks_per_image
        self._cameras = make_cameras(scenario)
        self.visions = [Vision(make_perception(scenario)) for _ in scenario.chasers]
        self._on_image = on_image

    def __call__(self, chaser: int, tick: int, time_ns: int, states: States) -> Sighting:
        return self.see(chaser, self.image(chaser, tick, time_ns, states))

    def image(self, chaser: int, tick: int, time_ns: int, states: States) -> Image:
        """Return a chaser's image."""
        return self._cameras.image(chaser, tick // self._ticks_per_image, tick, time_ns, states)

    def see(self, chaser: int, image: Image) -> Sighting:
        """Return the sighting in a chaser's image. Raises ValueError for a second one of a tick."""
        sighting = self.visions[chaser].look(self._on_image(image))
        if sighting is None:
            raise ValueError(f"chaser {chaser} has seen the image of tick {image.tick} before")
        return sighting
