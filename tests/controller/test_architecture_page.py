# SPDX-License-Identifier: Apache-2.0
"""docs/architecture.md lists calls that exist, in the order of packages; docs/phases.md is
generated.
"""

from __future__ import annotations

import re
import subprocess
import sys
from importlib import import_module
from itertools import groupby
from operator import attrgetter

from harness import ROOT

PAGE = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")


def listed_calls() -> list[tuple[str, bool]]:
    """Return the listed names, and whether ``step`` calls them itself."""
    (listing,) = re.findall(r"```text\n(.*?)```", PAGE, re.DOTALL)
    lines = listing.splitlines()
    return [(line.split()[0], len(line) - len(line.lstrip()) == 4) for line in lines]


def test_listed_names_exist() -> None:
    for name, _ in listed_calls():
        module = re.match(r"[a-z_.]+?(?=\.[A-Z]|\.[a-z_]+$)", name)
        assert module is not None, name
        owner = import_module(f"chaserdock_controller.{module[0]}")
        assert callable(attrgetter(name.removeprefix(f"{module[0]}."))(owner)), name


def test_step_enters_each_package_once_in_the_listed_order() -> None:
    names = [name for name, _ in listed_calls()]
    packages = [package for package, _ in groupby(name.split(".")[0] for name in names)]
    assert packages == ["core", "ingest", "estimation", "guidance", "nmpc", "output"]
    source = (ROOT / "controller" / "chaserdock_controller" / "core.py").read_text(encoding="utf-8")
    body = source[source.index("def step(") : source.index("def estimate(")]
    assert re.findall(r"self\.(\w+)\.run\(", body) == [
        "ingest",
        "estimation",
        "guidance",
        "planning",
        "output",
    ]


def test_the_phases_page_is_current() -> None:
    command = [sys.executable, str(ROOT / "docs" / "make_phases.py"), "--print"]
    made = subprocess.run(
        command, capture_output=True, text=True, check=True, encoding="utf-8"
    ).stdout
    committed = (ROOT / "docs" / "phases.md").read_text(encoding="utf-8")
    assert committed == made, "run: python docs/make_phases.py"
