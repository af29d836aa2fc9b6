"""What every process' main shares: its options, stopping cleanly, one thread for the number crunchers."""

from __future__ import annotations

import gc
import os
import signal
import sys
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from .transport import Link

Mode = Literal["lockstep", "realtime"]

SINGLE_THREADED = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
"""Environment of every process: one thread each, as there are more processes than cores, and for determinism."""


@dataclass(frozen=True)
class Rotation:
    """When a recorder begins a new file: after so many bytes, after so many seconds of simulated time."""

    size_bytes: int | None = None
    seconds: float | None = None

    @property
    def wanted(self) -> bool:
        return self.size_bytes is not None or self.seconds is not None


@dataclass(frozen=True)
class ProcessOptions:
    """How a process was started. Which fields count depends on the process.

    ``rejoin_s``: wall seconds that a world in lock-step waits when it has lost everybody; ``by_run``: a recorder
    makes a folder for each run in ``out``; ``until``: a router ends once that process has come and gone; ``standby``: a
    controller begins as the second one.
    """

    link: Link = field(default_factory=Link)
    chaser: int | None = None
    scenario: Path | None = None
    overrides: tuple[str, ...] = ()
    seed: int | None = None
    mode: Mode = "lockstep"
    out: Path = Path("runs")
    rotation: Rotation = Rotation()
    viewer_layer: bool = True
    recorder_expected: bool = True
    watch_parent: bool = False
    patience_s: float | None = None
    rejoin_s: float = 0.0
    by_run: bool = False
    until: str | None = None
    standby: bool = False


class Stop:
    """Set by SIGINT, SIGTERM or, where asked for, the end of standard input (the parent is gone)."""

    def __init__(self, watch_parent: bool) -> None:
        self._event = threading.Event()
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, self._on_signal)
            # Under `run`, Ctrl-C is the launcher's to handle; the terminal sends it to all.
            signal.signal(signal.SIGINT, signal.SIG_IGN if watch_parent else self._on_signal)
        if watch_parent:
            threading.Thread(target=self._watch, name="parent", daemon=True).start()

    def _on_signal(self, *_: object) -> None:
        self._event.set()

    def _watch(self) -> None:
        while os.read(sys.stdin.fileno(), 4096):
            pass
        self._event.set()

    def set(self) -> None:
        self._event.set()

    def __call__(self) -> bool:
        return self._event.is_set()


def built() -> None:
    """Says that this process is about to fly: what it holds by now stays, and the garbage collector, which would stop it
    for some 10 ms, need not go through all of that again and again."""
    gc.collect()
    gc.freeze()


def say(process: str, text: str) -> None:
    """One line on standard error."""
    print(f"{process}: {text}", file=sys.stderr, flush=True)
