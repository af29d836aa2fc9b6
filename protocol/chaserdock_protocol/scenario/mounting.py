# SPDX-License-Identifier: Apache-2.0
"""Derive what holds for chasers at their ports: nominal poses, and thrusters whose plume is
free.
"""

from __future__ import annotations

import math
from collections.abc import Set
from typing import TYPE_CHECKING

import numpy as np
from chaserdock_models.docking_geometry import centre_offset
from chaserdock_models.mounting import MountedChaser, plume_free
from numpy.typing import NDArray

if TYPE_CHECKING:
    from . import FlightScenario


def nominal_mounting(scenario: FlightScenario, chaser: int) -> MountedChaser:
    """Return the nominal pose of a chaser that is latched at its port. Raises ValueError without a
    port.
    """
    port = scenario.docking.port_of(chaser)
    if port is None:
        raise ValueError(f"chaser {chaser} has no port")
    centre = centre_offset(port, scenario.chaser.probe_reach_m, 0.0)
    return MountedChaser(centre, np.array(scenario.chasers[chaser].q_wxyz))


def plume_free_thrusters(
    scenario: FlightScenario, latched: Set[int]
) -> dict[int, NDArray[np.bool_]]:
    """Return which thrusters (n,) of each latched chaser may fire without a plume hitting anything.

    Uses nominal poses, so that noise changes nothing.
    """
    mounted = {i: nominal_mounting(scenario, i) for i in sorted(latched)}
    free = plume_free(
        mounted,
        scenario.chaser.thrusters,
        math.radians(scenario.detumble.plume_deg),
        scenario.target_model().boxes,
        [np.array(port.position_m) for port in scenario.docking.ports],
        scenario.chaser.size_m,
    )
    return dict(zip(mounted, free.reshape(len(mounted), -1), strict=True))
