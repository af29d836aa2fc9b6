# SPDX-License-Identifier: Apache-2.0
"""How long the verbs on a log take, and what memory they need: on a log as it is, and on one of many hours.

The long one is made of the given one by repetition: its ticks and times go on where the last repetition ended, and the
images are left out (ten hours of them would be hundreds of gigabytes). Needs no mission of its own:

    chaserdock run four-chaser-docking --out runs/main
    python benchmarks/long_logs.py runs/main --hours 10
"""

from __future__ import annotations

import os
import shutil
import sys
import tempfile
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

import msgspec
from chaserdock_protocol import topics
from chaserdock_protocol.messages import MissionEnd, encoding_of
from chaserdock_protocol.recording.log import LogWriter, read_log, read_scenario
from results import options_of, write_json

_TIMES = ("sim_time_ns", "effective_time_ns", "expires_ns")


@dataclass(frozen=True)
class Cost:
    """What one call took: wall-clock seconds, and the largest resident set in megabytes."""

    seconds: float
    peak_MB: float


def repeat(log: Path, out: Path, hours: float) -> int:
    """Writes ``log`` again and again into the new file ``out`` until it is ``hours`` long; the number of messages."""
    text, run = read_scenario(log)
    records = [
        r for r in read_log(log) if r.topic is not topics.IMAGE and not isinstance(r.message, MissionEnd)
    ]
    ticks = 1 + max(getattr(r.message, "tick", 0) for r in records)
    scenario = msgspec.json.decode(text)
    period_ns = round(ticks * 1e9 / scenario["time"]["rate_hz"])
    times = max(1, round(hours * 3.6e12 / period_ns))
    scenario["duration_s"] = (times * ticks - 1) / scenario["time"]["rate_hz"]  # the first tick is at zero
    writer = LogWriter(out)
    writer.describe(msgspec.json.encode(scenario).decode(), {k: v for k, v in run.items() if k != "crc32"})
    seq: dict[str, int] = {}
    encoder = msgspec.msgpack.Encoder()
    for k in range(times):
        for r in records:
            m = r.message
            seq[r.key] = seq.get(r.key, -1) + 1
            moved = {f: getattr(m, f) + k * period_ns for f in _TIMES if hasattr(m, f)}
            if hasattr(m, "tick"):
                moved["tick"] = m.tick + k * ticks
            again = msgspec.structs.replace(m, seq=seq[r.key], **moved)
            sent_ns = r.sent_ns + k * period_ns
            writer.write(r.key, encoding_of(type(m)), encoder.encode(again), sent_ns)
    writer.close()
    return writer.messages


def cost_of(*arguments: str) -> Cost:
    """Runs the program to its end and measures it; SystemExit when it did not do its work."""
    begun_s = time.perf_counter()
    command = [sys.executable, "-m", "chaserdock", *arguments]
    pid = os.posix_spawn(
        sys.executable,
        command,
        os.environ,
        file_actions=[(os.POSIX_SPAWN_OPEN, 1, os.devnull, os.O_WRONLY, 0)],
    )
    _, status, usage = os.wait4(pid, 0)
    if os.waitstatus_to_exitcode(status) not in (0, 1):  # 1: a flight that was no success
        raise SystemExit(f"{' '.join(arguments)}: failed")
    return Cost(time.perf_counter() - begun_s, usage.ru_maxrss / 1024.0)


def costs(log: Path, folder: Path) -> dict[str, Cost]:
    """Every verb that reads a whole log, once."""
    verbs = {
        "log info": ("log", "info", str(log)),
        "summary": ("summary", str(log)),
        "report": ("report", str(log), "--out", str(folder / "report.html")),
        "figures": ("figures", str(log), "--out", str(folder / "figures")),
        "export": ("log", "export", str(log), "--out", str(folder / "tables")),
        "tracks": ("log", "tracks", str(log), "--out", str(folder / "tracks")),
    }
    out = {}
    for name, arguments in verbs.items():
        out[name] = cost_of(*arguments)
        print(f"  {name:10} {out[name].seconds:8.1f} s {out[name].peak_MB:8.0f} MB", flush=True)
    return out


def main() -> None:
    parser = options_of(__doc__)
    parser.add_argument("log", type=Path, help="a run's folder or log")
    parser.add_argument("--hours", type=float, default=10.0)
    options = parser.parse_args()
    hours = 0.2 if options.quick else options.hours
    figures: dict[str, float] = {}
    with tempfile.TemporaryDirectory(prefix="long-log-") as place:
        folder = Path(place)
        long = folder / "long.mcap"
        for label in ("as it is", f"{hours:g} h"):
            log = options.log
            if label != "as it is":
                # In a process of its own: what a child is said to have held at most is never less than its parent held
                # when it began it (Linux, getrusage), and a writer keeps the index of all its chunks.
                with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as apart:
                    number = apart.submit(repeat, options.log, long, hours).result()
                size_MB = long.stat().st_size / 1e6
                print(f"{label}: {number} messages, {size_MB:.0f} MB, without images")
                log = long
            else:
                print(f"{options.log} {label}")
            work = folder / "out"
            work.mkdir()
            for verb, cost in costs(log, work).items():
                name = f"{verb.replace(' ', '_')}_{'long' if log is long else 'short'}"
                figures |= {f"{name}_s": cost.seconds, f"{name}_peak_MB": cost.peak_MB}
            shutil.rmtree(work)
    write_json(options.json, figures)


if __name__ == "__main__":
    main()
