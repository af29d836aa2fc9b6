# SPDX-License-Identifier: Apache-2.0
"""Stops by signals that let work in progress end first."""

from __future__ import annotations

import os
import signal
import sys
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from types import FrameType


@contextmanager
def stop_on_signals(notice: str = "") -> Generator[threading.Event]:
    """Set an event on SIGINT or SIGTERM, and print the notice; repeated signals change nothing."""
    stop = threading.Event()

    def request_stop(*_: object) -> None:
        if notice and not stop.is_set():
            print(f"\nchaserdock: {notice}", file=sys.stderr)
        stop.set()

    before = {
        number: signal.signal(number, request_stop) for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


class StopRequested(KeyboardInterrupt):
    """SIGINT or SIGTERM has arrived.

    Not KeyboardInterrupt itself: with that, Python ends the process by SIGINT where it has passed
    through ``exec``, although it was handled.
    """


_AGAIN_S = 0.05
"""Time, s, after which a signal that met an import is sent again: less than anybody notices."""


def _request_stop(number: int, frame: FrameType | None) -> None:
    """Raise StopRequested; within an import after it, as packages take any exception there for
    another package that is missing.
    """
    if not _is_importing(frame):
        raise StopRequested
    again = threading.Timer(_AGAIN_S, os.kill, (os.getpid(), number))
    again.daemon = True
    again.start()


def _is_importing(frame: FrameType | None) -> bool:
    while frame is not None and frame.f_code.co_filename != "<frozen importlib._bootstrap>":
        frame = frame.f_back
    return frame is not None


@contextmanager
def interrupts() -> Generator[None]:
    """Let SIGINT and SIGTERM raise StopRequested, so that all that is open is closed.

    Does nothing outside the main thread, and for a signal that is ignored.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {
        number: signal.signal(number, _request_stop)
        for number in (signal.SIGINT, signal.SIGTERM)
        if signal.getsignal(number) != signal.SIG_IGN
    }
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@contextmanager
def deferred_signals() -> Generator[None]:
    """Defer Python's handlers of SIGINT and SIGTERM, which may raise exceptions, to the end of the
    block.

    Only the main thread receives signals.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received: list[tuple[int, FrameType | None]] = []
    before: dict[int, Callable[[int, FrameType | None], object]] = {}

    def receive(number: int, frame: FrameType | None) -> None:
        received.append((number, frame))

    for number in (signal.SIGINT, signal.SIGTERM):
        if callable(handler := signal.getsignal(number)):
            before[number] = handler
            signal.signal(number, receive)
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for number, frame in received:
            before[number](number, frame)
