# SPDX-License-Identifier: Apache-2.0
"""Robustness of the decoders under seeded mutations of one valid sample.

Any exception but a decoder's own error is a crash; accepted messages are checked again by
``tests/fuzzing.py``. Memory is the resident set of this process.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial

import psutil
from common import BenchmarkFailed, Figures, Group, Options
from fuzzing import Outcome, boundaries, fuzz_logs, fuzz_messages, fuzz_scenarios, garbage_in
from message_samples import SAMPLES


def decoders(options: Options) -> Figures:
    """Mutate a message a million times (``--quick``: 20,000) for the decoder of every topic and
    query, files for the scenario loader and the log reader: no crash, nothing invalid accepted.
    """
    number = options.inputs or (20_000 if options.quick else 1_000_000)
    process = psutil.Process()
    figures: Figures = {}
    bad = 0
    runs: dict[str, Callable[[], Outcome]] = {
        name: partial(fuzz_messages, kind, number, options.seed)
        for name, kind in boundaries().items()
    }
    runs["scenario loader"] = partial(fuzz_scenarios, max(200, number // 50), options.seed)
    runs["log reader"] = partial(fuzz_logs, max(50, number // 500), options.seed)
    garbage_in(SAMPLES[0])  # load lazily imported code before memory is measured
    figures["memory_before_bytes"] = process.memory_info().rss
    for name, run in runs.items():
        begin_s, before = time.monotonic(), process.memory_info().rss
        out = run()
        growth = process.memory_info().rss - before
        refused = " ".join(f"{reason} {count}" for reason, count in sorted(out.refused.items()))
        print(
            f"{name:36} {out.total:8} total, {out.accepted:7} accepted, "
            f"{len(out.crashes)} crashes, {len(out.garbage)} accepted invalid; "
            f"{time.monotonic() - begin_s:.0f} s; {refused}",
            flush=True,
        )
        for line in (out.crashes + out.garbage)[:5]:
            print(f"    {line[:400]}")
        bad += len(out.crashes) + len(out.garbage)
        key = name.replace(" ", "_").replace("/", "_")
        figures |= {
            f"{key}_total": out.total,
            f"{key}_accepted": out.accepted,
            f"{key}_growth_bytes": growth,
        }
    figures |= {
        "memory_after_bytes": process.memory_info().rss,
        "crashes_and_invalid_accepted": bad,
    }
    if bad:
        raise BenchmarkFailed(f"{bad} crashes or accepted invalid messages", figures)
    return figures


GROUP = Group({"decoders": decoders})
