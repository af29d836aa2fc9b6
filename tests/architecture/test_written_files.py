# SPDX-License-Identifier: Apache-2.0
"""One helper writes the files that a user gets."""

from __future__ import annotations

import ast

import pytest
from source_tree import MODULES, short, tree_of

WRITES = {"write_text", "write_bytes", "imwrite"}
"""Calls that write a file, unless on ``new``, the name of what ``replaced`` yields."""
MODES = {kind + more for kind in "wxa" for more in ("", "b")}
ALLOWED = {
    "protocol/chaserdock_protocol/output_files.py": "the helper",
    "protocol/chaserdock_protocol/recording/log.py": "grows; readable after a failed write",
    "protocol/chaserdock_models/native/build.py": "run by developers",
    "world/chaserdock_world/physics/bullet_engine.py": "a temporary file",
    "chaserdock/launch/launcher.py": "output of the processes, which grows",
    "chaserdock/launch/keys.py": "exclusive, with the rights of a key",
    "chaserdock/analysis/video.py": "the path is what `replaced` yields",
    "chaserdock/tracking/overlay_video.py": "the path is what `replaced` yields",
    "chaserdock/logs/export.py": "the path is what `replaced` yields",
    "chaserdock/logs/recover.py": "a log, removed if it is not complete",
}
"""Modules that write files in another way, and why."""


def plain_writes(tree: ast.Module) -> list[int]:
    """Lines of calls that write a file in another way."""
    lines = []
    for node in ast.walk(tree):
        match node:
            case ast.Call(func=ast.Attribute(value=ast.Name(id="new"))):
                continue
            case ast.Call(func=ast.Attribute(attr=name)) if name in WRITES:
                lines.append(node.lineno)
            case ast.Call(func=ast.Attribute(attr="open") | ast.Name(id="open"), args=args):
                modes = {a.value for a in args if isinstance(a, ast.Constant)}
                if modes & MODES:
                    lines.append(node.lineno)
    return lines


def test_files_are_written_by_the_helper() -> None:
    found = {short(p): lines for _, p in MODULES if (lines := plain_writes(tree_of(p)))}
    assert {path: lines for path, lines in found.items() if path not in ALLOWED} == {}


@pytest.mark.parametrize(
    "line", ["p.write_text('a')", "p.open('w')", "open(p, 'xb')", "cv2.imwrite(str(p), image)"]
)
def test_the_check_above_sees_other_ways(line: str) -> None:
    assert plain_writes(ast.parse(line)) == [1]
