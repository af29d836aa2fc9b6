# SPDX-License-Identifier: Apache-2.0
"""Queue from Zenoh's threads to a process' own thread, bounded in bytes and items."""

from __future__ import annotations

import queue
import threading
from typing import Generic, TypeVar

T = TypeVar("T")

MAX_BYTES = 256_000_000
"""A quarter of the memory of a process in compose.yaml: ten seconds of 1280 x 720 JPEG images of 16
chasers at 15 Hz."""
MAX_ITEMS = 200_000
"""Bound for small messages, whose Python objects take more memory than their bytes."""


class BoundedQueue(Generic[T]):
    """FIFO queue between threads that drops items when it is full, and counts them in
    ``dropped``.
    """

    def __init__(self, max_bytes: int = MAX_BYTES, max_items: int = MAX_ITEMS) -> None:
        self.dropped = 0
        self._max_bytes, self._max_items = max_bytes, max_items
        self._items: queue.SimpleQueue[tuple[T, int]] = queue.SimpleQueue()
        self._bytes = 0
        self._lock = threading.Lock()

    def put(self, item: T, size: int) -> bool:
        """Append an item of ``size`` bytes. Return False if it was dropped."""
        with self._lock:
            if self._bytes + size > self._max_bytes or self._items.qsize() >= self._max_items:
                self.dropped += 1
                return False
            self._bytes += size
        self._items.put((item, size))
        return True

    def get(self, timeout_s: float | None) -> T:
        """Remove and return the oldest item. Raises queue.Empty on timeout."""
        item, size = (
            self._items.get_nowait() if timeout_s == 0 else self._items.get(timeout=timeout_s)
        )
        with self._lock:
            self._bytes -= size
        return item

    def empty(self) -> bool:
        return self._items.empty()
