# SPDX-License-Identifier: Apache-2.0
"""Draw scenarios by the schema: shipped ones of which some keys have other values."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import cache
from typing import Any

from chaserdock_models.targets import target_names
from chaserdock_protocol.scenario import Scenario, load_scenario
from chaserdock_protocol.scenario.camera import REPLACED_BY_INTRINSICS
from chaserdock_protocol.scenario.fields import LARGEST
from chaserdock_protocol.scenario.json_schema import SchemaNode, item_of, node_at, schema_of
from chaserdock_protocol.scenario.schema import ESTIMATORS, MARKER_PERCEPTIONS, PERCEPTIONS
from chaserdock_protocol.shipped_scenarios import shipped_names, shipped_scenario
from hypothesis import strategies as st

KeyPath = tuple[str | int, ...]
Draw = Callable[[st.SearchStrategy[Any]], Any]

NAMES: dict[KeyPath, tuple[str, ...]] = {
    ("perception", "name"): PERCEPTIONS,
    ("estimator", "name"): ESTIMATORS,
    ("controller", "solver"): ("rti", "ipopt"),  # `open` compiles its solver for a minute
    ("target", "model"): tuple(target_names()),
}
"""Keys whose values are names, and the names that there are."""
SKIPPED = {
    *("format", "name", "description", "duration_s", "extends", "surface", "mesh", "seed"),
    "simulation",
}
"""Keys that select no behaviour, or whose values are files or set below; and the network, which may
be so bad that a mission does not begin in time."""
UNIT = {"q_wxyz", "axis", "direction"}
"""Keys whose values have unit length."""
MOST_ITEMS = 3
TICKS = 4


@cache
def base(name: str) -> dict[str, Any]:
    """Return all keys of a shipped scenario with their values."""
    return load_scenario(shipped_scenario(name)).model_dump(mode="json")


@st.composite
def changed_scenarios(draw: Draw, most_changes: int = 6) -> tuple[str, dict[KeyPath, Any]]:
    """Return the name of a shipped scenario, and new values of some of its keys. They are in the
    range of the schema, but need not be consistent. Those without markers start for a minute.
    """
    name = draw(st.sampled_from([n for n in shipped_names() if not n.startswith("markerless")]))
    values, root = base(name), schema_of(Scenario)
    paths = sorted(key_paths_of(values), key=str)
    chosen = draw(st.lists(st.sampled_from(paths), min_size=1, max_size=most_changes, unique=True))
    return name, {
        path: drawn_value(draw, node, root, path, value_at(values, path))
        for path in chosen
        if (node := node_at(root, path)) is not None
    }


def with_changes(name: str, changes: dict[KeyPath, Any]) -> dict[str, Any]:
    """Return the tables of a shipped scenario of ``TICKS`` ticks with other values."""
    values = _copied(base(name))
    for path, value in changes.items():
        place: Any = values
        for key in path[:-1]:
            if isinstance(place, dict) and not place.get(key):
                place[key] = {}
            place = place[key]
        place[path[-1]] = value
    values["duration_s"] = TICKS / values["time"]["rate_hz"]
    values["settling_s"], values["steady_until_s"] = 0.0, None
    if ("perception", "name") not in changes and values["perception"]["name"] in MARKER_PERCEPTIONS:
        values["perception"]["name"] = "statistical"  # others are drawn, too, but take longer
    if values["camera"].get("intrinsics"):
        for key in REPLACED_BY_INTRINSICS:
            del values["camera"][key]
    return _without_none(values)


def key_paths_of(values: Any, path: KeyPath = ()) -> Iterator[KeyPath]:
    """Yield the path of every key of nested tables, and of every table in arrays."""
    if isinstance(values, dict):
        for key, value in values.items():
            if key not in SKIPPED:
                yield (*path, key)
                yield from key_paths_of(value, (*path, key))
    elif isinstance(values, list) and values and isinstance(values[0], dict):
        for k, value in enumerate(values):
            yield from key_paths_of(value, (*path, k))


def value_at(values: Any, path: KeyPath) -> Any:
    for key in path:
        values = values[key]
    return values


def drawn_value(draw: Draw, node: SchemaNode, root: SchemaNode, path: KeyPath, now: Any) -> Any:
    """Return a value of a key by its schema, near ``now`` or at a bound."""
    plain = tuple(key for key in path if isinstance(key, str))
    if plain in NAMES:
        return draw(st.sampled_from(NAMES[plain]))
    if "enum" in node:
        return draw(st.sampled_from(node["enum"]))
    kind = node.get("type")
    if kind == "boolean":
        return draw(st.booleans())
    if kind in ("number", "integer"):
        return drawn_number(draw, node, now if isinstance(now, int | float) else 0.0)
    if kind == "array":
        return _drawn_array(draw, node, root, path, now)
    if kind == "object":
        return _drawn_table(draw, node, root, path, now)
    return now


def drawn_number(draw: Draw, node: SchemaNode, now: float) -> float:
    """Return a number within its bounds: usually of the magnitude of ``now``."""
    low = node.get("minimum", node.get("exclusiveMinimum", -LARGEST))
    high = node.get("maximum", node.get("exclusiveMaximum", LARGEST))
    how = draw(st.sampled_from(["near", "near", "far", "bound"]))
    if how == "bound":
        value = draw(st.sampled_from([low, high]))
    else:
        decades = 0.3 if how == "near" else 3.0
        sign = draw(st.sampled_from([-1.0, 1.0])) if low < 0.0 else 1.0
        value = sign * (abs(now) or 0.1) * 10.0 ** draw(st.floats(-decades, decades))
    value = min(max(value, low), high)
    if node["type"] == "integer":
        return round(value)
    if value == node.get("exclusiveMinimum"):
        value = low + 1e-6 * max(1.0, abs(low))
    if value == node.get("exclusiveMaximum"):
        value = high - 1e-6 * max(1.0, abs(high))
    return float(value)


def _drawn_array(
    draw: Draw, node: SchemaNode, root: SchemaNode, path: KeyPath, now: Any
) -> list[Any]:
    now = now or []
    if "prefixItems" in node:
        count = len(node["prefixItems"])
    else:
        low, high = node.get("minItems", 0), node.get("maxItems", LARGEST)
        wanted = draw(st.sampled_from([len(now), *range(MOST_ITEMS + 1)]))
        count = int(min(max(wanted, low), high))
    items = []
    for k in range(count):
        inner = node_at(root, (*path, k)) or {}
        if item_of(node, k) is None:
            break
        items.append(drawn_value(draw, inner, root, (*path, k), now[k] if k < len(now) else None))
    if path[-1] in UNIT and len(items) in (3, 4):
        length = math.hypot(*items)
        return [v / length for v in items] if length else [1.0, *[0.0] * (len(items) - 1)]
    return items


def _drawn_table(
    draw: Draw, node: SchemaNode, root: SchemaNode, path: KeyPath, now: Any
) -> dict[str, Any]:
    now = now or {}
    keys = [key for key in node.get("properties", {}) if key not in SKIPPED]
    required = node.get("required", [])
    optional = [key for key in keys if key not in required]
    some = draw(st.lists(st.sampled_from(optional), max_size=2, unique=True)) if optional else []
    drawn = {
        key: drawn_value(draw, inner, root, (*path, key), now.get(key))
        for key in [*required, *some]
        if (inner := node_at(root, (*path, key))) is not None
    }
    return {**now, **drawn}


def _copied(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _copied(v) for k, v in value.items()}
    return [_copied(v) for v in value] if isinstance(value, list) else value


def _without_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {k: _without_none(v) for k, v in value.items() if v is not None}
    return [_without_none(v) for v in value] if isinstance(value, list) else value
