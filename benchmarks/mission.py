# SPDX-License-Identifier: Apache-2.0
"""How fast the main job flies, and how well: ``python benchmarks/mission.py [--quick] [--json FILE]``.

Flies ``four-chaser-docking`` in lock-step with everything on (images, recording), three times, each in its own
processes, and prints medians. ``--quick``: once, 30 s, without the docking.
"""

from __future__ import annotations

import json
import math
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from results import options_of, write_json

ROOT = Path(__file__).resolve().parents[1]
QUICK = ("duration_s=30.0", "steady_until_s=30.0", "timeline=[]", "success.docked=[]")


def fly(overrides: tuple[str, ...]) -> dict[str, Any]:
    """One flight; its summary. Raises SystemExit when it was no success."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        command = [
            sys.executable,
            "-m",
            "chaserdock",
            "run",
            "four-chaser-docking",
            "--out",
            str(out),
            "-q",
        ]
        command += [item for override in overrides for item in ("--set", override)]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise SystemExit(f"the flight failed:\n{done.stdout}{done.stderr}")
        return json.loads((out / "summary.json").read_text())


def figures(summaries: list[dict[str, Any]]) -> dict[str, float]:
    """Medians over the flights."""

    def median(of: Any) -> float:
        return statistics.median(of(s) for s in summaries)

    def worst(s: dict[str, Any], key: str) -> float:
        return math.sqrt(max(c["steady"][key] for c in s["chasers"].values()))

    out = {
        "real_time_factor": median(lambda s: s["sim_time_s"] / s["wall_time_s"]),
        "tick_wall_s": median(lambda s: s["wall_time_s"] / s["ticks"]),
        "exposure_to_command_p50_s": median(lambda s: s["latency_s"]["p50"]),
        "solve_p50_s": median(lambda s: s["solver"]["solve_s"]["p50"]),
        "solve_p95_s": median(lambda s: s["solver"]["solve_s"]["p95"]),
        "peak_memory_bytes": median(lambda s: s["peak_memory_bytes"]),
        "steady_position_rms_worst_chaser_m": median(lambda s: worst(s, "position_mse_m2")),
        "steady_orientation_rms_worst_chaser_rad": median(lambda s: worst(s, "orientation_mse_rad2")),
        "estimate_position_rms_m": median(lambda s: s["target_estimate"]["position_rms_m"]),
        "estimate_orientation_rms_rad": median(lambda s: s["target_estimate"]["orientation_rms_rad"]),
    }
    for name in summaries[0]["cpu_s"]:
        key = f"cpu_{name.replace('/', '_')}_s_per_s"
        out[key] = median(lambda s, name=name: s["cpu_s"].get(name, 0.0) / s["sim_time_s"])
    return out


def main() -> None:
    parser = options_of(__doc__)
    options = parser.parse_args()
    summaries = [fly(QUICK if options.quick else ()) for _ in range(1 if options.quick else 3)]
    digests = {s["digest"] for s in summaries}
    if len(digests) != 1:
        raise SystemExit(f"equal flights differ: digests {digests}")
    result = figures(summaries)
    width = max(map(len, result))
    for name, value in result.items():
        print(f"{name:{width}}  {value:.5g}")
    write_json(options.json, result)


if __name__ == "__main__":
    main()
