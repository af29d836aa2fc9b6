# SPDX-License-Identifier: Apache-2.0
"""Ctrl-C and SIGTERM end the program in one line, whenever they arrive, and leave nothing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import psutil
import pytest
from harness import chaserdock

from chaserdock.cli import main as program
from chaserdock.launch.signals import StopRequested, interrupts
from chaserdock.simulation.flight import memory_folder

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_while_the_program_is_imported_is_one_line(
    tmp_path: Path, number: signal.Signals
) -> None:
    """A module that waits stands for the first second, in which the program's modules are read."""
    (tmp_path / "typer.py").write_text(
        "import time\nprint('reading', flush=True)\ntime.sleep(60)\n"
    )
    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    process = chaserdock("run", "single", env={"PYTHONPATH": str(tmp_path)}, **pipes)
    assert process.stdout is not None
    assert process.stdout.readline() == b"reading\n"
    process.send_signal(number)
    out, errors = process.communicate(timeout=30)
    assert (process.returncode, out, errors) == (130, b"", b"chaserdock: stopped\n")


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_during_a_command_is_status_130(
    number: signal.Signals, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    closed = []

    def command(**_: Any) -> None:
        try:
            os.kill(os.getpid(), number)
            time.sleep(60)
        finally:
            closed.append(number)

    before = [signal.getsignal(n) for n in SIGNALS]
    monkeypatch.setattr(program, "app", command)
    monkeypatch.setattr(sys, "argv", ["chaserdock"])
    with pytest.raises(SystemExit) as caught:
        program.main()
    assert (caught.value.code, closed) == (130, [number])
    assert capsys.readouterr().err == "chaserdock: stopped\n"
    assert [signal.getsignal(n) for n in SIGNALS] == before


def test_a_signal_that_is_ignored_stays_ignored() -> None:
    """A shell starts background programs so."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with interrupts():
            assert signal.getsignal(signal.SIGINT) == signal.SIG_IGN
            with pytest.raises(StopRequested):
                os.kill(os.getpid(), signal.SIGTERM)
    finally:
        signal.signal(signal.SIGINT, before)


@pytest.mark.slow(1)
@pytest.mark.parametrize("jobs", [1, 2])
def test_simulate_leaves_no_folder_in_memory_after_sigterm(tmp_path: Path, jobs: int) -> None:
    folder = Path(memory_folder() or os.environ.get("TMPDIR", "/tmp"))
    seeds = ("--seeds", "1:9", "--jobs", str(jobs), "--out", str(tmp_path))
    process = chaserdock("simulate", "fault-drill", *seeds, stdout=subprocess.DEVNULL)

    def folders(pids: list[int]) -> list[Path]:
        return [path for pid in pids for path in folder.glob(f"chaserdock-{pid}-*")]

    pids, deadline = [process.pid], time.monotonic() + 60.0
    while len(folders(pids)) < jobs and time.monotonic() < deadline:
        pids = [process.pid, *(c.pid for c in psutil.Process(process.pid).children(True))]
        time.sleep(0.05)
    assert len(folders(pids)) == jobs
    process.send_signal(signal.SIGTERM)
    assert process.wait(30) == 130
    assert folders(pids) == []
