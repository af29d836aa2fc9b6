# SPDX-License-Identifier: Apache-2.0
"""Use a gripper under an autopilot as a latch: ``MAV_CMD_DO_GRIPPER``, in MAVLink and in PX4 on
ROS 2.

The autopilot acknowledges what it commands to the gripper, and reports neither touch nor grip. A
gripper closes when told, not at the touch, so that a switch at the probe must tell when.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from chaserdock_protocol.messages import Latch

from ..devices import DeviceError, LatchReading
from . import acknowledgements

DO_GRIPPER = 211
"""Number of the command. Parameters: number of the gripper, action."""
RELEASE, GRAB = 0.0, 1.0
"""Actions (GRIPPER_ACTIONS)."""
# Results (MAV_RESULT).
_ACCEPTED, _TEMPORARILY_REJECTED, _IN_PROGRESS, _CANCELLED = 0, 1, 5, 6
_DONE_S = 10.0
"""Longest time, s, from a command to the end of its action, which PX4 acknowledges after
PD_GRIPPER_TO: several times what a gripper takes to close.
"""


class Gripper:
    """A gripper that grabs at the touch while it is armed. ``ask(action, attempt)`` sends a command
    and does not wait.

    Sends in ``command`` and ``poll`` only, which the gateway does not call while robots are
    disarmed; what tells of touch, grip and results may come from other threads. An acknowledgement
    does not name its action: it counts for the newest one.
    """

    def __init__(
        self,
        name: str,
        ask: Callable[[float, int], None],
        now_ns: Callable[[], int],
        has_switch: bool,
    ) -> None:
        self._name, self._ask, self._now_ns, self._has_switch = name, ask, now_ns, has_switch
        self._lock = threading.Lock()
        self._armed = self._touches = self._touched = self._caught = False
        self._done: float | None = None
        self._grips: bool | None = None
        # The action that is not yet acknowledged: its attempts, when it was sent, its last result.
        self._asked: float | None = None
        self._attempt, self._sent_ns = 0, 0
        self._result: int | None = None

    def touch(self, touches: bool) -> None:
        """Note the state of the switch at the probe."""
        with self._lock:
            self._touches = touches
            self._touched |= touches
            self._caught |= touches and self._armed

    def grip(self, grips: bool) -> None:
        """Note the state of the switch that tells that the gripper holds the port."""
        with self._lock:
            self._grips = grips

    def acknowledge(self, result: int) -> None:
        """Note a result of the command."""
        with self._lock:
            # PX4 cancels an action that is under way when it is asked for the other one.
            if self._asked is None or result == _CANCELLED:
                return
            self._result = result
            if result == _ACCEPTED:
                self._done, self._asked = self._asked, None

    def command(self, latch: Latch) -> None:
        """Release the gripper, or grab once the probe has touched since it was armed. Raises
        DeviceError if nothing can be sent.
        """
        with self._lock:
            if latch == "keep":
                return
            self._armed = latch == "arm"
            self._caught = self._armed and (self._caught or self._touches)
            if self._armed and not self._caught:
                return  # it stays as it is: after a restart it may hold the target
            wanted = GRAB if self._caught else RELEASE
            if wanted != (self._done if self._asked is None else self._asked):
                self._asked, self._attempt = wanted, 0
                self._send()

    def poll(self) -> LatchReading | None:
        """Return the state; None before anything is known of it. Repeats a command without an
        acknowledgement. Raises DeviceError, once, if it was refused or was not acknowledged.
        """
        with self._lock:
            self._follow_up()
            if self._done is None and self._grips is None:
                return None
            contact, self._touched = self._touched or self._touches, False
            latched = bool(self._grips) if self._has_switch else self._done == GRAB
            return LatchReading(contact, self._armed, latched)

    def _send(self) -> None:
        self._sent_ns, self._result = self._now_ns(), None
        assert self._asked is not None
        try:
            self._ask(self._asked, self._attempt)
        except DeviceError:
            self._asked = None
            raise

    def _follow_up(self) -> None:
        if self._asked is None:
            return
        result, since_s = self._result, (self._now_ns() - self._sent_ns) / 1e9
        if result == _IN_PROGRESS:
            if since_s > _DONE_S:
                self._fail(f"in progress for over {_DONE_S:g} s")
        elif result not in (None, _TEMPORARILY_REJECTED):
            self._fail(acknowledgements.name_of(result))
        elif since_s > acknowledgements.REPLY_S:
            self._attempt += 1
            if self._attempt < acknowledgements.ATTEMPTS:
                self._send()
            else:
                self._fail(acknowledgements.name_of(result))

    def _fail(self, why: str) -> None:
        action, self._asked = self._asked, None
        raise DeviceError(f"{self._name}, {'grab' if action == GRAB else 'release'}: {why}")
