# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the tests of the world."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from chaserdock_world.physics.simulation import Physics
from docking_cases import world


@pytest.fixture
def worlds(request: pytest.FixtureRequest) -> Iterator[Any]:
    """Return a function that opens worlds of ``docking_cases``; all are closed at the end of the
    test.

    They are PyBullet's, or those of the engine that an indirect parameter names
    (``engine_cases.both``).
    """
    opened: list[Physics] = []
    engine = getattr(request, "param", "pybullet")

    def make(**changes: Any) -> Physics:
        opened.append(world(world={"engine": engine}, **changes))
        return opened[-1]

    yield make
    for physics in opened:
        physics.close()
