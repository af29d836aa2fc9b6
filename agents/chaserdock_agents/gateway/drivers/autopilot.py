# SPDX-License-Identifier: Apache-2.0
"""Arm, disarm and stop a robot under an autopilot, by the commands that MAVLink and PX4 on ROS 2
share.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable

from ..devices import DeviceError, RobotCommand
from .acknowledgements import (
    COMPONENT_ARM_DISARM,
    CUSTOM_MODE_ENABLED,
    DO_SET_MODE,
    FORCE,
    Acknowledgements,
)
from .command_stream import CommandStream


class AutopilotRobot(ABC):
    """A robot that an autopilot moves. Nothing is sent before it is armed: others may use it until
    then. ``stop`` may come from another thread while ``arm`` waits, and ends it: the autopilot is
    asked for nothing more but to disarm.
    """

    def __init__(self, now_ns: Callable[[], int]) -> None:
        self._acknowledgements = Acknowledgements()
        self._stream = CommandStream(self._publish, now_ns)
        self._was_armed = False
        self._stopped, self._asking = threading.Event(), threading.Lock()

    @abstractmethod
    def _publish(self, command: RobotCommand | None) -> None:
        """Publish a command, zero for None."""

    @abstractmethod
    def _command(self, command: int, attempt: int, param1: float, param2: float) -> None:
        """Send a command of MAV_CMD to the autopilot."""

    @abstractmethod
    def _release(self) -> None:
        """Release what connects to the autopilot."""

    def _arm_in(self, mode: float, what: str, armed: str) -> None:
        """Switch to a mode of the autopilot, arm it and let commands pass. Raises DeviceError if it
        refuses, or does not answer. ``what``, ``armed``: what is asked, for messages.
        """
        self._ask(DO_SET_MODE, what, CUSTOM_MODE_ENABLED, mode)
        self._ask(COMPONENT_ARM_DISARM, armed, 1.0, 0.0)
        self._unless_stopped(self._stream.arm)

    def _start_stream(self, lead_s: float) -> None:
        """Send zero for so long, s, as an autopilot expects before it arms. Raises DeviceError if
        the robot is stopped meanwhile.
        """
        self._was_armed = True
        self._stream.start()
        self._stopped.wait(lead_s)

    def _ask(self, command: int, what: str, param1: float, param2: float) -> None:
        def send(attempt: int) -> None:
            self._unless_stopped(lambda: self._command(command, attempt, param1, param2))

        self._acknowledgements.ask(command, what, send)

    def _unless_stopped(self, act: Callable[[], None]) -> None:
        with self._asking:  # what `stop` sends comes after what is sent here
            if self._stopped.is_set():
                raise DeviceError("stopped while it was being armed")
            act()

    def stop(self) -> None:
        """Command zero and disarm, in motion too, if this driver has armed. Does not wait."""
        with self._asking:
            self._stopped.set()
        self._stream.disarm()
        if not self._was_armed:
            return
        try:
            self._command(COMPONENT_ARM_DISARM, 0, 0.0, FORCE)
        except Exception:  # never heard, or gone: the stream has ended, too, which it notices
            return

    def close(self) -> None:
        """See `Robot`."""
        self.stop()
        self._stream.close()
        self._release()
