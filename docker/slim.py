# SPDX-License-Identifier: Apache-2.0
"""Removes what no process of a mission loads from the installed packages. Runs in the image layer that installs them.

Removed: PyBullet's models and examples, test suites, compiler headers and static libraries. Identical files (wheels cannot
contain symbolic links, so libraries are stored under each of their names) become hard links. tests/chaserdock/test_compose.py
limits the size of the image and flies a mission in it.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import sysconfig
from pathlib import Path

PACKAGES = Path(sysconfig.get_paths()["purelib"])
UNUSED = (
    "pybullet_data",
    "pybullet_envs",
    "pybullet_robots",
    "pybullet_examples",
    "casadi/include",
    "matplotlib/tests",
    "pyarrow/include",
    "pyarrow/tests",
    "**/*.a",
)
_MIN_LINKED_BYTES = 100_000


def remove() -> None:
    for pattern in UNUSED:
        for path in list(PACKAGES.glob(pattern)):
            if path.is_dir():
                shutil.rmtree(path)
            else:
                path.unlink(missing_ok=True)


def link_copies() -> None:
    kept: dict[tuple[int, str], Path] = {}
    for path in sorted(PACKAGES.rglob("*.so*")):
        if path.is_symlink() or not path.is_file() or path.stat().st_size < _MIN_LINKED_BYTES:
            continue
        content = (path.stat().st_size, hashlib.sha256(path.read_bytes()).hexdigest())
        first = kept.setdefault(content, path)
        if first is not path and not first.samefile(path):
            path.unlink()
            os.link(first, path)


if __name__ == "__main__":
    remove()
    link_copies()
