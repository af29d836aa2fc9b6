# SPDX-License-Identifier: Apache-2.0
"""Compute the loads of thrusters' plumes on the target and on the other chasers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.plume import REACH_M, panels_of, plume_wrench
from chaserdock_models.rigid_body import BodyState
from chaserdock_models.targets import Box
from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.plume import PlumeSection

_TARGET = "target"


class PlumeImpulse(NamedTuple):
    """Impulse (6,), N s and N m s, about a body's origin in its axes, and the largest force, N."""

    impulse: Array
    peak_force_N: float


class PlumeLoads:
    """Compute the loads of all plumes, and add them up until they are taken."""

    def __init__(self, scenario: Scenario, plume: PlumeSection) -> None:
        self._flux = plume.flux()
        body = scenario.chaser
        self._nozzles = np.array([t.position_m for t in body.thrusters])
        self._forces = np.array([t.direction for t in body.thrusters])
        chaser = panels_of([Box(body.size_m)])
        self._panels = {f"chaser/{i}": chaser for i in range(len(scenario.chasers))}
        self._panels[_TARGET] = panels_of(scenario.target_model().boxes)
        self._radius_m = {
            name: float(np.linalg.norm(panels.centres_m, axis=1).max())
            for name, panels in self._panels.items()
        }
        self._taken = {name: PlumeImpulse(np.zeros(6), 0.0) for name in self._panels}

    @property
    def bodies(self) -> tuple[str, ...]:
        """Names of all bodies that plumes can hit."""
        return tuple(self._panels)

    def act(
        self, states: Mapping[str, BodyState], thrusts_N: Mapping[str, Array], time_s: float
    ) -> dict[str, Array]:
        """Return the wrenches (6,) on the bodies that plumes hit, and add them up over ``time_s``.

        Body axes, about the body's origin. ``thrusts_N`` (n,): of each chaser's thrusters.
        """
        loads: dict[str, Array] = {}
        for name, thrusts in thrusts_N.items():
            if not thrusts.any():
                continue
            own = states[name]
            nozzles = own.position_m + rotations.rotate(own.q_wxyz, self._nozzles)
            forces = rotations.rotate(own.q_wxyz, self._forces)
            for hit in self._panels.keys() - {name}:
                wrench = self._wrench_on(hit, states[hit], nozzles, forces, thrusts)
                if wrench.any():
                    loads[hit] = loads.get(hit, 0.0) + wrench
        for hit, wrench in loads.items():
            total, peak_N = self._taken[hit]
            self._taken[hit] = PlumeImpulse(
                total + time_s * wrench, max(peak_N, float(np.linalg.norm(wrench[:3])))
            )
        return loads

    def _wrench_on(
        self, hit: str, body: BodyState, nozzles: Array, forces: Array, thrusts_N: Array
    ) -> Array:
        near = np.linalg.norm(nozzles - body.position_m, axis=1) - self._radius_m[hit] <= REACH_M
        local = rotations.rotate_inverse(body.q_wxyz, nozzles - body.position_m)
        directions = rotations.rotate_inverse(body.q_wxyz, forces)
        panels = self._panels[hit]
        return plume_wrench(self._flux, panels, local, directions, np.where(near, thrusts_N, 0.0))

    def take(self, name: str) -> PlumeImpulse:
        """Return what a body has received since the last call."""
        taken, self._taken[name] = self._taken[name], PlumeImpulse(np.zeros(6), 0.0)
        return taken
