# SPDX-License-Identifier: Apache-2.0
"""Removes what no process of a mission loads from the installed packages. Runs in the image layer
that installs them.

Removed: PyBullet's models and examples, its OpenGL renderer, pyarrow's Flight and S3, MuJoCo's
plugins, test suites, compiler headers and static libraries, and the symbols and debug information
of shared libraries (150 MB, most of them PyBullet's). Identical files (wheels cannot contain
symbolic links, so libraries are stored under each of their names) become hard links.
tests/chaserdock/test_compose.py limits the size of the image and flies a mission in it.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import struct
import sysconfig
from pathlib import Path

PACKAGES = Path(sysconfig.get_paths()["purelib"])
UNUSED = (
    "pybullet_data",
    "pybullet_envs",
    "pybullet_robots",
    "pybullet_examples",
    "eglRenderer*.so",
    "casadi/include",
    "matplotlib/tests",
    "mujoco/doc",
    "mujoco/include",
    "mujoco/plugin",
    "mujoco/testdata",
    "pyarrow/*flight*",
    "pyarrow/*s3*",
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


def without_symbols(library: bytes) -> bytes:
    """Return a shared library (64-bit ELF) without what the loader does not map: symbols, debug
    information, section table.

    Everything up to the end of the last segment stays in place, so that also libraries that were
    edited after linking load.
    """
    if library[:6] != b"\x7fELF\x02\x01":
        return library
    segments_at, (size, count) = (
        struct.unpack_from("<Q", library, 32)[0],
        struct.unpack_from("<HH", library, 54),
    )
    end = segments_at + size * count
    for k in range(count):
        offset, in_file = struct.unpack_from("<Q16xQ", library, segments_at + k * size + 8)
        end = max(end, offset + in_file)
    head = bytearray(library[:end])
    struct.pack_into("<Q", head, 40, 0)  # e_shoff: no section table
    struct.pack_into("<HH", head, 60, 0, 0)  # e_shnum, e_shstrndx
    return bytes(head)


def strip() -> None:
    for path in sorted(PACKAGES.rglob("*.so*")):
        if path.is_file() and not path.is_symlink() and path.stat().st_nlink == 1:
            content = path.read_bytes()
            kept = without_symbols(content)
            if len(content) - len(kept) >= _MIN_LINKED_BYTES:
                path.write_bytes(kept)


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
    strip()
    link_copies()
