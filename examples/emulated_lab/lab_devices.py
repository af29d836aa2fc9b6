# SPDX-License-Identifier: Apache-2.0
"""A laboratory of robots and a target: bodies, motion capture, cameras and probes, each device with
a clock, latency and faults of its own.

Shares nothing with chaserdock. `Laboratory.advance` takes any clock, so that it flies in virtual
and in real time.
"""

from __future__ import annotations

import math
import tomllib
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from lab_bodies import STEP_S, Actuators, Body, Port, Probe, apart_m, cross, shaft_apart_m
from scipy.spatial.transform import Rotation

LOST_S = 0.3  # without commands, robots stop by themselves: COM_OF_LOSS_T of PX4
# Camera axes (x right, y down, z forward) in body axes (x forward, z up).
CAMERA_AXES = Rotation.from_matrix([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])

NOTHING = (np.zeros(3), np.zeros(3))

FAULTS = (
    "camera frozen",
    "camera repeats",
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
    """What a camera sees: the target in its axes, and the stamp of the exposure. ``number`` seeds
    its noise.
    """

    stamp_ns: int
    target_m: np.ndarray
    q_wxyz: np.ndarray
    number: int


@dataclass(frozen=True)
class Optics:
    """The cameras, one on each robot: ``place`` in its axes, to which each is mounted with errors,
    and focal length off by a share; delays from exposure to arrival: the least, and the mean beyond
    it.
    """

    place: np.ndarray = field(default_factory=lambda: np.array([0.07, 0.0, 0.075]))
    width: int = 640
    height: int = 480
    hfov_deg: float = 60.0
    rate_hz: float = 29.4
    least_delay_s: float = 0.02
    more_delay_s: float = 0.004
    turn_sigma_deg: float = 0.05
    shift_sigma_m: float = 0.0005
    focal_sigma: float = 0.0005


@dataclass
class Setup:
    """A laboratory before a flight. ``layout``: side, and place to the right and up, of the markers
    of each face of the target, whose ids count on from face to face.
    """

    chasers: dict[int, Body]
    target: Body
    optics: Optics = field(default_factory=Optics)
    actuators: dict[int, Actuators] = field(default_factory=dict)
    probes: dict[int, Probe] = field(default_factory=dict)
    dictionary: str = "DICT_4X4_100"
    layout: tuple[tuple[float, float, float], ...] = ()
    margin_m: float = 0.005


class Laboratory:
    """Bodies and devices. ``command``, ``hear`` and ``stop`` are the robots' side: a robot that
    hears nothing stops.
    """

    def __init__(self, setup: Setup, seed: int, faults: Sequence[Fault] = ()) -> None:
        self.rng = np.random.default_rng(seed)
        self.setup, self.chasers, self.target = setup, setup.chasers, setup.target
        self.actuators = {i: setup.actuators.get(i) or Actuators() for i in self.chasers}
        self.probes, self.faults = setup.probes, tuple(faults)
        self.now_ns = 0
        self.begun_ns: int | None = None
        self._heard_ns: dict[int, int] = {}
        # For two listeners, the second of which may be absent.
        self.captured: deque[tuple[int, Capture]] = deque(maxlen=1000)
        self.copied: deque[tuple[int, Capture]] = deque(maxlen=1000)
        self.exposed: dict[int, deque[tuple[int, Exposure]]] = {i: deque() for i in self.chasers}
        self._last_exposure: dict[int, Exposure] = {}
        self.history: list[tuple[int, dict[str, tuple[np.ndarray, Rotation]]]] = []
        self.clearance_m = math.inf
        uniform = self.rng.uniform
        self.capture_clock = Clock(uniform(-0.5, 0.5), uniform(-5e-5, 5e-5))
        self.camera_clocks = {i: Clock(uniform(-5, 5), uniform(-5e-5, 5e-5)) for i in self.chasers}
        self._lenses: dict[int, tuple[np.ndarray, Rotation, float]] = {}
        optics, mounting = setup.optics, np.random.default_rng([seed, 13])
        for i in self.chasers:
            turn, shift = mounting.normal(size=(2, 3))
            turn_rad = turn * math.radians(optics.turn_sigma_deg)
            focal = mounting.normal(0.0, optics.focal_sigma)
            self.mount(i, turn_rad, shift * optics.shift_sigma_m, focal)
        period_ns = round(1e9 / setup.optics.rate_hz)
        self._next_exposure = {i: period_ns * i // len(self.chasers) for i in self.chasers}

    def mount(self, chaser: int, turn_rad: np.ndarray, shift_m: np.ndarray, focal: float) -> None:
        """Mount a camera with errors: a rotation vector and a shift, robot's axes, and a share of
        the focal length.
        """
        turn = Rotation.from_rotvec(turn_rad) * CAMERA_AXES
        self._lenses[chaser] = (self.setup.optics.place + shift_m, turn, 1.0 + focal)

    # -- robots ------------------------------------------------------------------------------------

    def command(
        self,
        chaser: int,
        force: np.ndarray,
        torque: np.ndarray,
        now_ns: int,
        duty: np.ndarray | None = None,
    ) -> None:
        """Command a robot: a wrench, or the duty of its thrusters where it has any."""
        self.advance(now_ns)
        if self.begun_ns is None:
            self.begun_ns = now_ns
        if self.has("robot gone", chaser):
            raise ConnectionError("the robot does not answer")
        self.hear(chaser, now_ns)
        self.chasers[chaser].is_on = True
        if duty is not None and len(duty):
            self.actuators[chaser].command_duty(duty, now_ns)
        else:
            self.actuators[chaser].command(force, torque)

    def hear(self, chaser: int, now_ns: int) -> None:
        """Note that a robot's commands go on, as they do when nothing changes."""
        self._heard_ns[chaser] = now_ns

    def stop(self, chaser: int, now_ns: int) -> None:
        self.advance(now_ns)
        self._switch_off(chaser)

    def _switch_off(self, chaser: int) -> None:
        self._heard_ns.pop(chaser, None)
        self.actuators[chaser].stop()
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
            self._next_exposure = {i: t + self.now_ns for i, t in self._next_exposure.items()}
        while self.now_ns + step_ns <= now_ns:
            for i, heard_ns in tuple(self._heard_ns.items()):
                if self.now_ns - heard_ns > LOST_S * 1e9:
                    self._switch_off(i)
            self._step()
            self.now_ns += step_ns
            number = self.now_ns // step_ns
            if number % 5 == 3:  # 100 Hz
                self._capture()
            for i, due_ns in self._next_exposure.items():
                if self.now_ns >= due_ns:
                    self._next_exposure[i] += round(1e9 / self.setup.optics.rate_hz)
                    self._expose(i)
            if number % 50 == 0:
                self._note()

    def _step(self) -> None:
        target_force, target_torque = np.zeros(3), np.zeros(3)
        for i, body in self.chasers.items():
            output = self.actuators[i].step(self.now_ns)
            if self.has("robot does not obey", i) and body.is_on:
                output = np.array([2.5, 1.0, -0.5, 0.0, 0.0, 0.004])
            force, torque = body.axes @ output[:3], output[3:]
            touch, twist = self.probes[i].load(body, self.target) if i in self.probes else NOTHING
            if touch.any():
                tip, _ = body.at(self.probes[i].tip)
                force = force + touch
                torque = torque + body.axes.T @ (twist + cross(tip - body.position, touch))
                target_force -= touch
                target_torque -= twist + cross(tip - self.target.position, touch)
            body.move(force, torque)
        self.target.move(target_force, self.target.axes.T @ target_torque)

    def _note(self) -> None:
        bodies = {"target": self.target, **{f"chaser/{i}": b for i, b in self.chasers.items()}}
        states = {name: (b.position.copy(), b.rotation) for name, b in bodies.items()}
        self.history.append((self.now_ns, states))
        apart = [apart_m(a, b) for a, b in combinations(bodies.values(), 2)]
        apart += [
            shaft_apart_m(self.chasers[i], probe.port.reach_m, self.target)
            for i, probe in self.probes.items()
        ]
        self.clearance_m = min(self.clearance_m, *apart)

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
                body = self.chasers.get((i + 1) % len(self.chasers), body)
            place = body.position + noise[0]
            if self.has("motion capture jumps", i):
                place = place + np.array([0.4, -0.3, 0.2])
            rotation = body.rotation * Rotation.from_rotvec(noise[1])
            capture = Capture(name, stamp_ns, place, wxyz(rotation))
            for listener in (self.captured, self.copied):
                listener.append((self.now_ns + delay_ns, capture))

    def _expose(self, i: int) -> None:
        lost = self.has("frames lost", i) and self.rng.uniform() < 0.7
        if lost or self.has("camera frozen", i):
            return
        optics, body = self.setup.optics, self.chasers[i]
        place, turn, focal = self._lenses[i]
        axes, lens = body.rotation * turn, body.position + body.rotation.apply(place)
        stamp_ns = self.camera_clocks[i].stamp_ns(self.now_ns)
        if self.has("camera clock steps", i):
            stamp_ns += 700_000_000
        exposure = Exposure(
            stamp_ns,
            # A longer lens shows the target as if it were nearer.
            axes.inv().apply(self.target.position - lens) / (1.0, 1.0, focal),
            wxyz(axes.inv() * self.target.rotation),
            int(self.rng.integers(2**31)),
        )
        if self.has("camera repeats", i) and i in self._last_exposure:
            last = self._last_exposure[i]
            exposure = Exposure(stamp_ns, last.target_m, last.q_wxyz, last.number)
        self._last_exposure[i] = exposure
        delay_s = optics.least_delay_s + self.rng.exponential(optics.more_delay_s)
        self.exposed[i].append((self.now_ns + round(delay_s * 1e9), exposure))


# -- files -----------------------------------------------------------------------------------------


def read_setup(path: Path, seed: int) -> Setup:
    """Read a laboratory from a file. ``seed`` draws what its maker did not measure exactly: masses
    and thrusts.
    """
    text = tomllib.loads(path.read_text(encoding="utf-8"))
    rng = np.random.default_rng([seed, 11])
    target = _body(text["target"], rng)
    chasers, actuators, probes = {}, {}, {}
    for i, robot in enumerate(text["robot"]):
        robot = {**text.get("robots", {}), **robot}
        chasers[i] = _body(robot, rng)
        thrusters = np.array(robot.get("thrusters", [])).reshape(-1, 7)
        thrusters[:, 6] *= rng.normal(1.0, robot.get("thrust_sigma", 0.0), len(thrusters))
        actuators[i] = Actuators(thrusters)
        if "port" in robot:
            probes[i] = Probe(_port(robot["port"], robot["reach_m"]))
    optics = {**text.get("camera", {})}
    if "place" in optics:
        optics["place"] = np.array(optics["place"])
    return Setup(
        chasers,
        target,
        Optics(**optics),
        actuators,
        probes,
        text["target"]["dictionary"],
        tuple(map(tuple, text["target"]["markers"])),
        text["target"]["margin_m"],
    )


def _body(text: Mapping[str, Any], rng: np.random.Generator) -> Body:
    share = rng.normal(1.0, text.get("mass_sigma", 0.0))
    return Body(
        np.array(text["position_m"], dtype=float),
        Rotation.from_rotvec(text.get("rotation_deg", [0.0, 0.0, 0.0]), degrees=True),
        text["mass_kg"] * share,
        np.array(text["inertia_kg_m2"]) * share,
        np.array(text["size_m"]),
        text.get("is_planar", False),
        np.array(text.get("velocity_m_s", [0.0, 0.0, 0.0]), dtype=float),
        np.radians(text.get("omega_deg_s", [0.0, 0.0, 0.0])),
    )


def _port(text: Mapping[str, Any], reach_m: float) -> Port:
    return Port(
        np.array(text["position_m"]),
        np.array(text["axis"]),
        Rotation.from_rotvec(text["docked_deg"], degrees=True),
        reach_m,
    )
