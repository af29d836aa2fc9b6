# SPDX-License-Identifier: Apache-2.0
"""Fixtures of the tests of the world."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from chaserdock_world.physics.simulation import Physics
from docking_cases import world


@pytest.fixture
def worlds() -> Iterator[Any]:
    """Return a function that opens worlds of ``docking_cases``; all are closed at the end of the test."""
    opened: list[Physics] = []

    def make(**changes: Any) -> Physics:
        opened.append(world(**changes))
        return opened[-1]

    yield make
    for physics in opened:
        physics.close()
