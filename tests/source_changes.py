# SPDX-License-Identifier: Apache-2.0
"""Changes of source files by exact text, applied to a copy of the checkout: planted bugs and
mutants.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tomllib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
SOURCES = ("agents", "chaserdock", "controller", "protocol", "world")
MUTANTS = ROOT / "tests" / "mutants.toml"


@dataclass(frozen=True)
class Change:
    """A replacement of text in one file; ``file`` is relative to the checkout."""

    file: str
    old: str
    new: str


@dataclass(frozen=True)
class Mutant:
    """A change that the tests in the files ``tests`` must detect."""

    change: Change
    tests: tuple[str, ...]

    @property
    def name(self) -> str:
        """Return the file and what replaces what, on one line."""
        return (
            f"{self.change.file}: {' '.join(self.change.old.split())} -> "
            f"{' '.join(self.change.new.split())}"
        )


def read_mutants(path: Path = MUTANTS) -> list[Mutant]:
    """Read the table of mutants. Raises KeyError for a mutant without file, old, new or tests."""
    tables = tomllib.loads(path.read_text(encoding="utf-8"))["mutant"]
    return [Mutant(Change(t["file"], t["old"], t["new"]), tuple(t["tests"])) for t in tables]


def apply(changes: Sequence[Change], folder: Path, write: bool = True) -> None:
    """Apply changes to the sources in ``folder``. Raises ValueError for text that its file does not
    contain exactly once.
    """
    for change in changes:
        path = folder / change.file
        source = path.read_text(encoding="utf-8") if path.is_file() else ""
        if source.count(change.old) != 1:
            raise ValueError(
                f"{change.file} contains the text to replace {source.count(change.old)} "
                f"times:\n{change.old}"
            )
        if write:
            path.write_text(source.replace(change.old, change.new), encoding="utf-8")


@contextmanager
def changed(change: Change, folder: Path) -> Iterator[None]:
    """Apply a change to the sources in ``folder``, and take it back. Raises as `apply`."""
    path = folder / change.file
    source = path.read_bytes()
    apply([change], folder)
    try:
        yield
    finally:
        path.write_bytes(source)


def copy_checkout(folder: Path, names: Sequence[str]) -> None:
    """Copy files and folders of the checkout, with compiled kernels, to ``folder``."""
    for name in names:
        if (ROOT / name).is_dir():
            shutil.copytree(
                ROOT / name,
                folder / name,
                ignore=shutil.ignore_patterns("__pycache__", "node_modules"),
            )
        else:
            shutil.copy(ROOT / name, folder / name)


def run_python(
    folder: Path, *arguments: str, timeout_s: float | None = None
) -> subprocess.CompletedProcess[str]:
    """Run Python in a copy of the checkout, which imports the packages of the copy. Raises
    TimeoutExpired.
    """
    paths = [str(folder), *(str(folder / name) for name in SOURCES if name != "chaserdock")]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(paths), "PYTHONDONTWRITEBYTECODE": "1"}
    command = [sys.executable, *arguments]
    return subprocess.run(
        command, cwd=folder, env=env, capture_output=True, text=True, check=False, timeout=timeout_s
    )
