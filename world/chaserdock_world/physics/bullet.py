# SPDX-License-Identifier: Apache-2.0
"""Import PyBullet and connect to it, without its messages on standard output and error.

Other programs may parse these.
"""

from __future__ import annotations

import ctypes
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager

from chaserdock_world.requirements import require_pybullet


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


require_pybullet()
with silenced():
    import pybullet
    from pybullet_utils.bullet_client import BulletClient

__all__ = ["connect", "pybullet", "silenced"]


def connect() -> BulletClient:
    """Return a new Bullet client without a window."""
    with silenced():
        return BulletClient(connection_mode=pybullet.DIRECT)
