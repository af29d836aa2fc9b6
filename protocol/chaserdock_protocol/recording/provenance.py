# SPDX-License-Identifier: Apache-2.0
"""Provenance of a log: versions of all installed packages, and the lock file."""

from __future__ import annotations

import gzip
import json
from functools import lru_cache
from importlib.metadata import distributions
from pathlib import Path

# Only in a source tree.
_LOCK_FILE = Path(__file__).resolve().parents[3] / "uv.lock"


@lru_cache
def installed_versions() -> dict[str, str]:
    """Return the version of every installed distribution, by name."""
    found = {d.metadata["Name"]: d.version for d in distributions() if d.metadata["Name"]}
    return dict(sorted(found.items(), key=lambda item: item[0].lower()))


def versions_json() -> bytes:
    """Return ``installed_versions`` as JSON."""
    return json.dumps(installed_versions(), indent=1).encode()


@lru_cache
def lock_file_gz() -> bytes | None:
    """Return the source tree's ``uv.lock``, gzipped reproducibly, or None outside a source tree."""
    try:
        return gzip.compress(_LOCK_FILE.read_bytes(), mtime=0)
    except OSError:
        return None
