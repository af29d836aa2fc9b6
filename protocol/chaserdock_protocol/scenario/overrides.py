"""Scenarios as people write them: overriding a value by its path, and telling what is wrong and where."""

from __future__ import annotations

import tomllib
from collections.abc import Callable
from typing import Any

from pydantic import ValidationError

from chaserdock_protocol.errors import ChaserdockError


class ScenarioError(ChaserdockError):
    """A scenario that cannot be flown; the text has one line a fault."""


_KINDS = {
    "float_type": "must be a number",
    "int_type": "must be a whole number",
    "bool_type": "must be true or false",
    "string_type": "must be text",
    "tuple_type": "must be an array",
    "model_type": "must be a table",
}
"""What a value of another kind should have been, by pydantic's name of the fault."""


def _toml(value: object) -> str:
    return str(value).lower() if isinstance(value, bool) else repr(value)


def explain(error: ValidationError) -> list[str]:
    """One line a fault: path, what would be right, what was given."""
    lines = []
    places = [fault["loc"] for fault in error.errors()]
    for fault in error.errors():
        # A faulty item also makes its array too short; the item says it all.
        loc = fault["loc"]
        if fault["type"] == "too_short" and any(len(p) > len(loc) and p[: len(loc)] == loc for p in places):
            continue
        path = ".".join(str(p) for p in fault["loc"]) or "(scenario)"
        message = _KINDS.get(fault["type"]) or fault["msg"].removeprefix("Value error, ")
        value = fault.get("input")
        value = list(value) if isinstance(value, tuple) else value
        shown = f" (got {_toml(value)})" if isinstance(value, int | float | str | list) else ""
        if fault["type"] == "missing":
            message, shown = "is missing", ""
        elif fault["type"] == "extra_forbidden":
            message, shown = "is not a key that is known here", ""
        lines.append(f"{path}: {message}{shown}")
    return lines


def override(values: dict[str, Any], text: str, resolved: Callable[[], dict[str, Any]]) -> None:
    """Sets ``key.path=value`` in nested tables and arrays, the value in TOML's notation; raises ScenarioError.

    ``resolved`` gives the same tables with all defaults: one element of an array that is not in ``values`` can only be
    set together with its neighbours.
    """
    path, equals, value = text.partition("=")
    if not equals or not path.strip():
        raise ScenarioError(f"--set {text}: must be key.path=value")
    try:
        parsed = tomllib.loads(f"value = {value}")["value"]
    except tomllib.TOMLDecodeError:
        parsed = value.strip()
    except RecursionError:
        raise ScenarioError(f"--set {path.strip()}: nested too deeply") from None
    place: Any = values
    keys = path.strip().split(".")
    for depth, key in enumerate(keys[:-1]):
        if isinstance(place, dict) and key not in place and _is_index(keys[depth + 1]):
            place[key] = _default(resolved(), keys[: depth + 1])
        place = _item(place, key, text) if isinstance(place, list) else place.setdefault(key, {})
        if not isinstance(place, dict | list):
            raise ScenarioError(f"--set {text}: {key} is a value, not a table")
    if isinstance(place, list):
        _item(place, keys[-1], text)
        place[int(keys[-1])] = parsed
    else:
        place[keys[-1]] = parsed


def _is_index(key: str) -> bool:
    return key.isascii() and key.isdigit()


def _default(values: Any, keys: list[str]) -> Any:
    for key in keys:
        values = values.get(key, {}) if isinstance(values, dict) else {}
    return values


def _item(place: list[Any], key: str, text: str) -> Any:
    if not _is_index(key) or int(key) >= len(place):
        raise ScenarioError(f"--set {text}: {key} must be a number from 0 to {len(place) - 1}")
    return place[int(key)]
