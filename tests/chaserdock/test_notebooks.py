# SPDX-License-Identifier: Apache-2.0
"""The notebooks of examples/ execute without an error, and are stored with the outputs of an
execution.
"""

from __future__ import annotations

import re
import runpy
from itertools import groupby
from pathlib import Path
from typing import Any

import pytest
from harness import ROOT

nbformat = pytest.importorskip("nbformat")
pytest.importorskip("nbclient")

NOTEBOOKS = sorted((ROOT / "examples").glob("*.ipynb"))
executed: Any = runpy.run_path(str(ROOT / "docs" / "run_notebooks.py"))["executed"]


def code_cells(notebook: Any) -> list[Any]:
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_is_stored_with_its_outputs(path: Path) -> None:
    """Every cell that shows something has an output, and none is an error, a warning, or a path of
    the author's machine.
    """
    notebook = nbformat.read(path, as_version=4)
    assert notebook.cells[0].source.startswith("# ")
    for cell in code_cells(notebook):
        assert cell.outputs or cell.source.rstrip().endswith(";") or _shows_nothing(cell.source), (
            cell.source
        )
        for output in cell.outputs:
            assert output.output_type != "error"
            assert output.get("name") != "stderr", output.text
    text = path.read_text(encoding="utf-8")
    assert not re.search(r"/(work|home|root|tmp)/", text)
    assert "image/png" in text
    assert path.stat().st_size < 100_000


def _shows_nothing(source: str) -> bool:
    """Return whether the last line of a cell is an assignment or an import."""
    last = source.rstrip().splitlines()[-1]
    return bool(re.match(r"(\S+(, \S+)* = |import |from |\)$)", last))


@pytest.mark.slow
@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_notebook_executes(path: Path, tmp_path: Path) -> None:
    notebook = executed(path, tmp_path)
    stored = nbformat.read(path, as_version=4)
    for new, old in zip(code_cells(notebook), code_cells(stored), strict=True):
        assert _kinds(new.outputs) == _kinds(old.outputs), new.source


def _kinds(outputs: list[Any]) -> list[str]:
    """Return the kinds of a cell's outputs. A text arrives in as many parts as its program's pace
    makes of it.
    """
    return [kind for kind, _ in groupby(map(_kind, outputs))]


def _kind(output: Any) -> str:
    """Return what a figure, a value or a text is; not what it says."""
    return (
        "figure"
        if "image/png" in output.get("data", {})
        else str(output.get("name", output.output_type))
    )
