# SPDX-License-Identifier: Apache-2.0
"""Docking by capture: geometry of a port's corridor, and observed state of a chaser at its port."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_models.docking_geometry import PortView, centre_offset
from chaserdock_protocol.scenario import FlightScenario
from chaserdock_protocol.scenario.docking import Docking, Port

from chaserdock_controller.interfaces import RelativePose

_ENTERED_M = 0.02
"""A chaser this far behind the entry counts as in the corridor. With less, errors of the estimate
would put a chaser that waits at the entry inside.
"""
_KEEP_OUT_MARGIN_M = 0.03
"""Distance by which a plan may come closer than the innermost reference, so that the keep-out does
not push against that.
"""


@dataclass(frozen=True)
class Dock:
    """A chaser's port with its docking limits. ``reach_m``: distance from the chaser's centre to
    the probe tip.
    """

    port: Port
    reach_m: float
    docking: Docking

    def offset(self, gap_m: float) -> Array:
        """Return the chaser's centre (3,), TRF, when its tip is ``gap_m`` in front of the port."""
        return centre_offset(self.port, self.reach_m, gap_m)

    def entry(self) -> Array:
        """Return the chaser's centre (3,), TRF, at the entry of the corridor."""
        return self.offset(self.docking.entry_m)

    def gap_and_lateral(self, offset_m: Array) -> tuple[float, float]:
        """Return gap and lateral distance (m) of the tip for a centre at ``offset_m`` (3,), TRF, in
        nominal attitude.
        """
        off, axis = offset_m - self.offset(0.0), np.asarray(self.port.axis)
        gap = float(off @ axis)
        return gap, float(np.linalg.norm(off - gap * axis))

    def inside(self, offset_m: Array) -> bool:
        """Return whether a centre at ``offset_m`` (3,), TRF, is in the corridor, closer than its
        entry.
        """
        gap, lateral = self.gap_and_lateral(offset_m)
        return (
            gap < self.docking.entry_m - _ENTERED_M
            and lateral < 2.0 * self.docking.corridor.lateral_m
        )

    def keep_out_m(self) -> float:
        """Return the least distance from the target's centre that a plan in this corridor must
        keep.
        """
        return max(
            0.0, float(np.linalg.norm(self.offset(-self.docking.overdrive_m))) - _KEEP_OUT_MARGIN_M
        )


def dock_of(scenario: FlightScenario, chaser: int) -> Dock | None:
    """Return the dock of a chaser; None if it does not dock by capture."""
    port = scenario.docking.port_of(chaser)
    return None if port is None else Dock(port, scenario.chaser.probe_reach_m, scenario.docking)


@dataclass(frozen=True)
class DockingObservation:
    """Estimated geometry of a chaser at its port, and state of its docking sensor.

    ``offset_m`` (3,), ``q_wxyz`` (4,): estimated centre and attitude in TRF. ``covariance`` (6, 6):
    of their changes in one view (``RelativePose.random_covariance``); zero if it is unknown.
    ``sensed``: the sensor has reported in this tick; otherwise ``latched`` is its last report.
    """

    view: PortView
    contact: bool
    latched: bool
    offset_m: Array
    q_wxyz: Array
    sensed: bool = True
    covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))

    @property
    def pose(self) -> RelativePose:
        """Return the estimated pose of the chaser relative to the target, with the covariance of
        its changes.
        """
        return RelativePose(self.offset_m, self.q_wxyz, self.covariance)
