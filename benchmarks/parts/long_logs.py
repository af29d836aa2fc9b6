# SPDX-License-Identifier: Apache-2.0
"""Time and memory of the commands that read a log, on one flight and on many hours.

The long log repeats the flown one with continued ticks and times, without images (ten hours of them
would be hundreds of gigabytes).
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from argparse import ArgumentParser
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import msgspec
from chaserdock_protocol import topics
from chaserdock_protocol.messages import MissionEnd, encoding_of
from chaserdock_protocol.recording.log import LogWriter, read_log, read_scenario
from common import Figures, Group, Options, chaserdock_command, run_chaserdock

_TIMES = ("sim_time_ns", "effective_time_ns", "expires_ns")


def repeat(log: Path, out: Path, hours: float) -> int:
    """Write ``log`` repeatedly to the new file ``out`` until it is ``hours`` long; return the
    number of messages.
    """
    text, run = read_scenario(log)
    records = [
        r
        for r in read_log(log)
        if r.topic is not topics.IMAGE and not isinstance(r.message, MissionEnd)
    ]
    ticks = 1 + max(getattr(r.message, "tick", 0) for r in records)
    scenario = msgspec.json.decode(text)
    period_ns = round(ticks * 1e9 / scenario["time"]["rate_hz"])
    times = max(1, round(hours * 3.6e12 / period_ns))
    scenario["duration_s"] = (times * ticks - 1) / scenario["time"][
        "rate_hz"
    ]  # the first tick is at zero
    writer = LogWriter(out)
    writer.describe(
        msgspec.json.encode(scenario).decode(), {k: v for k, v in run.items() if k != "crc32"}
    )
    seq: dict[str, int] = {}
    encoder = msgspec.msgpack.Encoder()
    for k in range(times):
        for r in records:
            m = r.message
            seq[r.key] = seq.get(r.key, -1) + 1
            changes = {f: getattr(m, f) + k * period_ns for f in _TIMES if hasattr(m, f)}
            if hasattr(m, "tick"):
                changes["tick"] = m.tick + k * ticks
            copy = msgspec.structs.replace(m, seq=seq[r.key], **changes)
            writer.write(
                r.key, encoding_of(type(m)), encoder.encode(copy), r.sent_ns + k * period_ns
            )
    writer.close()
    return writer.messages


def cost_of(*arguments: str | Path) -> tuple[float, float]:
    """Run ``chaserdock`` and return wall time (s) and largest resident set (bytes). Raise
    SystemExit if it fails.
    """
    begin_s = time.perf_counter()
    no_output = [(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)]
    command = chaserdock_command(*arguments)
    _, status, usage = os.wait4(
        os.posix_spawn(sys.executable, command, os.environ, file_actions=no_output), 0
    )
    if os.waitstatus_to_exitcode(status) not in (0, 1):  # 1: the recorded flight was no success
        raise SystemExit(f"chaserdock {' '.join(map(str, arguments))}: failed")
    return time.perf_counter() - begin_s, usage.ru_maxrss * 1024.0


def costs(log: Path, label: str) -> Figures:
    """Return time and memory of each command that reads a whole log."""
    figures: Figures = {}
    with tempfile.TemporaryDirectory() as name:
        out = Path(name)
        for command, arguments in {
            "log_info": ("log", log),
            "summary": ("judge", log),
            "report": ("report", log, "--out", out / "report.html"),
            "figures": ("report", log, "--figures", "--out", out / "figures"),
            "log_export": ("log", log, "--export", out / "tables"),
            "log_tracks": ("log", log, "--export", out / "tracks", "--format", "tum"),
        }.items():
            wall_s, peak_bytes = cost_of(*arguments)
            figures |= {
                f"{label}_{command}_wall_s": wall_s,
                f"{label}_{command}_peak_bytes": peak_bytes,
            }
    return figures


QUICK = ("duration_s=10.0", "settling_s=5.0", "steady_until_s=10.0", "timeline=[]", "success={}")


def logs(options: Options) -> Figures:
    """Run each command that reads a log on ``--log`` (default: a flight of the main mission), and
    on a log of ten hours (``--quick``: 0.2) made of it by repetition.
    """
    with tempfile.TemporaryDirectory(prefix="long-log-") as folder:
        log, long = options.log, Path(folder) / "long.mcap"
        if log is None:
            log = Path(folder) / "run"
            changes = [word for o in QUICK if options.quick for word in ("--set", o)]
            run_chaserdock("run", "four-chaser-docking", "--out", log, "-q", *changes)
        figures = costs(log, "given")
        # In a process of its own: Linux reports for a child at least the largest resident set that
        # its parent had when it started the child, and a writer keeps the index of all its chunks.
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            hours = 0.2 if options.quick else options.log_h
            messages = pool.submit(repeat, log, long, hours).result()
        figures |= {"long_messages": messages, "long_size_bytes": long.stat().st_size}
        return figures | costs(long, "long")


def add_options(parser: ArgumentParser) -> None:
    parser.add_argument(
        "--log", type=Path, help="of logs: a run's folder or log; default: a new run"
    )
    parser.add_argument(
        "--log-h", type=float, default=10.0, metavar="H", help="length of the long log"
    )


GROUP = Group({"logs": logs}, add_options=add_options)
