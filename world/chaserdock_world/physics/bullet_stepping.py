# SPDX-License-Identifier: Apache-2.0
"""Step free bodies in PyBullet without a Python call for each step and body, to the same bits.

``native/bullet.c`` calls Bullet's C interface, which PyBullet's library exports, with the client
that Bullet passes to a plugin in the same world.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from functools import cache
from typing import Any

import numpy as np
from chaserdock_models import rotations
from chaserdock_models.arrays import Array, IntArray
from chaserdock_models.native import address, location

from .bullet import pybullet, silenced
from .engine import PlacementPath
from .native import LIBRARY, function

FUNCTIONS = (
    "b3SubmitClientCommand",
    "b3ProcessServerStatus",
    "b3RequestActualStateCommandInit",
    "b3GetStatusActualState",
    "b3ApplyExternalForceCommandInit",
    "b3ApplyExternalForce",
    "b3ApplyExternalTorque",
    "b3InitStepSimulationCommand",
    "b3InitRequestContactPointInformation",
    "b3GetContactPointInformation",
    "b3CreatePoseCommandInit",
    "b3CreatePoseCommandSetBasePosition",
    "b3CreatePoseCommandSetBaseOrientation",
    "b3CreatePoseCommandSetBaseLinearVelocity",
    "b3CreatePoseCommandSetBaseAngularVelocity",
)


@cache
def _addresses() -> IntArray | None:
    """Return the addresses of ``FUNCTIONS``, None where PyBullet's library does not export them."""
    library = ctypes.CDLL(pybullet.__file__)
    if not all(hasattr(library, name) for name in FUNCTIONS):
        return None
    found = [ctypes.cast(getattr(library, name), ctypes.c_void_p).value or 0 for name in FUNCTIONS]
    return np.array(found, dtype=np.int64)


@LIBRARY.structure("Path")
class _Path(ctypes.Structure):
    """Mirror `Path` of native/bullet.c."""

    _fields_ = [(name, ctypes.c_int64) for name in ("body", "next", "every")] + [
        ("motion", ctypes.c_void_p)
    ]


def _motion_of(path: PlacementPath) -> Array:
    """Return the placements (K, 13) as Bullet takes them.

    Position, attitude x, y, z, w, velocity, rate.
    """
    s = path.states
    motion = np.empty((len(s.position_m), 13))
    motion[:, 0:3], motion[:, 3:6], motion[:, 6] = s.position_m, s.q_wxyz[:, 1:], s.q_wxyz[:, 0]
    motion[:, 7:10], motion[:, 10:13] = s.velocity_m_s, rotations.rotate(s.q_wxyz, s.omega_rad_s)
    return motion


class BulletStepper:
    """Step free bodies in one PyBullet client; ``bodies``: their identities there."""

    def __init__(
        self, bodies: Sequence[int], functions: IntArray, client: int, step_s: float
    ) -> None:
        self._identities = np.array(bodies, dtype=np.int64)
        self._functions, self._client, self._step_s = functions, ctypes.c_void_p(client), step_s
        self._advance, self._touching = (
            function("advance", ctypes.c_int64),
            np.zeros(1, dtype=np.int64),
        )

    def advance(
        self, bodies: IntArray, loads: Array, steps: int, path: PlacementPath | None
    ) -> tuple[int, bool]:
        """See ``RigidBodyEngine.advance``."""
        identities, moved = self._identities[bodies], None
        if path is not None:
            motion = _motion_of(path)
            body = int(self._identities[path.body])
            moved = ctypes.byref(_Path(body, path.first, path.every, location(motion)))
        made = self._advance(
            address(self._functions),
            self._client,
            ctypes.c_int64(len(bodies)),
            address(identities),
            address(loads),
            ctypes.c_int64(steps),
            ctypes.c_double(self._step_s),
            moved,
            address(self._touching),
        )
        if made < 0:
            raise ValueError(f"PyBullet does not know all bodies of {identities.tolist()}")
        return made, bool(self._touching[0])


def make_stepper(bodies: Sequence[int], client: int, step_s: float) -> BulletStepper | None:
    """Return a stepper for a PyBullet client; None if this build of PyBullet lacks what it
    needs.
    """
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
