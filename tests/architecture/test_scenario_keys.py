# SPDX-License-Identifier: Apache-2.0
"""Every key of a scenario is read by some code: none is accepted and ignored."""

from __future__ import annotations

import re
from typing import Any, get_args

from chaserdock_protocol.scenario import Scenario
from pydantic import BaseModel
from source_tree import MODULES


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
    """Return what may be an attribute in our modules, or its name in quotes, for `getattr`."""
    texts = (path.read_text(encoding="utf-8") for _, path in MODULES)
    return {name for text in texts for name in re.findall(r"[.\"'](\w+)\b", text)}


def test_every_key_is_read() -> None:
    read = names_read()
    sections: set[type[BaseModel]] = set()
    add_sections(Scenario, sections)
    keys = {key for section in sections for key in section.model_fields}
    assert len(keys) > 200
    # Figures in degrees may be read after conversion, by their name in radians.
    assert {key for key in keys if not {key, key.replace("_deg", "_rad")} & read} == set()
