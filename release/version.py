# SPDX-License-Identifier: Apache-2.0
"""The version of this source tree: ``python release/version.py`` prints it. Building the package
asks ``version``.

It is, in this order: the environment variable CHASERDOCK_VERSION (for builds without git, as in a
container); what git says; what ``git archive`` wrote into .git_archival.txt; the version of
CITATION.cff with the suffix ``+nogit``. In an sdist the build backend takes it from PKG-INFO and
does not ask here. A release is a commit with the tag vX.Y.Z.
"""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
_DESCRIBED = re.compile(r"v(\d+)\.(\d+)\.(\d+)(?:(rc|a|b)(\d+))?(?:-(\d+)-g([0-9a-f]+))?")
_TAGS = ("--tags", "--match", "v[0-9]*")


def from_description(text: str) -> str | None:
    """Return the version (PEP 440) that the output of ``git describe`` stands for; None if no tag
    is in it.

    A commit after a tag is a development version of the next patch release, or of the next release
    candidate.
    """
    found = _DESCRIBED.fullmatch(text.strip())
    if found is None:
        return None
    major, minor, patch, stage, number, commits, commit = found.groups()
    before = f"{stage}{number}" if stage else ""
    if commits is None:
        return f"{major}.{minor}.{patch}{before}"
    following = f"{patch}{stage}{int(number) + 1}" if stage else f"{int(patch) + 1}"
    return f"{major}.{minor}.{following}.dev{commits}+g{commit}"


def cited(root: Path) -> str:
    """Return the version in CITATION.cff: the latest release, before the first one that release."""
    found = re.search(
        r"^version: (\d+\.\d+\.\d+)$", (root / "CITATION.cff").read_text(encoding="utf-8"), re.M
    )
    if found is None:
        raise ValueError(f"{root / 'CITATION.cff'}: no line 'version: X.Y.Z'")
    return found[1]


def _git(root: Path, *arguments: str) -> str | None:
    """Return the output of git; None where it fails, is not installed, or ``root`` is not the top
    of a clone.
    """
    if not (root / ".git").exists():
        return None  # git would search the folders above
    command = ["git", "-c", f"safe.directory={root}", *arguments]
    try:
        done = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    except OSError:
        return None
    return done.stdout.strip() if done.returncode == 0 else None


def version(root: Path = ROOT) -> str:
    """Return the version of the source tree ``root``."""
    given = os.environ.get("CHASERDOCK_VERSION")
    if given:
        return given
    described = _git(root, "describe", *_TAGS)
    if described is not None and (known := from_description(described)):
        return known
    commits, commit = (
        _git(root, "rev-list", "--count", "HEAD"),
        _git(root, "rev-parse", "--short", "HEAD"),
    )
    if commits and commit:
        return f"{cited(root)}.dev{commits}+g{commit}"
    archival = root / ".git_archival.txt"
    archived = archival.read_text(encoding="utf-8").strip() if archival.is_file() else ""
    return from_description(archived) or f"{cited(root)}+nogit"


if __name__ == "__main__":
    print(version())
