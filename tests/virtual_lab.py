# SPDX-License-Identifier: Apache-2.0
"""A laboratory in virtual time: free flyers, motion capture and cameras with clocks of their own.

Shares no dynamics with the world: rigid bodies as scipy rotations, stepped at 1 kHz. Its devices
are polled by the gateway in the same thread of control, so that a flight is deterministic.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from chaserdock_agents.gateway import devices
from chaserdock_agents.gateway import process as gateway
from chaserdock_agents.gateway.devices import (
    CameraFrame,
    DeviceError,
    DeviceHost,
    PoseSample,
    RobotCommand,
)
from chaserdock_protocol import topics
from chaserdock_protocol.messages import ArmingCommand, ArmingReply
from chaserdock_protocol.pose_image import encode_pose
from chaserdock_protocol.process import ProcessOptions
from chaserdock_protocol.transport import Node
from scipy.spatial.transform import Rotation

from chaserdock.simulation.mission import SimulatedFlight, simulate

STEP_S = 1e-3
# Camera axes (x right, y down, z forward) in CRF (x forward, z up), from the frames' definition.
CAMERA_AXES = Rotation.from_matrix([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])


def wxyz(rotation: Rotation) -> np.ndarray:
    x, y, z, w = rotation.as_quat()
    return np.array([w, x, y, z])


@dataclass
class Clock:
    """A clock of a device: ahead of the host's by ``offset_s``, faster by ``drift``."""

    offset_s: float
    drift: float

    def stamp_ns(self, host_ns: int) -> int:
        return round(host_ns * (1.0 + self.drift) + self.offset_s * 1e9)


@dataclass
class Body:
    position: np.ndarray
    rotation: Rotation
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))
    omega: np.ndarray = field(default_factory=lambda: np.zeros(3))


@dataclass
class Fault:
    """From ``at_s`` to ``until_s`` of the flight, what ``kind`` says happens to ``chaser``."""

    kind: str
    at_s: float
    until_s: float = math.inf
    chaser: int = 0


