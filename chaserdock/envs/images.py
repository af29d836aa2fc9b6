# SPDX-License-Identifier: Apache-2.0
"""Observations that are images: what the world's cameras see of the bodies of a batch."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from chaserdock_models.arrays import IntArray
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.scenario import Scenario
from chaserdock_world.physics.definitions import TARGET
from chaserdock_world.rendering.cameras import Cameras
from numpy.typing import NDArray

Images = NDArray[np.uint8]


class BatchImages:
    """Keeps the newest image of each chaser of ``environments`` environments.

    Cameras, lenses, light and noise are the world's for the scenario and its seed. Images are taken
    at ``time.image_hz``; in the ticks between, the last one stays.
    """

    def __init__(self, scenario: Scenario, environments: int) -> None:
        self._cameras, self._chasers = Cameras(scenario), len(scenario.chasers)
        self._interval, rate_hz = scenario.timing.ticks_per_image, scenario.time.rate_hz
        self._tick_ns = round(1e9 / rate_hz)
        camera = scenario.camera
        size = (environments, self._chasers, camera.height_px, camera.width_px, 1)
        self._newest = np.zeros(size, np.uint8)

    def take(
        self, states: Sequence[Sequence[BodyState]], ages: IntArray, draws: NDArray[np.uint64]
    ) -> Images:
        """Return the images (n, m, h, w, 1) of all environments, and take those that are due.

        ``states``: by environment the target, then its chasers. ``ages`` (n,): ticks since the
        start of the episode. ``draws`` (n,): random number of each environment, which with the age
        makes the noise of its images.
        """
        for e, (target, *chasers) in enumerate(states):
            age = int(ages[e])
            if age % self._interval:
                continue
            bodies = {TARGET: target} | {f"chaser/{i}": s for i, s in enumerate(chasers)}
            number = (int(draws[e]) + age) % 2**63
            for i in range(self._chasers):
                image = self._cameras.render(i, number, age * self._tick_ns, bodies)
                self._newest[e, i, :, :, 0] = image
        return self._newest.copy()
