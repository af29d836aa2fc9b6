# SPDX-License-Identifier: Apache-2.0
"""Read and command a docking latch by ``std_msgs/msg/Bool``.

Below the device's name: ``latched`` and ``contact`` come from the device, ``command`` goes to it:
true lets the latch close at the next touch, false opens it. The command is repeated every tick, as
a message may be lost.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping
from typing import Any

from chaserdock_protocol.messages import Latch
from rosbags.typesys.stores import ros2_jazzy as ros

from ..devices import DeviceError, DeviceHost, LatchReading
from ..options import read_options
from .ros2_network import RosEndpoints, RosOptions, absolute_name

BOOL = "std_msgs/msg/Bool"


class RosLatchOptions(RosOptions, frozen=True, kw_only=True):
    """Options of a latch on ROS 2: names of its topics below its own. ``contact``: ``""`` for a
    device without a docking sensor, which touches when it latches.
    """

    latched: str = "latched"
    contact: str = "contact"
    command: str = "command"


class RosLatch:
    """A latch with one topic for each of its states, and one for commands."""

    def __init__(self, name: str, options: RosLatchOptions) -> None:
        self._topics = [
            absolute_name(f"{name}/{part}") if part else ""
            for part in (options.latched, options.contact, options.command)
        ]
        latched, contact, command = self._topics
        if not (latched and command):
            raise DeviceError("options latched and command must name a topic each")
        self._latched: bool | None = None
        self._lock = threading.Lock()
        self._touches = self._touched = self._armed = False
        self._wanted: bool | None = None
        self._has_contact = bool(contact)
        self._endpoints = RosEndpoints(options)
        try:
            self._endpoints.subscribe(latched, BOOL, self._take_latched)
            if contact:
                self._endpoints.subscribe(contact, BOOL, self._take_contact)
            self._publisher = self._endpoints.publisher(command, BOOL)
        except BaseException:
            self._endpoints.close()
            raise

    def _take_latched(self, message: Any) -> None:
        self._latched = bool(message.data)
        if not self._has_contact:
            self._take_contact(message)

    def _take_contact(self, message: Any) -> None:
        with self._lock:
            self._touches = bool(message.data)
            self._touched |= self._touches

    def poll(self) -> LatchReading | None:
        """See `DockingLatch`."""
        self._endpoints.check()
        self._publish()
        if self._latched is None:
            return None
        with self._lock:
            contact, self._touched = self._touched or self._touches, False
        return LatchReading(contact, self._armed, self._latched)

    def command(self, latch: Latch) -> None:
        """See `DockingLatch`."""
        if latch != "keep":
            self._wanted = self._armed = latch == "arm"
            self._publish()

    def _publish(self) -> None:
        if self._wanted is None:
            return
        try:
            self._publisher.publish(ros.std_msgs__msg__Bool(self._wanted))
        except Exception as error:  # of a session that is closed
            raise DeviceError(f"cannot send: {error}") from error

    def close(self) -> None:
        """See `DockingLatch`."""
        self._endpoints.close()


def open_latch(address: str, options: Mapping[str, Any], host: DeviceHost) -> RosLatch:
    """Open a latch: ``ros2:/robot0/latch``."""
    return RosLatch(absolute_name(address), read_options(RosLatchOptions, options))
