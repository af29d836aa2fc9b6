# SPDX-License-Identifier: Apache-2.0
"""Every scenario key is documented, and the generated page is up to date."""

from __future__ import annotations

import json
import subprocess
import sys

from chaserdock_protocol.scenario import Scenario
from chaserdock_protocol.scenario.json_schema import (
    description_of,
    editor_schema_text,
    key_paths,
    node_at,
    resolved,
    schema_of,
)
from harness import ROOT

SCHEMA = schema_of(Scenario)


def printed(option: str) -> str:
    command = [sys.executable, str(ROOT / "docs" / "make_scenario.py"), option]
    return subprocess.run(
        command, capture_output=True, text=True, check=True, encoding="utf-8"
    ).stdout


def description(path: str) -> str:
    """Description of a key by its dotted path."""
    *above, key = [0 if part == "N" else part for part in path.split(".")]
    table = node_at(SCHEMA, above)
    assert table is not None, path
    return description_of(resolved(table, SCHEMA)["properties"][key], SCHEMA)


def test_every_key_has_a_description() -> None:
    texts = {path: description(path) for path in key_paths(SCHEMA)}
    assert len(texts) > 200
    assert [path for path, text in texts.items() if len(text) < 9 or text[-1] != "."] == []


def test_the_committed_page_is_up_to_date() -> None:
    committed = (ROOT / "docs" / "scenario.md").read_text(encoding="utf-8")
    assert committed == printed("--print"), "run: python docs/make_scenario.py"
    for path in key_paths(SCHEMA):
        assert f"| `{path.rpartition('.')[2]}` |" in committed


def test_the_json_schema_has_no_dangling_reference_and_describes_every_key() -> None:
    schema = json.loads(editor_schema_text(Scenario))
    assert schema["$id"].startswith("urn:chaserdock:scenario")
    names = set()

    def walk(node: object) -> None:
        if isinstance(node, list):
            for item in node:
                walk(item)
        elif isinstance(node, dict):
            if isinstance(node.get("$ref"), str):
                names.add(node["$ref"])
            for value in node.values():
                walk(value)

    walk(schema)
    assert names
    assert names <= {f"#/definitions/{name}" for name in schema["definitions"]}
