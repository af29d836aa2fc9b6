# SPDX-License-Identifier: Apache-2.0
"""Decide whether robots may move, whatever the controller says. No I/O; time is passed in.

Nothing moves before ``arm``. What must not happen (``violations``) disarms all robots, with a
named reason; they stay so until ``arm``. ``kill`` is final.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from chaserdock_models.arrays import Array
from chaserdock_protocol.scenario.lab import LabSafety

ArmingState = Literal["disarmed", "armed", "killed"]
ArmingAction = Literal["arm", "disarm", "kill"]


@dataclass(frozen=True, eq=False)
class RobotSight:
    """What the gateway knows of a robot when it decides.

    Ages in s: of its newest pose, and of its newest command, infinite before the first one.
    position_m (3,) in WRF; None before the first odometry. ``jumped_m``: how far its odometry has
    jumped since the last look. ``unexplained_m_s2``: see ``Obedience``.
    """

    chaser: int
    odometry_age_s: float
    command_age_s: float
    position_m: Array | None = None
    speed_m_s: float = 0.0
    rate_rad_s: float = 0.0
    jumped_m: float = 0.0
    unexplained_m_s2: float = 0.0


def violations(robot: RobotSight, limits: LabSafety) -> list[str]:
    """Return what forbids a robot to move, whether it is commanded or not."""
    name, found = f"chaser {robot.chaser}", []
    if robot.position_m is None or not robot.odometry_age_s <= limits.stale_s:
        age = f"{robot.odometry_age_s:.2f} s old" if math.isfinite(robot.odometry_age_s) else "none"
        found.append(f"{name}: odometry lost ({age}, limit {limits.stale_s:g} s)")
        return found
    volume = limits.volume
    places = zip(volume.lower_m, robot.position_m.tolist(), volume.upper_m, strict=True)
    if not all(lower <= x <= upper for lower, x, upper in places):
        place = ", ".join(f"{x:.3f}" for x in robot.position_m)
        found.append(f"{name}: left the volume, at ({place}) m")
    if not robot.speed_m_s <= limits.max_speed_m_s:
        found.append(
            f"{name}: too fast, {robot.speed_m_s:.3f} m/s (limit {limits.max_speed_m_s:g})"
        )
    rate = math.degrees(robot.rate_rad_s)
    if not rate <= limits.max_rate_deg_s:
        found.append(f"{name}: turns too fast, {rate:.1f} deg/s (limit {limits.max_rate_deg_s:g})")
    if robot.jumped_m > 0.0:
        found.append(f"{name}: odometry jumped by {robot.jumped_m:.2f} m")
    return found


class Obedience:
    """Compare a robot's motion with its commands: the mean acceleration of the last
    ``MEMORY_S`` that they do not explain, m/s².
    """

    MEMORY_S = 3.0
    """Time constant: noise of a velocity of 5 mm/s then counts as less than 2 mm/s²."""

    def __init__(self, mass_kg: float) -> None:
        self._mass_kg = mass_kg
        self._expected_m_s: Array | None = None
        self._force_N: Array = np.zeros(3)
        self._time_ns = 0
        self.unexplained_m_s2 = 0.0

    def command(self, force_N: Array) -> None:
        """Note the force (3,) that acts from now on, WRF."""
        self._force_N = force_N

    def observe(self, time_ns: int, velocity_m_s: Array) -> None:
        """Take a measured velocity (3,), WRF."""
        if self._expected_m_s is None or time_ns - self._time_ns > self.MEMORY_S * 1e9:
            self._expected_m_s, self._time_ns = velocity_m_s.copy(), time_ns
            return
        step_s = (time_ns - self._time_ns) / 1e9
        if step_s <= 0.0:
            return
        self._time_ns = time_ns
        moved = self._expected_m_s + self._force_N / self._mass_kg * step_s
        share = math.exp(-step_s / self.MEMORY_S)
        self._expected_m_s = velocity_m_s + share * (moved - velocity_m_s)
        residual = float(np.linalg.norm(velocity_m_s - self._expected_m_s))
        self.unexplained_m_s2 = residual / self.MEMORY_S

    def restart(self) -> None:
        """Forget the past, as when robots are armed."""
        self._expected_m_s, self.unexplained_m_s2 = None, 0.0
        self._force_N = np.zeros(3)


class SafetyGate:
    """Arming state of all robots of a laboratory. ``reason``: why it is as it is."""

    def __init__(self, limits: LabSafety) -> None:
        self._limits = limits
        self.state: ArmingState = "disarmed"
        self.reason = "not armed yet"

    @property
    def is_armed(self) -> bool:
        """Return whether robots may move."""
        return self.state == "armed"

    def refusal(self, robots: tuple[RobotSight, ...]) -> str:
        """Return why robots may not be armed, empty if they may."""
        if self.state == "killed":
            return f"{self.reason}; start the gateway again"
        return "; ".join(text for robot in robots for text in violations(robot, self._limits))

    def request(
        self, action: ArmingAction, by: str, robots: tuple[RobotSight, ...]
    ) -> tuple[bool, str]:
        """Do what a person asks for. Returns whether it is done, and why."""
        who = by or "an operator"
        if self.state == "killed":
            return action == "kill", self.refusal(robots)
        if action == "arm":
            if refusal := self.refusal(robots):
                return False, refusal
            self.state = "armed"
        else:
            self.state = "killed" if action == "kill" else "disarmed"
        self.reason = f"{self.state} by {who}"
        return True, self.reason

    def check(self, robots: tuple[RobotSight, ...]) -> str:
        """Disarm if armed robots violate a limit, or have a stale command; return why, else
        nothing.
        """
        if not self.is_armed:
            return ""
        found = [text for robot in robots for text in violations(robot, self._limits)]
        found += [
            f"chaser {r.chaser}: command stale ({r.command_age_s:.2f} s old, limit "
            f"{self._limits.stale_s:g} s)"
            for r in robots
            if self._limits.stale_s < r.command_age_s < math.inf
        ]
        limit = self._limits.max_unexplained_m_s2
        found += [
            f"chaser {r.chaser}: does not obey, {r.unexplained_m_s2:.3f} m/s² that no command "
            f"explains (limit {limit:g})"
            for r in robots
            if not r.unexplained_m_s2 <= limit
        ]
        return self.trip("; ".join(found)) if found else ""

    def trip(self, reason: str) -> str:
        """Disarm for a reason that no person gave; return it."""
        if self.state != "killed":
            self.state, self.reason = "disarmed", reason
        return reason


def limited_wrench(force_N: Array, torque_N_m: Array, limits: LabSafety) -> tuple[Array, Array]:
    """Return force (3,) and torque (3,), each scaled to its limit; zero if not finite."""
    if not (np.isfinite(force_N).all() and np.isfinite(torque_N_m).all()):
        return np.zeros(3), np.zeros(3)
    return (
        _scaled(force_N, limits.max_force_N),
        _scaled(torque_N_m, limits.max_torque_N_m),
    )


def limited_duty(duty: Array, matrix: Array, limits: LabSafety) -> Array:
    """Return the duty (n,) of thrusters, scaled so that their mean wrench is within the limits.

    ``matrix`` (6, n): wrench of each open thruster, CRF.
    """
    duty = np.clip(np.where(np.isfinite(duty), duty, 0.0), 0.0, 1.0)
    wrench, share = matrix @ duty, 1.0
    for part, limit in ((wrench[:3], limits.max_force_N), (wrench[3:], limits.max_torque_N_m)):
        if limit is not None and (size := float(np.linalg.norm(part))) > limit:
            share = min(share, limit / size)
    return duty * share


def _scaled(vector: Array, limit: float | None) -> Array:
    size = float(np.linalg.norm(vector))
    return vector if limit is None or size <= limit else vector * (limit / size)
