# SPDX-License-Identifier: Apache-2.0
"""Propagate the target's orbit over a mission: its Hill frame, which is WRF, with sun and Earth in
it.

A function of time only.
"""

from __future__ import annotations

import math
from datetime import timedelta
from functools import lru_cache

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.orbit import (
    EARTH_RADIUS_M,
    HillFrame,
    OrbitState,
    hill_frame,
    propagate,
    state_of,
)
from chaserdock_models.orbit_environment import drag, sun_position, sunlit_share
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.orbit import Orbit

_GRID_S = 10.0
"""Interval of the stored states, s. A state follows from the last stored one, whatever was asked
before, so that it depends only on its time. Longer: less memory, and more steps from a stored state
to the asked one.
"""


class TargetOrbit:
    """Propagate an orbit from the beginning of the mission, on a fixed grid of time."""

    def __init__(self, section: Orbit) -> None:
        self._section, self.j2 = section, section.zonal_coefficient
        self._grid = [state_of(section.elements)]
        # Cached, as bodies, light and drag ask for the same moment.
        self.state_at = lru_cache(maxsize=4)(self._state_at)
        self.frame_at = lru_cache(maxsize=4)(self._frame_at)

    def _state_at(self, time_s: float) -> OrbitState:
        """Return the state at a time of the mission; equal at every call, whatever was asked
        before.
        """
        index = int(time_s / _GRID_S)
        while len(self._grid) <= index:
            self._grid.append(propagate(self._grid[-1], _GRID_S, self.j2))
        return propagate(self._grid[index], time_s - index * _GRID_S, self.j2)

    def _frame_at(self, time_s: float) -> HillFrame:
        return hill_frame(self.state_at(time_s), self.j2)

    def differential_drag(self, time_s: float) -> Array:
        """Return the acceleration (3,) of drag on a chaser minus that on the target, WRF."""
        chaser = self._section.chaser_ballistic_coefficient_kg_m2
        target = self._section.target_ballistic_coefficient_kg_m2
        if chaser is None or target is None:
            return np.zeros(3)
        state, axes = self.state_at(time_s), self.frame_at(time_s).axes
        of_unit = drag(state.position_m, state.velocity_m_s, 1.0)
        return axes @ of_unit * (1.0 / chaser - 1.0 / target)

    def to_sun(self, time_s: float) -> Array:
        """Return the unit vector (3,) to the sun, WRF."""
        to_sun = self._sun_m(time_s) - self.state_at(time_s).position_m
        return self.frame_at(time_s).axes @ (to_sun / np.linalg.norm(to_sun))

    def sunlit_share(self, time_s: float) -> float:
        """Return the share of the sun's disc that the Earth leaves visible, 0 to 1."""
        return sunlit_share(self.state_at(time_s).position_m, self._sun_m(time_s))

    def earth_radius_rad(self, time_s: float) -> float:
        """Return the angular radius of the Earth's disc; its centre is in direction -X of WRF."""
        return math.asin(EARTH_RADIUS_M / self.frame_at(time_s).radius_m)

    def _sun_m(self, time_s: float) -> Array:
        return sun_position(self._section.epoch + timedelta(seconds=time_s))


def to_sun(scenario: Scenario, time_s: float = 0.0) -> tuple[float, float, float]:
    """Return the direction (3,) to the sun, WRF, of any length.

    By the orbit, or as the camera section states it.
    """
    if scenario.orbit is None:
        return scenario.camera.sun_direction
    x, y, z = TargetOrbit(scenario.orbit).to_sun(time_s).tolist()
    return x, y, z


def earth_disc(scenario: Scenario) -> tuple[tuple[float, float, float], float] | None:
    """Return the Earth's disc: direction (3,) to its centre, WRF, and angular radius (rad).

    None without an Earth in images.
    """
    if scenario.orbit is not None:
        return (-1.0, 0.0, 0.0), TargetOrbit(scenario.orbit).earth_radius_rad(0.0)
    earth = scenario.camera.earth
    return None if earth is None else (earth.direction, math.radians(earth.radius_deg))
