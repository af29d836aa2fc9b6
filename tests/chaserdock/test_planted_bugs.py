# SPDX-License-Identifier: Apache-2.0
"""The planted bugs can still be planted, and simulation finds one."""

from __future__ import annotations

import subprocess
import sys

from harness import ROOT


def planted_bugs(*arguments: str) -> tuple[int, str]:
    command = [sys.executable, str(ROOT / "benchmarks" / "planted_bugs.py"), *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr


def test_every_patch_applies() -> None:
    status, text = planted_bugs("--check")
    assert status == 0, text
    assert int(text.split()[0]) >= 20


def test_a_planted_bug_is_found() -> None:
    status, text = planted_bugs("--only", "mission-ends-early", "--seeds", "1")
    assert status == 0, text
    assert "short-drill.toml | 1 | liveness |" in text
