# SPDX-License-Identifier: Apache-2.0
"""The emulated laboratory of the examples as devices in virtual time: the gateway polls it in its
own thread of control, so that a flight is deterministic.
"""

from __future__ import annotations

import importlib.util
import math
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
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

_PATH = Path(__file__).parents[1] / "examples" / "emulated_lab" / "laboratory.py"
_SPEC = importlib.util.spec_from_file_location("emulated_laboratory", _PATH)
assert _SPEC is not None
assert _SPEC.loader is not None
emulated = importlib.util.module_from_spec(_SPEC)
sys.modules[_SPEC.name] = emulated
_SPEC.loader.exec_module(emulated)
Fault, Body, Laboratory = emulated.Fault, emulated.Body, emulated.Laboratory


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
        try:
            now_ns = self.host.now_ns()
            self.lab.command(self.chaser, command.force_N, command.torque_N_m, now_ns)
        except ConnectionError as error:
            raise DeviceError(str(error)) from None
        SENT.append((now_ns, self.chaser))

    def stop(self) -> None:
        self.lab.stop(self.chaser, self.host.now_ns())

    def arm(self) -> None: ...


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
    """Let the scheme ``virtual`` open the devices of a laboratory, and latches that ``latch()``
    makes.
    """
    kinds: dict[str, Any] = {"camera": _Camera, "pose": _MotionCapture, "robot": _Robot}
    if latch is not None:
        kinds["latch"] = lambda lab, host, chaser: latch()

    def found(group: str) -> list[_Entry]:
        kind = next(k for k, g in devices.GROUPS.items() if g == group)

        def opened(rest: str, options: Mapping[str, Any], host: DeviceHost) -> _Device:
            if rest == "reference":
                return _MotionCapture(lab, host, from_copy=True)
            return kinds[kind](lab, host, int(rest or 0))

        return [_Entry("virtual", opened)] if kind in kinds else []

    monkeypatch.setattr(devices, "entry_points", found)
    SENT.clear()
    LATENCIES_S.clear()


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
    scenario: Path, folder: Path, lab: Any, monkeypatch: pytest.MonkeyPatch, **others: Any
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
[[lab.reference]]
body = "target"
address = "virtual:reference"
name = "target"
latency_s = 0.004
[[lab.reference]]
body = "chaser/0"
address = "virtual:reference"
name = "robot0"
latency_s = 0.004
[[lab.reference]]
body = "chaser/1"
address = "virtual:reference"
name = "robot1"
latency_s = 0.004
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


def two_free_flyers(seed: int, faults: Sequence[Any] = ()) -> Any:
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
    inertia = (0.1625, 0.1625, 0.3125)
    return Laboratory(chasers, target, (0.07, 0.0, 0.075), 30.0, inertia, seed, faults)


def tracking_errors_m(lab: Any, after_s: float) -> dict[int, np.ndarray]:
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
