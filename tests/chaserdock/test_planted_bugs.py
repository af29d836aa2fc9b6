# SPDX-License-Identifier: Apache-2.0
"""The planted bugs can still be planted, and simulation finds two."""

from __future__ import annotations

import subprocess
import sys

import pytest
from harness import ROOT


def planted_bugs(*arguments: str) -> tuple[int, str]:
    command = [sys.executable, str(ROOT / "benchmarks" / "planted_bugs.py"), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr


def test_every_patch_applies() -> None:
    status, text = planted_bugs("--check")
    assert status == 0, text
    assert int(text.split()[0]) >= 20


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "row"),
    [
        ("mission-ends-early", "short-drill.toml | 1 | liveness |"),
        ("lease-never-renewed", "fault-drill | 1 | no hand-over without a cause |"),
    ],
)
def test_a_planted_bug_is_found(name: str, row: str) -> None:
    status, text = planted_bugs("--only", name, "--known")
    assert status == 0, text
    assert row in text
