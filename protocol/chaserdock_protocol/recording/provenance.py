"""Which software a log was recorded with: the versions of all that is installed, and the lock file where there is one."""

from __future__ import annotations

import gzip
import json
from functools import lru_cache
from importlib.metadata import distributions
from pathlib import Path

# In a source tree; an installed package has none.
_LOCK_FILE = Path(__file__).resolve().parents[3] / "uv.lock"


@lru_cache
def installed_versions() -> dict[str, str]:
    """Version of every distribution that is installed here, by name."""
    found = {d.metadata["Name"]: d.version for d in distributions() if d.metadata["Name"]}
    return dict(sorted(found.items(), key=lambda item: item[0].lower()))


def versions_json() -> bytes:
    """``installed_versions`` as JSON."""
    return json.dumps(installed_versions(), indent=1).encode()


@lru_cache
def lock_file_gz() -> bytes | None:
    """The source tree's ``uv.lock``, gzipped (always the same bytes), or None outside of one."""
    try:
        return gzip.compress(_LOCK_FILE.read_bytes(), mtime=0)
    except OSError:
        return None
