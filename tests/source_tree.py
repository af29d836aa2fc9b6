# SPDX-License-Identifier: Apache-2.0
"""The packages' source files, parsed: which modules there are, and what each imports."""

from __future__ import annotations

import ast
from collections.abc import Iterator
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


def tree_of(path: Path) -> ast.Module:
    """Parse a source file."""
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def module_name(path: Path) -> str:
    """Return the dotted name of a module of ours."""
    package = next(f for f in PACKAGES.values() if path.is_relative_to(f))
    parts = [package.name, *path.relative_to(package).with_suffix("").parts]
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imported(path: Path) -> Iterator[str]:
    """Yield the full names of the modules that a module imports, anywhere in it; relative names are
    resolved.
    """
    package = next(f for f in PACKAGES.values() if path.is_relative_to(f))
    parts = (package.name, *path.relative_to(package).parts[:-1])
    for node in ast.walk(tree_of(path)):
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
                yield from _computed(node.args[0], path, ".".join(parts))


def _computed(argument: ast.expr, path: Path, package: str) -> Iterator[str]:
    """Yield what ``import_module(argument)`` imports: a constant name, or with f"{__name__}.{...}"
    in the ``__init__.py`` of a folder all modules of this folder.
    """
    if path.name == "__init__.py" and ast.unparse(argument).startswith("f'{__name__}."):
        yield from (f"{package}.{p.stem}" for p in sorted(path.parent.glob("[!_]*.py")))
    else:
        assert isinstance(argument, ast.Constant), f"{path}: import of a computed name"
        yield str(argument.value)


def short(item: object) -> str:
    """Return a test's label: the path relative to the repository."""
    return str(item.relative_to(ROOT)) if isinstance(item, Path) else str(item)
