# SPDX-License-Identifier: Apache-2.0
"""Import PyBullet and connect to it without its messages on standard output and error, which other programs may parse."""

from __future__ import annotations

import ctypes
import os
import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from chaserdock_protocol.errors import MissingPackageError


@contextmanager
def silenced() -> Iterator[None]:
    """Discard what this process, C libraries included, writes to standard output and error."""
    null = os.open(os.devnull, os.O_WRONLY)
    saved = {}
    for number, stream in ((1, sys.stdout), (2, sys.stderr)):
        stream.flush()
        saved[number] = os.dup(number)
        os.dup2(null, number)
    try:
        yield
    finally:
        if os.name == "posix":
            ctypes.CDLL(None).fflush(None)  # else C's buffers are written after the restoration
        for number, copy in saved.items():
            os.dup2(copy, number)
            os.close(copy)
        os.close(null)


try:
    with silenced():
        import pybullet
        from pybullet_utils.bullet_client import BulletClient
except ModuleNotFoundError as error:
    here = f"Python {sys.version_info.major}.{sys.version_info.minor} on {sys.platform} {platform.machine()}"
    raise MissingPackageError(
        "the world needs PyBullet, which is not installed; it has wheels for Python 3.11 on Linux x86_64 only (this is "
        f"{here}); elsewhere run the other processes, and the world on such a machine or in a container",
        name=error.name,
    ) from None

__all__ = ["connect", "pybullet", "silenced"]


def connect() -> BulletClient:
    """Return a new Bullet client without a window."""
    with silenced():
        return BulletClient(connection_mode=pybullet.DIRECT)
