# SPDX-License-Identifier: Apache-2.0
"""A laboratory of free flyers: bodies, thruster response, motion capture and cameras, each with a
clock, latency and faults of its own.

Shares nothing with chaserdock: rigid bodies as scipy rotations, stepped at 500 Hz. `advance` takes
any clock, so that it flies in virtual and in real time.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

STEP_S = 2e-3
RESPONSE_S = 0.02  # time constant of the thrusters
STOP_PER_S = 1.5  # how fast a body that is switched off comes to rest, as on a floor without air
# Camera axes (x right, y down, z forward) in body axes (x forward, z up).
CAMERA_AXES = Rotation.from_matrix([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])

FAULTS = (
    "camera frozen",
    "frames lost",
    "camera clock steps",
    "motion capture jumps",
    "motion capture frozen",
    "motion capture swapped",
    "robot does not obey",
    "robot gone",
)


def wxyz(rotation: Rotation) -> np.ndarray:
    x, y, z, w = rotation.as_quat()
    return np.array([w, x, y, z])


@dataclass
class Clock:
    """A clock that is ahead by ``offset_s`` and faster by ``drift``."""

    offset_s: float
    drift: float

    def stamp_ns(self, time_ns: int) -> int:
        return round(time_ns * (1.0 + self.drift) + self.offset_s * 1e9)


@dataclass
class Body:
    """A rigid body; ``omega`` in its own axes. Switched off it comes to rest by friction."""

    position: np.ndarray
    rotation: Rotation
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))
    omega: np.ndarray = field(default_factory=lambda: np.zeros(3))
    force: np.ndarray = field(default_factory=lambda: np.zeros(3))
    torque: np.ndarray = field(default_factory=lambda: np.zeros(3))
    is_on: bool = True


@dataclass(frozen=True)
class Fault:
    """What goes wrong with ``chaser`` from ``at_s`` to ``until_s`` after the first command."""

    kind: str
    at_s: float
    until_s: float = math.inf
    chaser: int = 0


@dataclass(frozen=True)
class Capture:
    """What motion capture says of one body."""

    name: str
    stamp_ns: int
    position: np.ndarray
    q_wxyz: np.ndarray


@dataclass(frozen=True)
class Exposure:
    """What a camera sees: the target in its axes, and the stamp of the exposure."""

    stamp_ns: int
    target_m: np.ndarray
    q_wxyz: np.ndarray
    number: int


class Laboratory:
    """Bodies and devices. ``command`` and ``stop`` are the robots' side."""

    def __init__(
        self,
        chasers: Mapping[int, Body],
        target: Body,
        camera_m: Sequence[float],
        mass_kg: float,
        inertia: Sequence[float],
        seed: int,
        faults: Sequence[Fault] = (),
    ) -> None:
        self.rng = np.random.default_rng(seed)
        self.chasers, self.target = dict(chasers), target
        self.mass_kg, self.inertia = mass_kg, np.array(inertia)
        self.camera_m, self.faults = np.array(camera_m), tuple(faults)
        self.wrench = {i: (np.zeros(3), np.zeros(3)) for i in chasers}
        self.now_ns = 0
        self.begun_ns: int | None = None
        self.captured: deque[tuple[int, Capture]] = deque()
        self.exposed: dict[int, deque[tuple[int, Exposure]]] = {i: deque() for i in chasers}
        self.history: list[tuple[int, dict[str, tuple[np.ndarray, Rotation]]]] = []
        self.closest_m = math.inf
        uniform = self.rng.uniform
        self.capture_clock = Clock(uniform(-0.5, 0.5), uniform(-5e-5, 5e-5))
        self.camera_clocks = {i: Clock(uniform(-5, 5), uniform(-5e-5, 5e-5)) for i in chasers}

    # -- robots ------------------------------------------------------------------------------------

    def command(self, chaser: int, force: np.ndarray, torque: np.ndarray, now_ns: int) -> None:
        self.advance(now_ns)
        if self.begun_ns is None:
            self.begun_ns = now_ns
        if self.has("robot gone", chaser):
            raise ConnectionError("the robot does not answer")
        self.chasers[chaser].is_on = True
        self.wrench[chaser] = (force, torque)

    def stop(self, chaser: int, now_ns: int) -> None:
        self.advance(now_ns)
        self.wrench[chaser] = (np.zeros(3), np.zeros(3))
        self.chasers[chaser].is_on = self.begun_ns is None

    def has(self, kind: str, chaser: int = 0) -> bool:
        """Whether a fault is present."""
        if self.begun_ns is None:
            return False
        t = (self.now_ns - self.begun_ns) / 1e9
        return any(
            f.kind == kind and f.chaser == chaser and f.at_s <= t < f.until_s for f in self.faults
        )

    # -- time --------------------------------------------------------------------------------------

    def advance(self, now_ns: int) -> None:
        """Move on to a time, and measure on the way."""
        step_ns = round(STEP_S * 1e9)
        if self.now_ns == 0:
            self.now_ns = now_ns - now_ns % step_ns
        while self.now_ns + step_ns <= now_ns:
            self._step()
            self.now_ns += step_ns
            number = self.now_ns // step_ns
            if number % 5 == 3:  # 100 Hz
                self._capture()
            for i in self.chasers:
                if number % 17 == 5 * i:  # 29.4 Hz
                    self._expose(i)
            if number % 50 == 0:
                self._note()

    def _step(self) -> None:
        for i, body in self.chasers.items():
            force, torque = self.wrench[i]
            if self.has("robot does not obey", i) and body.is_on:
                force, torque = np.array([2.5, 1.0, -0.5]), np.array([0.0, 0.0, 0.004])
            share = STEP_S / RESPONSE_S
            body.force = body.force + (force - body.force) * share
            body.torque = body.torque + (torque - body.torque) * share
            self._move(body, body.force, body.torque)
        turned = Rotation.from_rotvec(self.target.omega * STEP_S)
        self.target.rotation = self.target.rotation * turned
        self.target.position = self.target.position + self.target.velocity * STEP_S

    def _move(self, body: Body, force: np.ndarray, torque: np.ndarray) -> None:
        body.velocity = body.velocity + body.rotation.apply(force) / self.mass_kg * STEP_S
        (x, y, z), (a, b, c) = body.omega, self.inertia
        gyro = np.array([(c - b) * y * z, (a - c) * z * x, (b - a) * x * y])
        body.omega = body.omega + (torque - gyro) / self.inertia * STEP_S
        if not body.is_on:
            kept = max(0.0, 1.0 - STOP_PER_S * STEP_S)
            body.velocity, body.omega = body.velocity * kept, body.omega * kept
        body.position = body.position + body.velocity * STEP_S
        body.rotation = body.rotation * Rotation.from_rotvec(body.omega * STEP_S)

    def _note(self) -> None:
        bodies = {"target": self.target, **{f"chaser/{i}": b for i, b in self.chasers.items()}}
        states = {name: (b.position.copy(), b.rotation) for name, b in bodies.items()}
        self.history.append((self.now_ns, states))
        for (a, _), (b, _) in combinations(states.values(), 2):
            self.closest_m = min(self.closest_m, float(np.linalg.norm(a - b)))

    # -- devices -----------------------------------------------------------------------------------

    def _capture(self) -> None:
        stamp_ns = self.capture_clock.stamp_ns(self.now_ns)
        delay_ns = round((0.004 + self.rng.exponential(0.001)) * 1e9)
        bodies = {"target": self.target, **{f"robot{i}": b for i, b in self.chasers.items()}}
        for name, body in bodies.items():
            i = int(name[5:]) if name != "target" else -1
            noise = self.rng.normal(0, 3e-4, 3), self.rng.normal(0, math.radians(0.03), 3)
            if self.has("motion capture frozen", i):
                continue
            if self.has("motion capture swapped", i):
                body = self.chasers[(i + 1) % len(self.chasers)]
            place = body.position + noise[0]
            if self.has("motion capture jumps", i):
                place = place + np.array([0.4, -0.3, 0.2])
            rotation = body.rotation * Rotation.from_rotvec(noise[1])
            capture = Capture(name, stamp_ns, place, wxyz(rotation))
            self.captured.append((self.now_ns + delay_ns, capture))

    def _expose(self, i: int) -> None:
        lost = self.has("frames lost", i) and self.rng.uniform() < 0.7
        if lost or self.has("camera frozen", i):
            return
        body = self.chasers[i]
        axes = body.rotation * CAMERA_AXES
        lens = body.position + body.rotation.apply(self.camera_m)
        stamp_ns = self.camera_clocks[i].stamp_ns(self.now_ns)
        if self.has("camera clock steps", i):
            stamp_ns += 700_000_000
        exposure = Exposure(
            stamp_ns,
            axes.inv().apply(self.target.position - lens),
            wxyz(axes.inv() * self.target.rotation),
            int(self.rng.integers(2**31)),
        )
        delay_ns = round((0.02 + self.rng.exponential(0.004)) * 1e9)
        self.exposed[i].append((self.now_ns + delay_ns, exposure))
