# SPDX-License-Identifier: Apache-2.0
"""Older scenario formats: scenarios stored in logs are migrated, files get an error that names the new key."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

FORMAT = 2
"""Present format of scenario files. Format 1 called thrusters jets, and images pictures."""

_RENAMED_KEYS: dict[tuple[str, ...], str] = {
    ("time", "picture_hz"): "image_hz",
    ("chaser", "jet_test_s"): "thruster_test_s",
    ("chaser", "jet_faults_by_command"): "thruster_faults_by_command",
    ("timeline", "*", "jet"): "thruster",
    ("jet_failure", "*", "jet"): "thruster",
    ("jet_failure", "*", "told"): "reported",
    ("jet_failure",): "thruster_failure",
}
"""Path of a key in format 1 (``*``: every element of an array) -> its present name. Parents follow their children."""


def _holders(
    values: Any, path: tuple[str, ...], at: tuple[str, ...] = ()
) -> Iterator[tuple[dict[str, Any], str]]:
    """Yield every table that holds the last key of ``path``, with that key's path as text."""
    if isinstance(values, dict) and len(path) == 1:
        if path[0] in values:
            yield values, ".".join((*at, path[0]))
    elif isinstance(values, dict):
        yield from _holders(values.get(path[0]), path[1:], (*at, path[0]))
    elif isinstance(values, list | tuple) and path[0] == "*":
        for i, item in enumerate(values):
            yield from _holders(item, path[1:], (*at, str(i)))


def old_keys(values: dict[str, Any]) -> list[str]:
    """Return one line per key, or value, of an older format, naming its present name."""
    lines = []
    for old, new in _RENAMED_KEYS.items():
        for _, path in _holders(values, old):
            lines.append(f"{path}: is now called {path.rpartition('.')[0]}.{new}".replace(" .", " "))
    for table, path in _holders(values, ("fault", "*", "topic")):
        if table["topic"] == "jets":
            lines.append(f"{path}: 'jets' is now called 'thrusters'")
    return lines


def old_format(values: dict[str, Any]) -> list[str]:
    """Return an error line for values that state another format than the present one."""
    stated = values.get("format", FORMAT)
    if stated == FORMAT:
        return []
    if stated == 1:
        changes = "; ".join(old_keys(values)) or "no key of this file has another name"
        return [f"format: 1 is not supported any more; set format = {FORMAT} and change: {changes}"]
    return [f"format: must be {FORMAT}, the format that this version of chaserdock reads (got {stated!r})"]


def migrated(text: str) -> str:
    """Return a resolved scenario (JSON) in the present format. Text that is not JSON is returned unchanged."""
    try:
        values = json.loads(text)
    except (json.JSONDecodeError, RecursionError):
        return text
    if not isinstance(values, dict) or values.get("format", 1) != 1:
        return text
    for old, new in _RENAMED_KEYS.items():
        for table, _ in _holders(values, old):
            table[new] = table.pop(old[-1])
    for fault, _ in _holders(values, ("fault", "*", "topic")):
        if fault["topic"] == "jets":
            fault["topic"] = "thrusters"
    return json.dumps({"format": FORMAT, **values})
