# SPDX-License-Identifier: Apache-2.0
"""Provenance of a log: commit, versions of all installed packages, lock file, BLAS in use."""

from __future__ import annotations

import gzip
import json
import subprocess
from functools import lru_cache
from importlib import metadata
from pathlib import Path

import numpy  # noqa: F401 - loads its BLAS
from threadpoolctl import threadpool_info

_FOLDER = Path(__file__).resolve().parent
# Only in a source tree.
_LOCK_FILE = Path(__file__).resolve().parents[3] / "uv.lock"


@lru_cache
def installed_versions() -> dict[str, str]:
    """Return the version of every installed distribution, by name."""
    # Each access to the metadata of a distribution parses its file.
    parsed = [d.metadata for d in metadata.distributions()]
    found = {m["Name"]: m["Version"] for m in parsed if m["Name"]}
    return dict(sorted(found.items(), key=lambda item: item[0].lower()))


@lru_cache
def version(package: str) -> str:
    """Return the version of an installed package."""
    return metadata.version(package)


@lru_cache
def commit_of(folder: Path = _FOLDER) -> str | None:
    """Return the commit of the checkout that tracks ``folder``, by default that of this package.

    Ends with ``-dirty`` where tracked files are changed. None outside a checkout or without git.
    """

    def git(*arguments: str) -> str:
        command = ["git", "-C", str(folder), *arguments]
        try:
            done = subprocess.run(command, capture_output=True, text=True, check=False)
        except OSError:  # git is not installed
            return ""
        return done.stdout.strip() if done.returncode == 0 else ""

    if not git("ls-files", "."):
        return None
    return git("describe", "--always", "--dirty", "--abbrev=12", "--exclude=*") or None


def versions_json() -> bytes:
    """Return ``installed_versions`` as JSON."""
    return json.dumps(installed_versions(), indent=1).encode()


@lru_cache
def blas_in_use() -> str:
    """Return name, version and processor type of NumPy's BLAS; empty if not known.

    Such as "openblas 0.3.31 Haswell". OpenBLAS has kernels for each processor type, which differ in
    the last bits. The environment variable OPENBLAS_CORETYPE overrides the type.
    """
    found = [library for library in threadpool_info() if library["user_api"] == "blas"]
    own = [
        library for library in found if "numpy" in Path(library["filepath"]).parent.name
    ] or found
    names = ("internal_api", "version", "architecture")
    return " ".join(str(own[0][name]) for name in names if own[0].get(name)) if own else ""


@lru_cache
def lock_file_gz() -> bytes | None:
    """Return the source tree's ``uv.lock``, gzipped reproducibly, or None outside a source tree."""
    try:
        return gzip.compress(_LOCK_FILE.read_bytes(), mtime=0)
    except OSError:
        return None
