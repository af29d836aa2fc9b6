# SPDX-License-Identifier: Apache-2.0
"""Follow points from one image to another by pyramidal Lucas-Kanade, forward and back."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class FlowTuning:
    """Numbers of the optical flow, with units and reasons."""

    window_px: int = 21
    """Side of the window that is followed: smaller ones slide along the grid of solar cells, larger
    ones mix surfaces of different depth."""
    levels: int = 2
    """Halvings of the image: catch 40 px from reference to image."""
    return_px: float = 0.4
    """Forward and back must end so close to the start: four standard deviations of good points."""


def followed(
    first: NDArray[np.uint8],
    then: NDArray[np.uint8],
    start: NDArray[np.float32],
    guess: NDArray[np.float32],
    tuning: FlowTuning,
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    """Return where points at pixels ``start`` (n, 2) of one image are in another one (n, 2), and
    whether they lead back (n,). ``guess`` (n, 2): about where.
    """
    window = (tuning.window_px, tuning.window_px)
    found, good, _ = cv2.calcOpticalFlowPyrLK(
        first, then, start, guess.copy(), winSize=window, maxLevel=tuning.levels,
        criteria=_CRITERIA, flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    back, back_good, _ = cv2.calcOpticalFlowPyrLK(
        then, first, found, start.copy(), winSize=window, maxLevel=0, criteria=_CRITERIA,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    leads_back = np.linalg.norm(back - start, axis=1) < tuning.return_px
    good = (good.ravel() > 0) & (back_good.ravel() > 0) & leads_back
    return np.asarray(found, dtype=np.float32), good


_CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 20, 0.01)
"""Lucas-Kanade ends after 20 steps or at a step of 0.01 px, a tenth of its error."""
