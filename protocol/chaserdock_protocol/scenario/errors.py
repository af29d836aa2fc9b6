# SPDX-License-Identifier: Apache-2.0
"""Explain errors of scenario files: one line per error, with its path and what would be right."""

from __future__ import annotations

import difflib
import json
import re
from collections.abc import Sequence
from typing import Any

from pydantic import BaseModel, ValidationError

from chaserdock_protocol.errors import ScenarioError

from .fields import LARGEST
from .json_schema import (
    SchemaNode,
    expected_text,
    key_paths,
    node_at,
    options_of,
    schema_of,
    without_alternatives,
)

_LONGEST_VALUE = 60  # characters of a value in an error, so that it stays one line
_WITH_BOUNDS = ("greater_than_equal", "less_than_equal")
_FROM_SCHEMA = (
    "float_type",
    "int_type",
    "bool_type",
    "string_type",
    "tuple_type",
    "dict_type",
    "model_type",
    "literal_error",
    "greater_than",
    "less_than",
    *_WITH_BOUNDS,
    "too_short",
    "too_long",
)
"""Kinds of errors (pydantic's names) whose text is what the schema expects."""


def path_text(parts: Sequence[str | int]) -> str:
    """Return a dotted path; parts that are no bare TOML keys are quoted."""
    return ".".join(str(p) if re.fullmatch(r"[\w+-]+", str(p)) else json.dumps(p) for p in parts)


def value_text(value: object) -> str:
    """Return a value in TOML's notation, shortened."""
    value = list(value) if isinstance(value, tuple) else value
    text = str(value).lower() if isinstance(value, bool) else repr(value)
    return text if len(text) <= _LONGEST_VALUE else f"{text[: _LONGEST_VALUE - 1]}…"


def explain(error: ValidationError, model: type[BaseModel]) -> list[str]:
    """Return one line per error of validating ``model``."""
    root = schema_of(model)
    errors = [{**e, "loc": without_alternatives(e["loc"], root)} for e in error.errors()]
    paths = [e["loc"] for e in errors]
    lines: list[str] = []
    for e in errors:
        # An invalid element also makes its array too short, or no other kind of value that is
        # possible there; report the element only.
        path = e["loc"]
        if (e["type"] == "too_short" or _has_alternatives(path, root)) and any(
            len(p) > len(path) and p[: len(path)] == path for p in paths
        ):
            continue
        line = _line(e, root)
        if line not in lines:
            lines.append(line)
    return lines


def _has_alternatives(path: Sequence[str | int], root: SchemaNode) -> bool:
    """Return whether a value may be of several kinds, such as a number or an array."""
    node = node_at(root, path)
    return node is not None and len(options_of(node, root)) > 1


def invalid(error: ValidationError, model: type[BaseModel], source: object) -> ScenarioError:
    """Return the error of validating ``model`` with values of ``source``, which begins each
    line.
    """
    return ScenarioError("\n".join(f"{source}: {line}" for line in explain(error, model)))


def _line(error: Any, root: SchemaNode) -> str:
    path, kind, value = error["loc"], error["type"], error.get("input")
    if kind == "extra_forbidden":
        return unknown_key(path, root)
    if kind == "missing":
        if not (path and isinstance(path[-1], int)):
            alternatives = "; give it, attitude_deg or look_at" if path[-1:] == ("q_wxyz",) else ""
            return f"{path_text(path)}: is missing{alternatives}"
        path, kind = path[:-1], "too_short"
    node = node_at(root, path)
    # The bound of all numbers is stated only where it is exceeded.
    largest = kind in _WITH_BOUNDS and LARGEST in map(abs, error["ctx"].values())
    expected = expected_text(node, root, largest) if node is not None else ""
    if kind == "finite_number":
        message = "must be a finite number"
    elif kind == "string_pattern_mismatch":
        message = (
            "must begin with a letter or digit, and have only letters, digits, '.', '_' and '-', "
            "at most 64 in all"
        )
    elif kind in _FROM_SCHEMA and expected:
        message = f"must be {expected}"
    else:
        message = error["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
    shown = (
        f" (got {value_text(value)})" if isinstance(value, int | float | str | list | tuple) else ""
    )
    if kind == "literal_error" and isinstance(value, str) and node is not None:
        close = difflib.get_close_matches(value, [str(c) for c in node.get("enum", ())], 1)
        shown += f"; did you mean {close[0]}?" if close else ""
    return f"{path_text(path) or '(scenario)'}: {message}{shown}"


def unknown_key(path: Sequence[str | int], root: SchemaNode) -> str:
    """Return the line for an unknown key, with the nearest known one or all keys of its table."""
    *above, key = path
    table = node_at(root, above) or {}
    siblings = list(table.get("properties", ()))
    line = f"unknown key {path_text(path)}"
    if close := difflib.get_close_matches(str(key), siblings, 1):
        return f"{line}; did you mean {path_text([*above, close[0]])}?"
    elsewhere = {p.rpartition(".")[2]: p for p in sorted(key_paths(root), key=len, reverse=True)}
    if close := difflib.get_close_matches(str(key), elsewhere, 1, 0.85):
        return f"{line}; did you mean {elsewhere[close[0]]}?"
    return f"{line}; known keys: {', '.join(siblings)}"
