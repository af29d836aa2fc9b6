# SPDX-License-Identifier: Apache-2.0
"""The emulated laboratory of the examples as devices in virtual time: the gateway polls it in its
own thread of control, so that a flight is deterministic.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib import import_module
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
    LatchReading,
    PoseSample,
    RobotCommand,
)
from chaserdock_protocol import topics
from chaserdock_protocol.messages import (
    ArmingCommand,
    ArmingReply,
    CommandReply,
    MissionEnd,
    OperatorCommand,
    Reference,
)
from chaserdock_protocol.pose_image import encode_pose
from chaserdock_protocol.process import ProcessOptions
from chaserdock_protocol.transport import Node

from chaserdock.simulation.mission import SimulatedFlight, simulate

FOLDER = Path(__file__).parents[1] / "examples" / "emulated_lab"
sys.path.append(str(FOLDER))
emulated = import_module("lab_devices")

Fault, Laboratory = emulated.Fault, emulated.Laboratory


@dataclass
class _Device:
    lab: Any
    host: DeviceHost
    chaser: int = 0

    def close(self) -> None: ...


@dataclass
class _MotionCapture(_Device):
    from_copy: bool = False

    def poll(self) -> list[PoseSample]:
        now_ns = self.host.now_ns()
        captured = self.lab.copied if self.from_copy else self.lab.captured
        self.lab.advance(now_ns)
        if not self.from_copy and self.lab.begun_ns is not None:
            for chaser, body in self.lab.chasers.items():
                if body.is_on:  # as drivers go on to send while their process lives
                    self.lab.hear(chaser, now_ns)
        found = []
        while captured and captured[0][0] <= now_ns:
            at_ns, c = captured.popleft()
            found.append(PoseSample(c.name, c.stamp_ns, at_ns, c.position, c.q_wxyz))
        return found


class _Camera(_Device):
    def poll(self) -> list[CameraFrame]:
        now_ns, exposed = self.host.now_ns(), self.lab.exposed[self.chaser]
        self.lab.advance(now_ns)
        found = []
        while exposed and exposed[0][0] <= now_ns:
            at_ns, e = exposed.popleft()
            pixels = encode_pose(e.target_m, e.q_wxyz, (e.number, self.chaser))
            image = np.frombuffer(pixels, dtype=np.uint8).reshape(1, -1)
            found.append(CameraFrame(image, e.stamp_ns, at_ns))
            LATENCIES_S.append((now_ns - at_ns) / 1e9)
        return found


class _Robot(_Device):
    def send(self, command: RobotCommand) -> None:
        now_ns, wrench = self.host.now_ns(), (command.force_N, command.torque_N_m)
        try:
            self.lab.command(self.chaser, *wrench, now_ns, command.duty)
        except ConnectionError as error:
            raise DeviceError(str(error)) from None
        SENT.append((now_ns, self.chaser))

    def stop(self) -> None:
        self.lab.stop(self.chaser, self.host.now_ns())

    def arm(self) -> None: ...


class _Latch(_Device):
    def poll(self) -> LatchReading:
        self.lab.advance(self.host.now_ns())
        probe = self.lab.probes[self.chaser]
        touched, probe.has_touched = probe.has_touched, False
        return LatchReading(touched, probe.is_armed, probe.is_latched)

    def command(self, latch: str) -> None:
        self.lab.advance(self.host.now_ns())
        self.lab.probes[self.chaser].command(latch)


SENT: list[tuple[int, int]] = []
"""Times and chasers of the commands that robots have got in the present flight."""
LATENCIES_S: list[float] = []
"""Times from the arrival of an image, s, until the gateway has read it, in the present flight."""


@dataclass
class _Entry:
    name: str
    driver: Callable[..., Any]

    def load(self) -> Callable[..., Any]:
        return self.driver


def install(monkeypatch: pytest.MonkeyPatch, lab: Any, latch: Any = None) -> None:
    """Let the scheme ``virtual`` open the devices of a laboratory; its latches, or those that
    ``latch()`` makes.
    """
    kinds: dict[str, Any] = {
        "camera": _Camera,
        "pose": _MotionCapture,
        "robot": _Robot,
        "latch": _Latch if latch is None else lambda lab, host, chaser: latch(),
    }

    def found(group: str) -> list[_Entry]:
        kind = next(k for k, g in devices.GROUPS.items() if g == group)

        def opened(rest: str, options: Mapping[str, Any], host: DeviceHost) -> _Device:
            if rest == "reference":
                return _MotionCapture(lab, host, from_copy=True)
            return kinds[kind](lab, host, int(rest or 0))

        return [_Entry("virtual", opened)]

    monkeypatch.setattr(devices, "entry_points", found)
    SENT.clear()
    LATENCIES_S.clear()


class GatewayKilled(BaseException):
    """Ends the gateway from within a device, as SIGKILL does."""


def killed_and_restarted(
    lab: Any, after_s: float, absent_s: float, monkeypatch: pytest.MonkeyPatch
) -> Callable[[ProcessOptions], int]:
    """Return a gateway that is killed so long after its first command, and started again after
    ``absent_s``.
    """
    poll, stop = _MotionCapture.poll, _Robot.stop

    def dying(device: _MotionCapture) -> list[PoseSample]:
        now_ns = device.host.now_ns()
        if lab.begun_ns is not None and now_ns - lab.begun_ns > after_s * 1e9:
            raise GatewayKilled
        return poll(device)

    def main(options: ProcessOptions) -> int:
        resumable = replace(options, resume=options.out.with_name("begun.json"))
        monkeypatch.setattr(_MotionCapture, "poll", dying)
        monkeypatch.setattr(_Robot, "stop", lambda device: None)  # nobody stops the robots
        try:
            return gateway.main(resumable)
        except GatewayKilled:
            monkeypatch.setattr(_MotionCapture, "poll", poll)
            monkeypatch.setattr(_Robot, "stop", stop)
        node = Node("time", "operator", options.link)
        for _ in range(round(absent_s / 0.1)):  # time of the laboratory, which goes on
            node.host.sleep(0.1)
            lab.advance(round(node.host.now_s() * 1e9))
        node.close()
        return gateway.main(resumable)

    return main


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


def arm_again(options: ProcessOptions, after_s: float) -> int:
    """Arm when ready, and again so long after; return 0 if both were done."""
    if arm_when_ready(options):
        return 1
    node = Node("operator", "operator", options.link)
    node.host.sleep(after_s)
    node.close()
    return arm_when_ready(options)


HELD_S, LONGEST_S = 3.0, 300.0
"""Time for which a chaser must hold before the operator commands it again, and the longest flight
that is watched, s.
"""


def approach_again(options: ProcessOptions) -> int:
    """Command ``approach`` to each chaser that has backed out and holds since, as flight software
    leaves that to a person, until the mission ends; return 0.
    """
    node = Node("watcher", "viewer", options.link)
    node.subscribe(topics.REFERENCE)
    node.subscribe(topics.END)
    backed_out: set[int] = set()
    begun = node.host.now_s()
    try:
        while node.host.now_s() - begun < LONGEST_S:
            received = node.receive(0.5)
            match None if received is None else received.message:
                case MissionEnd():
                    return 0
                case Reference(chaser=i, phase="retreat" | "abort"):
                    backed_out.add(i)
                case Reference(chaser=i, phase="hold", phase_time_s=held_s) if (
                    i in backed_out and held_s > HELD_S
                ):
                    again = OperatorCommand(command="approach", chaser=i, operator="test")
                    reply = node.query(topics.OPERATE_KEY, again, CommandReply, 1.0)
                    if reply is not None and reply.accepted:
                        backed_out.discard(i)
                case _:
                    pass
        return 1
    finally:
        node.close()


def fly(
    scenario: Path,
    folder: Path,
    lab: Any,
    monkeypatch: pytest.MonkeyPatch,
    overrides: tuple[str, ...] = (),
    **others: Any,
) -> SimulatedFlight:
    """Fly a scenario with ``[lab]`` on a virtual laboratory, armed as soon as it can be."""
    install(monkeypatch, lab)
    processes = {"world": gateway.main, "operator": arm_when_ready, **others}
    # Images are poses.
    overrides = ("simulation.mode='realtime'", "camera.effects.jpeg_quality=0", *overrides)
    return simulate(scenario, folder, overrides, others=processes)


def flight_of(
    name: str,
    seed: int,
    faults: Sequence[Any] = (),
    cameras: bool = True,
    camera_hz: float = 29.4,
) -> tuple[str, Any]:
    """Return the scenario ``name`` of the emulated laboratory, on virtual devices, and the
    laboratory. Cameras run freely; without ``cameras`` they are not the gateway's.
    """
    text = (FOLDER / name / "scenario.toml").read_text(encoding="utf-8").partition("[[lab.")[0]
    setup = emulated.read_setup(FOLDER / name / "lab.toml", seed)
    setup.optics = emulated.Optics(setup.optics.place, rate_hz=camera_hz)
    parts = [text, "[perception]\nname = 'statistical'\n"]
    for i in setup.chasers:
        own = f"address = 'virtual:{i}'\n"
        parts.append(f"[[lab.odometry]]\nbody = 'chaser/{i}'\nname = 'robot{i}'\n{_CAPTURE}")
        parts.append(f"[[lab.robot]]\nchaser = {i}\n{own}")
        if cameras:
            parts.append(f"[[lab.camera]]\nchaser = {i}\n{own}latency_s = 0.02\n")
        if i in setup.probes:
            parts.append(f"[[lab.latch]]\nchaser = {i}\n{own}")
    for body in ("target", *setup.chasers):
        known = ("target", "target") if body == "target" else (f"chaser/{body}", f"robot{body}")
        parts.append("[[lab.reference]]\nbody = '{}'\nname = '{}'\n".format(*known))
        parts.append(_CAPTURE.replace("virtual:", "virtual:reference"))
    return "".join(parts), Laboratory(setup, seed, faults)


_CAPTURE = "address = 'virtual:'\nlatency_s = 0.004\nsigma_m = 3e-4\nsigma_deg = 0.03\n"


SCENARIO = flight_of("tracking", 0)[0]
"""Two free flyers that track a turning target, each 1 m from it."""


def two_free_flyers(seed: int, faults: Sequence[Any] = ()) -> Any:
    """Return the laboratory of ``SCENARIO``."""
    return flight_of("tracking", seed, faults)[1]


PLACES = {0: np.array([-1.0, 0.0, 0.0]), 1: np.array([0.0, -1.0, 0.0])}
"""Where the chasers of ``tracking`` are to be beside the target, m."""


def tracking_errors_m(
    lab: Any, after_s: float, before_s: float = math.inf
) -> dict[int, np.ndarray]:
    """Return the distance of each chaser from its place beside the target, between two times after
    the first command.
    """
    assert lab.begun_ns is not None
    errors: dict[int, list[float]] = {0: [], 1: []}
    for time_ns, states in lab.history:
        if not after_s * 1e9 <= time_ns - lab.begun_ns < before_s * 1e9:
            continue
        p, r = states["target"]
        for i, place in PLACES.items():
            errors[i].append(float(np.linalg.norm(states[f"chaser/{i}"][0] - p - r.apply(place))))
    return {i: np.array(e) for i, e in errors.items()}
