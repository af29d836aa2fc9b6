# SPDX-License-Identifier: Apache-2.0
"""Training environments of a scenario with a table ``[learning]``, for Gymnasium and PettingZoo.

    environments = chaserdock.envs.make_vec("docking-learning", 1024)

The dynamics are those of the world without contact forces, in C (``native``). Needs
``chaserdock[learn]``; ``DockingBatch`` (batch.py) works without. See docs/learning.md.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from chaserdock_protocol.errors import require_extra
from chaserdock_protocol.scenario import Scenario

from ..api import load_scenario

if TYPE_CHECKING:
    from .parallel import DockingParallelEnv
    from .single import DockingEnv
    from .vector import DockingVectorEnv

ID = "chaserdock/Docking-v0"
"""Name of the environment in Gymnasium's registry, after ``register``."""


def make(scenario: str | Path | Scenario, *, render_mode: str | None = None) -> DockingEnv:
    """Return a Gymnasium ``Env`` of one chaser.

    ``scenario``: name, file, or a loaded one. ``render_mode``: ``human`` or ``rgb_array``. Raises
    ScenarioError for a scenario that is not for training, MissingPackageError without
    ``chaserdock[learn]``.
    """
    require_extra("gymnasium", "learn")
    from .single import DockingEnv

    return DockingEnv(scenario, render_mode=render_mode)


def make_vec(
    scenario: str | Path | Scenario, num_envs: int, *, render_mode: str | None = None
) -> DockingVectorEnv:
    """Return a Gymnasium ``VectorEnv`` of ``num_envs`` environments of one chaser; see ``make``."""
    require_extra("gymnasium", "learn")
    from .vector import DockingVectorEnv

    return DockingVectorEnv(scenario, num_envs, render_mode=render_mode)


def parallel_env(
    scenario: str | Path | Scenario, *, render_mode: str | None = None
) -> DockingParallelEnv:
    """Return a PettingZoo ``ParallelEnv`` of one to sixteen chasers; see ``make``."""
    require_extra("pettingzoo", "learn")
    require_extra("gymnasium", "learn")
    from .parallel import DockingParallelEnv

    return DockingParallelEnv(scenario, render_mode=render_mode)


def register() -> None:
    """Register ``ID`` for ``gymnasium.make`` and ``make_vec``, which then take ``scenario``. Raises
    MissingPackageError without ``chaserdock[learn]``.
    """
    require_extra("gymnasium", "learn")
    import gymnasium

    if ID not in gymnasium.registry:
        gymnasium.register(
            ID,
            entry_point="chaserdock.envs.single:DockingEnv",
            vector_entry_point="chaserdock.envs.vector:DockingVectorEnv",
        )


def loaded(scenario: str | Path | Scenario) -> Scenario:
    """Return a scenario that is given by name, file, or as itself. Raises ScenarioError."""
    return scenario if isinstance(scenario, Scenario) else load_scenario(scenario)
