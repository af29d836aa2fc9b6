# SPDX-License-Identifier: Apache-2.0
"""A campaign killed half way, resumed, and flown once more on a cluster: ``python benchmarks/campaign.py [--quick]``.

200 seeds (``--runs``) of a shortened ``single`` with small images, two at a time. With half of the results there the
program and all it has started are killed with kill -9; started again it must fly the rest and nothing twice. The same
file then goes to a Dask cluster of two worker processes on this machine. Tables are compared row by row, whole.
``--out`` keeps the folders, and what is there already is not flown again.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
import pyarrow.parquet as pq
from results import options_of, write_json

PLAN = """
name = "killed-and-resumed"
scenario = "single"
seeds = [{seeds}]
[set]
duration_s = 2.0
settling_s = 1.0
"camera.width_px" = 320
"camera.height_px" = 240
"success.steady_position_rms_m" = 0.5
"success.steady_orientation_rms_deg" = 20.0
"""
POLL_S = 0.2


def command(file: Path, *arguments: str) -> list[str]:
    return [sys.executable, "-m", "chaserdock", "campaign", str(file), *arguments]


def results(folder: Path) -> dict[Path, int]:
    """The results so far, each with when it was written."""
    return {path: path.stat().st_mtime_ns for path in folder.glob("runs/*/result.json")}


def table(folder: Path) -> list[dict[str, Any]]:
    """The rows, but for where the logs are."""
    rows = pq.read_table(folder / "results.parquet").to_pylist()
    return [{name: value for name, value in row.items() if name != "log"} for row in rows]


def kill_half_way(file: Path, out: Path, half: int) -> int:
    """Starts the campaign and kills it and all it has started; how many results are there then."""
    running = psutil.Popen(command(file, "--out", str(out), "--jobs", "2"), stdout=subprocess.DEVNULL)
    while running.poll() is None and len(results(out)) < half:
        time.sleep(POLL_S)
    family: Sequence[psutil.Process] = [*running.children(recursive=True), running]
    for process in family:
        with suppress(psutil.NoSuchProcess):
            process.kill()
    running.wait()
    return len(results(out))


def finish(file: Path, out: Path, *arguments: str) -> float:
    """Flies what is left; seconds of wall time. Raises SystemExit if the program failed."""
    begun = time.monotonic()
    done = subprocess.run(
        command(file, "--out", str(out), *arguments), capture_output=True, text=True, check=False
    )
    if done.returncode != 0:
        raise SystemExit(f"status {done.returncode}:\n{done.stdout}{done.stderr}")
    return time.monotonic() - begun


def main() -> None:
    parser = options_of(__doc__)
    parser.add_argument("--runs", type=int, default=200, help="how many")
    parser.add_argument("--out", type=Path, help="folder to keep; a temporary one by default")
    options = parser.parse_args()
    runs = 6 if options.quick else options.runs
    kept = options.out is not None
    folder = options.out if kept else Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    file, here, there = folder / "campaign.toml", folder / "here", folder / "there"
    file.write_text(PLAN.format(seeds=", ".join(map(str, range(runs)))), encoding="utf-8")

    half = kill_half_way(file, here, runs // 2)
    before = results(here)
    print(f"killed with {half} of {runs} results", flush=True)
    took = finish(file, here, "--jobs", "2")
    untouched = sum(results(here).get(path) == written for path, written in before.items())
    rows = table(here)
    digests = {row["digest"] for row in rows}
    print(f"resumed: {len(rows)} rows, {len(digests)} distinct flights, {untouched} of {half} as they were")
    print(f"         {took / max(1, runs - half):.1f} s a run, two at a time", flush=True)

    os.environ.setdefault(
        "DASK_DISTRIBUTED__WORKER__DAEMON", "False"
    )  # a worker starts a mission's processes
    from distributed import LocalCluster

    cluster: Any = LocalCluster(n_workers=2, threads_per_worker=1, processes=True, dashboard_address="")
    with cluster:
        took = finish(file, there, "--cluster", cluster.scheduler_address)
    same = json.dumps(table(there)) == json.dumps(rows)
    print(
        f"cluster of two workers: {'the same table' if same else 'ANOTHER TABLE'}, {took / runs:.1f} s a run"
    )
    figures = {
        "runs": runs,
        "killed_with": half,
        "rows": len(rows),
        "distinct": len(digests),
        "untouched": untouched,
        "same_table_on_cluster": same,
    }
    write_json(options.json, figures)
    if not kept:
        shutil.rmtree(folder)
    if not (same and len(rows) == len(digests) == runs and untouched == half):
        raise SystemExit("the campaign is not what was asked for")


if __name__ == "__main__":
    main()
