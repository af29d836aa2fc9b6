# SPDX-License-Identifier: Apache-2.0
"""The packages' source files, parsed: which modules there are, and what each imports."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PACKAGES = {
    "chaserdock": ROOT / "chaserdock",
    "chaserdock_models": ROOT / "protocol" / "chaserdock_models",
    "chaserdock_protocol": ROOT / "protocol" / "chaserdock_protocol",
    "chaserdock_world": ROOT / "world" / "chaserdock_world",
    "chaserdock_agents": ROOT / "agents" / "chaserdock_agents",
    "chaserdock_controller": ROOT / "controller" / "chaserdock_controller",
}
MODULES = [
    (package, path) for package, folder in PACKAGES.items() for path in sorted(folder.rglob("*.py"))
]
FLYING = [p for _, p in MODULES if p.is_relative_to(PACKAGES["chaserdock_controller"])] + [
    p for _, p in MODULES if p.is_relative_to(PACKAGES["chaserdock_agents"] / "chaser")
]


@cache
def tree_of(path: Path) -> ast.Module:
    """Parse a source file."""
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def is_numeric(value: ast.expr | None) -> bool:
    """Return whether an expression is a number, or a tuple or list of numbers."""
    match value:
        case ast.Constant(value=number):
            return type(number) in (int, float)
        case ast.UnaryOp(operand=operand):
            return is_numeric(operand)
        case ast.BinOp(left=left, right=right):
            return is_numeric(left) and is_numeric(right)
        case ast.Tuple(elts=items) | ast.List(elts=items):
            return bool(items) and all(map(is_numeric, items))
    return False


def module_name(path: Path) -> str:
    """Return the dotted name of a module of ours."""
    package = next(f for f in PACKAGES.values() if path.is_relative_to(f))
    parts = [package.name, *path.relative_to(package).with_suffix("").parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


@cache
def imported(path: Path, at_once: bool = False) -> frozenset[str]:
    """Return the full names of the modules that a module imports; relative names are resolved.

    ``at_once``: only those that are imported with it, not when a function is called.
    """
    return frozenset(_imported(path, at_once))


def _imported(path: Path, at_once: bool) -> Iterator[str]:
    package = next(f for f in PACKAGES.values() if path.is_relative_to(f))
    parts = (package.name, *path.relative_to(package).parts[:-1])
    tree = tree_of(path)
    for node in tree.body if at_once else ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = parts[: len(parts) - node.level + 1] if node.level else ()
            module = ".".join((*base, *(node.module or "").split("."))).strip(".")
            yield module
            yield from (f"{module}.{alias.name}" for alias in node.names)
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute | ast.Name):
            # importlib.import_module("..."), __import__("...")
            name = node.func.attr if isinstance(node.func, ast.Attribute) else node.func.id
            if name in ("import_module", "__import__") and node.args:
                assert isinstance(node.args[0], ast.Constant), f"{path}: import of a computed name"
                yield str(node.args[0].value)


def short(item: object) -> str:
    """Return a test's label: the path relative to the repository."""
    return str(item.relative_to(ROOT)) if isinstance(item, Path) else str(item)
