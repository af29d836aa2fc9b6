# SPDX-License-Identifier: Apache-2.0
"""Say what a chaser must not cross, and the least acceleration that lets it still brake before it.

Pure functions; SI units; WRF unless stated otherwise. Each condition is a control barrier in
discrete time: at the end of a command the chaser must still be able to stop before the surface.
Its safe set is therefore the set from which braking is a safe abort.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

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
    """Position and velocity (..., 3) of a chaser relative to other bodies, with covariances (...,
    3, 3).
    """

    position_m: Array
    velocity_m_s: Array
    position_covariance: Array
    velocity_covariance: Array

    def margins(self, normals: Array, margin: Margin) -> tuple[list[float], list[float]]:
        """Return the margins of distance, m, and of speed, m/s, along unit vectors (n, 3)."""
        out = []
        bounds = (margin.most_m, margin.most_m_s)
        covariances = (self.position_covariance, self.velocity_covariance)
        for covariance, most in zip(covariances, bounds, strict=True):
            variances = ((normals[:, None] @ covariance)[:, 0] * normals).sum(axis=1).tolist()
            out.append([min(margin.sigmas * math.sqrt(max(0.0, v)), most) for v in variances])
        return out[0], out[1]


@dataclass(frozen=True)
class Margin:
    """Standard deviations that conditions allow for, at most ``most_m`` of distance and
    ``most_m_s`` of speed.
    """

    sigmas: float
    most_m: float
    most_m_s: float


def distance_barriers(
    offsets: OffsetEstimate, least_m: Sequence[float], margin: Margin
) -> list[Barrier]:
    """Return the barriers that keep distances (n,) from the centre of the target, the first row of
    ``offsets`` (n, 3), and from those of other chasers.

    The sideways velocity only adds to the distance; it is left out.
    """
    distances_m = np.sqrt((offsets.position_m**2).sum(axis=1))
    outward = offsets.position_m / np.where(distances_m > 0.0, distances_m, 1.0)[:, None]
    outward[distances_m == 0.0] = [1.0, 0.0, 0.0]
    rates_m_s = (outward * offsets.velocity_m_s).sum(axis=1).tolist()
    off_m, off_m_s = offsets.margins(outward, margin)
    return [
        Barrier(
            "chaser" if k else "target",
            outward[k],
            distance_m - least_m[k] - off_m[k],
            rates_m_s[k] - off_m_s[k],
        )
        for k, distance_m in enumerate(distances_m.tolist())
    ]


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
        _, rooms_m = self._facets(gap_m, aside)
        return gap_m > -self.docking.overdrive_m and bool(rooms_m.min() > 0.0)

    @cached_property
    def _planes(self) -> tuple[Array, Array, float, float]:
        """Planes of the cone: inward normals (k, 3), TRF, and, per metre of offset (3,), of gap,
        and constant, their distances.
        """
        inscribed = math.cos(math.pi / _FACETS)
        slope = inscribed * math.tan(math.radians(self.docking.corridor_angle_deg))
        axis, size = np.asarray(self.port.axis), math.hypot(1.0, slope)
        outward = np.array(list(_around(axis))) / size
        constant_m = inscribed * 2.0 * self.docking.corridor.lateral_m / size
        return slope / size * axis - outward, -outward, slope / size, constant_m

    def _facets(self, gap_m: float, aside: Array) -> tuple[Array, Array]:
        """Return inward normals (k, 3), TRF, and distances (k,) of the planes of the cone."""
        normals, per_m, per_gap, constant_m = self._planes
        return normals, per_m @ aside + (per_gap * gap_m + constant_m)

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

        normals, rooms_m = self._facets(gap_m, aside)
        found: list[tuple[Hazard, float, float]] = [
            ("corridor", room_m, -math.inf) for room_m in rooms_m.tolist()
        ]
        q_off = rotations.multiply(rotations.conjugate(target.q_wxyz), q_wxyz)
        if axis_error_deg(self.port, q_off) > docking.corridor.angle_deg:
            found.append(("alignment", gap_m - docking.entry_m + ENTRY_SLACK_M, -math.inf))
        next_m = max(0.0, min(gap_m, gap_m + float(velocity @ axis) * interval_s))
        found.append(("closing speed", math.inf, -self._fastest(next_m, braking_m_s2)))
        normals = np.vstack([normals, np.tile(axis, (len(found) - len(normals), 1))])
        rates_m_s, drifts = (normals @ velocity).tolist(), (normals @ drift).tolist()
        normals = rotations.rotate(target.q_wxyz, normals)
        off_m, off_m_s = offset.margins(normals, margin)
        for k, (hazard, room_m, slowest_m_s) in enumerate(found):
            rate_m_s = rates_m_s[k] - off_m_s[k]
            yield Barrier(hazard, normals[k], room_m - off_m[k], rate_m_s, drifts[k], slowest_m_s)

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
