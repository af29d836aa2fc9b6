# SPDX-License-Identifier: Apache-2.0
"""Every key of a scenario is read by some code: none is accepted and ignored."""

from __future__ import annotations

import ast
from typing import Any, get_args

from chaserdock_protocol.scenario import Scenario
from pydantic import BaseModel
from source_tree import MODULES, tree_of


def add_sections(annotation: Any, found: set[type[BaseModel]]) -> None:
    """Add the sections below a type to ``found``."""
    section = isinstance(annotation, type) and issubclass(annotation, BaseModel)
    if section and annotation not in found:
        found.add(annotation)
        for field in annotation.model_fields.values():
            add_sections(field.annotation, found)
    for inner in get_args(annotation):
        add_sections(inner, found)


def names_read() -> set[str]:
    """Return all attributes that our modules read, and all texts, by which `getattr` may."""
    found: set[str] = set()
    for _, path in MODULES:
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Load):
                found.add(node.attr)
            elif isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.add(node.value)
    return found


def test_every_key_is_read() -> None:
    read = names_read()
    sections: set[type[BaseModel]] = set()
    add_sections(Scenario, sections)
    keys = {key for section in sections for key in section.model_fields}
    assert len(keys) > 200
    # Figures in degrees may be read after conversion, by their name in radians.
    assert {key for key in keys if not {key, key.replace("_deg", "_rad")} & read} == set()