class VirtualLab:
    """Bodies and devices. ``begun_ns``: host's time of the first command; faults count from it."""

    mass_kg, inertia = 4.1, np.array([0.03, 0.032, 0.034])

    def __init__(
        self,
        chasers: Mapping[int, Body],
        target: Body,
        camera_m: Sequence[float],
        seed: int,
        faults: Sequence[Fault] = (),
        mass_kg: float = 4.1,
        inertia: Sequence[float] = (0.03, 0.032, 0.034),
    ) -> None:
        self.rng = np.random.default_rng(seed)
        self.chasers, self.target = dict(chasers), target
        self.mass_kg, self.inertia = mass_kg, np.array(inertia)
        self.camera_m = np.array(camera_m)
        self.faults = tuple(faults)
        self.wrench = {i: (np.zeros(3), np.zeros(3)) for i in chasers}
        self.sent: list[tuple[int, int, RobotCommand]] = []
        self.stops = 0
        self.now_ns = 0
        self.begun_ns: int | None = None
        r = self.rng
        self.mocap_clock = Clock(r.uniform(-0.5, 0.5), r.uniform(-5e-5, 5e-5))
        self.camera_clocks = {i: Clock(r.uniform(-5, 5), r.uniform(-5e-5, 5e-5)) for i in chasers}
        self.poses: deque[tuple[int, PoseSample]] = deque()
        self.frames: dict[int, deque[tuple[int, CameraFrame]]] = {i: deque() for i in chasers}
        self.history: list[tuple[int, dict[str, tuple[np.ndarray, Rotation]]]] = []

    def is_on(self, kind: str, chaser: int = 0) -> bool:
        if self.begun_ns is None:
            return False
        t = (self.now_ns - self.begun_ns) / 1e9
        return any(
            f.kind == kind and f.chaser == chaser and f.at_s <= t < f.until_s for f in self.faults
        )

    def advance(self, host_ns: int) -> None:
        """Move on to a time of the host's clock, and measure on the way."""
        step_ns = round(STEP_S * 1e9)
        if self.now_ns == 0:
            self.now_ns = host_ns - host_ns % step_ns
        while self.now_ns + step_ns <= host_ns:
            for i, body in self.chasers.items():
                force, torque = self.wrench[i]
                if self.is_on("robot does not obey", i):
                    force, torque = np.array([2.5, 1.0, -0.5]), np.array([0.0, 0.0, 0.004])
                self._step(body, force, torque)
            self._step(self.target, np.zeros(3), None)
            self.now_ns += step_ns
            number = self.now_ns // step_ns
            if number % 10 == 3:
                self._capture()
            for i in self.chasers:
                if number % 33 == 5 * i:
                    self._expose(i)
            if number % 100 == 0:
                self.history.append((self.now_ns, self._states()))

    def _step(self, body: Body, force: np.ndarray, torque: np.ndarray | None) -> None:
        body.velocity = body.velocity + body.rotation.apply(force) / self.mass_kg * STEP_S
        body.position = body.position + body.velocity * STEP_S
        if torque is not None:
            gyro = np.cross(body.omega, self.inertia * body.omega)
            body.omega = body.omega + (torque - gyro) / self.inertia * STEP_S
        body.rotation = body.rotation * Rotation.from_rotvec(body.omega * STEP_S)

    def _states(self) -> dict[str, tuple[np.ndarray, Rotation]]:
        bodies = {"target": self.target, **{f"chaser/{i}": b for i, b in self.chasers.items()}}
        return {name: (b.position.copy(), b.rotation) for name, b in bodies.items()}

    def _capture(self) -> None:
        stamp_ns = self.mocap_clock.stamp_ns(self.now_ns)
        delay_ns = round((0.004 + self.rng.exponential(0.001)) * 1e9)
        bodies = {"target": self.target, **{f"robot{i}": b for i, b in self.chasers.items()}}
        for name, body in bodies.items():
            i = int(name[5:]) if name.startswith("robot") else 0
            if name != "target" and self.is_on("motion capture frozen", i):
                continue
            if name != "target" and self.is_on("motion capture swapped", i) and len(bodies) > 2:
                body = self.chasers[(i + 1) % len(self.chasers)]
            place = body.position + self.rng.normal(0, 3e-4, 3)
            if name != "target" and self.is_on("motion capture jumps", i):
                place = place + np.array([0.4, -0.3, 0.2])
            turn = Rotation.from_rotvec(self.rng.normal(0, math.radians(0.03), 3))
            sample = PoseSample(name, stamp_ns, 0, place, wxyz(body.rotation * turn))
            self.poses.append((self.now_ns + delay_ns, sample))

    def _expose(self, i: int) -> None:
        if self.is_on("frames lost", i) and self.rng.uniform() < 0.7:
            return
        if self.is_on("camera frozen", i):
            return
        body = self.chasers[i]
        axes = body.rotation * CAMERA_AXES
        lens = body.position + body.rotation.apply(self.camera_m)
        seen = axes.inv().apply(self.target.position - lens)
        q = wxyz(axes.inv() * self.target.rotation)
        seed = (int(self.rng.integers(2**31)), i)
        pixels = np.frombuffer(encode_pose(seen, q, seed), dtype=np.uint8).reshape(1, -1)
        clock = self.camera_clocks[i]
        stamp = clock.stamp_ns(self.now_ns)
        if self.is_on("clock steps", i):
            stamp += 700_000_000
        delay_ns = round((0.02 + self.rng.exponential(0.004)) * 1e9)
        self.frames[i].append((self.now_ns + delay_ns, CameraFrame(pixels, stamp, 0)))


@dataclass
class _Device:
    lab: VirtualLab
    host: DeviceHost
    chaser: int = 0

    def close(self) -> None: ...


class _MotionCapture(_Device):
    def poll(self) -> list[PoseSample]:
        now_ns = self.host.now_ns()
        self.lab.advance(now_ns)
        found = []
        while self.lab.poses and self.lab.poses[0][0] <= now_ns:
            at_ns, s = self.lab.poses.popleft()
            found.append(PoseSample(s.body, s.stamp_ns, at_ns, s.position_m, s.q_wxyz))
        return found


class _Camera(_Device):
    def poll(self) -> list[CameraFrame]:
        now_ns, frames = self.host.now_ns(), self.lab.frames[self.chaser]
        self.lab.advance(now_ns)
        found = []
        while frames and frames[0][0] <= now_ns:
            at_ns, frame = frames.popleft()
            found.append(CameraFrame(frame.image, frame.stamp_ns, at_ns))
        return found


class _Robot(_Device):
    def send(self, command: RobotCommand) -> None:
        now_ns = self.host.now_ns()
        self.lab.advance(now_ns)
        if self.lab.begun_ns is None:
            self.lab.begun_ns = now_ns
        self.lab.sent.append((now_ns, self.chaser, command))
        if not self.lab.is_on("robot gone", self.chaser):
            self.lab.wrench[self.chaser] = (command.force_N, command.torque_N_m)
        else:
            raise DeviceError("no reply")

    def stop(self) -> None:
        self.lab.advance(self.host.now_ns())
        self.lab.stops += 1
        self.lab.wrench[self.chaser] = (np.zeros(3), np.zeros(3))

    def arm(self) -> None: ...


