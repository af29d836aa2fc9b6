# SPDX-License-Identifier: Apache-2.0
"""SIGTERM and Ctrl-C end every command with status 130 and no traceback."""

from __future__ import annotations

import importlib
import os
import signal
import subprocess
import time
from pathlib import Path
from typing import Any

import pytest
from harness import ROOT, chaserdock

from chaserdock.cli import main as program
from chaserdock.launch.launcher import free_port
from chaserdock.launch.signals import StopRequested, interrupts

GOLDEN = ROOT / "tests" / "golden" / "two-chasers.mcap"


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signal_ends_a_command_that_does_not_handle_it(
    number: signal.Signals, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def work(*_: Any, **__: Any) -> None:
        os.kill(os.getpid(), number)
        time.sleep(10.0)
        pytest.fail("the signal did not end the work")

    monkeypatch.setattr(program, "app", work)
    monkeypatch.setattr("sys.argv", ["chaserdock", "judge", "log"])
    before = signal.signal(signal.SIGTERM, lambda *_: pytest.fail("SIGTERM has no handler yet"))
    try:
        with pytest.raises(SystemExit) as ended:
            program.main()
    finally:
        signal.signal(signal.SIGTERM, before)
    assert ended.value.code == 130
    assert capsys.readouterr().err == "chaserdock: stopped\n"


def test_a_signal_within_an_import_is_not_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a package that takes any exception for a missing one, as trimesh does."""
    kill = "import os, signal\ntry:\n    os.kill(os.getpid(), signal.SIGTERM)\n    sum(range(10))"
    (tmp_path / "swallows.py").write_text(f"{kill}\nexcept BaseException:\n    pass\n")
    monkeypatch.syspath_prepend(tmp_path)
    with interrupts():
        importlib.import_module("swallows")
        with pytest.raises(StopRequested):
            time.sleep(10.0)


def handles_sigterm(process: subprocess.Popen[bytes]) -> bool:
    """Whether a process has a handler for SIGTERM, as the kernel tells."""
    status = Path(f"/proc/{process.pid}/status").read_text()
    caught = next(line for line in status.splitlines() if line.startswith("SigCgt:"))
    return bool(int(caught.split()[1], 16) >> (signal.SIGTERM - 1) & 1)


@pytest.mark.slow(2)
@pytest.mark.parametrize(
    "arguments",
    [
        ["world", "single", "-l", "{endpoint}"],
        ["chaser", "0", "-e", "{endpoint}"],
        ["controller", "-e", "{endpoint}"],
        ["record", "--out", "{tmp}", "-e", "{endpoint}"],
        ["router", "-l", "{endpoint}"],
        ["view", str(GOLDEN)],
        ["view", "-e", "{endpoint}"],
        ["judge", "{tmp}", "--live", "-e", "{endpoint}"],
        ["simulate", "detumble", "--out", "{tmp}"],
        ["status", "-e", "{endpoint}", "--duration", "600"],
    ],
    ids=" ".join,
)
@pytest.mark.parametrize("after_s", [0.0, 4.0])
def test_sigterm_gives_status_130(arguments: list[str], after_s: float, tmp_path: Path) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port()}"
    filled = [a.format(endpoint=endpoint, tmp=tmp_path) for a in arguments]
    process = chaserdock(*filled, stdout=subprocess.PIPE, stderr=subprocess.STDOUT)
    try:
        while not handles_sigterm(process):
            time.sleep(0.05)
        time.sleep(after_s)
        process.send_signal(signal.SIGTERM)
        said, _ = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
    assert process.returncode == 130, said
    assert b"Traceback" not in said
