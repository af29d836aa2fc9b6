# SPDX-License-Identifier: Apache-2.0
"""Stops by signals that let work in progress end first."""

from __future__ import annotations

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


class Interrupt(KeyboardInterrupt):
    """SIGINT or SIGTERM has arrived.

    A class of its own: a plain KeyboardInterrupt that passes through code from a string, as in the
    making of a dataclass, lets Python end by a signal instead of with the status, even if caught.
    """


@contextmanager
def interrupts() -> Generator[None]:
    """Raise ``Interrupt`` on SIGTERM and SIGINT, unless ignored, in the main thread."""

    def raise_interrupt(*_: object) -> None:
        raise Interrupt

    before = {
        number: signal.signal(number, raise_interrupt)
        for number in (signal.SIGTERM, signal.SIGINT)
        if signal.getsignal(number) is not signal.SIG_IGN
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
