# SPDX-License-Identifier: Apache-2.0
"""Find scenario files: by path, or by the name of a scenario that is shipped with chaserdock."""

from __future__ import annotations

import difflib
from pathlib import Path

from .errors import ScenarioError

_HERE = Path(__file__).resolve()
# In a source tree the folder lies beside the packages, in an installed package inside `chaserdock`.
SHIPPED = (_HERE.parents[2] / "scenarios", _HERE.parents[1] / "chaserdock" / "shipped")

_RENAMED = {"jet-failure": "thruster-failure"}
"""Former names of shipped scenarios."""


class ScenarioNotFound(ScenarioError):
    """No scenario file of that path, and no shipped scenario of that name."""


def shipped_names() -> list[str]:
    """Return the names of the shipped scenarios, sorted."""
    return sorted({path.stem for folder in SHIPPED for path in folder.glob("*.toml")})


def shipped_scenario(name: str) -> Path:
    """Return the file of a shipped scenario. Raises ScenarioNotFound."""
    for folder in SHIPPED:
        path = folder / f"{name}.toml"
        if path.name == f"{name}.toml" and path.is_file():
            return path
    if name in _RENAMED:
        raise ScenarioNotFound(f"{name}: this shipped scenario is now called {_RENAMED[name]}")
    names = shipped_names()
    close = difflib.get_close_matches(name, names, 1)
    hint = f"did you mean {close[0]}? " if close else ""
    raise ScenarioNotFound(
        f"{name}: no such scenario file or shipped scenario; {hint}shipped: {', '.join(names)}"
    )


def find_scenario(name: str) -> Path:
    """Return a scenario file by its path, or by the name of a shipped one. Raises
    ScenarioNotFound.
    """
    path = Path(name)
    if path.is_file():
        return path
    if path.parent != Path():
        raise ScenarioNotFound(f"{name}: no such scenario file")
    return shipped_scenario(name.removesuffix(".toml"))