@dataclass
class _Entry:
    name: str
    driver: Callable[..., Any]

    def load(self) -> Callable[..., Any]:
        return self.driver


def install(monkeypatch: pytest.MonkeyPatch, lab: VirtualLab) -> None:
    """Let the scheme ``virtual`` open the devices of a laboratory."""
    kinds = {"camera": _Camera, "pose": _MotionCapture, "robot": _Robot}

    def found(group: str) -> list[_Entry]:
        kind = next(k for k, g in devices.GROUPS.items() if g == group)

        def opened(rest: str, options: Mapping[str, Any], host: DeviceHost) -> _Device:
            return kinds[kind](lab, host, int(rest or 0))

        return [_Entry("virtual", opened)] if kind in kinds else []

    monkeypatch.setattr(devices, "entry_points", found)


def arm_when_ready(options: ProcessOptions, give_up_s: float = 20.0) -> int:
    """Ask the gateway to arm until it does; return 0 if it did."""
    node = Node("operator", "operator", options.link)
    try:
        begun = node.host.now_s()
        while node.host.now_s() - begun < give_up_s:
            reply = node.query(
                topics.ARMING_KEY, ArmingCommand(action="arm", operator="test"), ArmingReply, 1.0
            )
            if reply is not None and reply.accepted:
                return 0
            node.host.sleep(0.2)
        return 1
    finally:
        node.close()


def fly(
    scenario: Path, folder: Path, lab: VirtualLab, monkeypatch: pytest.MonkeyPatch, **others: Any
) -> SimulatedFlight:
    """Fly a scenario with ``[lab]`` on a virtual laboratory, armed as soon as it can be."""
    install(monkeypatch, lab)
    processes = {"world": gateway.main, "operator": arm_when_ready, **others}
    return simulate(scenario, folder, ("simulation.mode='realtime'",), others=processes)


SCENARIO = """
extends = "two-chaser-tracking"
name = "virtual-lab"
duration_s = 40.0
[camera]
effects.jpeg_quality = 0
[perception]
name = "statistical"
[success]
steady_position_rms_m = 0.008
[lab.safety]
volume = { lower_m = [-2.0, -2.0, -2.0], upper_m = [2.0, 2.0, 2.0] }
max_speed_m_s = 0.3
[[lab.odometry]]
body = "chaser/0"
address = "virtual:"
name = "robot0"
latency_s = 0.004
[[lab.odometry]]
body = "chaser/1"
address = "virtual:"
name = "robot1"
latency_s = 0.004
[[lab.robot]]
chaser = 0
address = "virtual:0"
[[lab.robot]]
chaser = 1
address = "virtual:1"
[[lab.camera]]
chaser = 0
address = "virtual:0"
latency_s = 0.02
[[lab.camera]]
chaser = 1
address = "virtual:1"
latency_s = 0.02
"""
"""Two free flyers that track a turning target, each 1 m from it."""


def two_free_flyers(seed: int, faults: Sequence[Fault] = ()) -> VirtualLab:
    """Return the laboratory of ``SCENARIO``."""
    target = Body(np.zeros(3), Rotation.identity(), omega=np.array([0.0, 0.0, math.radians(3.0)]))
    chasers = {
        0: Body(np.array([-1.2, 0.03, 0.0]), Rotation.from_rotvec([0.2, 0.0, 0.0])),
        1: Body(
            np.array([0.02, -1.2, 0.02]),
            Rotation.from_rotvec([0.0, 0.0, math.pi / 2])
            * Rotation.from_rotvec([-0.2, 0.03, -0.03]),
        ),
    }
    body = (30.0, (0.1625, 0.1625, 0.3125))
    return VirtualLab(chasers, target, (0.07, 0.0, 0.075), seed, faults, *body)


def tracking_errors_m(lab: VirtualLab, after_s: float) -> dict[int, np.ndarray]:
    """Return the distance of each chaser from its place beside the target, from ``after_s`` after
    the first command on.
    """
    assert lab.begun_ns is not None
    places = {0: np.array([-1.0, 0.0, 0.0]), 1: np.array([0.0, -1.0, 0.0])}
    errors: dict[int, list[float]] = {0: [], 1: []}
    for time_ns, states in lab.history:
        if time_ns - lab.begun_ns < after_s * 1e9:
            continue
        p, r = states["target"]
        for i, place in places.items():
            errors[i].append(float(np.linalg.norm(states[f"chaser/{i}"][0] - p - r.apply(place))))
    return {i: np.array(e) for i, e in errors.items()}
