"""Migrate scenarios of older formats: those stored in logs are converted, files get an error that names the new key."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

FORMAT = 2
"""Present format of scenario files. 1 called thrusters jets and images pictures."""

_RENAMED_KEYS: dict[tuple[str, ...], str] = {
    ("time", "picture_hz"): "image_hz",
    ("chaser", "jet_test_s"): "thruster_test_s",
    ("chaser", "jet_faults_by_command"): "thruster_faults_by_command",
    ("timeline", "*", "jet"): "thruster",
    ("jet_failure", "*", "jet"): "thruster",
    ("jet_failure", "*", "told"): "reported",
    ("jet_failure",): "thruster_failure",
}
"""Path of a key in format 1 (``*``: every element of an array) -> its present name. Parents stand last."""


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
    """Return one line per key of an older format, naming its present name."""
    return [
        f"{path}: is now called {new}"
        for old, new in _RENAMED_KEYS.items()
        for _, path in _holders(values, old)
    ]


def migrated(text: str) -> str:
    """Return a resolved scenario (JSON) in the present format; text of the present format, or no JSON, stays as it is."""
    try:
        values = json.loads(text)
    except (json.JSONDecodeError, RecursionError):
        return text
    if not isinstance(values, dict) or values.get("format", 1) != 1:
        return text
    for old, new in _RENAMED_KEYS.items():
        for table, _ in _holders(values, old):
            table[new] = table.pop(old[-1])
    faults = values.get("fault", ())
    for fault in faults if isinstance(faults, list) else ():
        if isinstance(fault, dict) and fault.get("topic") == "jets":
            fault["topic"] = "thrusters"
    return json.dumps({"format": FORMAT, **values})
