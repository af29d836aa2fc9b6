# SPDX-License-Identifier: Apache-2.0
"""Scenario section ``[world]``: how the world simulates the bodies (docs/world.md)."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from .fields import Section


class WorldSection(Section):
    """How the world simulates the bodies."""

    engine: Literal["pybullet", "mujoco"] = Field(
        default="pybullet",
        description="Physics engine: `pybullet` (Python 3.11 on Linux x86_64), or `mujoco` (all "
        "platforms; needs `chaserdock[mujoco]`). Both integrate alike; they differ in "
        "contacts and joints ([world.md](world.md)).",
    )
