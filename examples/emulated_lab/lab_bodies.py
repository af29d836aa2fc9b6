# SPDX-License-Identifier: Apache-2.0
"""Bodies of the emulated laboratory: robots with thrusters, and a target with ports.

Rigid bodies, moved by Euler steps of 2 ms. Touch and latch are springs with dampers. Shares no code
with chaserdock.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import InitVar, dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

STEP_S = 2e-3
STOP_PER_S = 1.5  # how fast a body that is switched off comes to rest, as on a floor without air
# Springs: 0.2 mm deep at 10 mm/s and 15 kg; their periods are 100 steps long.
TOUCH_N_M, TOUCH_N_S_M = 2e4, 100.0
LATCH_N_M, LATCH_N_S_M = 2e4, 600.0
LATCH_N_M_RAD, LATCH_N_M_S_RAD = 600.0, 15.0
FRICTION = 0.2
PORT_RADIUS_M = 0.03  # touches of the tip farther from the middle of its port hit something else
NEW_TOUCH_S = 0.02  # time without touch after which a touch is a new one


def cross(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Return the cross product of two vectors (3,): a tenth of the time of numpy's."""
    (ax, ay, az), (bx, by, bz) = a, b
    return np.array([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx])


def turned(vector: np.ndarray) -> np.ndarray:
    """Return the matrix (3, 3) of a rotation vector, by Rodrigues: a tenth of scipy's time."""
    x, y, z = vector
    angle = max(math.sqrt(x * x + y * y + z * z), 1e-12)
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]) / angle
    return np.eye(3) + math.sin(angle) * skew + (1.0 - math.cos(angle)) * skew @ skew


