# SPDX-License-Identifier: Apache-2.0
"""Steps of free bodies in PyBullet without Python calls for each step and body; the bits are those of these calls.

``native/bullet.c`` calls Bullet's C interface, which PyBullet's library exports, with the client that Bullet hands to a
plugin in the same world.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from chaserdock_models.arrays import Array, IntArray
from chaserdock_models.native import address

from .bullet import pybullet, silenced
from .native import LIBRARY, function

FUNCTIONS = (
    "b3SubmitClientCommandAndWaitStatus",
    "b3RequestActualStateCommandInit",
    "b3GetStatusActualState",
    "b3ApplyExternalForceCommandInit",
    "b3ApplyExternalForce",
    "b3ApplyExternalTorque",
    "b3InitStepSimulationCommand",
    "b3InitRequestContactPointInformation",
    "b3GetContactPointInformation",
)


@cache
def _addresses() -> IntArray | None:
    """Return the addresses of ``FUNCTIONS``, None where PyBullet's library does not export them."""
    library = ctypes.CDLL(pybullet.__file__)
    if not all(hasattr(library, name) for name in FUNCTIONS):
        return None
    found = [ctypes.cast(getattr(library, name), ctypes.c_void_p).value or 0 for name in FUNCTIONS]
    return np.array(found, dtype=np.int64)


class BulletStepper:
    """Makes the steps of free bodies in one PyBullet client; ``bodies``: their identities there."""

    def __init__(self, bodies: Sequence[int], functions: IntArray, client: int, step_s: float) -> None:
        self._identities = np.array(bodies, dtype=np.int64)
        self._functions, self._client, self._step_s = functions, ctypes.c_void_p(client), step_s
        self._advance, self._touching = function("advance", ctypes.c_int64), np.zeros(1, dtype=np.int64)

    def advance(self, bodies: IntArray, loads: Array, steps: int) -> tuple[int, bool]:
        """See ``RigidBodyEngine.advance``."""
        identities = self._identities[bodies]
        made = self._advance(
            address(self._functions),
            self._client,
            ctypes.c_int64(len(bodies)),
            address(identities),
            address(loads),
            ctypes.c_int64(steps),
            ctypes.c_double(self._step_s),
            address(self._touching),
        )
        if made < 0:
            raise ValueError(f"PyBullet does not know all bodies of {identities.tolist()}")
        return made, bool(self._touching[0])


def make_stepper(bodies: Sequence[int], client: int, step_s: float) -> BulletStepper | None:
    """Return a stepper for a PyBullet client, None if this build of PyBullet does not offer what it needs."""
    functions = _addresses()
    if functions is None:
        return None
    untyped: Any = pybullet
    with silenced():
        plugin = untyped.loadPlugin(str(LIBRARY.path), f"_v{LIBRARY.level}_", client)
    if plugin < 0:
        return None
    handle = ctypes.c_void_p()
    place = np.array([ctypes.addressof(handle)], dtype=np.uint64).view(np.int32).tolist()
    untyped.executePluginCommand(plugin, "", place, [], client)
    return None if handle.value is None else BulletStepper(bodies, functions, handle.value, step_s)
