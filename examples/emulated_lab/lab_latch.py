# SPDX-License-Identifier: Apache-2.0
"""Driver of the latches of the emulated laboratory: three topics of ROS 2 state contact, armed and
latched, a fourth arms (true) or opens (false); all ``std_msgs/msg/Bool``.

``emulated-latch:/robot0/latch``; options of ROS 2 (docs/devices.md).
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from functools import partial
from typing import Any

from chaserdock_agents.gateway.devices import DeviceHost, LatchReading
from chaserdock_agents.gateway.drivers.options import read_options
from chaserdock_agents.gateway.drivers.ros2_network import RosEndpoints, RosOptions
from chaserdock_agents.ros2.types import TYPES
from chaserdock_protocol.messages import Latch

BOOL = "std_msgs/msg/Bool"
STALE_S = 1.0


class EmulatedLatch:
    """The latch below one topic."""

    def __init__(self, topic: str, options: RosOptions, host: DeviceHost) -> None:
        self._endpoints, self._now_ns = RosEndpoints(options), host.now_ns
        self._state = {"contact": False, "armed": False, "latched": False}
        self._heard: set[str] = set()
        for name in self._state:
            self._endpoints.subscribe(f"{topic}/{name}", BOOL, partial(self._take, name))
        self._publisher = self._endpoints.publisher(f"{topic}/arm", BOOL)
        self._commanded: tuple[bool, float] | None = None

    def _take(self, name: str, message: Any) -> None:
        self._heard.add(name)
        kept = name == "contact" and self._state[name]  # until the next poll
        self._state[name] = bool(message.data) or kept

    def poll(self) -> LatchReading | None:
        """See `DockingLatch`."""
        if len(self._heard) < len(self._state):
            return None
        self._endpoints.check()
        reading = LatchReading(**self._state)
        self._state["contact"] = False
        return reading

    def command(self, latch: Latch) -> None:
        """See `DockingLatch`. Repeats a command that the latch does not show once a second."""
        arm = latch == "arm"
        last = self._commanded
        if last is not None and last[0] == arm and time.monotonic() - last[1] < STALE_S:
            return
        self._commanded = arm, time.monotonic()
        self._publisher.publish(TYPES.types[BOOL](arm))

    def close(self) -> None:
        """See `DockingLatch`."""
        self._endpoints.close()


def open_latch(rest: str, options: Mapping[str, Any], host: DeviceHost) -> EmulatedLatch:
    """Open a latch: ``emulated-latch:/robot0/latch``."""
    return EmulatedLatch(rest, read_options(RosOptions, options), host)
