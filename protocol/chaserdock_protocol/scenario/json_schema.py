# SPDX-License-Identifier: Apache-2.0
"""Derive the scenario's JSON schema, for editors, the reference page and the texts of validation
errors.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Iterator, Sequence
from functools import cache
from typing import Any

from pydantic import BaseModel

from .fields import LARGEST
from .migrations import FORMAT

SchemaNode = dict[str, Any]


@cache
def schema_of(model: type[BaseModel]) -> SchemaNode:
    """Return the JSON schema of a model, as pydantic derives it."""
    return model.model_json_schema()


def resolved(node: SchemaNode, root: SchemaNode) -> SchemaNode:
    """Return the node that a reference, or an optional value, stands for."""
    while True:
        if "$ref" in node:
            node = root["$defs"][node["$ref"].rpartition("/")[2]]
            continue
        options = [option for option in node.get("anyOf", ()) if option.get("type") != "null"]
        if len(options) != 1:
            return node
        node = options[0]


def item_of(node: SchemaNode, index: int = 0) -> SchemaNode | None:
    """Return the schema of an array's element."""
    fixed = node.get("prefixItems")
    if fixed:
        return fixed[index] if index < len(fixed) else None
    return node.get("items")


def node_at(root: SchemaNode, path: Sequence[str | int]) -> SchemaNode | None:
    """Return the schema of the value at a path, or None for an unknown key."""
    node: SchemaNode | None = root
    for part in path:
        below = (_below(option, part) for option in options_of(node, root))
        node = next((found for found in below if found is not None), None)
        if node is None:
            return None
    return resolved(node, root)


def _below(node: SchemaNode, part: str | int) -> SchemaNode | None:
    """Return the schema of an array's element or of a table's key, or None."""
    if isinstance(part, int):
        return item_of(node, part)
    others = node.get("additionalProperties")
    return node.get("properties", {}).get(part, others if isinstance(others, dict) else None)


def options_of(node: SchemaNode, root: SchemaNode) -> list[SchemaNode]:
    """Return the alternatives of a value, without null; one for most."""
    node = resolved(node, root)
    options = [o for o in node.get("anyOf", ()) if o.get("type") != "null"]
    return [resolved(option, root) for option in options] or [node]


def without_alternatives(path: Sequence[str | int], root: SchemaNode) -> tuple[str | int, ...]:
    """Return a path of pydantic without the parts that name the alternative it tried for a
    value.
    """
    plain: list[str | int] = []
    for part in path:
        node = node_at(root, plain)
        several = node is not None and len(options_of(node, root)) > 1
        if not (several and node_at(root, [*plain, part]) is None):
            plain.append(part)
    return tuple(plain)


def description_of(node: SchemaNode, root: SchemaNode) -> str:
    """Return the description of a key, or of the table that is its value."""
    if "description" in node:
        return node["description"]
    inner = resolved(node, root)
    if "description" not in inner and (item := item_of(inner)) is not None:
        inner = resolved(item, root)
    return " ".join(inner.get("description", "").split())


def number_text(value: float) -> str:
    """Return a number without a needless exponent or fraction."""
    return str(int(value)) if float(value).is_integer() and abs(value) < 1e10 else f"{value:g}"


def range_text(node: SchemaNode, every: bool = False) -> str:
    """Return the range of a number in words; ``every``: including the bound that all
    numbers have.
    """
    bounds = {
        k: node[k]
        for k in ("minimum", "exclusiveMinimum", "maximum", "exclusiveMaximum")
        if k in node
    }
    if not every:
        bounds = {k: v for k, v in bounds.items() if abs(v) < LARGEST}
    text = {k: number_text(v) for k, v in bounds.items()}
    if bounds.keys() == {"minimum", "maximum"}:
        return f"from {text['minimum']} to {text['maximum']}"
    words = {
        "minimum": "at least",
        "exclusiveMinimum": "greater than",
        "maximum": "at most",
        "exclusiveMaximum": "less than",
    }
    return " and ".join(f"{words[k]} {v}" for k, v in text.items())


