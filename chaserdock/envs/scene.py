# SPDX-License-Identifier: Apache-2.0
"""Pictures of an environment, by the world's renderer, from outside."""

from __future__ import annotations

import math

import numpy as np
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.scenario import Scenario
from numpy.typing import NDArray

from ..analysis.body_renderer import BodyRenderer
from ..analysis.chase_camera import BodyPose, Viewpoint
from .batch import DockingBatch

RgbImage = NDArray[np.uint8]
RENDER_MODES = ("human", "rgb_array")
_WIDTH_PX, _HEIGHT_PX = 640, 480  # Gymnasium's recorders need even sides
_AZIMUTH_RAD, _ELEVATION_RAD = math.radians(-60.0), math.radians(25.0)  # beside and above
_ROOM, _BODY_M = 2.7, 0.6
"""Distance of the viewpoint over that of the farthest body from their middle, and what is added for
the size of a body, m: with them, all are in view.
"""


class EnvironmentView:
    """Draws the bodies of a batch's first environment. ``mode``: one of ``RENDER_MODES``, or None.

    Raises ValueError for another mode.
    """

    def __init__(self, scenario: Scenario, mode: str | None) -> None:
        if mode is not None and mode not in RENDER_MODES:
            raise ValueError(f"render_mode: one of {', '.join(RENDER_MODES)} (got {mode!r})")
        self.mode = mode
        self._scenario = scenario
        self._renderer: BodyRenderer | None = None
        self._window: _Window | None = None

    def show(self, batch: DockingBatch) -> RgbImage | None:
        """Return the picture (480, 640, 3), or show it in a window for ``human``.

        None with ``human`` and without a mode. Raises ChaserdockError without a display.
        """
        if self.mode is None:
            return None
        image = self.draw(batch)
        if self.mode == "rgb_array":
            return image
        self._window = self._window or _Window()
        self._window.show(image)
        return None

    def draw(self, batch: DockingBatch) -> RgbImage:
        """Return the picture (480, 640, 3) of the first environment."""
        target = batch.state(0, None)
        chasers = {i: batch.state(0, i) for i in range(batch.chasers)}
        places = np.array([s.position_m for s in (target, *chasers.values())])
        middle = (places.min(axis=0) + places.max(axis=0)) / 2.0
        away_m = _ROOM * (float(np.linalg.norm(places - middle, axis=1).max()) + _BODY_M)
        look = Viewpoint(middle, away_m, _AZIMUTH_RAD, _ELEVATION_RAD, _WIDTH_PX, _HEIGHT_PX)
        self._renderer = self._renderer or BodyRenderer(self._scenario, tuple(chasers), look)
        poses = {i: _pose(s) for i, s in chasers.items()}
        bgr = self._renderer.render(look, _pose(target), poses).bgr
        return np.ascontiguousarray(bgr[:, :, ::-1])

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
            self._window = None


class _Window:
    """A window of matplotlib."""

    def __init__(self) -> None:
        import matplotlib.pyplot as plt

        self._plt = plt
        self._figure, self._axes = plt.subplots(num="chaserdock")
        if self._figure.canvas.required_interactive_framework is None:
            self.close()
            raise ChaserdockError(
                f"render_mode human needs a display; matplotlib has {plt.get_backend()!r} here: "
                "use rgb_array"
            )
        self._axes.set_axis_off()
        self._picture = None

    def show(self, image: RgbImage) -> None:
        if self._picture is None:
            self._picture = self._axes.imshow(image)
        self._picture.set_data(image)
        self._plt.pause(1e-3)

    def close(self) -> None:
        self._plt.close(self._figure)


def _pose(s: BodyState) -> BodyPose:
    return s.position_m, s.q_wxyz
