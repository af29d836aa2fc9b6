# SPDX-License-Identifier: Apache-2.0
"""Simulated flights that once violated an invariant, in the simplest form that did."""

from __future__ import annotations

from pathlib import Path

import pytest

from chaserdock.simulation.flight import fly_case

CASES = sorted((Path(__file__).parents[1] / "regressions").glob("*.toml"))


@pytest.mark.slow
@pytest.mark.parametrize("path", CASES, ids=lambda path: path.stem)
def test_fixed_failures_stay_fixed(path: Path, tmp_path: Path) -> None:
    result = fly_case({"extends": str(path)}, 0, tmp_path)
    assert [str(violation) for violation in result.violations] == []