def _count_text(node: SchemaNode) -> str:
    low, high = node.get("minItems", 0), node.get("maxItems")
    if high is None:
        return f"at least {low} " if low else ""
    return f"{low} " if low == high else f"{low} to {high} " if low else f"at most {high} "


def expected_text(node: SchemaNode, root: SchemaNode, every: bool = False) -> str:
    """Return in words what a value must be, such as "a number greater than 0"; empty if the schema
    does not say.
    """
    if len(options := options_of(node, root)) > 1:
        return " or ".join(expected_text(option, root, every) for option in options)
    if "enum" in node:
        return f"one of {', '.join(map(str, node['enum']))}"
    if "const" in node:
        return str(node["const"])
    kind = node.get("type")
    if kind in ("number", "integer"):
        name = "a number" if kind == "number" else "a whole number"
        return f"{name} {range_text(node, every)}".strip()
    if kind == "array":
        item = item_of(node)
        inner = resolved(item, root).get("type") if item else None
        names = {
            "number": "numbers",
            "integer": "whole numbers",
            "object": "tables",
            "string": "texts",
        }
        return f"an array of {_count_text(node)}{names.get(str(inner), 'values')}"
    return {"boolean": "true or false", "string": "text", "object": "a table"}.get(str(kind), "")


def key_paths(root: SchemaNode) -> Iterator[str]:
    """Yield the dotted path of every key; ``N`` stands for the number of an array's element."""

    def walk(node: SchemaNode, path: str) -> Iterator[str]:
        node = resolved(node, root)
        if (item := item_of(node)) is not None:
            yield from walk(item, f"{path}.N")
        for key, inner in node.get("properties", {}).items():
            below = f"{path}.{key}".removeprefix(".")
            yield below
            yield from walk(inner, below)

    return walk(root, "")


def editor_schema(model: type[BaseModel]) -> SchemaNode:
    """Return the schema of scenario files for editors (draft 7, which taplo and VS Code's Even
    Better TOML support).

    It describes files as written: with ``extends`` no other key is required, and ``model`` may be a
    path.
    """
    schema = _simplified(copy.deepcopy(schema_of(model)))
    definitions = schema.pop("$defs")
    required = schema.pop("required")
    definitions["Target"]["properties"]["model"].pop("pattern")
    chaser = definitions["Chaser"]
    chaser["required"].remove("q_wxyz")
    chaser["oneOf"] = [{"required": [key]} for key in ("q_wxyz", "attitude_deg", "look_at")]
    schema["properties"]["format"] = {**schema["properties"]["format"], "enum": [FORMAT]}
    return {
        "$schema": "http://json-schema.org/draft-07/schema#",
        "$id": f"urn:chaserdock:scenario:{FORMAT}",
        "title": "chaserdock scenario",
        **schema,
        "anyOf": [{"required": ["extends"]}, {"required": required}],
        "definitions": definitions,
    }


def editor_schema_text(model: type[BaseModel]) -> str:
    """Return the schema for editors as JSON text."""
    return json.dumps(editor_schema(model), indent=2, ensure_ascii=False) + "\n"


def _simplified(node: Any) -> Any:
    """Remove titles and nulls, and replace keywords that draft 7 lacks by equivalent ones."""
    if isinstance(node, list):
        return [_simplified(item) for item in node]
    if not isinstance(node, dict):
        return node
    options = node.pop("anyOf", None)
    if options is not None:
        node |= next(option for option in options if option.get("type") != "null")
    if "prefixItems" in node:
        node["items"] = node.pop("prefixItems")[0]
    if isinstance(node.get("title"), str):
        del node["title"]
    if "default" in node and node["default"] is None:
        del node["default"]
    out = {k: _simplified(v) for k, v in node.items()}
    if isinstance(out.get("description"), str):
        out["description"] = " ".join(out["description"].replace("``", "`").split())
    if isinstance(reference := out.get("$ref"), str):
        out["$ref"] = reference.replace("#/$defs/", "#/definitions/")
        if len(out) > 1:  # draft 7 ignores everything beside a reference
            out = {
                **{k: v for k, v in out.items() if k != "$ref"},
                "allOf": [{"$ref": out["$ref"]}],
            }
    return out
