# SPDX-License-Identifier: Apache-2.0
"""Values and tables in TOML's notation."""

from __future__ import annotations

import json
from collections.abc import Mapping
from numbers import Integral, Real
from pathlib import Path
from typing import Any


def toml_value(value: Any) -> str:
    """Return a number, string, boolean, path, array or inline table. Raise TypeError for another
    type.
    """
    match value:
        case bool():
            return str(value).lower()
        case str() | Path():
            return json.dumps(str(value), ensure_ascii=False).replace("\x7f", "\\u007f")
        case Integral():
            return str(int(value))
        case Real():
            return repr(float(value))
        case Mapping():
            items = (
                f"{json.dumps(k, ensure_ascii=False)} = {toml_value(v)}" for k, v in value.items()
            )
            return "{" + ", ".join(items) + "}"
        case list() | tuple():
            return "[" + ", ".join(map(toml_value, value)) + "]"
    raise TypeError(f"a value of type {type(value).__name__} cannot be set in a scenario")


def toml_document(values: Mapping[str, Any]) -> str:
    """Return the text of a file with these keys. A table may be empty. Raise TypeError as
    ``toml_value``.
    """
    return "\n".join(_table(values, ())).lstrip("\n") + "\n"


def _table(values: Mapping[str, Any], path: tuple[str, ...]) -> list[str]:
    """Return the lines of a table: plain values first, then tables and arrays of tables."""
    lines: list[str] = []
    below: list[str] = []
    for key, value in values.items():
        name = ".".join((*path, key))
        if isinstance(value, Mapping):
            below += ["", f"[{name}]", *_table(value, (*path, key))]
        elif isinstance(value, list) and value and isinstance(value[0], Mapping):
            for item in value:
                below += ["", f"[[{name}]]", *_table(item, (*path, key))]
        else:
            lines.append(f"{key} = {toml_value(value)}")
    return [*lines, *below]
