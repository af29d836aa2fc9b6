# SPDX-License-Identifier: Apache-2.0
"""Say what a chaser must not cross, and the least acceleration that lets it still brake before it.

Pure functions; SI units; WRF unless stated otherwise. Each condition is a control barrier in
discrete time: at the end of a command the chaser must still be able to stop before the surface.
Its safe set is therefore the set from which braking is a safe abort.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array
from chaserdock_models.docking_geometry import axis_error_deg
from chaserdock_models.rigid_body import BodyState
from chaserdock_protocol.messages import Hazard
from chaserdock_protocol.scenario.docking import Docking, Port

RECOVERY_M_S = 0.02
"""Speed at which a chaser leaves where it must not be, m/s: as fast as a latch allows a touch
(`docking.tolerances.closing_m_s`), slow enough that no other surface is reached within a second.
"""
SETTLING_S = 0.5
"""Time constant of the last part of a stop, s: without it commands alternate between the asked
force and full braking at the surface. Several intervals of the default rate; it costs 4 mm for the
default body."""
ENTRY_SLACK_M = 0.05
"""Way into its corridor that a chaser may make before its attitude is right, m: a chaser that
aligns itself at the entry strays by less (0.03 m, `docking.corridor.lateral_m`).
"""
_FACETS = 8
"""Planes in place of the corridor's cone, inscribed in it: they leave 92 % of its radius."""


@dataclass(frozen=True, eq=False)
class Barrier:
    """A surface that must not be crossed, or a speed that must not be exceeded.

    ``room_m``: distance from it, and ``rate_m_s`` its rate of change, both at the time from which
    the next command acts, less their margins. ``normal`` (3,): direction in which an acceleration
    adds room. ``drift_m_s2``: acceleration of the room without any force. ``slowest_m_s``: least
    rate allowed by speed alone; ``room_m`` is infinite where it is the only limit.
    """

    hazard: Hazard
    normal: Array
    room_m: float
    rate_m_s: float
    drift_m_s2: float = 0.0
    slowest_m_s: float = -math.inf

    def least_acceleration(self, braking_m_s2: float, interval_s: float) -> float:
        """Return the least acceleration along ``normal`` over the next command, m/s².

        With it the room that is left at the end of ``interval_s`` suffices to come to rest by
        ``braking_m_s2``. A chaser that is beyond the surface stops, and returns at ``RECOVERY_M_S``
        without more than that braking.
        """
        fastest_m_s = stopping_speed(self.room_m, self.rate_m_s, braking_m_s2, interval_s)
        lowest_m_s = max(-fastest_m_s, self.slowest_m_s)
        needed = (lowest_m_s - self.rate_m_s) / interval_s - self.drift_m_s2
        beyond = self.room_m + self.rate_m_s * interval_s / 2.0 < 0.0
        if beyond:
            at_rest = -self.rate_m_s / interval_s - self.drift_m_s2
            needed = max(min(needed, braking_m_s2), at_rest)
        return needed


def stopping_speed(room_m: float, rate_m_s: float, braking_m_s2: float, interval_s: float) -> float:
    """Return the greatest speed towards a surface at the end of an interval from which a chaser
    stops before it, m/s; minus ``RECOVERY_M_S`` for one that is beyond it.

    With s that speed, r the room at the end and b the braking, s² / (2 b) <= r - b t² / 2 and, near
    the surface, s <= r / t, where t is ``SETTLING_S``: the curves touch at s = b t, and braking
    never exceeds b. As the acceleration is constant, r = room + (rate - s) T / 2.
    """
    if math.isinf(room_m):
        return math.inf
    reach_m, half_s = room_m + rate_m_s * interval_s / 2.0, interval_s / 2.0
    if reach_m < 0.0:
        return -RECOVERY_M_S
    settling_m_s = reach_m / (SETTLING_S + half_s)
    if settling_m_s <= braking_m_s2 * SETTLING_S:
        return settling_m_s
    braked_m = reach_m - braking_m_s2 * SETTLING_S**2 / 2.0
    return braking_m_s2 * (math.sqrt(half_s**2 + 2.0 * braked_m / braking_m_s2) - half_s)


@dataclass(frozen=True, eq=False)
class OffsetEstimate:
    """Position and velocity (3,) of a chaser relative to another body, with covariances (3, 3)."""

    position_m: Array
    velocity_m_s: Array
    position_covariance: Array
    velocity_covariance: Array

    def barrier(
        self, hazard: Hazard, normal: Array, room_m: float, rate_m_s: float, margin: Margin,
        **limits: float,
    ) -> Barrier:  # fmt: skip
        """Return a barrier whose room and rate are less by the margins of this offset's errors."""
        room_sigma_m = math.sqrt(max(0.0, float(normal @ self.position_covariance @ normal)))
        rate_sigma_m_s = math.sqrt(max(0.0, float(normal @ self.velocity_covariance @ normal)))
        room_m -= min(margin.sigmas * room_sigma_m, margin.most_m)
        rate_m_s -= min(margin.sigmas * rate_sigma_m_s, margin.most_m_s)
        return Barrier(hazard, normal, room_m, rate_m_s, **limits)


@dataclass(frozen=True)
class Margin:
    """Standard deviations that conditions allow for, at most ``most_m`` of distance and
    ``most_m_s`` of speed.
    """

    sigmas: float
    most_m: float
    most_m_s: float


