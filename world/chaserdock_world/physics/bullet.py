"""PyBullet, loaded and connected without a word: it greets on standard output and error, which programs may read."""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def hushed() -> Iterator[None]:
    """Standard output and error of this process, libraries in C included, go nowhere meanwhile."""
    nowhere = os.open(os.devnull, os.O_WRONLY)
    kept = {}
    for number, stream in ((1, sys.stdout), (2, sys.stderr)):
        stream.flush()
        kept[number] = os.dup(number)
        os.dup2(nowhere, number)
    try:
        yield
    finally:
        if os.name == "posix":
            ctypes.CDLL(None).fflush(None)  # C's own buffers, or it comes out later
        for number, copy in kept.items():
            os.dup2(copy, number)
            os.close(copy)
        os.close(nowhere)


with hushed():
    import pybullet
    from pybullet_utils.bullet_client import BulletClient

__all__ = ["connect", "hushed", "pybullet"]


def connect() -> BulletClient:
    """A Bullet world of one's own, without a window."""
    with hushed():
        return BulletClient(connection_mode=pybullet.DIRECT)
