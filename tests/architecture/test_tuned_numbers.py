# SPDX-License-Identifier: Apache-2.0
"""Every tuned number has a reason: a text that states its unit and where it comes from."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest
from source_tree import MODULES, ROOT, is_numeric, tree_of

ALLOWED: dict[str, int] = {}
"""Numbers of each root that may still be without a reason. It only falls; delete a root at 0."""

C_NUMBER = re.compile(
    r"#define\s+\w+\s+\(?[-\d.]|(?:static\s+)?const\s+(?:float|double|int|long|size_t)\s.*="
)
"""A line of C, outside of functions, that defines a number or an array of numbers."""


def is_text(statement: ast.stmt | None) -> bool:
    """Return whether a statement is a docstring."""
    return isinstance(statement, ast.Expr) and isinstance(statement.value, ast.Constant)


def python_numbers_without_reason(tree: ast.Module, source: str) -> Iterator[int]:
    """Yield the lines of a module's constants that have neither a docstring below, nor a comment on
    their lines or the line above."""
    lines = source.splitlines()
    for statement, following in zip(tree.body, [*tree.body[1:], None], strict=False):
        if not isinstance(statement, (ast.Assign, ast.AnnAssign)):
            continue
        if not is_numeric(statement.value) or is_text(following):
            continue
        first, last = statement.lineno - 1, statement.end_lineno or statement.lineno
        commented = any("#" in line for line in lines[first:last])
        if not (commented or lines[first - 1].startswith("#")):
            yield statement.lineno


def c_numbers_without_reason(source: str) -> Iterator[int]:
    """Yield the lines of numbers that have neither a comment on their line nor above it."""
    before = ""
    for number, line in enumerate(source.splitlines(), start=1):
        is_explained = "/*" in line or "//" in line or is_c_comment(before)
        if C_NUMBER.match(line) and not is_explained:
            yield number
        before = line


def is_c_comment(line: str) -> bool:
    """Return whether a line of C is, or ends, a comment without code."""
    text = line.strip()
    return text.startswith(("/*", "*", "//")) or (text.endswith("*/") and "/*" not in text)


def without_reason(root: str) -> list[str]:
    """Return the places of all numbers of a source root that have no reason."""
    found = []
    for _, path in MODULES:
        if path.is_relative_to(ROOT / root):
            lines = python_numbers_without_reason(tree_of(path), path.read_text(encoding="utf-8"))
            found += [f"{path.relative_to(ROOT)}:{line}" for line in lines]
    for path in sorted(p for p in (ROOT / root).rglob("*") if p.suffix in (".c", ".h")):
        lines = c_numbers_without_reason(path.read_text(encoding="utf-8"))
        found += [f"{path.relative_to(ROOT)}:{line}" for line in lines]
    return found


@pytest.mark.parametrize("root", ["agents", "chaserdock", "controller", "protocol", "world"])
def test_tuned_numbers_have_a_reason(root: str) -> None:
    found, allowed = without_reason(root), ALLOWED.get(root, 0)
    assert len(found) <= allowed, "state unit and reason of:\n" + "\n".join(found)
    assert len(found) == allowed, f"lower ALLOWED[{root!r}] to {len(found)}"


def test_numbers_without_a_reason_are_found(tmp_path: Path) -> None:
    source = '''
A = 1
B = 2.0  # a reason
C, D = 3, -4e-3
"""A reason."""
# a reason
E = (5, 6)
F = [7, 1 << 8]
G = "text"
'''
    assert list(python_numbers_without_reason(ast.parse(source), source)) == [2, 8]
    source = """
#define A 1
#define B 2 /* a reason */
#define C (3 + 1)
/* a reason */
static const double D = 4.0;
static const float E[2] = {5, 6};
#define F "text"
"""
    assert list(c_numbers_without_reason(source)) == [2, 4, 7]
