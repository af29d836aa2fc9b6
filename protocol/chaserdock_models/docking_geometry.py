# SPDX-License-Identifier: Apache-2.0
"""Geometry of a probe relative to its docking port, shared by guidance and simulator. Pure
functions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike

from . import rotations
from .arrays import Array
from .rigid_body import BodyState


class PortGeometry(Protocol):
    """A docking port: position (3,) and outward axis (3,), both in TRF."""

    @property
    def position_m(self) -> ArrayLike: ...
    @property
    def axis(self) -> ArrayLike: ...


class PoseLimits(Protocol):
    """Tolerances of a probe's pose and motion relative to its port."""

    @property
    def lateral_m(self) -> float: ...
    @property
    def angle_deg(self) -> float: ...
    @property
    def lateral_speed_m_s(self) -> float: ...
    @property
    def rate_deg_s(self) -> float | None: ...


@dataclass(frozen=True)
class PortView:
    """State of a probe's tip relative to its port, in the port's rotating frame.

    ``gap_m``: along the axis, positive outside. ``lateral_m``: distance from the axis.
    ``closing_m_s``: speed towards the port. ``angle_rad``: between the chaser's attitude and its
    docked attitude. ``rate_rad_s``: of the chaser relative to the target.
    """

    gap_m: float
    lateral_m: float
    angle_rad: float
    closing_m_s: float
    lateral_speed_m_s: float
    rate_rad_s: float = 0.0

    def fault(self, limits: PoseLimits, closing_m_s: float = math.inf) -> str:
        """Describe the first violated limit with its values; empty if all hold."""
        rate_deg_s = math.inf if limits.rate_deg_s is None else limits.rate_deg_s
        for name, value, limit, unit in (
            ("lateral", self.lateral_m * 1e3, limits.lateral_m * 1e3, "mm"),
            ("angle", math.degrees(self.angle_rad), limits.angle_deg, "deg"),
            ("lateral speed", self.lateral_speed_m_s * 1e3, limits.lateral_speed_m_s * 1e3, "mm/s"),
            ("closing speed", self.closing_m_s * 1e3, closing_m_s * 1e3, "mm/s"),
            ("rate", math.degrees(self.rate_rad_s), rate_deg_s, "deg/s"),
        ):
            if value > limit:
                return f"{name} {value:.2f} {unit}, at most {limit:g}"
        return ""


def centre_offset(port: PortGeometry, reach_m: float, gap_m: float) -> Array:
    """Return a chaser's centre (3,) in TRF when its tip is ``gap_m`` in front of the port and its
    +X along -axis.
    """
    return np.asarray(port.position_m) + np.asarray(port.axis) * (reach_m + gap_m)


def corridors_apart(a: PortGeometry, b: PortGeometry, reach_m: float, entry_m: float) -> float:
    """Return the least distance (m) between the centres of two chasers in their corridors, from the
    port to ``entry_m`` before it.
    """
    ends = [centre_offset(port, reach_m, gap_m) for port in (a, b) for gap_m in (0.0, entry_m)]
    return segments_apart(*ends)


def axis_error_deg(port: PortGeometry, q_off_wxyz: Array) -> float:
    """Return the angle between a chaser's +X and the inward axis of its port; ``q_off_wxyz`` (4,)
    CRF to TRF.
    """
    ahead = rotations.rotate(q_off_wxyz, (1.0, 0.0, 0.0))
    return math.degrees(math.acos(min(1.0, max(-1.0, -float(ahead @ np.asarray(port.axis))))))


def view_of(
    port: PortGeometry, reach_m: float, q_off_wxyz: Array, chaser: BodyState, target: BodyState
) -> PortView:
    """Return the state of the tip relative to the port.

    ``reach_m``: distance of the tip from the chaser's centre along +X. ``q_off_wxyz`` (4,): docked
    attitude, CRF to TRF. Velocities are relative to the rotating target, as seen by an observer on
    the port.
    """
    tip = rotations.rotate(chaser.q_wxyz, (reach_m, 0.0, 0.0))
    position = rotations.rotate_inverse(target.q_wxyz, chaser.position_m + tip - target.position_m)
    tip_velocity = rotations.rotate(
        chaser.q_wxyz, rotations.cross(chaser.omega_rad_s, np.array([reach_m, 0.0, 0.0]))
    )
    velocity = rotations.rotate_inverse(
        target.q_wxyz, chaser.velocity_m_s + tip_velocity - target.velocity_m_s
    )
    velocity = velocity - rotations.cross(target.omega_rad_s, position)
    axis = np.asarray(port.axis)
    off = position - np.asarray(port.position_m)
    gap, speed = float(off @ axis), float(velocity @ axis)
    attitude = rotations.multiply(target.q_wxyz, q_off_wxyz)
    return PortView(
        gap_m=gap,
        lateral_m=float(np.linalg.norm(off - gap * axis)),
        angle_rad=float(rotations.angle_between(attitude, chaser.q_wxyz)),
        closing_m_s=-speed,
        lateral_speed_m_s=float(np.linalg.norm(velocity - speed * axis)),
        rate_rad_s=_relative_rate(chaser, target),
    )


def _relative_rate(chaser: BodyState, target: BodyState) -> float:
    """Return the magnitude of the rate of a chaser relative to the target, rad/s."""
    own = rotations.rotate(chaser.q_wxyz, chaser.omega_rad_s)
    return float(np.linalg.norm(own - rotations.rotate(target.q_wxyz, target.omega_rad_s)))


def segments_apart(a: Array, b: Array, c: Array, d: Array) -> float:
    """Return the smallest distance between the segments a-b and c-d, each end (3,).

    Source: C. Ericson, "Real-Time Collision Detection", 2005, section 5.1.9.
    """
    u, v, r = b - a, d - c, a - c
    uu, vv, uv, ur, vr = (float(x) for x in (u @ u, v @ v, u @ v, u @ r, v @ r))
    slant = uu * vv - uv * uv
    s = (
        min(1.0, max(0.0, (uv * vr - ur * vv) / slant))
        if slant > 1e-12 * uu * vv and slant > 0.0
        else 0.0
    )
    t = (uv * s + vr) / vv if vv > 0.0 else 0.0
    if not 0.0 <= t <= 1.0 or vv == 0.0:
        t = min(1.0, max(0.0, t))
        s = min(1.0, max(0.0, (uv * t - ur) / uu)) if uu > 0.0 else 0.0
    return float(np.linalg.norm(r + s * u - t * v))
