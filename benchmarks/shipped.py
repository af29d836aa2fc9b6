# SPDX-License-Identifier: Apache-2.0
"""Every shipped scenario under other grades: ``python benchmarks/shipped.py [--grades GRADE ...]
[--only SCENARIO ...]``.

Flies each scenario once under every grade, seed 0, with rendered images and plant mismatch
(``truth.preset = "mismatch"``), all processes in one (``chaserdock simulate``), which gives the
same flight as separate ones. Under ``orbit`` captures follow a calibration of the cameras. Prints a
row of a table: RMS tracking error of the worst chaser in steady state against ground truth, and the
criteria that the flight missed.
"""

from __future__ import annotations

import math
import tempfile
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

from chaserdock_protocol.scenario.navigation import GRADES
from chaserdock_protocol.shipped_scenarios import find_scenario
from common import Figures, make_parser, write_json
from dispersion import overrides_of

import chaserdock as cd
from chaserdock.analysis.summary import summarize
from chaserdock.simulation.mission import simulate
from chaserdock.summary import Summary

NOT_FLOWN = ("endurance", "paper-single")
"""An hour long; as in the paper, exact."""


def fly(name: str, grade: str) -> Summary:
    """Fly a shipped scenario under a grade and judge it. Raises SystemExit without a complete log."""
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "run"
        flight = simulate(find_scenario(name), out, overrides_of(name, grade, seed=0, images=True))
        if flight.crashes or flight.stalled:
            raise SystemExit(f"{name}, {grade}: {flight.crashes or flight.stalled}")
        return Summary.from_dict(summarize(out))


def cell_of(summary: Summary) -> tuple[str, float, float]:
    """Return a flight's cell of the table, and the RMS tracking errors (m, rad) of its worst
    chaser.
    """
    steady = [c.steady for c in summary.chasers.values()]
    rms = [
        math.sqrt(max((x for x in values if x is not None), default=math.nan))
        for values in (
            [s.position_mse_m2 for s in steady],
            [s.orientation_mse_rad2 for s in steady],
        )
    ]
    text = f"{rms[0] * 1e3:.2f} mm, {math.degrees(rms[1]):.3f} deg"
    return text + "".join(f"; missed: {failure}" for failure in summary.failures), rms[0], rms[1]


def main() -> None:
    """Fly the scenarios and print the table."""
    names = [name for name in cd.list_scenarios() if name not in NOT_FLOWN]
    parser = make_parser(__doc__, names)
    parser.add_argument("--grades", nargs="+", choices=GRADES, default=["exact", "lab", "orbit"])
    parser.add_argument(
        "--jobs", type=int, default=2, metavar="N", help="flights at a time (default: 2)"
    )
    options = parser.parse_args()
    figures: Figures = {}
    print(f"| scenario | {' | '.join(options.grades)} |\n|{' --- |' * (1 + len(options.grades))}")
    with ProcessPoolExecutor(options.jobs) as pool:
        flights = {name: pool.map(partial(fly, name), options.grades) for name in options.only}
        for name, summaries in flights.items():
            cells = []
            for grade, summary in zip(options.grades, summaries, strict=True):
                text, tracking_m, tracking_rad = cell_of(summary)
                cells.append(text)
                key = f"{name}_{grade}".replace("-", "_")
                figures |= {f"{key}_tracking_m": tracking_m, f"{key}_tracking_rad": tracking_rad}
                figures[f"{key}_success"] = float(summary.success)
            print(f"| `{name}` | {' | '.join(cells)} |", flush=True)
    write_json(options.json, figures)


if __name__ == "__main__":
    main()
