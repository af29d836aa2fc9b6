# SPDX-License-Identifier: Apache-2.0
"""Make the engine that a scenario names. Its package is imported only when it is used."""

from __future__ import annotations

from typing import Literal

from chaserdock_protocol.errors import require_extra

from .engine import EngineSetup, RigidBodyEngine

EngineName = Literal["pybullet", "mujoco"]


def make_engine(name: EngineName, setup: EngineSetup) -> RigidBodyEngine:
    """Return an engine with these bodies. Raises MissingPackageError (see
    ``requirements.require_packages``).
    """
    if name == "mujoco":
        require_extra("mujoco", "mujoco")
        from .mujoco_engine import MujocoEngine

        return MujocoEngine(setup)
    from .bullet_engine import BulletEngine

    return BulletEngine(setup)
