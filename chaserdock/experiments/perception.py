# SPDX-License-Identifier: Apache-2.0
"""What the chasers see of the target in an in-process mission."""

from __future__ import annotations

from collections.abc import Callable

from chaserdock_agents.chaser.perception import make_perception
from chaserdock_agents.chaser.sighting import apply_geometry, look, prediction_from
from chaserdock_protocol.messages import ExpectedPose, Image, Sighting, WrenchCommand
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.rendering.cameras import States
from chaserdock_world.rendering.pose_cameras import make_cameras

PerceptionModel = Callable[[int, int, int, States], Sighting]
"""Maps chaser, tick, time (ns) and the true states of all bodies to the chaser's sighting."""


class RenderedImages:
    """Render each chaser's image, with the scenario's camera errors and effects, and run its
    perception on it.

    With statistical perception no image is rendered. ``on_image`` sees every image, and returns the
    one that perception gets.
    """

    def __init__(
        self, scenario: Scenario, on_image: Callable[[Image], Image] = lambda image: image
    ) -> None:
        self._ticks_per_image = scenario.timing.ticks_per_image
        self._cameras = make_cameras(scenario)
        self._perceptions = [make_perception(scenario) for _ in scenario.chasers]
        self._last: dict[int, Sighting] = {}
        self._expected: dict[int, ExpectedPose | None] = {}
        self._on_image = on_image

    def __call__(self, chaser: int, tick: int, time_ns: int, states: States) -> Sighting:
        return self.see(chaser, self.image(chaser, tick, time_ns, states))

    def image(self, chaser: int, tick: int, time_ns: int, states: States) -> Image:
        """Return a chaser's image."""
        return self._cameras.image(chaser, tick // self._ticks_per_image, tick, time_ns, states)

    def see(self, chaser: int, image: Image) -> Sighting:
        """Return the sighting in a chaser's image."""
        predicted = prediction_from(
            self._last.get(chaser), self._expected.get(chaser), image.sim_time_ns
        )
        self._last[chaser] = look(self._perceptions[chaser], self._on_image(image), predicted)
        return self._last[chaser]

    def inform(self, chaser: int, command: WrenchCommand) -> None:
        """Pass on what a command tells about the target, as the chaser's process does.

        Raises RuntimeError for geometry that the perception refuses.
        """
        self._expected[chaser] = command.expected
        if refused := apply_geometry(self._perceptions[chaser], command.geometry):
            raise RuntimeError(refused)
