# SPDX-License-Identifier: Apache-2.0
"""Send commands to a robot without a gap, and zero when they cease.

A robot that loses its commands must stop by itself. Until then, and if the gateway hangs while its
threads live on, this stream commands zero.
"""

from __future__ import annotations

import threading
from collections.abc import Callable

from ..devices import DeviceError, RobotCommand

PERIOD_S = 0.1
"""Longest gap between two messages, s: PX4 ends its offboard mode below 2 Hz (docs.px4.io,
Offboard Mode), and its manual mode after 0.5 s (COM_RC_LOSS_T).
"""
HOLD_S = 0.25
"""Time, s, after which a command is replaced by zero: four ticks at 15 Hz are missing."""


class CommandStream:
    """Publishes the newest command, again if nothing else was published for a period, and zero
    (None) without a fresh command or while it is not armed. Publishes nothing before ``start``.
    Safe to call from several threads.
    """

    def __init__(
        self, publish: Callable[[RobotCommand | None], None], now_ns: Callable[[], int]
    ) -> None:
        self._publish, self._now_ns = publish, now_ns
        self._lock, self._wake = threading.Lock(), threading.Event()
        self._last: RobotCommand | None = None
        self._last_ns = self._published_ns = now_ns()
        self._armed = False
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Publish from now on, zero until ``arm``."""
        with self._lock:
            if self._thread is None and not self._wake.is_set():
                self._thread = threading.Thread(target=self._run, daemon=True)
                self._thread.start()

    def put(self, command: RobotCommand) -> None:
        """Publish a command now. Raises DeviceError if nothing can be published."""
        with self._lock:
            if self._wake.is_set():
                raise DeviceError("the robot is closed")
            if self._thread is None:
                return
            self._last, self._last_ns = command, self._now_ns()
            failure = self._publish_now()
            if failure is not None:
                self._last = None  # a command that cannot be sent is not repeated
        if failure is not None:
            raise DeviceError(f"cannot send: {failure}") from failure

    def arm(self) -> None:
        """Let commands pass from now on."""
        with self._lock:
            self._armed, self._last = True, None

    def disarm(self) -> None:
        """Publish zero, now and until armed again. Never raises."""
        with self._lock:
            self._armed, self._last = False, None
            if self._thread is not None and not self._wake.is_set():
                self._publish_now()

    def close(self) -> None:
        """Publish zero, and end the stream."""
        self.disarm()
        self._wake.set()
        if self._thread is not None:
            self._thread.join()

    def _publish_now(self) -> Exception | None:
        """Publish what is due; return why it failed."""
        self._published_ns = self._now_ns()
        fresh = self._published_ns - self._last_ns < HOLD_S * 1e9
        try:
            self._publish(self._last if self._armed and fresh else None)
        except Exception as error:  # of a session or a socket; `put` raises its own
            return error
        return None

    def _run(self) -> None:
        wait_s = 0.0
        while not self._wake.wait(wait_s):
            with self._lock:
                silent_s = (self._now_ns() - self._published_ns) / 1e9
                if silent_s >= PERIOD_S:
                    self._publish_now()
                    silent_s = 0.0
            wait_s = PERIOD_S - silent_s
