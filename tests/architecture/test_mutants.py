# SPDX-License-Identifier: Apache-2.0
"""The table of mutants fits the sources, so that ``benchmarks/mutations.py`` can apply every
one.
"""

from __future__ import annotations

import ast
from pathlib import Path

import pytest
from source_changes import MUTANTS, ROOT, SOURCES, Change, Mutant, apply, read_mutants

ALL = read_mutants()


def test_there_are_mutants_of_every_source_root() -> None:
    assert len(ALL) >= 50
    assert len({mutant.change for mutant in ALL}) == len(ALL)
    assert {mutant.change.file.split("/")[0] for mutant in ALL} == set(SOURCES)


@pytest.mark.parametrize("mutant", ALL, ids=lambda m: m.name)
def test_every_mutant_changes_one_place_and_names_its_tests(mutant: Mutant) -> None:
    change = mutant.change
    apply([change], ROOT, write=False)
    source = (ROOT / change.file).read_text(encoding="utf-8")
    mutated = ast.parse(source.replace(change.old, change.new))
    assert ast.dump(mutated) != ast.dump(ast.parse(source))
    assert mutant.tests
    assert [test for test in mutant.tests if not (ROOT / test).is_file()] == []


@pytest.mark.parametrize(("text", "count"), [("a = 1\na = 1\n", 2), ("a = 2\n", 0)])
def test_text_that_does_not_occur_once_is_an_error(tmp_path: Path, text: str, count: int) -> None:
    (tmp_path / "module.py").write_text(text)
    with pytest.raises(ValueError, match=rf"module\.py contains the text to replace {count} times"):
        apply([Change("module.py", "a = 1", "a = 3")], tmp_path)
    assert (tmp_path / "module.py").read_text() == text


def test_a_change_is_applied_to_the_copy_only(tmp_path: Path) -> None:
    change = ALL[0].change
    source = (ROOT / change.file).read_text(encoding="utf-8")
    (tmp_path / change.file).parent.mkdir(parents=True)
    (tmp_path / change.file).write_text(source, encoding="utf-8")
    apply([change], tmp_path)
    assert (tmp_path / change.file).read_text(encoding="utf-8") == source.replace(
        change.old, change.new
    )
    assert (ROOT / change.file).read_text(encoding="utf-8") == source
    assert MUTANTS.is_relative_to(ROOT)
