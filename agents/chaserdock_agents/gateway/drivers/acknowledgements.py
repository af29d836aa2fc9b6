# SPDX-License-Identifier: Apache-2.0
"""Command an autopilot, and wait for its acknowledgement: MAVLink's command protocol, whose numbers
PX4 uses on ROS 2, too.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from ..devices import DeviceError

# Numbers of commands (MAV_CMD), and their parameters.
DO_SET_MODE, COMPONENT_ARM_DISARM = 176, 400
CUSTOM_MODE_ENABLED = 1.0
"""First parameter of DO_SET_MODE (MAV_MODE_FLAG_CUSTOM_MODE_ENABLED): the second is the mode."""
FORCE = 21196.0
"""Second parameter of COMPONENT_ARM_DISARM: in motion, too, which is refused otherwise."""
_RESULTS = (
    "accepted", "temporarily rejected", "denied", "unsupported", "failed", "in progress",
    "cancelled",
)  # fmt: skip
REPLY_S = 0.5
"""Wait, s, for an acknowledgement: some round trips of a slow radio link."""
ATTEMPTS = 4
"""Number of times that a command is sent: messages may be lost."""


def name_of(result: int | None) -> str:
    """Return the name of a result (MAV_RESULT), or that there is none."""
    if result is None:
        return f"no acknowledgement within {ATTEMPTS * REPLY_S:g} s"
    return _RESULTS[result] if 0 <= result < len(_RESULTS) else f"result {result}"


class Acknowledgements:
    """Results of commands, as they arrive; safe to call from several threads."""

    def __init__(self) -> None:
        self._arrived = threading.Condition()
        self._results: dict[int, int] = {}

    def take(self, command: int, result: int) -> None:
        """Note an acknowledgement."""
        with self._arrived:
            self._results[command] = result
            self._arrived.notify_all()

    def ask(self, command: int, what: str, send: Callable[[int], None]) -> None:
        """Call ``send(attempt)`` until the command is acknowledged. Raises DeviceError, which says
        ``what`` was refused, unless it is accepted.
        """
        with self._arrived:
            self._results.pop(command, None)
        for attempt in range(ATTEMPTS):
            send(attempt)
            with self._arrived:
                if self._arrived.wait_for(lambda: command in self._results, REPLY_S):
                    break
        with self._arrived:
            result = self._results.get(command)
        if result != 0:
            raise DeviceError(f"{what}: {name_of(result)}")
