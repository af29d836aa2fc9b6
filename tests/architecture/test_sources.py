# SPDX-License-Identifier: Apache-2.0
"""Rules for source files: licence header, typed packages, unique names of classes and types."""

from __future__ import annotations

import ast
import re
import subprocess
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest
from source_tree import MODULES, PACKAGES, ROOT, tree_of


def test_source_files_state_their_licence() -> None:
    tracked = subprocess.check_output(["git", "ls-files"], cwd=ROOT, text=True).split()
    sources = [name for name in tracked if re.search(r"\.(py|c|h|js|css|toml|ya?ml|json5)$", name)]
    assert len(sources) > 400
    missing = [
        name
        for name in sources
        if ".min." not in name  # of others, with their licence beside them
        and "SPDX-License-Identifier: Apache-2.0" not in (ROOT / name).read_text()[:300]
    ]
    assert missing == []


def test_packages_are_typed() -> None:
    assert [name for name, folder in PACKAGES.items() if not (folder / "py.typed").is_file()] == []


def type_names(path: Path) -> Iterator[str]:
    """Yield the public classes of a module, and its type aliases and type variables, which are
    assigned in CamelCase.
    """
    tree = tree_of(path)
    yield from (n.name for n in ast.walk(tree) if isinstance(n, ast.ClassDef) and n.name[0] != "_")
    for node in tree.body:
        targets = node.targets if isinstance(node, ast.Assign) else [getattr(node, "target", None)]
        names = [t.id for t in targets if isinstance(t, ast.Name)]
        yield from (
            name for name in names if re.fullmatch(r"[A-Z][A-Za-z0-9]*[a-z][A-Za-z0-9]*", name)
        )


@pytest.mark.slow
def test_no_name_of_a_class_or_type_is_used_for_two_things() -> None:
    """In the packages and the benchmarks, so that a search for a name finds one thing."""
    places: dict[str, list[str]] = defaultdict(list)
    paths = [path for _, path in MODULES] + sorted((ROOT / "benchmarks").rglob("*.py"))
    for path in paths:
        for name in type_names(path):
            places[name].append(str(path.relative_to(ROOT)))
    assert len(places) > 500
    assert {name: found for name, found in places.items() if len(found) > 1} == {}
