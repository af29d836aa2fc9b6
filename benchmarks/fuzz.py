# SPDX-License-Identifier: Apache-2.0
"""Robustness of the decoders: ``python benchmarks/fuzz.py [--messages N] [--quick] [--json FILE]``.

Feeds seeded mutations of one valid sample to the decoder of every topic (and of the two queries),
to the scenario loader and to the log reader. Any exception but the decoder's own error is a crash;
accepted messages are checked again by ``tests/fuzzing.py``. Memory is the resident set of this
process. Status 1 on a crash or an accepted invalid message.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from functools import partial

import psutil
from common import ROOT, Figures, make_parser, write_json

sys.path.insert(0, str(ROOT / "tests"))

from fuzzing import Outcome, boundaries, fuzz_logs, fuzz_messages, fuzz_scenarios, garbage_in
from message_samples import SAMPLES


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument(
        "--messages", type=int, default=1_000_000, help="mutated messages per topic"
    )
    parser.add_argument("--seed", type=int, default=1)
    options = parser.parse_args()
    number = 20_000 if options.quick else options.messages
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
    first = process.memory_info().rss
    for name, run in runs.items():
        begin_s, before = time.monotonic(), process.memory_info().rss
        out = run()
        after = process.memory_info().rss
        refused = " ".join(f"{reason} {count}" for reason, count in sorted(out.refused.items()))
        print(
            f"{name:36} {out.total:8} total, {out.accepted:7} accepted, {len(out.crashes)} crashes, {len(out.garbage)} "
            f"accepted invalid; {before / 1e6:.0f} -> {after / 1e6:.0f} MB; {time.monotonic() - begin_s:.0f} s; {refused}",
            flush=True,
        )
        for line in (out.crashes + out.garbage)[:5]:
            print(f"    {line[:400]}")
        bad += len(out.crashes) + len(out.garbage)
        key = name.replace(" ", "_").replace("/", "_")
        figures |= {
            f"{key}_total": out.total,
            f"{key}_accepted": out.accepted,
            f"{key}_growth_bytes": after - before,
        }
    last = process.memory_info().rss
    figures |= {
        "crashes_and_invalid_accepted": bad,
        "memory_before_bytes": first,
        "memory_after_bytes": last,
    }
    print(
        f"memory {first / 1e6:.0f} -> {last / 1e6:.0f} MB; {bad} crashes or accepted invalid messages"
    )
    write_json(options.json, figures)
    sys.exit(1 if bad else 0)


if __name__ == "__main__":
    main()