@dataclass
class Body:
    """A rigid body, a cuboid; ``omega`` in its own axes, which are the columns of ``axes``.
    Switched off, friction stops it.
    """

    position: np.ndarray
    start: InitVar[Rotation]
    mass_kg: float = 30.0
    inertia: np.ndarray = field(default_factory=lambda: np.array([0.1625, 0.1625, 0.3125]))
    size_m: np.ndarray = field(default_factory=lambda: np.array([0.25, 0.25, 0.05]))
    is_planar: bool = False  # moves on a floor: in x, y and yaw
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))
    omega: np.ndarray = field(default_factory=lambda: np.zeros(3))
    is_on: bool = True

    def __post_init__(self, start: Rotation) -> None:
        self.axes = start.as_matrix()

    @property
    def rotation(self) -> Rotation:
        """The attitude: from its own axes to the laboratory's."""
        return Rotation.from_matrix(self.axes)

    @rotation.setter
    def rotation(self, rotation: Rotation) -> None:
        self.axes = rotation.as_matrix()

    def at(self, point: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return place and velocity of a point of the body."""
        sweep = self.axes @ cross(self.omega, point)
        return self.position + self.axes @ point, self.velocity + sweep

    def move(self, force: np.ndarray, torque: np.ndarray) -> None:
        """Move for a step; force in the axes of the laboratory, torque in the body's."""
        if self.is_planar:
            force, torque = force * (1.0, 1.0, 0.0), torque * (0.0, 0.0, 1.0)
        self.velocity = self.velocity + force / self.mass_kg * STEP_S
        (x, y, z), (a, b, c) = self.omega, self.inertia
        gyro = np.array([(c - b) * y * z, (a - c) * z * x, (b - a) * x * y])
        self.omega = self.omega + (torque - gyro) / self.inertia * STEP_S
        if not self.is_on:
            kept = max(0.0, 1.0 - STOP_PER_S * STEP_S)
            self.velocity, self.omega = self.velocity * kept, self.omega * kept
        self.position = self.position + self.velocity * STEP_S
        self.axes = self.axes @ turned(self.omega * STEP_S)


@dataclass(frozen=True)
class Port:
    """Where a robot docks, in the axes of the target: place of its tip, outward axis, and its
    attitude when docked. A touch within the limits closes an armed latch.
    """

    position: np.ndarray
    axis: np.ndarray
    docked: Rotation
    reach_m: float  # of the tip, ahead of the robot's centre
    lateral_m: float = 0.01
    angle_deg: float = 3.0
    lateral_speed_m_s: float = 0.01
    closing_m_s: float = 0.02


class Probe:
    """The probe of a robot: touches the target, and holds it once its latch has closed.

    ``misses``: touches of the target beside the port. ``refusals``: why touches did not latch.
    """

    def __init__(self, port: Port) -> None:
        self.port = port
        self._far_m2 = (port.reach_m + 2.0 * float(np.linalg.norm(port.position))) ** 2
        self.tip = np.array([port.reach_m, 0.0, 0.0])
        self.is_armed = self.is_latched = self.has_touched = False
        self.misses: list[str] = []
        self.refusals: list[str] = []
        self._since_touch_s = math.inf
        self._held = (np.zeros(3), Rotation.identity())

    def command(self, command: str) -> None:
        """Arm the latch, or open it (``release``)."""
        self.is_armed = command == "arm"
        self.is_latched &= self.is_armed

    def load(self, robot: Body, target: Body) -> tuple[np.ndarray, np.ndarray]:
        """Return force and torque of the target on the robot at its tip, laboratory's axes."""
        self._since_touch_s += STEP_S
        apart = robot.position - target.position
        if apart @ apart > self._far_m2:  # cannot touch
            return np.zeros(3), np.zeros(3)
        tip, tip_speed = robot.at(self.tip)
        place = target.axes.T @ (tip - target.position)
        _, speed = target.at(place)
        motion = target.axes.T @ (tip_speed - speed)
        if self.is_latched:
            return self._held_load(robot, target, place, motion)
        off = place - self.port.position
        gap, rise = float(off @ self.port.axis), float(motion @ self.port.axis)
        inside = np.abs(place) <= target.size_m / 2.0
        at_face = -PORT_RADIUS_M < gap <= 0.0
        if not at_face or not (inside | (np.abs(self.port.axis) > 0.5)).all():
            return np.zeros(3), np.zeros(3)
        self._touch(robot, target, off, motion)
        press = max(0.0, -TOUCH_N_M * gap - TOUCH_N_S_M * rise)
        slide = motion - rise * self.port.axis
        drag = FRICTION * press * slide / max(float(np.linalg.norm(slide)), 1e-3)
        return target.axes @ (press * self.port.axis - drag), np.zeros(3)

    def _touch(self, robot: Body, target: Body, off: np.ndarray, motion: np.ndarray) -> None:
        is_new, self._since_touch_s = self._since_touch_s > NEW_TOUCH_S, 0.0
        self.has_touched = True
        if not is_new:
            return
        port, turn = self.port, target.rotation.inv() * robot.rotation
        gap, rise = float(off @ port.axis), float(motion @ port.axis)
        figures = {
            "mm off": (np.linalg.norm(off - gap * port.axis) * 1e3, port.lateral_m * 1e3),
            "deg off": (math.degrees((port.docked.inv() * turn).magnitude()), port.angle_deg),
            "mm/s lateral": (
                np.linalg.norm(motion - rise * port.axis) * 1e3,
                port.lateral_speed_m_s * 1e3,
            ),
            "mm/s closing": (-rise * 1e3, port.closing_m_s * 1e3),
        }
        if figures["mm off"][0] > PORT_RADIUS_M * 1e3:
            self.misses.append(f"{figures['mm off'][0]:.0f} mm beside the port")
        wrong = [f"{value:.1f} {unit}" for unit, (value, most) in figures.items() if value > most]
        if not self.is_armed or wrong:
            self.refusals.append(", ".join(wrong) or "not armed")
            return
        self.is_latched, self._held = True, (off + port.position, turn)

    def _held_load(
        self, robot: Body, target: Body, place: np.ndarray, motion: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        held, turn = self._held
        force = -LATCH_N_M * (place - held) - LATCH_N_S_M * motion
        off = (turn.inv() * target.rotation.inv() * robot.rotation).as_rotvec()
        spin = robot.omega - robot.axes.T @ target.axes @ target.omega
        torque = -LATCH_N_M_RAD * off - LATCH_N_M_S_RAD * spin
        return target.axes @ force, robot.axes @ torque


class Actuators:
    """Force and torque of a robot, body axes, that follow their commands with a lag.

    ``thrusters`` (n, 7): place, direction and thrust of each. Without them, the robot takes
    wrenches.
    """

    RESPONSE_S = 0.02
    PERIOD_S = 0.1  # of the pulses by which thrusters, which are open or closed, obey a duty

    def __init__(self, thrusters: np.ndarray | None = None) -> None:
        self.matrix = np.zeros((6, 0))
        if thrusters is not None and len(thrusters):
            force = thrusters[:, 3:6] * thrusters[:, 6:]
            self.matrix = np.hstack([force, np.cross(thrusters[:, :3], force)]).T
        self._wrench = np.zeros(6)
        self._duty = np.zeros(self.matrix.shape[1])
        self._begun_ns = 0
        self.output = np.zeros(6)

    @property
    def is_at_zero(self) -> bool:
        """Whether zero is commanded."""
        return not (self._wrench.any() or self._duty.any())

    def command(self, force: np.ndarray, torque: np.ndarray) -> None:
        """Give a wrench from now on."""
        self._wrench = np.concatenate([force, torque])

    def command_duty(self, duty: np.ndarray, now_ns: int) -> None:
        """Open each thruster for its share of a period that begins now; then close it."""
        self._duty, self._begun_ns = np.nan_to_num(duty), now_ns

    def stop(self) -> None:
        """Command zero."""
        self._wrench, self._duty = np.zeros(6), np.zeros(self.matrix.shape[1])

    def step(self, now_ns: int) -> np.ndarray:
        """Return the wrench (6,) of a step."""
        wrench = self._wrench
        if self.matrix.size:
            left_s = self._duty * self.PERIOD_S - (now_ns - self._begun_ns) / 1e9
            wrench = self.matrix @ np.clip(left_s / STEP_S, 0.0, 1.0)
        self.output = self.output + (wrench - self.output) * (STEP_S / self.RESPONSE_S)
        return self.output


def apart_m(a: Body, b: Body) -> float:
    """Return the distance of two cuboids, by points on the surface of either: 0 if they touch."""
    return min(_surface_apart(a, b), _surface_apart(b, a))


def shaft_apart_m(robot: Body, reach_m: float, target: Body) -> float:
    """Return the distance of a probe, less its last 3 cm, from the target's cuboid."""
    ahead = np.linspace(robot.size_m[0] / 2.0, reach_m - PORT_RADIUS_M, 6)
    return _points_apart(robot, np.outer(ahead, [1.0, 0.0, 0.0]), target)


_UNIT = np.array(
    [p for p in itertools.product(np.linspace(-0.5, 0.5, 5), repeat=3) if max(map(abs, p)) == 0.5]
)


def _surface_apart(a: Body, b: Body) -> float:
    return _points_apart(a, _UNIT * a.size_m, b)


def _points_apart(a: Body, points: np.ndarray, b: Body) -> float:
    places = b.rotation.inv().apply(a.rotation.apply(points) + a.position - b.position)
    beyond = np.maximum(np.abs(places) - b.size_m / 2.0, 0.0)
    return float(np.linalg.norm(beyond, axis=1).min())
