"""A queue between Zenoh's threads and a process' own, bounded by what it holds."""

from __future__ import annotations

import queue
import threading
from typing import Generic, TypeVar

T = TypeVar("T")

MOST_BYTES = 256_000_000
MOST_ITEMS = 200_000


class Inbox(Generic[T]):
    """First in, first out. What does not fit any more is dropped, and counted in ``dropped``."""

    def __init__(self, most_bytes: int = MOST_BYTES, most_items: int = MOST_ITEMS) -> None:
        self.dropped = 0
        self._most_bytes, self._most_items = most_bytes, most_items
        self._items: queue.SimpleQueue[tuple[T, int]] = queue.SimpleQueue()
        self._bytes = 0
        self._lock = threading.Lock()

    def put(self, item: T, size: int) -> bool:
        """Appends an item of ``size`` bytes; False when it was dropped."""
        with self._lock:
            if self._bytes + size > self._most_bytes or self._items.qsize() >= self._most_items:
                self.dropped += 1
                return False
            self._bytes += size
        self._items.put((item, size))
        return True

    def get(self, timeout_s: float | None) -> T:
        """The oldest item; raises queue.Empty when none comes in time."""
        item, size = self._items.get_nowait() if timeout_s == 0 else self._items.get(timeout=timeout_s)
        with self._lock:
            self._bytes -= size
        return item

    def empty(self) -> bool:
        return self._items.empty()
