# SPDX-License-Identifier: Apache-2.0
"""Rules for source files: licence header and typed packages."""

from __future__ import annotations

import re
import subprocess

from source_tree import PACKAGES, ROOT


def test_source_files_state_their_licence() -> None:
    tracked = subprocess.check_output(["git", "ls-files"], cwd=ROOT, text=True).split()
    sources = [name for name in tracked if re.search(r"\.(py|c|h|js|css|toml|ya?ml|json5)$", name)]
    assert len(sources) > 400
    missing = [
        name
        for name in sources
        if "SPDX-License-Identifier: Apache-2.0" not in (ROOT / name).read_text()[:300]
    ]
    assert missing == []


def test_packages_are_typed() -> None:
    assert [name for name, folder in PACKAGES.items() if not (folder / "py.typed").is_file()] == []
