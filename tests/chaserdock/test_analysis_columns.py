# SPDX-License-Identifier: Apache-2.0
"""Growing tables: in memory, in a file, and equal reports from both."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest
from chaserdock_protocol.errors import ChaserdockError
from hypothesis import given, settings
from hypothesis import strategies as st

from chaserdock.analysis import columns, summary
from chaserdock.analysis.columns import Columns
from chaserdock.analysis.report import report_of

GOLDEN = Path(__file__).parents[1] / "golden" / "two-chasers.mcap"


@settings(max_examples=60, deadline=None)
@given(
    width=st.integers(1, 5),
    rows=st.integers(0, 60),
    held=st.integers(1, 200),
    seed=st.integers(0, 2**32 - 1),
)
def test_table_returns_added_rows_from_memory_and_file(
    width: int, rows: int, held: int, seed: int
) -> None:
    values = np.random.default_rng(seed).normal(size=(rows, width))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(columns, "_MAX_IN_MEMORY", held)
        table = Columns(width)
        for row in values:
            table.add(row[:1], row[1:])
        for _ in range(2):  # repeated calls return the same rows
            np.testing.assert_array_equal(table.table(), values)


def test_incomplete_row_raises_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(columns, "_MAX_IN_MEMORY", 4)
    table = Columns(3)
    table.add((1.0, 2.0, 3.0), (4.0, 5.0))
    with pytest.raises(ValueError, match="reshape"):
        table.table()


@pytest.mark.slow
def test_report_is_equal_with_tables_in_files(monkeypatch: pytest.MonkeyPatch) -> None:
    in_memory = report_of(GOLDEN)
    monkeypatch.setattr(columns, "_MAX_IN_MEMORY", 64)
    monkeypatch.setattr(summary, "_BLOCK", 7)
    assert report_of(GOLDEN) == in_memory


def test_full_disk_raises_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    full = Path("/dev/full")
    if not full.exists():
        pytest.skip("no /dev/full on this system")
    monkeypatch.setattr(columns, "_MAX_IN_MEMORY", 4)
    monkeypatch.setattr(tempfile, "TemporaryFile", lambda **_: full.open("wb", buffering=0))
    with pytest.raises(ChaserdockError, match=r"No space left on device; TMPDIR"):
        Columns(4).add((1.0, 2.0, 3.0, 4.0))
