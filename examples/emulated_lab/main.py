# SPDX-License-Identifier: Apache-2.0
"""Run an emulated laboratory in real time, until it is interrupted::

    python main.py planar-docking/lab.toml --seed 3 --fault "camera frozen,0,20,25"

Devices: see README.md. A fault has a kind, the number of a robot, and begin and end in seconds
after the first command.
"""

from __future__ import annotations

import argparse
import json
import signal
import threading
import time
import tomllib
from collections import deque
from pathlib import Path
from typing import Any

import cv2
import lab_network as net
from lab_devices import FAULTS, Exposure, Fault, Laboratory, read_setup
from lab_pictures import Camera

PERIOD_S = 0.001


class Cameras(threading.Thread):
    """Draws exposures and publishes them when they are due, beside the laboratory's loop."""

    def __init__(self, lab: Laboratory, network: net.RosNetwork) -> None:
        super().__init__(daemon=True)
        self._camera = Camera(lab.setup)
        self._topics = {i: net.RosCamera(i, self._camera.matrix, network) for i in lab.chasers}
        self._waiting: deque[tuple[int, int, Exposure]] = deque()
        self._is_over = threading.Event()
        self._new = threading.Event()

    def add(self, robot: int, due_ns: int, exposure: Exposure) -> None:
        self._waiting.append((due_ns, robot, exposure))
        self._new.set()

    def run(self) -> None:
        while not self._is_over.is_set():
            if not self._waiting:
                self._new.wait(0.1)
                self._new.clear()
                continue
            due_ns, robot, exposure = self._waiting.popleft()
            image = self._camera.picture(exposure)
            self._is_over.wait(max(0.0, (due_ns - time.monotonic_ns()) / 1e9))
            self._topics[robot].publish(image, exposure.stamp_ns)

    def end(self) -> None:
        self._is_over.set()
        self.join()


def run(lab: Laboratory, text: dict[str, Any], over: threading.Event) -> None:
    """Publish what the devices measure and obey what robots are told, until ``over``."""
    network = net.RosNetwork(text["network"]["port"])
    robot = net.Px4Robot if text["network"]["robots"] == "px4" else net.WrenchRobot
    for i in lab.chasers:
        robot(lab, i, network)
    ticking: list[Any] = [net.Latch(lab, i, network) for i in lab.probes]
    names = ["target", *(f"robot{i}" for i in lab.chasers)]
    listeners: list[Any] = [net.RosMotionCapture(names, network)]
    if "mavlink" in text["network"]:
        ticking.append(net.MavlinkMotionCapture("robot0", text["network"]["mavlink"]))
        listeners.append(ticking[-1])
    cameras = Cameras(lab, network)
    cameras.start()
    print("laboratory: ready", flush=True)
    try:
        while not over.wait(PERIOD_S):
            while not network.inbox.empty():
                network.inbox.get()()
            now_ns = time.monotonic_ns()
            lab.advance(now_ns)
            for i, exposed in lab.exposed.items():
                while exposed:
                    cameras.add(i, *exposed.popleft())
            while lab.captured and lab.captured[0][0] <= now_ns:
                _, capture = lab.captured.popleft()
                for listener in listeners:
                    listener.publish(capture)
            for device in ticking:
                device.tick(now_ns)
    finally:
        cameras.end()
        network.close()


def summary(lab: Laboratory) -> dict[str, Any]:
    """Return what has happened: closest approach of bodies, and how the probes did."""
    return {
        "clearance_m": lab.clearance_m,
        "speeds_m_s": [float((b.velocity**2).sum() ** 0.5) for b in lab.chasers.values()],
        "latched": [i for i, probe in lab.probes.items() if probe.is_latched],
        "misses": {i: probe.misses for i, probe in lab.probes.items() if probe.misses},
        "refusals": {i: probe.refusals for i, probe in lab.probes.items() if probe.refusals},
    }


def fault(text: str) -> Fault:
    """Read ``KIND,ROBOT,FROM,TO``."""
    kind, robot, begin, end = text.split(",")
    if kind not in FAULTS:
        raise argparse.ArgumentTypeError(f"{kind!r}: must be one of: {', '.join(FAULTS)}")
    return Fault(kind, float(begin), float(end), int(robot))


def main() -> None:
    parser = argparse.ArgumentParser(description="Run an emulated laboratory in real time.")
    parser.add_argument("lab", type=Path, help="its file, such as planar-docking/lab.toml")
    parser.add_argument("--seed", type=int, default=0, help="of noise, clocks, masses and thrusts")
    parser.add_argument("--fault", type=fault, action="append", default=[])
    parser.add_argument("--summary", type=Path, help="file for what has happened, at the end")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    text = tomllib.loads(arguments.lab.read_text(encoding="utf-8"))
    lab = Laboratory(read_setup(arguments.lab, arguments.seed), arguments.seed, arguments.fault)
    over = threading.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: over.set())
    try:
        run(lab, text, over)
    finally:
        found = json.dumps(summary(lab), indent=1)
        print(f"laboratory: {found}")
        if arguments.summary:
            arguments.summary.write_text(found, encoding="utf-8")


if __name__ == "__main__":
    main()
