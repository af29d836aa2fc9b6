# SPDX-License-Identifier: Apache-2.0
"""Measure the structure of the sources: ``python release/structure.py [--json FILE]``.

Prints lines per root, the largest classes, numeric constants without a reason, comments, lengths of
lines, checks for None, maps by chaser number, scenario keys, commands, and the size of README and
CHANGELOG. Run it in the environment of the tests before and after a change of structure.
"""

from __future__ import annotations

import argparse
import ast
import io
import json
import re
import subprocess
import tokenize
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
ROOTS = ("protocol", "agents", "controller", "world", "chaserdock")
SOURCES = (".py", ".c", ".h")
LONG_LINE = 99
"""Lines above this length count as long (characters): the figure that issue reports quote."""


@dataclass(frozen=True)
class PythonFile:
    """A parsed source file of a root."""

    path: Path
    text: str
    tree: ast.Module

    @property
    def lines(self) -> list[str]:
        """Return the lines of the file."""
        return self.text.splitlines()


def tracked(*folders: str) -> list[Path]:
    """Return the files that git tracks below folders of the repository."""
    listed = subprocess.run(
        ["git", "ls-files", *folders], cwd=ROOT, capture_output=True, text=True, check=True
    )
    return [ROOT / name for name in listed.stdout.splitlines() if (ROOT / name).is_file()]


def python_files(root: str) -> list[PythonFile]:
    """Return the Python files of a root, parsed."""
    texts = [(p, p.read_text(encoding="utf-8")) for p in tracked(root) if p.suffix == ".py"]
    return [PythonFile(path, text, ast.parse(text)) for path, text in texts]


def count_lines(root: str) -> int:
    """Return the lines of a root's Python and C files."""
    files = [p for p in tracked(root) if p.suffix in SOURCES]
    return sum(len(p.read_text(encoding="utf-8").splitlines()) for p in files)


def sizes_of_classes(files: list[PythonFile]) -> list[tuple[int, int, str]]:
    """Return methods, attributes and name of every class, the largest first.

    Attributes are the names that methods store on ``self``, and annotated fields.
    """
    found = []
    for file in files:
        for node in ast.walk(file.tree):
            if not isinstance(node, ast.ClassDef):
                continue
            methods = sum(isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef) for n in node.body)
            stored = {
                n.attr
                for n in ast.walk(node)
                if isinstance(n, ast.Attribute)
                and isinstance(n.ctx, ast.Store)
                and isinstance(n.value, ast.Name)
                and n.value.id == "self"
            }
            if methods > 3:  # not a record of data
                fields = {n.target.id for n in node.body if _is_field(n)}  # type: ignore[union-attr]
                stored |= fields
            found.append((methods, len(stored), f"{node.name} ({file.path.relative_to(ROOT)})"))
    return sorted(found, reverse=True)


def _is_field(node: ast.stmt) -> bool:
    return isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name)


def _is_number(node: ast.expr) -> bool:
    match node:
        case ast.Constant(value=bool()):
            return False
        case ast.Constant(value=int() | float()):
            return True
        case ast.UnaryOp(operand=operand):
            return _is_number(operand)
        case ast.Tuple(elts=[_, *_] as elements):
            return all(map(_is_number, elements))
        case _:
            return False


def numeric_constants(file: PythonFile) -> Iterator[tuple[int, bool]]:
    """Yield line number of each numeric constant of a module, and whether a reason stands with it.

    A reason is a docstring below, or a comment on the line or above it.
    """
    body = file.tree.body
    for k, node in enumerate(body):
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value and _is_number(node.value):
            after = body[k + 1] if k + 1 < len(body) else None
            documented = (
                isinstance(after, ast.Expr)
                and isinstance(after.value, ast.Constant)
                and isinstance(after.value.value, str)
            )
            above = file.lines[node.lineno - 2].lstrip() if node.lineno > 1 else ""
            commented = "#" in file.lines[node.lineno - 1] or above.startswith("#")
            yield node.lineno, documented or commented


