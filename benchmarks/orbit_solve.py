# SPDX-License-Identifier: Apache-2.0
"""Time of a solve with ``[orbit]`` over that without: ``python benchmarks/orbit_solve.py
[--scenario low-orbit] [--ticks 600]``.

Two missions in one process, equal but for ``[orbit]``, with statistical perception, tick by tick in
turn. Prints the medians of the solver's and of the whole controller's processor time, and their
ratios. ``--safety enforce``: passive safety in the first of them.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from statistics import median
from typing import ParamSpec, TypeVar

from chaserdock_protocol.scenario import Scenario
from common import Figures, make_parser, print_figures, write_json
from flights import load_shipped

from chaserdock.experiments.in_process import InProcessMission
from chaserdock.experiments.perception import RenderedImages

P = ParamSpec("P")
T = TypeVar("T")


class TimedFlight:
    """A mission whose controller is timed. ``solve_s``, ``tick_s``: processor time of each tick's
    solve and of its controller.
    """

    def __init__(self, scenario: Scenario) -> None:
        self.mission = InProcessMission(scenario, RenderedImages(scenario))
        self.solve_s: list[float] = []
        self.tick_s: list[float] = []
        controller = self.mission.controller
        solve, step = controller.planning.solver.solve, controller.step
        controller.planning.solver.solve = timed(solve, self.solve_s)
        controller.step = timed(step, self.tick_s)


def timed(function: Callable[P, T], durations_s: list[float]) -> Callable[P, T]:
    """Return the function, which then appends its processor time to ``durations_s`` at each call."""

    def measured(*args: P.args, **options: P.kwargs) -> T:
        start_s = time.process_time()
        result = function(*args, **options)
        durations_s.append(time.process_time() - start_s)
        return result

    return measured


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("--scenario", default="low-orbit", help="shipped scenario with [orbit]")
    parser.add_argument("--ticks", type=int, default=600, help="number of ticks")
    parser.add_argument("--safety", default="off", choices=("off", "monitor", "enforce"))
    options = parser.parse_args()
    overrides = ("perception.name='statistical'", "timeline=[]", "duration_s=1000.0")
    in_orbit = load_shipped(
        options.scenario, *overrides, f"limits.passive_safety='{options.safety}'"
    )
    free = load_shipped(options.scenario, *overrides, "limits.passive_safety='off'")
    pair = [TimedFlight(in_orbit), TimedFlight(free.model_copy(update={"orbit": None}))]
    for _ in range(60 if options.quick else options.ticks):
        for flight in pair:
            flight.mission.step()
    figures: Figures = {"ticks": len(pair[0].tick_s)}
    for name, orbit_s, free_s in (
        ("solve", median(pair[0].solve_s), median(pair[1].solve_s)),
        ("tick", median(pair[0].tick_s), median(pair[1].tick_s)),
    ):
        figures |= {
            f"orbit_{name}_s": orbit_s,
            f"free_{name}_s": free_s,
            f"ratio_{name}": orbit_s / free_s,
        }
    print_figures(figures)
    write_json(options.json, figures)


if __name__ == "__main__":
    main()
