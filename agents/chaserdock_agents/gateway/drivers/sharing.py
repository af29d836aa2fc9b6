# SPDX-License-Identifier: Apache-2.0
"""Share what several devices use: a session, a port."""

from __future__ import annotations

import threading
from collections.abc import Callable, Hashable
from typing import Generic, Protocol, TypeVar


class _Closable(Protocol):
    def close(self) -> None: ...


_Closing = TypeVar("_Closing", bound=_Closable)


class Shared(Generic[_Closing]):
    """Objects by key, each opened for its first user, and closed after its last."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users: dict[Hashable, tuple[_Closing, int]] = {}

    def acquire(self, key: Hashable, make: Callable[[], _Closing]) -> _Closing:
        """Return the object of a key, made by ``make`` unless it is open."""
        with self._lock:
            shared, users = self._users.get(key) or (make(), 0)
            self._users[key] = shared, users + 1
            return shared

    def release(self, key: Hashable) -> None:
        """Note that one user has ended."""
        with self._lock:
            shared, users = self._users.pop(key)
            if users > 1:
                self._users[key] = shared, users - 1
            else:
                shared.close()
