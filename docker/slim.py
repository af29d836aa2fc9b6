# SPDX-License-Identifier: Apache-2.0
"""Takes out of the installed packages what no process of a mission loads. Run in the layer that installs them.

What goes: PyBullet's models and examples, tests of packages, and what only a compiler needs.
What lies there several times (wheels cannot hold symbolic links, so libraries come under each of their names) stays
once, with hard links. test_compose.py holds the image's size, and a mission is flown in it.
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
_WORTH_A_LINK_BYTES = 100_000


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
        if path.is_symlink() or not path.is_file() or path.stat().st_size < _WORTH_A_LINK_BYTES:
            continue
        content = (path.stat().st_size, hashlib.sha256(path.read_bytes()).hexdigest())
        first = kept.setdefault(content, path)
        if first is not path and not first.samefile(path):
            path.unlink()
            os.link(first, path)


if __name__ == "__main__":
    remove()
    link_copies()
