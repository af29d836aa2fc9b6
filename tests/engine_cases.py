# SPDX-License-Identifier: Apache-2.0
"""Tests that hold on each physics engine."""

from __future__ import annotations

import pytest

ENGINES = ("pybullet", "mujoco")
both = pytest.mark.parametrize("worlds", ENGINES, indirect=True)
"""Gives the fixture ``worlds`` of a test each engine in turn."""
