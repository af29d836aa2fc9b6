# SPDX-License-Identifier: Apache-2.0
"""The planted bugs can still be planted, and simulation finds two."""

from __future__ import annotations

import subprocess
import sys

import planted_bugs as benchmark
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


def test_a_bug_that_cannot_be_flown_does_not_count_as_missed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """As one in C where the compiler is missing."""

    def hunt(bug: benchmark.PlantedBug, *_: int) -> benchmark.FailedSeed | None:
        if bug.name.startswith("01"):
            raise RuntimeError("does not compile")
        return benchmark.FailedSeed(11, "liveness", "stands") if bug.name[:2] == "02" else None

    monkeypatch.setattr(benchmark, "hunt", hunt)
    monkeypatch.setattr(benchmark, "simulate", lambda *_: None)
    monkeypatch.setattr(sys, "argv", ["planted_bugs.py", "--only", "01", "02", "03"])
    assert benchmark.main() == 1
    said = capsys.readouterr()
    assert "1 of 2 found; not: 03-missing-gate; not flown, see above: 01-nmpc" in said.out
    assert "does not compile" in said.err


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
