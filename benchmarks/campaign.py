# SPDX-License-Identifier: Apache-2.0
"""Resuming and distributing a campaign: ``python benchmarks/campaign.py [--runs N] [--out DIR]
[--quick] [--json FILE]``.

200 seeds (``--runs``) of a shortened ``single`` with small images, two at a time. When half of the
results exist, all processes are killed with SIGKILL. The campaign is then resumed and must complete
without repeating a finished run. A Dask cluster of two workers on this machine runs the same file;
its table must equal that of the first campaign. Status 1 otherwise. ``--out`` keeps the folders,
and finished runs in it are not repeated.
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import tempfile
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
import pyarrow.parquet as pq
from common import chaserdock_command, make_parser, print_figures, run_chaserdock, write_json

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


def results(folder: Path) -> dict[Path, int]:
    """Return the result files so far with their modification times (ns)."""
    return {path: path.stat().st_mtime_ns for path in folder.glob("runs/*/result.json")}


def table(folder: Path) -> list[dict[str, Any]]:
    """Return the rows of the campaign's table without the paths of logs."""
    rows = pq.read_table(folder / "results.parquet").to_pylist()
    return [{name: value for name, value in row.items() if name != "log"} for row in rows]


def kill_half_way(file: Path, out: Path, half: int) -> int:
    """Start the campaign, kill all its processes when ``half`` of the results exist, and return the
    number of results.
    """
    command = chaserdock_command("campaign", file, "--out", out, "--jobs", "2")
    running = psutil.Popen(command, stdout=subprocess.DEVNULL)
    while running.poll() is None and len(results(out)) < half:
        time.sleep(POLL_S)
    # Parents first: a surviving parent would record a failed run.
    for process in [running, *running.children(recursive=True)]:
        with suppress(psutil.NoSuchProcess):
            process.kill()
    running.wait()
    return len(results(out))


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--runs", type=int, default=200, help="number of seeds")
    parser.add_argument(
        "--out", type=Path, metavar="DIR", help="folder to keep; default: a temporary one"
    )
    options = parser.parse_args()
    runs = 6 if options.quick else options.runs
    folder = options.out or Path(tempfile.mkdtemp())
    folder.mkdir(parents=True, exist_ok=True)
    file, local, distributed = folder / "campaign.toml", folder / "local", folder / "cluster"
    file.write_text(PLAN.format(seeds=", ".join(map(str, range(runs)))), encoding="utf-8")

    killed_with = kill_half_way(file, local, runs // 2)
    before = results(local)
    run_chaserdock("campaign", file, "--out", local, "--jobs", "2")
    kept = sum(results(local).get(path) == written for path, written in before.items())
    rows = table(local)

    # A worker starts the processes of a mission.
    os.environ.setdefault("DASK_DISTRIBUTED__WORKER__DAEMON", "False")
    from distributed import LocalCluster

    cluster: Any = LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, dashboard_address=""
    )
    with cluster:
        run_chaserdock(
            "campaign", file, "--out", distributed, "--cluster", cluster.scheduler_address
        )
    figures = {
        "runs": runs,
        "results_when_killed": killed_with,
        "results_kept": kept,
        "rows": len(rows),
        "distinct_flights": len({row["digest"] for row in rows}),
        "equal_table_on_cluster": json.dumps(table(distributed))
        == json.dumps(rows),  # NaN equals NaN
    }
    print_figures(figures)
    write_json(options.json, figures)
    if options.out is None:
        shutil.rmtree(folder)
    complete = figures["rows"] == figures["distinct_flights"] == runs and kept == killed_with
    if not (complete and figures["equal_table_on_cluster"]):
        raise SystemExit("runs are missing or repeated, or the tables differ")


if __name__ == "__main__":
    main()
