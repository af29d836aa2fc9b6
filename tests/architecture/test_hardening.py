# SPDX-License-Identifier: Apache-2.0
"""What no module may do with what comes from outside, and that nothing that waits is without a
bound.
"""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Annotated, get_args, get_origin, get_type_hints

import msgspec
import pytest
from chaserdock_protocol import messages as m
from source_tree import MODULES, imported, short, tree_of

# Modules that make objects or code of bytes.
UNSAFE_LIBRARIES = {
    "pickle",
    "cPickle",
    "dill",
    "cloudpickle",
    "marshal",
    "shelve",
    "joblib",
    "code",
    "codeop",
}
UNSAFE_CALLS = {"eval", "exec", "compile", "__import__", "breakpoint"}
QUEUES = {"Queue", "SimpleQueue", "LifoQueue", "PriorityQueue"}


def unsafe_calls(tree: ast.Module) -> list[int]:
    """Lines that run code which arrives as text or bytes."""
    lines = []
    for node in ast.walk(tree):
        match node:
            case ast.Call(func=ast.Name(id=name)) if name in UNSAFE_CALLS:
                lines.append(node.lineno)
            case ast.keyword(arg="shell" | "allow_pickle", value=ast.Constant(value=value)) if (
                value
            ):
                lines.append(node.lineno)
    return lines


@pytest.mark.slow
def test_nothing_is_unpickled_or_evaluated() -> None:
    paths = [path for _, path in MODULES]
    libraries = {
        short(p): found
        for p in paths
        if (found := {name.partition(".")[0] for name in imported(p)} & UNSAFE_LIBRARIES)
    }
    assert libraries == {}
    calls = {short(p): found for p in paths if (found := unsafe_calls(tree_of(p)))}
    assert calls == {}


@pytest.mark.parametrize("line", ["eval(text)", "run(text, shell=True)", "load(f, allow_pickle=1)"])
def test_the_check_above_sees_unsafe_calls(line: str) -> None:
    assert unsafe_calls(ast.parse(line)) == [1]


def named(node: ast.AST) -> str:
    return (
        node.attr
        if isinstance(node, ast.Attribute)
        else node.id
        if isinstance(node, ast.Name)
        else ""
    )


def unbounded_queues(path: Path) -> list[int]:
    """Lines that make a queue without a ``maxsize``, or hand on what makes one."""
    nodes = list(ast.walk(tree_of(path)))
    bounded = {
        n.func
        for n in nodes
        if isinstance(n, ast.Call) and any(k.arg == "maxsize" for k in n.keywords)
    }
    types = {m for n in nodes if isinstance(n, ast.Subscript) for m in ast.walk(n)}
    return [n.lineno for n in nodes if named(n) in QUEUES and n not in bounded | types]  # type: ignore[attr-defined]


def test_queues_between_threads_are_bounded() -> None:
    """``inbox`` alone makes a bare queue, and bounds it itself."""
    assert [path.name for _, path in MODULES if unbounded_queues(path)] == ["bounded_queue.py"]


def unbounded(kind: object, path: str) -> list[str]:
    """Places of a type that could hold any number of things."""
    if get_origin(kind) is Annotated:
        inner, *metas = get_args(kind)
        bounded = any(
            isinstance(meta, msgspec.Meta) and meta.max_length is not None for meta in metas
        )
        whole = any(
            isinstance(meta, msgspec.Meta) and None not in (meta.ge, meta.le) for meta in metas
        )
        if inner in (str, bytes):
            return [] if bounded else [path]
        if inner is int:
            return [] if whole else [path]
        parts = [part for part in get_args(inner) if part is not Ellipsis]
        return ([] if bounded else [path]) + [p for part in parts for p in unbounded(part, path)]
    if kind in (str, bytes, int):
        return [path]
    if get_origin(kind) is dict or (get_origin(kind) is tuple and Ellipsis in get_args(kind)):
        return [path]
    if isinstance(kind, type) and issubclass(kind, msgspec.Struct):
        return unbounded_in(kind, path)
    if get_origin(kind) in (tuple,) or hasattr(kind, "__args__"):
        if all(isinstance(part, str) for part in get_args(kind)):  # Literal
            return []
        return [
            p for part in get_args(kind) if part is not type(None) for p in unbounded(part, path)
        ]
    return []


def unbounded_in(kind: type[msgspec.Struct], path: str) -> list[str]:
    hints = get_type_hints(kind, include_extras=True)
    return [p for name, hint in hints.items() for p in unbounded(hint, f"{path}.{name}")]


def test_every_field_of_every_message_is_bounded() -> None:
    """Texts, bytes, lists, maps and whole numbers by their type, floats by the codec."""
    assert [place for kind in m.VERSION for place in unbounded_in(kind, kind.__name__)] == []


def test_the_check_above_sees_what_is_unbounded() -> None:
    class Open(msgspec.Struct):
        text: str
        numbers: tuple[int, ...]
        names: Annotated[dict[str, int], msgspec.Meta(max_length=3)]
        maybe: tuple[float, float] | None

    assert set(unbounded_in(Open, "")) == {".text", ".numbers", ".names"}
