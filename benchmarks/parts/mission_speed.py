# SPDX-License-Identifier: Apache-2.0
"""Speed and accuracy of the main mission: ``four-chaser-docking`` in lock-step, in separate
processes, with images and recording.
"""

from __future__ import annotations

import json
import math
import statistics
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from common import Figures, Group, Options, run_chaserdock

QUICK = ("duration_s=30.0", "steady_until_s=30.0", "timeline=[]", "success.docked=[]")


def fly(overrides: tuple[str, ...]) -> dict[str, Any]:
    """Return the summary of one flight. Raise SystemExit if it was no success."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        changes = [part for override in overrides for part in ("--set", override)]
        run_chaserdock("run", "four-chaser-docking", "--out", out, "-q", *changes)
        return json.loads((out / "summary.json").read_text())


def figures(summaries: list[dict[str, Any]]) -> Figures:
    """Return medians over the flights."""

    def median(value_of: Callable[[dict[str, Any]], float]) -> float:
        return statistics.median(map(value_of, summaries))

    def worst(s: dict[str, Any], key: str) -> float:
        return math.sqrt(max(c["steady"][key] for c in s["chasers"].values()))

    out = {
        "real_time_factor": median(lambda s: s["sim_time_s"] / s["wall_time_s"]),
        "tick_wall_s": median(lambda s: s["wall_time_s"] / s["ticks"]),
        "exposure_to_command_median_s": median(lambda s: s["latency_s"]["p50"]),
        "solve_median_s": median(lambda s: s["solver"]["solve_s"]["p50"]),
        "solve_p95_s": median(lambda s: s["solver"]["solve_s"]["p95"]),
        "peak_memory_bytes": median(lambda s: s["peak_memory_bytes"]),
        "steady_position_rms_worst_chaser_m": median(lambda s: worst(s, "position_mse_m2")),
        "steady_orientation_rms_worst_chaser_rad": median(
            lambda s: worst(s, "orientation_mse_rad2")
        ),
        "estimate_position_rms_m": median(lambda s: s["target_estimate"]["position_rms_m"]),
        "estimate_orientation_rms_rad": median(
            lambda s: s["target_estimate"]["orientation_rms_rad"]
        ),
    }
    for name in summaries[0]["cpu_s"]:
        key = f"cpu_{name.replace('/', '_')}_s_per_s"
        out[key] = median(lambda s, name=name: s["cpu_s"].get(name, 0.0) / s["sim_time_s"])
    return out


def speed(options: Options) -> Figures:
    """Fly the main mission three times (``--quick``: once, 30 s, without docking): medians of
    simulated over wall time, latency, solve time, memory, processor time by process, accuracy.
    """
    summaries = [fly(QUICK if options.quick else ()) for _ in range(1 if options.quick else 3)]
    digests = {s["digest"] for s in summaries}
    if len(digests) != 1:
        raise SystemExit(f"equal flights differ: digests {digests}")
    return figures(summaries)


GROUP = Group({"speed": speed})
