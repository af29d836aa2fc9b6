# SPDX-License-Identifier: Apache-2.0
"""Assigns the methods of an object to the message types that they read."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, TypeVar

ReadMethod = TypeVar("ReadMethod", bound=Callable[..., None])


def reads(kind: type) -> Callable[[ReadMethod], ReadMethod]:
    """Mark the method of a ``MessageReader`` that is called with each message of a type."""

    def mark(method: ReadMethod) -> ReadMethod:
        method.__dict__["_reads"] = kind
        return method

    return mark


class MessageReader:
    """Reads messages of some types as they are published, by methods marked with ``reads``."""

    def readers(self) -> Iterator[tuple[type, Callable[[Any], None]]]:
        """Yield each type of message that is read, and the method to call with one."""
        for name, method in vars(type(self)).items():
            if kind := getattr(method, "_reads", None):
                yield kind, getattr(self, name)
