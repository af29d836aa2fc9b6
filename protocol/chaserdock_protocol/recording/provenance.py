# SPDX-License-Identifier: Apache-2.0
"""Provenance of a log: versions of all installed packages, the lock file, and the BLAS in use."""

from __future__ import annotations

import gzip
import json
from functools import lru_cache
from importlib import metadata
from pathlib import Path

import numpy  # noqa: F401 - loads its BLAS
from threadpoolctl import threadpool_info

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


def versions_json() -> bytes:
    """Return ``installed_versions`` as JSON."""
    return json.dumps(installed_versions(), indent=1).encode()


@lru_cache
def blas_in_use() -> str:
    """Return name, version and processor type of NumPy's BLAS, such as "openblas 0.3.31 Haswell";
    empty if not known.

    OpenBLAS has kernels for each processor type, which differ in the last bits. The environment
    variable OPENBLAS_CORETYPE overrides the type.
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
