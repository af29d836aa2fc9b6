"""Where scenario files are found."""

from __future__ import annotations

from pathlib import Path

_HERE = Path(__file__).resolve()
# In a source tree the folder lies beside the package, in an installed package inside it.
SHIPPED = (_HERE.parents[2] / "scenarios", _HERE.parents[1] / "shipped")


def shipped_names() -> list[str]:
    """Names of the scenarios that are shipped, sorted."""
    return sorted({path.stem for folder in SHIPPED for path in folder.glob("*.toml")})


def find_scenario(name: str) -> Path | None:
    """A scenario file by its path, or by the name of a shipped one (with or without ``.toml``)."""
    path = Path(name)
    if path.is_file():
        return path
    for folder in SHIPPED:
        shipped = folder / f"{path.name.removesuffix('.toml')}.toml"
        if path.parent == Path() and shipped.is_file():
            return shipped
    return None
