# SPDX-License-Identifier: Apache-2.0
"""Stop by a signal: work in progress ends first."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Generator
from contextlib import contextmanager


@contextmanager
def stop_on_signals(notice: str = "") -> Generator[threading.Event]:
    """Set an event on SIGINT or SIGTERM, and print the notice; repeated signals change nothing."""
    stop = threading.Event()

    def request_stop(*_: object) -> None:
        if notice and not stop.is_set():
            print(f"\nchaserdock: {notice}", file=sys.stderr)
        stop.set()

    before = {number: signal.signal(number, request_stop) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield stop
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
