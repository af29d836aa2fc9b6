# SPDX-License-Identifier: Apache-2.0
"""Change the values of a scenario: variants (``extends``) and overrides (``--set`` of commands)."""

from __future__ import annotations

import copy
import tomllib
from collections.abc import Callable
from typing import Any

from chaserdock_models.targets import target_names

from .errors import ScenarioError, value_text
from .fields import ATTITUDE_KEYS

Values = dict[str, Any]


def merge(base: Values, variant: Values) -> Values:
    """Return ``base`` with the values of ``variant``: tables are merged, everything else, arrays
    too, is replaced.
    """
    out = dict(base)
    for key, value in variant.items():
        _drop_alternatives(out, key, value)
        old = out.get(key)
        out[key] = merge(old, value) if isinstance(old, dict) and isinstance(value, dict) else value
    return out


def _drop_alternatives(table: Values, key: str, value: Any) -> None:
    """Remove from a table what a new value of ``key`` replaces.

    These are other forms of an attitude, and a target's own geometry.
    """
    if key in ATTITUDE_KEYS:
        for other in ATTITUDE_KEYS:
            if other != key:
                table.pop(other, None)
    elif key == "model" and value in target_names():
        table.pop("geometry", None)


def with_override(values: Values, text: str, resolve: Callable[[Values], Values]) -> Values:
    """Return a copy of nested tables and arrays with ``key.path=value`` set, the value in TOML's
    notation.

    ``resolve`` returns the same tables with all defaults; an element of an array that is not in
    ``values`` is set in a copy of the default. Raises ScenarioError, whose lines begin with
    ``text``.
    """
    values = copy.deepcopy(values)
    path, equals, value = text.partition("=")
    if not equals or not path.strip():
        raise ScenarioError(f"{text}: must be KEY=VALUE, such as camera.width_px=640")
    keys = path.strip().split(".")
    table: Any = values
    for depth, key in enumerate(keys[:-1]):
        if isinstance(table, dict) and key not in table and _is_index(keys[depth + 1]):
            table[key] = _value_at(resolve(values), keys[: depth + 1])
        table = _child(table, key, text)
    _assign(table, keys[-1], _parsed(value, path), text)
    return values


def _parsed(value: str, path: str) -> Any:
    try:
        return tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        return value.strip()
    except RecursionError:
        raise ScenarioError(f"{path.strip()}: nested too deeply") from None


def _child(table: Any, key: str, text: str) -> Any:
    if isinstance(table, list):
        child = _element(table, key, text)
    else:
        _drop_alternatives(table, key, None)
        child = table.setdefault(key, {})
    if not isinstance(child, dict | list):
        raise ScenarioError(f"{text}: {key} is a value ({value_text(child)}), not a table")
    return child


def _assign(table: Any, key: str, value: Any, text: str) -> None:
    if isinstance(table, list):
        _element(table, key, text)
        table[int(key)] = value
    else:
        _drop_alternatives(table, key, value)
        table[key] = value


def _element(array: list[Any], key: str, text: str) -> Any:
    if not _is_index(key) or int(key) >= len(array):
        valid = (
            f"must be a number from 0 to {len(array) - 1}"
            if array
            else "is no element: the array is empty"
        )
        raise ScenarioError(f"{text}: {key} {valid}")
    return array[int(key)]


def _is_index(key: str) -> bool:
    return key.isascii() and key.isdigit() and len(key) < 10


def _value_at(values: Any, keys: list[str]) -> Any:
    for key in keys:
        if isinstance(values, list):
            values = values[int(key)] if _is_index(key) and int(key) < len(values) else {}
        else:
            values = values.get(key, {}) if isinstance(values, dict) else {}
    return copy.deepcopy(values)
