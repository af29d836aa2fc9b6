# SPDX-License-Identifier: Apache-2.0
"""What decides how a process computes: the sources of chaserdock, Python, and packages."""

from __future__ import annotations

import hashlib
import re
import sys
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

from chaserdock_protocol.errors import ChaserdockError
from chaserdock_protocol.recording.provenance import commit_of
from chaserdock_protocol.shipped_scenarios import SHIPPED

Version = dict[str, str]
"""By name: ``chaserdock``, ``commit``, ``sources`` (a digest), ``Python`` (without the patch
level), and installed packages that chaserdock names. Plain values: other versions must read it.
"""

_PACKAGES = (
    "chaserdock",
    "chaserdock_agents",
    "chaserdock_controller",
    "chaserdock_models",
    "chaserdock_protocol",
    "chaserdock_world",
)

_NOT_COMPUTING = ("chaserdock", "commit")
"""What may differ where sources are equal."""


def version() -> Version:
    """Return the version of what is installed now, which a process that has imported it earlier
    may not have.
    """
    found = {
        "chaserdock": metadata.version("chaserdock"),
        "commit": commit_of() or "unknown",
        "sources": sources_digest(),
        "Python": f"{sys.version_info.major}.{sys.version_info.minor}",
    }
    for requirement in metadata.requires("chaserdock") or ():
        name = re.split(r"[^\w.-]", requirement, maxsplit=1)[0]
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:  # of an extra
            continue
    return found


def difference(theirs: Version, ours: Version) -> str:
    """Return in what another process differs from this one: what it has, and what is here; "" if
    it computes the same. A package that only one of both has does not count.
    """
    if theirs.get("sources") != ours["sources"]:
        return f"{_chaserdock(theirs)}, here {_chaserdock(ours)}"
    for name in ours:
        if theirs.get(name, ours[name]) != ours[name] and name not in _NOT_COMPUTING:
            return f"{name} {theirs[name]}, here {ours[name]}"
    return ""


def digest_of(of: Version) -> str:
    """Return a digest that is equal for processes that compute the same."""
    relevant = sorted(item for item in of.items() if item[0] not in _NOT_COMPUTING)
    return hashlib.sha256(repr(relevant).encode()).hexdigest()[:8]


def _chaserdock(of: Version) -> str:
    number, commit, sources = (of.get(k, "unknown") for k in ("chaserdock", "commit", "sources"))
    return f"chaserdock {number} of commit {commit} (sources {sources[:8]})"


def sources_digest(without: Path | None = None) -> str:
    """Return a digest of all sources and shipped scenarios, but for those in the folder
    ``without``. Raise ChaserdockError unless all packages are installed.
    """
    digest = hashlib.sha256()
    for package in _PACKAGES:
        spec = find_spec(package)
        if spec is None or spec.origin is None:
            raise ChaserdockError(f"{package} is not installed, which flights need")
        folder = Path(spec.origin).resolve().parent
        for path in sorted(p for p in folder.rglob("*") if p.suffix in (".py", ".c", ".h")):
            if path.parent != without:
                digest.update(path.read_bytes())
    for path in sorted(path for folder in SHIPPED for path in folder.glob("*.toml")):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]