def distance_barrier(
    hazard: Hazard, offset: OffsetEstimate, least_m: float, margin: Margin
) -> Barrier:
    """Return the barrier that keeps a distance between two centres.

    The sideways velocity only adds to the distance; it is left out.
    """
    distance_m = float(np.linalg.norm(offset.position_m))
    outward = offset.position_m / distance_m if distance_m > 0.0 else np.array([1.0, 0.0, 0.0])
    rate_m_s = float(outward @ offset.velocity_m_s)
    return offset.barrier(hazard, outward, distance_m - least_m, rate_m_s, margin)


@dataclass(frozen=True, eq=False)
class PortCorridor:
    """The cone in front of a chaser's port, in which it may come nearer than the keep-out.

    Distances are of the chaser's centre from where it is when the tip is in the port, along the
    port's axis (``gap``) and from it. ``reach_m``: of the tip from the centre along +X.
    """

    port: Port
    reach_m: float
    docking: Docking

    def holds(self, offset: OffsetEstimate, target: BodyState) -> bool:
        """Return whether the centre is in the cone."""
        gap_m, aside, _, _ = self._seen(offset, target)
        rooms = [room_m for _, room_m in self._facets(gap_m, aside)]
        return gap_m > -self.docking.overdrive_m and min(rooms) > 0.0

    def _facets(self, gap_m: float, aside: Array) -> Iterator[tuple[Array, float]]:
        """Yield the inward normal (3,), TRF, and the distance of each plane of the cone."""
        axis = np.asarray(self.port.axis)
        inscribed = math.cos(math.pi / _FACETS)
        slope = inscribed * math.tan(math.radians(self.docking.corridor_angle_deg))
        radius_m = inscribed * 2.0 * self.docking.corridor.lateral_m + slope * gap_m
        size = math.hypot(1.0, slope)
        for outward in _around(axis):
            yield (slope * axis - outward) / size, (radius_m - float(aside @ outward)) / size

    def _seen(self, offset: OffsetEstimate, target: BodyState) -> tuple[float, Array, Array, Array]:
        """Return the gap, the offset from the axis (3,), and position and velocity (3,) relative to
        the rotating target, in TRF.
        """
        position = rotations.rotate_inverse(target.q_wxyz, offset.position_m)
        velocity = rotations.rotate_inverse(target.q_wxyz, offset.velocity_m_s)
        velocity = velocity - rotations.cross(target.omega_rad_s, position)
        axis, away = np.asarray(self.port.axis), position - np.asarray(self.port.position_m)
        along_m = float(away @ axis)
        return along_m - self.reach_m, away - along_m * axis, position, velocity

    def barriers(
        self, offset: OffsetEstimate, target: BodyState, q_wxyz: Array, braking_m_s2: float,
        interval_s: float, margin: Margin,
    ) -> Iterator[Barrier]:  # fmt: skip
        """Yield the conditions on a chaser in the cone, with attitude ``q_wxyz`` (4,)."""
        docking = self.docking
        gap_m, aside, position, velocity = self._seen(offset, target)
        axis, omega = np.asarray(self.port.axis), target.omega_rad_s
        # Of a body that moves uniformly in WRF, seen from axes that rotate at a constant rate.
        drift = -2.0 * rotations.cross(omega, velocity) - rotations.cross(
            omega, rotations.cross(omega, position)
        )

        def of(hazard: Hazard, normal: Array, room_m: float, **limits: float) -> Barrier:
            return offset.barrier(
                hazard,
                rotations.rotate(target.q_wxyz, normal),
                room_m,
                float(normal @ velocity),
                margin,
                drift_m_s2=float(normal @ drift),
                **limits,
            )

        for normal, room_m in self._facets(gap_m, aside):
            yield of("corridor", normal, room_m)
        q_off = rotations.multiply(rotations.conjugate(target.q_wxyz), q_wxyz)
        if axis_error_deg(self.port, q_off) > docking.corridor.angle_deg:
            yield of("alignment", axis, gap_m - docking.entry_m + ENTRY_SLACK_M)
        next_m = max(0.0, min(gap_m, gap_m + float(velocity @ axis) * interval_s))
        fastest_m_s = self._fastest(next_m, braking_m_s2)
        yield of("closing speed", axis, math.inf, slowest_m_s=-fastest_m_s)

    def _fastest(self, gap_m: float, braking_m_s2: float) -> float:
        """Return the greatest closing speed at a gap, m/s: by braking, the speed of the corridor at
        its entry and that of a touch at the port are reached.
        """
        docking = self.docking
        corridor_m_s, touch_m_s = docking.corridor.closing_m_s, docking.tolerances.closing_m_s
        before_m = max(0.0, gap_m - docking.entry_m)
        at_entry_m_s = math.sqrt(corridor_m_s**2 + 2.0 * braking_m_s2 * before_m)
        at_port_m_s = math.sqrt(touch_m_s**2 + 2.0 * braking_m_s2 * gap_m)
        return min(at_entry_m_s, max(at_port_m_s, touch_m_s))


def _around(axis: Array) -> Iterator[Array]:
    """Yield ``_FACETS`` unit vectors (3,) perpendicular to an axis, at equal angles."""
    first = rotations.cross(axis, np.eye(3)[int(np.argmin(np.abs(axis)))])
    first /= np.linalg.norm(first)
    second = rotations.cross(axis, first)
    for k in range(_FACETS):
        angle = 2.0 * math.pi * k / _FACETS
        yield math.cos(angle) * first + math.sin(angle) * second
