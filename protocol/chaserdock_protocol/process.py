# SPDX-License-Identifier: Apache-2.0
"""Options, stop signal and start-up steps that all processes share."""

from __future__ import annotations

import os
import signal
import sys
import threading
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from .stall import DEFAULT_STALL_S
from .transport import Link

Mode = Literal["lockstep", "realtime"]

SINGLE_THREADED = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}
"""Environment of every process: single-threaded numerics, as processes outnumber cores, and for
determinism.
"""


@dataclass(frozen=True)
class Rotation:
    """Limits after which a recorder starts a new file: bytes, seconds of simulated time."""

    size_bytes: int | None = None
    seconds: float | None = None

    @property
    def wanted(self) -> bool:
        return self.size_bytes is not None or self.seconds is not None


@dataclass(frozen=True)
class RosLink:
    """Describe how a bridge reaches ROS 2.

    Endpoints to connect to, or to ``listen`` on as the router. ``domain``: ROS_DOMAIN_ID.
    ``control``: take the controller's place, with wrenches of ROS 2, instead of showing the
    mission.
    """

    connect: tuple[str, ...] = ("tcp/127.0.0.1:7447",)
    listen: tuple[str, ...] = ()
    domain: int = 0
    control: bool = False


@dataclass(frozen=True)
class ProcessOptions:
    """Start options of a process. Each process uses a subset.

    ``patience_s``: wall-clock time (s) that a process waits for a world, and the world for another
    process to connect before the first tick. ``rejoin_s``: wall-clock time (s) that a lock-step
    world waits after it lost all processes. ``by_run``: the recorder creates one folder per run in
    ``out``. ``until``: the router ends when this process has joined and left. ``standby``: the
    controller starts as the standby. ``signals``: the process stops on SIGINT and SIGTERM. ``ros``:
    for the bridge. ``dry_run``: a gateway sends nothing to robots. ``resume``: file by which it
    takes up a mission again.
    ``camera``, ``camera_latency_s``: as in `[[lab.camera]]`, of a chaser with a camera of its own.
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
    compressed_log: bool = True
    recorder_expected: bool = True
    watch_parent: bool = False
    patience_s: float | None = None
    rejoin_s: float = 0.0
    stall_s: float = DEFAULT_STALL_S
    by_run: bool = False
    until: str | None = None
    standby: bool = False
    signals: bool = True
    ros: RosLink = RosLink()
    dry_run: bool = False
    resume: Path | None = None
    camera: str = ""
    camera_latency_s: float = 0.0

    def stop_signal(self) -> StopSignal:
        """Return the signal that stops the process."""
        return StopSignal(self.watch_parent, self.signals)


_signalled = threading.Event()


def stopped_by_signal() -> bool:
    """Return whether a ``StopSignal`` of this process has received SIGINT or SIGTERM."""
    return _signalled.is_set()


class StopSignal:
    """Record that this process is to stop.

    Set by SIGINT, SIGTERM and, with ``watch_parent``, the end of standard input (the parent has
    ended).
    """

    def __init__(self, watch_parent: bool, signals: bool = True) -> None:
        self._event = threading.Event()
        if signals and threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, self._on_signal)
            # The terminal sends Ctrl-C to all processes of `run`; the launcher handles it.
            signal.signal(signal.SIGINT, signal.SIG_IGN if watch_parent else self._on_signal)
        if watch_parent:
            threading.Thread(target=self._watch, name="parent", daemon=True).start()

    def _on_signal(self, *_: object) -> None:
        _signalled.set()
        self._event.set()

    def _watch(self) -> None:
        while os.read(sys.stdin.fileno(), 4096):
            pass
        self._event.set()

    def set(self) -> None:
        self._event.set()

    def __call__(self) -> bool:
        return self._event.is_set()


def print_status(process: str, text: str) -> None:
    """Print one line to standard error, if that can be written: a full disk ends no process."""
    with suppress(OSError):
        print(f"{process}: {text}", file=sys.stderr, flush=True)