def explained_lines(file: PythonFile) -> int:
    """Return the number of lines that hold a comment or are part of a docstring."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(file.text).readline):
        if token.type == tokenize.COMMENT:
            lines.add(token.start[0])
    for node in ast.walk(file.tree):
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant):
            value = node.value
            if isinstance(value.value, str) and value.end_lineno is not None:
                lines.update(range(value.lineno, value.end_lineno + 1))
    return len(lines)


def texts_of(files: list[PythonFile]) -> list[str]:
    """Return the lines of files that are not empty."""
    return [line for file in files for line in file.lines if line.strip()]


def scenario_keys() -> tuple[int, int]:
    """Return the number of scenario keys, and of those that no shipped scenario sets."""
    import tomllib

    from chaserdock_protocol.scenario import Scenario
    from chaserdock_protocol.scenario.json_schema import editor_schema_text

    schema = json.loads(editor_schema_text(Scenario))
    keys = set(_schema_keys(schema, schema, ""))

    set_by_any: set[str] = set()
    for path in (ROOT / "scenarios").glob("*.toml"):
        set_by_any.update(_set_keys(tomllib.loads(path.read_text(encoding="utf-8")), ""))
    return len(keys), len(keys - set_by_any)


def _schema_keys(node: Any, schema: Any, prefix: str, depth: int = 0) -> Iterator[str]:
    """Yield the dotted names of the leaves of a JSON schema."""
    if depth > 12 or not isinstance(node, dict):
        return
    if "$ref" in node:
        target = schema
        for part in node["$ref"].removeprefix("#/").split("/"):
            target = target[part]
        yield from _schema_keys(target, schema, prefix, depth + 1)
        return
    branches = [b for key in ("anyOf", "oneOf", "allOf") for b in node.get(key, ())]
    properties = node.get("properties")
    inner = [*branches, *([node["items"]] if isinstance(node.get("items"), dict) else [])]
    nested = [name for b in inner for name in _schema_keys(b, schema, prefix, depth + 1)]
    if properties:
        for key, value in properties.items():
            yield from _schema_keys(value, schema, f"{prefix}.{key}" if prefix else key, depth + 1)
    elif any(name != prefix for name in nested):
        yield from (name for name in nested if name != prefix)
    elif prefix:
        yield prefix


def _set_keys(table: Any, prefix: str) -> Iterator[str]:
    """Yield the dotted names of the values that a TOML document sets."""
    if isinstance(table, dict):
        for key, value in table.items():
            yield from _set_keys(value, f"{prefix}.{key}" if prefix else key)
    elif isinstance(table, list) and any(isinstance(v, dict) for v in table):
        for value in table:
            yield from _set_keys(value, prefix)
    else:
        yield prefix


def commands() -> list[str]:
    """Return every command of the program that can be run, groups as ``group command``."""
    import typer

    from chaserdock.cli.main import app

    def leaves(command: Any, path: str) -> Iterator[str]:
        members = getattr(command, "commands", None)
        if not members:
            yield path
            return
        for name, member in members.items():
            if not member.hidden:
                yield from leaves(member, f"{path} {name}".strip())

    return list(leaves(typer.main.get_command(app), ""))


def measure() -> dict[str, Any]:
    """Return all figures by name."""
    figures: dict[str, Any] = {}
    files = {root: python_files(root) for root in ROOTS}
    figures |= {f"lines_{root}": count_lines(root) for root in ROOTS}
    figures["lines_five_roots"] = sum(figures[f"lines_{root}"] for root in ROOTS)
    figures |= {f"lines_{folder}": count_lines(folder) for folder in ("tests", "benchmarks")}
    everything = [file for root in ROOTS for file in files[root]]
    largest = [f"{m} / {a}  {name}" for m, a, name in sizes_of_classes(everything)[:6]]
    figures["largest_classes_methods_attributes"] = largest
    reasons = [reason for file in everything for _, reason in numeric_constants(file)]
    figures["numeric_constants"] = len(reasons)
    figures["numeric_constants_without_reason"] = reasons.count(False)
    texts = texts_of(everything)
    explained = sum(explained_lines(file) for file in everything)
    figures["comments_and_docstrings_share"] = round(explained / len(texts), 3)
    figures["mean_line_characters"] = round(sum(map(len, texts)) / len(texts), 1)
    long_share = sum(len(line) > LONG_LINE for line in texts) / len(texts)
    figures["long_lines_share"] = round(long_share, 4)
    for root in ("controller", "agents"):
        lines = texts_of(files[root])
        checks = sum(len(re.findall(r"\bis (?:not )?None\b", line)) for line in lines)
        figures[f"none_checks_per_1000_lines_{root}"] = round(1000 * checks / len(lines), 1)
    maps = [
        line for line in texts_of(files["controller"]) if re.search(r"(dict|Mapping)\[int", line)
    ]
    figures["maps_by_chaser_number_controller"] = len(maps)
    types = [line for line in texts if "isinstance" in line and "Estimator" in line]
    figures["type_tests_of_estimators"] = len(types)
    figures["scenario_keys"], figures["scenario_keys_set_by_no_scenario"] = scenario_keys()
    names = commands()
    figures["commands"] = len(names)
    readme = (ROOT / "README.md").read_text(encoding="utf-8")
    figures["readme_words"] = len(readme.split())
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    figures["changelog_lines"] = len(changelog.splitlines())
    return figures


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "--json", type=Path, help="write the figures to FILE as well", metavar="FILE"
    )
    options = parser.parse_args()
    figures = measure()
    for name, value in figures.items():
        print(f"{name:<44}", "\n".ljust(46).join(value) if isinstance(value, list) else value)
    if options.json:
        options.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
